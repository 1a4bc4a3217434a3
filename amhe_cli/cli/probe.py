"""`amhe probe`: design an excitation that makes the parameters visible, and record it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from amhe_cli.cli import at_the_robot, options
from amhe_cli.cli.command import Given, command, flag, option
from amhe_cli.cli.kinds import Number
from amhe_cli.cli.session import Session, stopping

if TYPE_CHECKING:
    from amhe_cli.estimation.design.design import Accuracy, ProbePlan
    from amhe_cli.estimation.design.probe import Probe, ProbeOptions, Say


#: Options of a `ProbeOptions`.
_CHOSEN = (
    "task", "seconds", "belief", "belief_anyway", "fix", "only", "plant", "box", "recipe", "seed", "threads",
    "engine",
)  # fmt: skip


def _recipe(name: str, about: str) -> Any:
    return flag(f"recipe --{name}", about, flag_value=name, default=None, panel="Commands for your own robot")


@command(
    "Design and record the most informative motion.",
    options.system_or("go1_push"),
    at_the_robot.target("What is probed."),
    at_the_robot.REACH,
    at_the_robot.dry_run_option(f"Write plan.json and stop before anything moves; {at_the_robot.CHECKS}"),
    options.task(
        "Whose box and floor go1_push is probed with, as they are before anything changes; walk: free "
        "walking, which reveals the robot itself.  [default: t1]",
        None,
        ("walk",),
    ),
    options.seconds("The longest that the probe may take.", 10.0, max=600),
    options.believed("A belief.yaml to design with, and to walk with, instead of the system's own prior."),
    options.narrowing,
    options.robot,
    option(
        "--plant NAME|XML",
        "What is probed in simulation, instead of the system's own model: another Go1, as of amhe run, or "
        "the MJCF of another model with the same joints and actuators.",
    ),
    option(
        "--box KG MU",
        "Mass and friction of the box that is probed in simulation, instead of the task's.",
        Number(min=0, min_open=True, max=100),
        nargs=2,
    ),
    _recipe(
        "chirp",
        "Also write excitation.csv, .npz and .mcap, commands for a robot's own program: sines whose "
        "frequency grows.",
    ),
    _recipe("multisine", "The same: sums of sines."),
    _recipe("steps", "The same: targets that jump."),
    _recipe("sweep", "The same: slow ramps."),
    options.work,
    options.tuning,
    options.output,
)
def probe(session: Session, given: Given) -> None:
    """Find the most informative motion, predict the accuracy of the parameters, and record the motion.

    Writes plan.json, probe.mcap (probe.csv where the system reads tables), result.json and report.html; the
    log goes into `amhe identify` as it is. With --chirp, --multisine, --steps or --sweep the commands of your
    own robot are written too: they are the recipe with the most information among those that, simulated under
    draws of the prior, reach no limit of joints, speed or force, and touch nothing. On a real Go1 (--target
    go1: read docs/go1.md first) it is all planned before anything is sent.
    """
    from amhe_cli.cli.progress import of_words, progress
    from amhe_cli.core.files import filling, json_text, plain
    from amhe_cli.estimation.design.design import known_record, plan_record
    from amhe_cli.estimation.design.playback import log_name
    from amhe_cli.estimation.design.probe import ActuatorProbe, ProbeOptions
    from amhe_cli.report.check import said_before
    from amhe_cli.report.probe import print_achieved, print_plan, write_probe_page
    from amhe_cli.robots.go1.probing.probe import Go1OnLink, open_probe, robot_to_probe
    from amhe_cli.system.description.folders import find_system
    from amhe_cli.system.provenance import provenance

    system, target, dry_run = given.system, given.target, given.dry_run
    folder = given.reserve()
    settings, schema = given.overrides.suited(find_system(system or "go1_push"))
    chosen = ProbeOptions(system, settings=settings, schema=schema, **given.pick(*_CHOSEN))
    link, reached = dict[str, Any](), at_the_robot.wire_of(target, given)
    robot = Go1OnLink(reached, at_the_robot.attendant(session, link)) if reached else None
    if robot and dry_run:
        return at_the_robot.dry_run(session, robot_to_probe(chosen, robot))
    opened = open_probe(chosen, robot)
    log = log_name(opened.system.signals)
    findings = said_before(opened.system, (), None if session.json else session.console())
    say = click.get_current_context().with_resource(progress(session, "probe", of_words))
    plan = opened.design(say)
    inputs = [Path(path) for path in (given.belief, given.plant) if path and Path(path).is_file()]
    about = {
        "system": opened.system.name, "task": opened.task, "target": target, "seed": given.seed,
        "out": str(folder),
        "fixed": opened.system.fixed, "findings": findings,
        "provenance": provenance(session.command_line, given.seed, "probe", opened.system, inputs, ()),
    }  # fmt: skip
    record, error = plain(session.record(**about, **plan_record(plan))), None
    if not session.json:
        print_plan(record, session.console())
    with filling(folder, keep=True, force=given.force) as scratch:
        (scratch / "plan.json").write_text(json_text(record), encoding="utf-8")
        if given.recipe and isinstance(opened, ActuatorProbe):
            opened.excitation().write(scratch)
        if not dry_run:
            error, known = _played(session, opened, plan, scratch / log, chosen, say)
            record = plain(session.record(**about, **(plan_record(plan) | known_record(known)), **link))
            record |= {"interrupted": session.interrupted, "error": None if error is None else str(error)}
            (scratch / "result.json").write_text(json_text(record), encoding="utf-8")
    recorded = not dry_run and (folder / log).exists()
    if recorded:
        write_probe_page(folder, log, opened.system, record)
    if not session.gave(record) and recorded:
        print_achieved(record, _to_identify(folder / log, opened, system), folder, session.console())
    session.failed = at_the_robot.is_trip(error)
    if error and not session.failed:
        raise error


def _to_identify(log: Path, probe: Probe, system: str | None) -> str:
    """The command that identifies what was recorded."""
    from amhe_cli.system.description.folders import bundled_systems

    own = "" if probe.system.folder in bundled_systems().values() else f" --system {system}"
    return f"amhe identify {log}{own}{' --unknowns robot' if probe.task == 'walk' else ''}"


def _played(
    session: Session, probe: Probe, plan: ProbePlan, log: Path, chosen: ProbeOptions, say: Say
) -> tuple[Exception | None, dict[str, Accuracy | None]]:
    """Play a plan into its log: what went wrong, and how well the parameters are known, by what."""
    from amhe_cli.estimation.design.probe import achieved

    with stopping(session) as stopped:
        ending = probe.run(plan, log, stopped, say)
    session.interrupted = ending.interrupted
    if isinstance(ending.error, OSError):  # as on a full disk
        raise ending.error
    known: dict[str, Accuracy | None] = {"expected": plan.expected, "plain": plan.plain}
    if not session.interrupted and ending.error is None:
        say("computing the achieved accuracy")
        try:
            known["achieved"] = achieved(probe.system, log, chosen)
        except KeyboardInterrupt:  # it must not cost the log
            session.interrupted = True
    return ending.error, known
