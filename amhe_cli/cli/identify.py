"""`amhe identify`: from logs to parameters with honest uncertainty."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from amhe_cli.cli import log_path, options, parsing
from amhe_cli.cli.estimation_options import believed, narrowing
from amhe_cli.cli.model_path import ModelPath
from amhe_cli.cli.session import Session

if TYPE_CHECKING:
    from amhe_cli.cli.inputs import Inputs
    from amhe_cli.cli.progress import Shown
    from amhe_cli.cli.settings import Overrides
    from amhe_cli.estimation.core.result import Iteration


def _a_cause(ctx: click.Context, param: click.Parameter, value: str | None) -> str | None:
    """A cause by its name; a log behind the option would be taken for one."""
    if value not in (None, "all") and "@" not in value:
        text = f"{value!r} is no cause such as spring@arm; give logs before --repair"
        raise click.BadParameter(text, ctx, param)
    return value


@click.command(cls=parsing.Command, short_help="Logs to parameters with honest uncertainty.")
@click.argument(
    "logs", nargs=-1, required=True, type=log_path.LOG, callback=log_path.episodes, metavar="LOG..."
)
@options.where
@click.option(
    "--model",
    type=ModelPath(exists=True, dir_okay=False, readable=False, path_type=Path),
    metavar="FILE",
    help="Make the system of this MJCF or URDF file, or menagerie:NAME, as `amhe init` does, in OUT/system.",
)
@options.held_out("Log used only to validate")
@believed("Start from an earlier belief.yaml instead of the system's own prior.")
@narrowing
@click.option(
    "--repair",
    is_flag=False,
    flag_value="all",
    callback=_a_cause,
    metavar="[KIND@PLACE]",
    help="Give a copy of the system, in OUT/system, what it lacks: each cause, or the one named, stays if "
    "held-out errors fall by more than chance.",
)
@options.choice(
    "--method",
    ("linearised", "cmaes"),
    "linearised",
    "Estimator; linearised falls back on cmaes where it does not help.",
)
@options.setting(
    "match",
    type=click.Choice(["motion", "effort", "both"]),
    help="Compare the motion under what drives it, the joints' efforts along it, or both.  [default: the "
    "system's]",
)
@click.option(
    "--max-time",
    type=parsing.Number(min=0, min_open=True),
    metavar="S",
    help="Search and conclude within this time: the best so far, without the checks that take too long.",
)
@parsing.new_file(
    "--checkpoint", use="Save the search here as it goes; resume from it, to the bit, if it exists."
)
@options.work
@options.spread_if_chosen
@options.tuning
@options.out
@options.common
@click.pass_obj
def identify(
    session: Session,
    logs: tuple[Path, ...],
    inputs: Inputs,
    model: Path | str | None,
    held_out: tuple[Path, ...],
    belief: Path | None,
    belief_anyway: bool,
    fix: dict[str, float],
    only: list[str] | None,
    repair: str | None,
    workers: int | None,
    cluster: str | None,
    overrides: Overrides,
    out: options.Output,
    **how: Any,
) -> None:
    """Find the parameters that make the simulation follow LOG...

    A LOG is an MCAP file, a rosbag2 folder, a ROS 1 bag, a table (CSV, npz, parquet and others), a ULog,
    a LeRobot dataset, or a YAML file that lists logs and what is known of each: see docs/logs.md. Writes
    belief.yaml, identified.xml, result.json and report.html.
    """
    from functools import partial

    from amhe_cli.api.identify import Interrupted
    from amhe_cli.api.identify import identify as run
    from amhe_cli.api.repair import repair as repaired
    from amhe_cli.cli.progress import progress
    from amhe_cli.logs import members, read_log
    from amhe_cli.logs.truth import truth_in_metadata
    from amhe_cli.report.identification import print_identification
    from amhe_cli.study.executors import executor_of

    session.hush_mujoco()
    if model and inputs.system:
        raise click.UsageError("give --system or --model: a model's system is made anew")
    folder = out.reserve()
    _check_apart(logs, held_out)
    if model:
        inputs = inputs.of_model(model, logs, folder / "system")
    opened = inputs.open(logs, overrides)
    known: Any = {"fix": fix, "only": only, "belief_anyway": belief_anyway}
    opened.starting_from(belief, **known)  # a mistake in an option is found before long logs are read
    training = inputs.read(opened, logs)
    validation = read_log(held_out, opened, msg_path=inputs.msg_path)
    if repair:
        run = partial(repaired, cause=None if repair == "all" else repair)
    with progress(session, "identify", _shown) as show, executor_of(workers, cluster) as executor:
        try:
            result = run(
                opened, training, held_out=validation, prior=belief, executor=executor,
                progress=lambda iteration, total: show((iteration, total)), **known, **how,
            )  # fmt: skip
        except Interrupted as stop:
            result = stop.result
    session.interrupted = result.found.interrupted
    record = session.record(**result.record(), out=str(folder))
    read = [*logs, *(one.path for path in logs for one in members(path))]
    result.write(folder, record, session.command_line, read, held_out, out.force or bool(model))
    if session.json:
        session.print_json(record)
    else:
        print_identification(result.found, folder, session.console(), truth_in_metadata(training))


def _check_apart(logs: Sequence[Path], held_out: Sequence[Path]) -> None:
    """Refuse a log that is both fitted and held out, before any is read."""
    from amhe_cli.core.errors import ConfigError

    fitted = {path.resolve() for path in logs}
    for path in held_out:
        if path.resolve() in fitted:
            raise ConfigError(f"{path}: is both fitted and held out; validation needs a log of its own")


def _shown(item: tuple[Iteration, int]) -> Shown:
    """'linearised 3/16: cost 1.04, sigma 0.12', or 'cost profiles 14/15'."""
    iteration, total = item
    state = f": cost {iteration.cost:.4g}, sigma {iteration.sigma:.2g}" if iteration.rollouts else ""
    return f"{iteration.method} {iteration.number}/{total}{state}", iteration.number, total
