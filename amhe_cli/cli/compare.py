"""`amhe compare`: which of several models predicts what was not fitted?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from amhe_cli.cli import completion, options
from amhe_cli.cli.command import Given, argument, command, flag, option
from amhe_cli.cli.kinds import LOG, each_episode, episodes
from amhe_cli.cli.session import Session

if TYPE_CHECKING:
    from amhe_cli.system.system import System


@command(
    "Which of several models predicts better?",
    argument("systems", nargs=-1, required=True, metavar="SYSTEM...", shell_complete=completion.systems),
    option(
        "--logs ...",
        "Log to fit; more may follow, as in --logs run*.csv.",
        LOG,
        required=True,
        callback=episodes,
    ),
    options.held_out("Log to score on"),
    flag(
        "--friction",
        "Compare the friction models M1 to M6 of the one SYSTEM, and take the smallest within one standard "
        "error of the best.",
    ),
    options.msg_path,
    options.max_time,
    options.work,
    options.tuning,
    options.output,
)
def compare(session: Session, given: Given) -> None:
    """Fit each SYSTEM to the same logs, and compare how well they predict what was not fitted.

    SYSTEM is a bundled system or a folder with a system.yaml. With --friction it is one, and the models are
    those of its joints' friction: constant, larger at rest, growing with load (docs/systems.md).
    Writes result.json and report.html, and the files of each identification in a folder of its name.
    """
    from amhe_cli.api.compare import compare as run
    from amhe_cli.cli.progress import of_words, progress
    from amhe_cli.report.comparison import comparison_table
    from amhe_cli.report.page import print_page
    from amhe_cli.report.tables import rich_table

    names, more = _parted(given.systems)
    logs, folder = given.logs + each_episode(more), given.reserve()
    inputs = [replace(given.inputs, system=name) for name in names]
    systems = opened = [one.open(logs) for one in inputs]
    if given.friction:
        systems = _with_frictions(opened)
        inputs = inputs * len(systems)
    pairs = list(zip(inputs, systems, strict=True))
    read = [one.read(system, logs) for one, system in pairs]
    scored = [one.read(system, given.held_out) for one, system in pairs] if given.held_out else None
    with progress(session, "compare", of_words) as show:
        how = given.pick("seed", "threads", "engine", "max_time")
        found = run(systems, read, held_out=scored, simplest=given.friction, progress=show, **how)
    compared = found.record()
    lines = _lines(opened[0], compared["best"]) if given.friction and compared["best"] else []
    record = session.record(**compared, out=str(folder)) | ({"lines": lines} if lines else {})
    found.write(folder, record, session.command_line)
    if session.gave(record):
        return
    console = session.console()
    console.print(rich_table(comparison_table(found.names, found.horizons, found.best)), "")
    for text in found.verdicts:
        console.print(text)
    if lines:
        console.print("\n".join(lines), soft_wrap=True)
    print_page(folder, console)


def _parted(given: Sequence[str]) -> tuple[list[str], list[Path]]:
    """Systems, and logs that the shell wrote behind `--logs`: what exists and is no system."""
    from amhe_cli.system.description.folders import bundled_systems  # not at the top: --help needs no YAML

    known = bundled_systems()  # also beside a folder of that name
    files = [name for name in given if name not in known and Path(name).exists()]
    logs = [name for name in files if not (Path(name) / "system.yaml").is_file()]
    return [name for name in given if name not in logs], [Path(name) for name in logs]


def _with_frictions(systems: Sequence[System]) -> list[System]:
    """The one system with each friction model."""
    from amhe_cli.core.errors import ConfigError
    from amhe_cli.system.friction_models import friction_models

    if len(systems) != 1:
        raise ConfigError("--friction compares friction models of one SYSTEM; give one")
    return list(friction_models(systems[0]).values())


def _lines(system: System, name: str) -> list[str]:
    """What to write into `system.yaml` to go on with a friction model."""
    from amhe_cli.core.yaml_file import flow
    from amhe_cli.system.friction_models import MODELS, friction_entries, of_gears

    entries, own = friction_entries(system, name), ", ".join(of_gears(system))
    head, where = f"{name}: {MODELS[name][1]}", "the parameters of system.yaml"
    if own:
        head += f"; in {where}, in place of {own}:" if entries else f"; take {own} out of {where}"
    elif entries:
        head += f"; add to {where}:"
    return [head, *(f"  {key}: {flow(entry)}" for key, entry in entries.items())]
