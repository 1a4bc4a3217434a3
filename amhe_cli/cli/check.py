"""`amhe check`: what is wrong with a model's numbers, and what a log will determine, before any fit."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import click

from amhe_cli.cli import options
from amhe_cli.cli.command import Given, argument, command, flag
from amhe_cli.cli.kinds import LOG, MODEL, episodes
from amhe_cli.cli.session import LOSSY, Session

if TYPE_CHECKING:
    from amhe_cli.check.findings import Finding
    from amhe_cli.cli.inputs import Inputs
    from amhe_cli.core.log import Log
    from amhe_cli.system.system import System


@command(
    "What is wrong with a model, and what will a log show?",
    argument("model", MODEL),
    argument("logs", LOG, nargs=-1, callback=episodes, metavar="[LOG]..."),
    options.where,
    options.require("the sd expected of a parameter"),
    flag("--no-meshes", "Read a URDF without its meshes."),
    options.page,
)
def check(session: Session, given: Given) -> int | None:
    """Look through MODEL for numbers that no robot has: the worst first, each with what would cure it.

    MODEL is an MJCF or URDF file, or menagerie:NAME. Masses and inertias are held against shapes, left
    against right, gains against the time step, limits against gravity.

    With a LOG also where its motion is, the sd and the verdict that `amhe identify` is expected to give each
    parameter, and how long it would take; of the system of --system, else of one as `amhe init` writes it.
    With --strict, any finding is exit code 3.
    """
    from amhe_cli.check.findings import worst_first
    from amhe_cli.check.model import check_model, total_mass
    from amhe_cli.check.motion import log_findings, motions
    from amhe_cli.cli.inputs import model_file, urdf_options
    from amhe_cli.cli.required import matching, missed_of, names_of
    from amhe_cli.estimation.design.expected import expected
    from amhe_cli.report.check import check_page, expected_record, print_expected, print_findings
    from amhe_cli.system.model.files import compiled, read_spec

    if given.require and not given.logs:
        raise click.UsageError("--require is about what a log will determine: give a LOG")
    given.refuse_existing()
    path = model_file(given.model)
    session.listed = of_model = []
    made = compiled(read_spec(path, urdf_options(path, not given.no_meshes)), path.name)
    session.listed = None
    found, moved, hope, missed = [*check_model(made), *_read_with(path, of_model)], (), None, []
    if given.logs:
        session.listed = texts = []
        system, read = _read(given.inputs, path, given.logs, not given.no_meshes)
        matching(names_of(system), given.require)
        moved = motions(system, read)
        found += log_findings(system, read, moved)
        found += _recorded(system, read, [text for text in texts if text not in of_model])
        hope = expected(system, read)
        session.listed = None
        missed = missed_of((*hope.parameters, *hope.bodies), given.require, "expected to be known")
    found = worst_first(found)
    session.warnings += [f"{one.where}: {one.what}" for one in found]
    facts = (f"{total_mass(made):.4g} kg", f"joints: {made.njnt}", f"actuators: {made.nu}")
    outlook = {} if hope is None else expected_record(hope, moved, missed)
    listed = [asdict(one) for one in found]
    record = session.record(model=str(path), mass=total_mass(made), findings=listed, **outlook)
    if not session.gave(record):
        console = session.console()
        console.print(f"{path.name}: {', '.join(facts)}")
        print_findings(found, console)
        if not found:
            console.print("  every number is one that a robot can have", style="green")
        if hope is not None:
            print_expected(hope, moved, console)
        for text in missed:
            console.print(f"not reached: {text}", style="yellow")
    about = (path.name, facts, found, hope, moved, missed, session.command_line)
    given.write_out(record, lambda: check_page(*about))
    return LOSSY if missed else None


def _read_with(path: Path, texts: Sequence[str]) -> Iterator[Finding]:
    """What was reported when a model was read: an inertia that no body has, a joint that is left out."""
    from amhe_cli.check.findings import WRONG, Finding
    from amhe_cli.cli.advice import entry_of

    for text in dict.fromkeys(texts):
        cure = f"amhe help {entry_of(text)}" if entry_of(text) else "put it right in the model"
        yield Finding("file", path.name, text.removeprefix(f"{path}: "), WRONG, cure)


def _recorded(system: System, logs: Sequence[Log], texts: Sequence[str]) -> Iterator[Finding]:
    """What was reported when logs were read, and at first sight: clocks, spikes, damage, signs, units."""
    from amhe_cli.check.findings import WRONG, Finding
    from amhe_cli.cli.advice import entry_of
    from amhe_cli.estimation.explain.inputs import foremost, remarks, uncommanded

    for log in logs:
        for wrong in foremost(system, log):
            yield Finding("recording", wrong.place, wrong.what, WRONG, f"{wrong.remedy} in its signal")
    for text in uncommanded(system):
        columns = "columns `command_position_NAME` of servos, `command_effort_NAME` of motors"
        cure = f"log its commands: {columns}, or a topic that `signals` names"
        yield Finding("recording", "log", text, WRONG, cure)
    sources = {log.source for log in logs}
    for text in dict.fromkeys([*texts, *(text for log in logs for text in remarks(system, log))]):
        source = next((one for one in sources if text.startswith(f"{one}: ")), "")
        entry = entry_of(text)
        cure = f"amhe help {entry}" if entry else "put it right in the log, or in what the system says of it"
        yield Finding("recording", source or "log", text.removeprefix(f"{source}: "), 1.0, cure)


def _read(inputs: Inputs, path: Path, logs: Sequence[Path], meshes: bool) -> tuple[System, list[Log]]:
    """The system that the logs are checked for, and the logs."""
    import logging

    from amhe_cli.core.errors import NOTE

    if inputs.system:
        system = inputs.open(logs)
    else:
        made = inputs.proposal(path, logs, meshes=meshes)
        for note in made.notes:
            logging.getLogger(__name__).log(NOTE, "%s", note)
        system = made.system(path.stem, inputs.overrides.all).reading(inputs.topics)
    return system, inputs.read(system, logs)
