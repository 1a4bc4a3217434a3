"""`amhe audit`: the numbers of a model against what a robot did, or against another model."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from amhe_cli.cli import log_path, options, parsing
from amhe_cli.cli.model_path import MENAGERIE, ModelPath, model_file, urdf_options
from amhe_cli.cli.session import Session
from amhe_cli.core.text import printable

if TYPE_CHECKING:
    from amhe_cli.audit.audit import Audit
    from amhe_cli.cli.inputs import Inputs
    from amhe_cli.cli.progress import Shown
    from amhe_cli.cli.settings import Overrides
    from amhe_cli.estimation.core.result import Iteration

#: Suffixes of model files.
_MODELS = (".xml", ".urdf", ".mjcf")


class _Against(ModelPath):
    """A log, or another model."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """A name of the menagerie and the path of a model stay; any other value is a log."""
        named = str(value).startswith(MENAGERIE) or str(value).endswith(_MODELS)
        return super().convert(value, param, ctx) if named else log_path.LOG.convert(value, param, ctx)


@click.command(cls=parsing.Command, short_help="A model's numbers against logs, or against another model.")
@click.argument("model", type=ModelPath(exists=True, readable=False, path_type=Path))
@click.argument(
    "against", nargs=-1, type=_Against(exists=True, readable=False, path_type=Path), metavar="[LOG|MODEL]..."
)
@click.option(
    "--against",
    "vendor",
    type=ModelPath(exists=True, dir_okay=False, readable=False, path_type=Path),
    metavar="FILE",
    help="Compare the numbers of this file with MODEL, the folder of a result.",
)
@click.option(
    "--write",
    metavar="NAME,...",
    callback=parsing.listed,
    help="Numbers that the audited file takes from the logs, by names or patterns.  [default: those that "
    "are contradicted]",
)
@options.where
@options.work
@options.tuning
@options.out
@options.common
@click.pass_obj
def audit(
    session: Session,
    model: Path | str,
    against: tuple[Path | str, ...],
    vendor: Path | str | None,
    write: tuple[str, ...],
    inputs: Inputs,
    seed: int,
    threads: int,
    engine: str,
    overrides: Overrides,
    out: options.Output,
) -> None:
    """Compare every number that MODEL says with LOG, and write the file with contradicted ones replaced.

    MODEL is an MJCF or URDF file, or menagerie:NAME. Instead of logs, give another model to list what
    differs; or give the folder of a result, and the file that it is to be held against with --against.
    To try it: amhe audit example:arm example:arm. --system DIR takes the signals of a system folder.
    """
    session.hush_mujoco()
    models = [one for one in against if str(one).startswith(MENAGERIE) or str(one).endswith(_MODELS)]
    if vendor is not None and not against and Path(model).is_dir():
        _result(session, Path(model), model_file(vendor))
    elif models and len(against) == 1 and vendor is None:
        _files(session, model_file(model), model_file(models[0]))
    elif against and not models and vendor is None:
        how = {"seed": seed, "threads": threads, "engine": engine}
        _logs(session, model_file(model), tuple(map(Path, against)), write, inputs, overrides, out, how)
    else:
        raise click.UsageError("give MODEL and logs, MODEL and one other model, or RESULT --against FILE")


def _files(session: Session, one: Path, other: Path) -> None:
    """Print what differs between two files."""
    from amhe_cli.audit.files import compare
    from amhe_cli.report.audit import difference_record, difference_table, difference_text
    from amhe_cli.report.tables import rich_table
    from amhe_cli.system.model.files import compiled, read_spec

    found = compare(*(compiled(read_spec(path), repr(path.name)) for path in (one, other)))
    if session.json:
        session.print_json(session.record(**difference_record(found, one, other)))
        return
    console = session.console()
    if found.differences:
        console.print(rich_table(difference_table(found, one.name, other.name)))
        console.print()
    for line in difference_text(found, one.name, other.name):
        print(printable(line))


def _result(session: Session, folder: Path, vendor: Path) -> None:
    """Print what a file says against what a result found."""
    from amhe_cli.audit.result import held_against
    from amhe_cli.cli.viewed import system_of_result
    from amhe_cli.core.belief import read_belief
    from amhe_cli.system.model.files import compiled, read_spec
    from amhe_cli.system.system import System

    belief = read_belief(folder / "belief.yaml")
    system = system_of_result(folder / "belief.yaml") or System.load(belief.system, warn=False)
    lines = held_against(system, belief, compiled(read_spec(vendor), repr(vendor.name)))
    _print(session, lines, f"{folder.name} against {vendor.name}", {})


def _logs(
    session: Session,
    model: Path,
    logs: tuple[Path, ...],
    write: tuple[str, ...],
    inputs: Inputs,
    overrides: Overrides,
    out: options.Output,
    how: dict[str, Any],
) -> None:
    """Audit a file by logs."""
    from amhe_cli.audit.audit import audit as run
    from amhe_cli.cli.progress import progress
    from amhe_cli.estimation.identification import IdentifyOptions
    from amhe_cli.init.folder import proposed, proposed_as
    from amhe_cli.logs import read_log
    from amhe_cli.report.audit import write_audit

    folder, logs = out.reserve(), log_path.each_episode(logs)
    urdf = urdf_options(model)
    if inputs.system:
        proposal = proposed_as(model, inputs.open(logs), urdf)
    else:
        proposal = proposed(model, logs, inputs.msg_path, urdf, efforts=True)
    with progress(session, "audit", _shown) as show:
        found = run(
            proposal,
            model.stem,
            lambda system: read_log(
                logs,
                system.reading(inputs.topics),
                start=inputs.start,
                end=inputs.end,
                msg_path=inputs.msg_path,
            ),
            IdentifyOptions(**how),
            overrides.all,
            lambda iteration, total: show((iteration, total)),
        )
    record = session.record(out=str(folder), model=str(model))
    write_audit(folder, model, logs, found, write, record, session.command_line, how["seed"], out.force)
    _print(session, found.lines, model.name, record, found)


def _print(
    session: Session, lines: Any, name: str, record: dict[str, object], found: Audit | None = None
) -> None:
    from amhe_cli.report.audit import STYLES, audit_record, audit_table, audit_text
    from amhe_cli.report.tables import rich_table

    if session.json:
        session.print_json((record or session.record()) | audit_record(lines, found))
        return
    console, told = session.console(), [one for one in lines if one.verdict != "cannot tell"]
    console.print_table(rich_table(audit_table(told), STYLES))
    console.print()
    for line in audit_text(lines, found, record.get("out")):
        console.print(line, soft_wrap=True)


def _shown(item: tuple[Iteration, int]) -> Shown:
    """'linearised 3/16'."""
    iteration, total = item
    return f"{iteration.method} {iteration.number}/{total}", iteration.number, total
