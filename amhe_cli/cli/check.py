"""`amhe check`: what is wrong with a model's numbers, and what a log will tell, before anything is fitted."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import click

from amhe_cli.cli import options
from amhe_cli.cli.command import Given, argument, command, flag, option
from amhe_cli.cli.kinds import LOG, MODEL, episodes
from amhe_cli.cli.session import LOSSY, Session

if TYPE_CHECKING:
    from amhe_cli.check.findings import Finding
    from amhe_cli.check.motion import JointMotion
    from amhe_cli.cli.inputs import Inputs
    from amhe_cli.core.log import Log
    from amhe_cli.estimation.design.expected import Expected
    from amhe_cli.system.system import System

#: Findings that are listed; `--json` has all of them.
_SHOWN = 20
#: Combinations that are listed.
_TOGETHER = 4
_REQUIRED = re.compile(r"^\s*([\w.*-]+)\s*<\s*([0-9.]+)\s*%\s*$")


def _required(ctx: click.Context, param: click.Parameter, given: Sequence[str]) -> dict[str, float]:
    """NAME<5% -> the largest share."""
    found = {}
    for text in given:
        match = _REQUIRED.match(text)
        if match is None:
            raise click.BadParameter(f"{text!r} is not of the form 'NAME<5%'", ctx, param)
        found[match.group(1)] = float(match.group(2)) / 100.0
    return found


@command(
    "What is wrong with a model, and what will a log tell?",
    argument("model", MODEL),
    argument("logs", LOG, nargs=-1, callback=episodes, metavar="[LOG]..."),
    options.where,
    option(
        "--require",
        "Exit code 3 if the sd expected of this parameter is larger; repeat for more.",
        metavar="'NAME<5%'",
        multiple=True,
        callback=_required,
    ),
    flag("--no-meshes", "Read a URDF without its meshes."),
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
    from amhe_cli.check.motion import motions, still
    from amhe_cli.cli.inputs import model_file, urdf_options
    from amhe_cli.estimation.design.expected import expected
    from amhe_cli.system.model.files import compiled, read_spec

    logs, require = given.logs, given.require
    if require and not logs:
        raise click.UsageError("--require is about what a log will tell: give a LOG")
    path = model_file(given.model)
    made = compiled(read_spec(path, urdf_options(path, not given.no_meshes)), path.name)
    found, moved, hope = list(check_model(made)), (), None
    if logs:
        system, read = _read(given.inputs, path, logs, not given.no_meshes)
        moved = motions(system, read)
        found += still(moved)
        hope = expected(system, read)
    found = worst_first(found)
    session.warnings += [f"{one.where}: {one.what}" for one in found]
    missed = _missed(hope, require)
    told = {} if hope is None else _record(hope, moved, missed)
    listed = [asdict(one) for one in found]
    if session.gave(session.record(model=str(path), mass=total_mass(made), findings=listed, **told)):
        return LOSSY if missed else None
    print(f"{path.name}: {total_mass(made):.4g} kg, {made.njnt} joints, {made.nu} actuators")
    _print_findings(session, found)
    if hope is not None:
        _print_expected(session, hope, moved)
    for text in missed:
        session.console().print(f"not reached: {text}", style="yellow")
    return LOSSY if missed else None


def _read(inputs: Inputs, path: Path, logs: Sequence[Path], meshes: bool) -> tuple[System, list[Log]]:
    """The system that the logs are checked for, and the logs."""
    with tempfile.TemporaryDirectory() as scratch:
        if not inputs.system:
            inputs = inputs.of_model(path, logs, Path(scratch) / "system", meshes)
        system = inputs.open(logs)
        return system, inputs.read(system, logs)


def _missed(hope: Expected | None, require: dict[str, float]) -> list[str]:
    """What is required and not expected, in words."""
    from fnmatch import fnmatchcase

    from amhe_cli.core.errors import ConfigError, one_of

    missed = []
    for pattern, most in require.items():
        assert hope is not None
        alike = [p for p in hope.parameters if fnmatchcase(p.name, pattern)]
        if not alike:
            raise ConfigError(f"`require`: {one_of('parameter', pattern, [p.name for p in hope.parameters])}")
        for p in alike:
            share = p.sd / max(abs(p.estimate), 1e-300)
            if share > most:
                missed.append(f"{p.name} is expected to {100 * share:.2g} %, not {100 * most:g} %")
    return missed


def _record(hope: Expected, moved: Sequence[JointMotion], missed: Sequence[str]) -> dict[str, object]:
    names = ("name", "unit", "estimate", "prior", "sd", "shrinkage", "verdict")
    return {
        "motion": [asdict(one) for one in moved],
        "expected": [
            {name: getattr(p, name) for name in names} | {"reasons": [asdict(r) for r in p.reasons]}
            for p in hope.parameters
        ],
        "together": [asdict(one) for one in hope.combinations],
        "idle": hope.idle,
        "fit_cpu_seconds": hope.seconds,
        "not_reached": list(missed),
    }


def _print_findings(session: Session, found: Sequence[Finding]) -> None:
    console = session.console()
    for one in found[:_SHOWN]:
        console.print(f"  {one.where}: {one.what}", style="yellow", soft_wrap=True)
        console.print(f"    {one.cure}", style="dim", soft_wrap=True)
    if len(found) > _SHOWN:
        console.print(f"  and {len(found) - _SHOWN} more: --json lists all")
    if not found:
        console.print("  nothing that a robot could not have", style="green")


def _print_expected(session: Session, hope: Expected, moved: Sequence[JointMotion]) -> None:
    from amhe_cli.report.tables import NUMBER, Table, rich_table

    console = session.console()
    rows = [
        (one.joint, f"{one.low:.3g} to {one.high:.3g}", "" if one.share is None else f"{one.share:.0%}",
         f"{one.speed:.3g}")
        for one in moved
    ]  # fmt: skip
    console.print()
    console.print(rich_table(Table(("joint", "moves", "of its range", "speed"), ("", *[NUMBER] * 3), rows)))
    rows = [
        (p.name, f"{p.prior:.3g}", f"{100 * p.sd / max(abs(p.estimate), 1e-300):.2g} %", p.unit, p.verdict)
        for p in hope.parameters
    ]
    looks = ("", NUMBER, NUMBER, "", "")
    console.print()
    console.print(rich_table(Table(("parameter", "prior", "expected sd", "unit", "verdict"), looks, rows)))
    console.print()
    for p in hope.parameters:
        reason = hope.idle.get(p.name) or next((one.text for one in p.reasons), "")
        if p.verdict != "identified" and reason:
            console.print(f"{p.name}: {reason}", soft_wrap=True)
    for one in hope.combinations[:_TOGETHER]:
        console.print(f"known together: {one.text} to {100 * one.sd:.2g} %", soft_wrap=True)
    console.print(f"`amhe identify` would take about {float(f'{hope.seconds:.1g}'):g} s of CPU")
