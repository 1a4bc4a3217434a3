"""`amhe identify`: from logs to parameters with honest uncertainty."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from amhe_cli.cli import options
from amhe_cli.cli.command import Given, command, option, setting
from amhe_cli.cli.kinds import MODEL, NewFile
from amhe_cli.cli.session import LOSSY, Session

if TYPE_CHECKING:
    from amhe_cli.api.identify import Result
    from amhe_cli.cli.inputs import Inputs
    from amhe_cli.core.log import Log
    from amhe_cli.estimation.core.result import ParameterResult
    from amhe_cli.system.system import System


def _a_cause(ctx: click.Context, param: click.Parameter, value: str | None) -> str | None:
    """A cause by its name; a log behind the option would be taken for one."""
    if value not in (None, "all") and "@" not in value:
        text = f"{value!r} is no cause such as spring@arm; give logs before --repair"
        raise click.BadParameter(text, ctx, param)
    return value


@command(
    "Logs to parameters with honest uncertainty.",
    options.logs,
    options.where,
    options.held_out("Log used only to validate"),
    option(
        "--model",
        "Make the system of this MJCF or URDF file, or menagerie:NAME, as `amhe init` does, in OUT/system.",
        MODEL,
        panel="Logs and system",
    ),
    options.believed("Start from an earlier belief.yaml instead of the system's own prior."),
    options.narrowing,
    options.robot,
    option(
        "--repair [KIND@PLACE]",
        "Give a copy of the system, in OUT/system, what it lacks: each cause, or the one named, stays if "
        "held-out errors fall by more than chance.",
        is_flag=False,
        flag_value="all",
        callback=_a_cause,
    ),
    option("--method", "Estimator; cmaes is that of SPI.", ("linearised", "cmaes"), default="linearised"),
    setting(
        "match",
        "Compare the motion under what drives it, the joints' efforts along it, or both.  [default: the "
        "system's]",
        ("motion", "effort", "both"),
    ),
    options.require("the sd of a parameter"),
    options.max_time,
    option(
        "--checkpoint",
        "Save the search here as it goes; resume from it, to the bit, if it exists.",
        NewFile(),
    ),
    options.work,
    options.spread_if_chosen,
    options.tuning,
    options.output,
)
def identify(session: Session, given: Given) -> int | None:
    """Find the parameters that make the simulation follow LOG...

    A LOG is an MCAP file, a rosbag2 folder, a ROS 1 bag, a table (CSV, npz, parquet and others), a ULog,
    a LeRobot dataset, or a YAML file that lists logs and what is known of each: see docs/logs.md. Writes
    belief.yaml, identified.xml, result.json and report.html.
    """
    from amhe_cli.check.motion import log_findings, motions
    from amhe_cli.cli.required import matching, missed_of, names_of
    from amhe_cli.logs import members, read_log
    from amhe_cli.logs.read import truth_in_metadata
    from amhe_cli.report.check import said_before
    from amhe_cli.report.identification import print_identification

    logs = given.logs
    if given.model and given.inputs.system:
        raise click.UsageError("give --system or --model: a model's system is made anew")
    folder = given.reserve()
    with _described(given, folder / "system") as inputs:
        system = inputs.open(logs)
        known: Any = given.pick("fix", "only", "belief_anyway")
        system.starting_from(given.belief, **known)  # a mistake is found before long logs are read
        matching(names_of(system), given.require)
        training = inputs.read(system, logs)
        doubts = log_findings(system, training, motions(system, training))
        findings = said_before(system, doubts, None if session.json else session.console())
        validation = read_log(given.held_out, system, msg_path=inputs.msg_path)
        result = _searched(session, given, system, training, validation)
    session.interrupted = result.found.interrupted
    missed = missed_of((*result.found.parameters, *result.found.bodies), given.require, "known")
    about = {"findings": findings, "not_reached": missed, "out": str(folder)}
    record = session.record(**result.record(), **about)
    read = [*logs, *(one.path for path in logs for one in members(path))]
    force = given.force or bool(given.model)
    result.write(folder, record, session.command_line, read, given.held_out, force)
    if not session.gave(record):
        print_identification(result.found, folder, session.console(), truth_in_metadata(training))
        _print_help(session, result.found.parameters, missed)
    return LOSSY if missed else None


@contextmanager
def _described(given: Given, folder: Path) -> Iterator[Inputs]:
    """Which system the logs are about; one that is made of a model goes again if the block fails.

    So the same command, with its mistake mended, is not refused for what it left.
    """
    inputs, made = given.inputs, not folder.exists()
    try:
        yield inputs.of_model(given.model, given.logs, folder) if given.model else inputs
    except BaseException:
        if given.model and made:
            shutil.rmtree(folder, ignore_errors=True)
            with suppress(OSError):  # it has more, or was there
                folder.parent.rmdir()
        raise


def _searched(
    session: Session, given: Given, system: System, training: Sequence[Log], validation: Sequence[Log]
) -> Result:
    """The result, or the best so far where the user stops the search."""
    from functools import partial

    from amhe_cli.api.identify import Interrupted
    from amhe_cli.api.identify import identify as run
    from amhe_cli.api.repair import repair
    from amhe_cli.cli.progress import of_search, progress
    from amhe_cli.study.executors import executor_of

    if given.repair:
        run = partial(repair, cause=None if given.repair == "all" else given.repair)
    known: Any = given.pick(
        "fix", "only", "belief_anyway", "method", "max_time", "checkpoint", "seed", "threads", "engine"
    )
    with (
        progress(session, "identify", of_search, left=True) as show,
        executor_of(given.workers, given.cluster) as executor,
    ):
        try:
            return run(
                system, training, held_out=validation, prior=given.belief, executor=executor,
                progress=lambda iteration, total: show((iteration, total)), **known,
            )  # fmt: skip
        except Interrupted as stop:
            return stop.result


def _print_help(session: Session, parameters: Sequence[ParameterResult], missed: Sequence[str]) -> None:
    """Name what explains the reasons of the table, and say what was required and not reached."""
    from amhe_cli.cli.advice import entries

    told = {one.reasons[0].kind for one in parameters if one.reasons}
    if words := sorted(told & entries().keys()):
        print(f"explained: amhe help {', '.join(words)}")
    for text in missed:
        session.console().print(f"not reached: {text}", style="yellow")
