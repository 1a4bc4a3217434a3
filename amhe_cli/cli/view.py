"""`amhe view`: a log or a result, and its ghosts, in a browser."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from amhe_cli.cli import log_path, options
from amhe_cli.cli.prior_options import believed
from amhe_cli.cli.session import Session

if TYPE_CHECKING:
    from amhe_cli.cli.inputs import Inputs
    from amhe_cli.cli.settings import Overrides

#: Results that can be viewed, by the command that wrote them.
_VIEWED = ("identify", "run")
#: Options that say how logs are read: those with which a result was made, unless the user gives others.
_READING = ("system", "topics", "msg_path", "start", "end")


@click.command(cls=options.Command, short_help="A log and what the model predicts, in a browser.")
@click.argument("source", type=log_path.LOG, metavar="LOG|RESULT")
@options.where
@believed("The belief.yaml of an identification: its ghost is shown beside the nominal one.")
@click.option(
    "--save",
    type=click.Path(path_type=Path, dir_okay=False),
    callback=options.in_existing_folder,
    metavar="PAGE.html",
    help="Write one page that needs no network, and serve nothing.",
)
@click.option("--host", default="127.0.0.1", show_default=True, metavar="ADDRESS", help="To serve on.")
@click.option(
    "--port",
    type=options.WholeNumber(0, 65535),
    default=0,
    show_default="any free one",
    metavar="N",
    help="To serve on.",
)
@options.tuning
@options.common
@click.pass_obj
def view(
    session: Session,
    source: Path,
    inputs: Inputs,
    belief: Path | None,
    belief_anyway: bool,
    save: Path | None,
    host: str,
    port: int,
    overrides: Overrides,
) -> None:
    """Show a LOG, or the logs of a RESULT folder, in three dimensions beside what the model predicts.

    The log is cut into clips. From the first state of each, a ghost shows the prediction under nominal
    parameters, and another one that under --belief. Clips are ordered by misfit, those that were held out of
    a fit first. A RESULT is the folder that `amhe identify` or `amhe run` wrote; its logs must still be where
    they were. The page is served to this computer until Ctrl-C.
    """
    from amhe_cli.api.arguments import cores
    from amhe_cli.core.files import write_whole
    from amhe_cli.view.open import page_of

    session.hush_mujoco()
    about: Mapping[str, Any] = {}
    logs: tuple[Path, ...] = (source,)
    apart: tuple[Path, ...] = ()
    fixed: Mapping[str, float] = {}
    if (source / "result.json").is_file():
        about, logs, apart, inputs, overrides = _result(source, inputs, overrides)
        belief = belief or (source / "belief.yaml" if about["command"] == "identify" else None)
        fixed = about.get("fixed") or {}
    opened = inputs.open(logs, overrides)
    opened, known = opened.starting_from(belief, fix=fixed, belief_anyway=belief_anyway)
    read = inputs.read(opened, [*logs, *apart])
    held_out = [log for log in read if log.held_out or log.file in apart]
    page = page_of(
        opened,
        [log for log in read if not any(log is other for other in held_out)],
        held_out=held_out,
        belief=known,
        fitted=about.get("command") == "identify",
        threads=cores(),
        title=f"{opened.name}: {source.name}",
    )
    if save is not None:
        write_whole(save, page)
        if session.json:
            return session.print_json(session.record(page=str(save), bytes=len(page.encode())))
        return session.console().print(f"page: {save}", soft_wrap=True)
    _serve(session, page, host, port)


def _result(
    folder: Path, inputs: Inputs, overrides: Overrides
) -> tuple[Mapping[str, Any], tuple[Path, ...], tuple[Path, ...], Inputs, Overrides]:
    """The record of a result, its logs, those held out, and how they are read."""
    import json

    from amhe_cli.cli.settings import Overrides, gathered
    from amhe_cli.core.errors import ConfigError
    from amhe_cli.core.yaml_file import merged

    try:
        record = json.loads((folder / "result.json").read_text(encoding="utf-8"))
        version, command = record["schema_version"], record["command"]
    except (OSError, ValueError, KeyError, TypeError):
        raise ConfigError(f"{folder / 'result.json'}: is no result of amhe; view the log itself") from None
    if version != 1 or command not in _VIEWED:
        other = f"of version {version}" if version != 1 else f"of `amhe {command}`"
        raise ConfigError(f"{folder}: is a result {other}, which cannot be viewed; view its log itself")
    if command == "run":
        return record, (folder / "log.mcap",), (), inputs, overrides
    given = _as_given(folder)
    logs = tuple(given.get("logs") or map(Path, record["logs"]))
    apart = tuple(given.get("held_out") or ())
    for path in (*logs, *apart):
        if not path.exists():
            raise ConfigError(
                f"{path}: this log of the result is not there; run the command where the result was "
                f"made, or view the log with --belief {folder / 'belief.yaml'}"
            )
    chosen = replace(
        inputs, **{name: getattr(inputs, name) or given.get(name) for name in _READING if given.get(name)}
    )
    before = gathered(given.get("config"), {}, given.get("assignments") or ())
    return record, logs, apart, chosen, Overrides(overrides.shared, merged(before.all, overrides.chosen))


def _as_given(folder: Path) -> dict[str, Any]:
    """Values of the options with which `amhe identify` made a result; {} if the library did."""
    from amhe_cli.cli.identify import identify
    from amhe_cli.core.parameters import Belief

    command = shlex.split(str(Belief.load(folder / "belief.yaml").provenance.get("command", "")))
    if command[:2] != ["amhe", "identify"]:
        return {}
    return dict(identify.make_context("identify", command[2:], resilient_parsing=True).params)


def _serve(session: Session, page: str, host: str, port: int) -> None:
    import time

    from amhe_cli.cli.browser import announce
    from amhe_cli.cli.stopping import stopping
    from amhe_cli.view.server import PageServer

    with stopping(session) as stopped, PageServer(page, host, port) as server:
        announce(session, server)
        while not stopped():
            time.sleep(0.1)
