"""`amhe compare`: which of several models predicts what was not fitted?"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from amhe_cli.cli import completion, log_path, options, parsing
from amhe_cli.cli.session import Session

if TYPE_CHECKING:
    from amhe_cli.cli.progress import Shown
    from amhe_cli.cli.settings import Overrides
    from amhe_cli.system.system import System


@click.command(cls=parsing.Command, short_help="Which of several models predicts better?")
@click.argument("given", nargs=-1, required=True, metavar="SYSTEM...", shell_complete=completion.systems)
@click.option(
    "--logs",
    multiple=True,
    required=True,
    type=log_path.LOG,
    callback=log_path.episodes,
    metavar="LOG",
    help="Log to fit; more may follow, as in --logs run*.csv.",
)
@options.held_out("Log to score on")
@click.option(
    "--friction",
    is_flag=True,
    help="Compare the friction models M1 to M6 of the one SYSTEM, and take the smallest within one standard "
    "error of the best.",
)
@options.msg_path
@click.option(
    "--max-time",
    type=parsing.Number(min=0, min_open=True),
    metavar="S",
    help="Share this time among the systems: the best so far of each.",
)
@options.work
@options.tuning
@options.out
@options.common
@click.pass_obj
def compare(
    session: Session,
    given: tuple[str, ...],
    logs: tuple[Path, ...],
    held_out: tuple[Path, ...],
    friction: bool,
    msg_path: Path | None,
    overrides: Overrides,
    out: options.Output,
    **how: Any,
) -> None:
    """Fit each SYSTEM to the same logs, and compare how well they predict what was not fitted.

    SYSTEM is a bundled system or a folder with a system.yaml. With --friction it is one, and the models are
    those of its joints' friction: constant, larger at rest, growing with load (docs/systems.md).
    Writes result.json and report.html, and the files of each identification in a folder of its name.
    """
    from amhe_cli.api.compare import compare as run
    from amhe_cli.cli.inputs import Inputs
    from amhe_cli.cli.progress import progress
    from amhe_cli.report.comparison import comparison_table, ratio_table
    from amhe_cli.report.tables import rich_table

    session.hush_mujoco()
    systems, more = _parted(given)
    logs = logs + log_path.episodes(click.get_current_context(), click.Argument(["logs"]), more)
    folder = out.reserve()
    inputs = [Inputs(name, {}, msg_path, None, None) for name in systems]
    opened = [one.open(logs, overrides) for one in inputs]
    if friction:
        opened = _with_frictions(opened)
        inputs = inputs * len(opened)
    read = [one.read(system, logs) for one, system in zip(inputs, opened, strict=True)]
    scored = [one.read(system, held_out) for one, system in zip(inputs, opened, strict=True)]
    with progress(session, "compare", _shown) as show:
        unseen = scored if held_out else None
        found = run(opened, read, held_out=unseen, simplest=friction, progress=show, **how)
    record = session.record(**found.record(), out=str(folder))
    found.write(folder, record, session.command_line)
    if session.json:
        session.print_json(record)
        return
    console = session.console()
    console.print(rich_table(comparison_table(found.names, found.horizons)))
    console.print()
    console.print(rich_table(ratio_table(found.names, found.horizons, found.best)))
    console.print()
    for text in found.verdicts:
        console.print(text)
    if friction:
        console.print("\n".join(_lines(opened[0], found.names[found.best])), soft_wrap=True)
    console.print(f"report: {folder / 'report.html'}", soft_wrap=True)


def _with_frictions(systems: Sequence[System]) -> list[System]:
    """The one system with each friction model."""
    from amhe_cli.core.errors import ConfigError
    from amhe_cli.system.friction_models import friction_models

    if len(systems) != 1:
        raise ConfigError("--friction compares friction models of one SYSTEM; give one")
    return list(friction_models(systems[0]).values())


def _lines(plain: System, name: str) -> list[str]:
    """What to write into `system.yaml` to go on with a friction model."""
    from amhe_cli.core.yaml_file import flow
    from amhe_cli.system.friction_models import MODELS, friction_entries

    entries = friction_entries(plain, name)
    head = f"{name}: {MODELS[name][1]}" + ("; add to the parameters of system.yaml:" if entries else "")
    return [head, *(f"  {key}: {flow(entry)}" for key, entry in entries.items())]


def _parted(given: Sequence[str]) -> tuple[list[str], tuple[Path, ...]]:
    """Systems, and logs that the shell wrote behind `--logs`: what exists and is no system."""
    logs = [name for name in given if Path(name).exists() and not (Path(name) / "system.yaml").is_file()]
    return [name for name in given if name not in logs], tuple(map(Path, logs))


def _shown(text: str) -> Shown:
    return text, 0, None
