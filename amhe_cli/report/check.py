"""What is wrong with a model, and what logs will determine: on a terminal, as a page, and before a fit."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from typing import Any

from rich.console import Console

from amhe_cli.check.findings import Finding, worst_first
from amhe_cli.check.model import check_model
from amhe_cli.check.motion import JointMotion
from amhe_cli.estimation.core.result import ParameterResult
from amhe_cli.estimation.design.expected import Expected
from amhe_cli.report import numbers
from amhe_cli.report.page import Section, Statement, page
from amhe_cli.report.parameters import MANY
from amhe_cli.report.tables import NUMBER, TEXT, VERDICT, Table, rich_table
from amhe_cli.system.system import System
from amhe_cli.web.plots import shown_unit

#: Findings that a terminal lists, alone and before a fit, and combinations.
_LISTED, _FEW, _TOGETHER = 20, 3, 4
#: What a reason says of one parameter: reasons that are alike but for it are one.
_LEFT_OPEN = re.compile(r"[,:] that leaves [^;]* open")
#: Kind of the first reason of a verdict -> what would cure it.
_CURES = {
    "idle": "move what it acts on, or log what it moves: `amhe probe` writes an excitation",
    "open": "move what it acts on faster and farther: `amhe probe` writes an excitation",
    "together": "measure one of them, or record a motion in which they differ: `amhe probe`",
    "assumed": "measure what is given, or make it a parameter",
    "prior": "measure what your prior is about, or free what it holds: another motion, `amhe probe`",
    "noise": "record more, or another motion: `amhe probe`",
    "repeats": "look for what the model lacks: `amhe explain`",
    "parts": "look for what differs between the parts: `amhe explain`",
    "minimum": "a prior that excludes the other minimum",
    "curvature": "record more of such motion",
    "bound": "widen its bounds, or look for what is wrong",
}


def print_findings(found: Sequence[Finding], console: Console, most: int = _LISTED) -> None:
    """Print the worst findings, each with its cure."""
    for one in found[:most]:
        console.print(f"  {one.where}: {one.what}", style="yellow", soft_wrap=True)
        console.print(f"    {one.cure}", style="dim", soft_wrap=True)


def said_before(system: System, more: Iterable[Finding], console: Console | None) -> list[dict[str, Any]]:
    """Check the model of a system before a fit or a probe, and print the worst findings.

    Args:
        more: What was found in logs.
        console: Where to print; None: nowhere.

    Returns:
        The key `findings` of result.json.
    """
    model, told = system.original.compile(), system.edits.apply(system.model, system.space.nominal)
    if model.nv == told.nv:  # what parameters set is there
        for field in ("dof_armature", "dof_damping", "dof_frictionloss"):
            getattr(model, field)[:] = getattr(told, field)
    found = worst_first([*check_model(model), *more])
    if found and console:
        others = f"; `amhe check` says more of the other {len(found) - _FEW}" if len(found) > _FEW else ""
        console.print(f"first of all, {_doubts(len(found))}{others}:", soft_wrap=True)
        print_findings(found, console, _FEW)
        console.print()
    return [asdict(one) for one in found]


def print_expected(hope: Expected, moved: Sequence[JointMotion], console: Console) -> None:
    """Print where the motion is, and what it will determine."""
    for table in (_motion_table(moved), _expected_table(hope)):
        if table.rows:
            console.print()
            console.print(rich_table(table))
    console.print()
    for why, names in _alike(hope).items():
        console.print(f"{numbers.some(names)}: {why}", soft_wrap=True)
    for text in _together(hope)[:_TOGETHER]:
        console.print(f"known together: {text}", soft_wrap=True)
    console.print(_time(hope))


def before_section(findings: Sequence[Mapping[str, Any]]) -> Section:
    """What was wrong before a fit, folded.

    Args:
        findings: The key `findings` of result.json.
    """
    table = _table((one["where"], one["what"], one["cure"]) for one in findings)
    return Section("Before the fit", table=table, folded=True, remark=_doubts(len(findings)))


def check_page(
    name: str,
    facts: Sequence[str],
    found: Sequence[Finding],
    hope: Expected | None,
    moved: Sequence[JointMotion],
    missed: Sequence[str],
    command: str,
) -> str:
    """The page as HTML.

    Args:
        name: Of the model.
        facts: The model in a few words.
        found: What is wrong, the worst first.
        hope, moved: What logs will determine, and where their motion is; None: there is no log.
        missed: What was required, and is not expected.
        command: The command line.
    """
    statements = [Statement("bad", f"Not reached: {text}.") for text in missed]
    statements += [Statement("mixed", f"{one.where}: {one.what}.") for one in found[:_FEW]]
    sections = []
    if found:
        text = "The worst first: how far a number is beyond what robots have."
        rows = ((one.where, one.what, one.cure) for one in found)
        sections.append(Section("What no robot has", text=text, table=_table(rows)))
    if hope is not None:
        determined = sum(p.verdict in ("identified", "conditional") for p in hope.lines)
        good = "good" if determined == len(hope.lines) else "mixed"
        tell = f"These logs will determine {determined} of {len(hope.lines)} parameters."
        statements.append(Statement(good, tell))
        sections += [Section("Where the motion is", table=_motion_table(moved))] if moved else []
        sections += [
            Section(
                "What a fit will say",
                text=f"From slopes near the estimate of a few clips. {_time(hope)}.",
                table=_expected_table(hope),
                items=[f"{numbers.some(n)}: {why}" for why, n in _alike(hope).items() if len(n) >= MANY],
            ),
        ]
        if known := _together(hope):
            sections.append(Section("Known together only", items=known))
    sections.append(Section("How it was made", items=[command], files=True, folded=True))
    of = ("the model",) if hope is None else ()
    headline = f"{_doubts(len(found), *of)}." if found else "Every number is one that a robot can have."
    return page("check", title=name, facts=facts, headline=headline, statements=statements, sections=sections)


def expected_record(hope: Expected, moved: Sequence[JointMotion], missed: Sequence[str]) -> dict[str, Any]:
    """What `amhe check --json` says of logs."""
    names = ("name", "unit", "estimate", "prior", "sd", "shrinkage", "verdict")
    return {
        "motion": [asdict(one) for one in moved],
        "expected": [
            {name: getattr(p, name) for name in names}
            | {"reasons": [asdict(r) for r in p.reasons], "cure": _cure(p)}
            for p in hope.lines
        ],
        "together": [asdict(one) for one in hope.combinations],
        "idle": hope.idle,
        "fit_cpu_seconds": hope.seconds,
        "not_reached": list(missed),
    }


def _doubts(count: int, of: str = "model and logs") -> str:
    return f"{count} doubt{'s' * (count != 1)} about {of}"


def _table(rows: Any) -> Table:
    return Table(("where", "what", "what would cure it"), (TEXT, TEXT, TEXT), [*rows])


def _motion_table(moved: Sequence[JointMotion]) -> Table:
    rows = []
    for one in moved:
        factor, unit = shown_unit(one.unit)
        shown = [factor * value for value in (one.low, one.high, one.speed)]
        low, high, speed = (f"{value:.3g}" if abs(value) < 1e3 else f"{value:.0f}" for value in shown)
        ends = f"{low} to {high}{' ' * unit.isalpha()}{unit}"
        share = "" if one.share is None else numbers.percent(one.share)
        band = "" if one.band is None else f"{one.band:.2g} Hz"
        rows.append((one.joint, ends, share, f"{speed} {unit}/s", band))
    return Table(("joint", "moves", "of its range", "speed", "up to"), ("", *[NUMBER] * 4), rows)


def _expected_table(hope: Expected) -> Table:
    priors = [numbers.rounded(p.prior, 0.1 * p.prior_sd) for p in hope.lines]
    rows = [
        (p.name, p.verdict, _size(p), numbers.quantity(prior, p.unit))
        for p, prior in zip(hope.lines, priors, strict=True)
    ]
    looks = ("name", VERDICT, NUMBER, NUMBER)
    shared = {name for names in _alike(hope).values() if len(names) >= MANY for name in names}
    remarks = ["" if p.name in shared else _why(hope, p) for p in hope.lines]  # these stand below the table
    return Table(("parameter", "verdict", "expected sd", "prior"), looks, rows, remarks)


def _together(hope: Expected) -> list[str]:
    """Products and ratios that will be known better than either of their factors."""
    sd = {p.name: relative(p) for p in hope.parameters}
    return [
        f"{one.text}, to {numbers.percent(one.sd)}"
        for one in hope.combinations
        if one.sd < min(sd[name] for name in one.names)
    ]


def _size(p: ParameterResult) -> str:
    """The sd as a share of the value; where that may be zero, or is before any log, in its unit."""
    return (
        numbers.percent(relative(p))
        if p.prior and p.sd < abs(p.estimate)
        else numbers.quantity(f"{p.sd:.2g}", p.unit)
    )


def relative(p: ParameterResult) -> float:
    """A parameter's sd as a share of its value."""
    return p.sd / max(abs(p.estimate), 1e-300)


def _why(hope: Expected, p: ParameterResult) -> str:
    """Why a parameter will not be determined, and what would cure it; '' of one that will."""
    reason = hope.idle.get(p.name) or next((one.text for one in p.reasons), "these logs say little of it")
    return "; ".join(filter(None, (reason, _cure(p)))) if p.verdict != "identified" else ""


def _alike(hope: Expected) -> dict[str, list[str]]:
    """Why parameters will not be determined -> those of which that is said."""
    alike: dict[str, list[str]] = {}
    for p in hope.lines:
        if why := _LEFT_OPEN.sub("", _why(hope, p)):
            alike.setdefault(why, []).append(p.name)
    return alike


def _cure(p: ParameterResult) -> str:
    kind = p.reasons[0].kind if p.reasons else "open"
    return _CURES.get(kind, "") if p.verdict != "identified" else ""


def _time(hope: Expected) -> str:
    return f"`amhe identify` would take about {float(f'{hope.seconds:.1g}'):g} s of CPU"
