"""`amhe probe`: design an excitation that makes the parameters visible, and record it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from amhe_cli.cli import at_the_robot, options, parsing
from amhe_cli.cli.estimation_options import believed, narrowing
from amhe_cli.cli.session import Session, stopping

if TYPE_CHECKING:
    from amhe_cli.cli.progress import Shown
    from amhe_cli.cli.settings import Overrides
    from amhe_cli.estimation.design.design import Accuracy, ProbePlan
    from amhe_cli.estimation.design.probe import Probe, ProbeOptions, Say


@click.command(cls=parsing.Command, short_help="Design and record the most informative motion.")
@options.system_or("go1_push")
@options.choice("--target", ("sim", "go1"), "sim", "What is probed.")
@at_the_robot.reach_options
@at_the_robot.dry_run_option(f"Write plan.json and stop before anything moves; {at_the_robot.CHECKS}")
@options.task(
    "Whose box and floor go1_push is probed with, as they are before anything changes.  [default: t1]", None
)
@options.seconds("The longest that the probe may take [s].", 10.0, min=0, min_open=True, max=600)
@believed("A belief.yaml to design with, and to walk with, instead of the system's own prior.")
@narrowing
@click.option(
    "--plant",
    type=parsing.EXISTING_FILE,
    metavar="XML",
    help="MJCF of what is probed in simulation, instead of the system's own model: another Go1, or another "
    "model with the same joints and actuators.",
)
@click.option(
    "--box",
    nargs=2,
    type=parsing.Number(min=0, min_open=True, max=100),
    metavar="KG MU",
    help="Mass and friction of the box that is probed in simulation, instead of the task's.",
)
@click.option(
    "--chirp",
    "recipe",
    flag_value="chirp",
    help="Also write excitation.csv, .npz and .mcap, commands for a robot's own program: sines whose "
    "frequency grows.",
)
@click.option("--multisine", "recipe", flag_value="multisine", help="The same: sums of sines.")
@click.option("--steps", "recipe", flag_value="steps", help="The same: targets that jump.")
@click.option("--sweep", "recipe", flag_value="sweep", help="The same: slow ramps.")
@options.work
@options.tuning
@options.out
@options.common
@click.pass_obj
def probe(
    session: Session,
    system: str | None,
    target: str,
    dry_run: bool,
    wire: dict[str, Any],
    belief: Path | None,
    plant: Path | None,
    recipe: str | None,
    seed: int,
    overrides: Overrides,
    out: options.Output,
    **how: Any,
) -> None:
    """Find the most informative motion, predict the accuracy of the parameters, and record the motion.

    Writes plan.json, probe.mcap (probe.csv where the system reads tables), result.json and report.html; the
    log goes into `amhe identify` as it is. With --chirp, --multisine, --steps or --sweep the commands of your
    own robot are written too: they are the recipe with the most information among those that, simulated under
    draws of the prior, reach no limit of joints, speed or force, and touch nothing. On a real Go1 (--target
    go1: read docs/go1.md first) it is all planned before anything is sent.
    """
    from amhe_cli.cli.progress import progress
    from amhe_cli.core.files import filling, plain
    from amhe_cli.estimation.design.design import known_record, plan_record
    from amhe_cli.estimation.design.files import log_name
    from amhe_cli.estimation.design.probe import ActuatorProbe, ProbeOptions
    from amhe_cli.report.probe import print_achieved, print_plan
    from amhe_cli.robots.go1.probing.probe import Go1OnLink, open_probe, robot_to_probe
    from amhe_cli.system.description.folders import bundled_systems, find_system
    from amhe_cli.system.provenance import provenance

    session.hush_mujoco()
    folder = out.reserve()
    settings, schema = overrides.suited(find_system(system or "go1_push"))
    chosen = ProbeOptions(
        system, belief=belief, plant=plant, recipe=recipe, seed=seed, settings=settings, schema=schema, **how
    )
    link: dict[str, Any] = {}
    reached = at_the_robot.wire_of(target, wire)
    robot = Go1OnLink(reached, at_the_robot.attendant(session, link)) if reached else None
    if robot and dry_run:
        return at_the_robot.dry_run(session, robot_to_probe(chosen, robot))
    opened = open_probe(chosen, robot)
    log = log_name(opened.system.signals)
    say = click.get_current_context().with_resource(progress(session, "probe", _shown))
    plan = opened.design(say)
    inputs = [path for path in (belief, plant) if path]
    about = {
        "system": opened.system.name, "task": opened.task, "target": target, "seed": seed, "out": str(folder),
        "fixed": opened.system.fixed,
        "provenance": provenance(session.command_line, seed, "probe", opened.system, inputs, ()),
    }  # fmt: skip
    record, error = plain(session.record(**about, **plan_record(plan))), None
    if not session.json:
        print_plan(record, session.console())
    with filling(folder, keep=True, force=out.force) as scratch:
        _write(scratch / "plan.json", record)
        if recipe and isinstance(opened, ActuatorProbe):
            opened.excitation().write(scratch)
        if not dry_run:
            error, known = _played(session, opened, plan, scratch / log, chosen, say)
            record = plain(session.record(**about, **(plan_record(plan) | known_record(known)), **link))
            record |= {"interrupted": session.interrupted, "error": None if error is None else str(error)}
            _write(scratch / "result.json", record)
    recorded = not dry_run and (folder / log).exists()
    if recorded:
        from amhe_cli.report.probe_page import write_probe_page  # figures load after the robot is let down

        write_probe_page(folder, log, opened.system, record)
    if session.json:
        session.print_json(record)
    elif recorded:
        own = "" if opened.system.folder in bundled_systems().values() else f" --system {system}"
        print_achieved(record, f"amhe identify {folder / log}{own}", folder, session.console())
    session.failed = at_the_robot.is_trip(error)
    if error and not session.failed:
        raise error


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


def _write(path: Path, record: object) -> None:
    import json

    path.write_text(json.dumps(record, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def _shown(text: str) -> Shown:
    return text, 0.0, None
