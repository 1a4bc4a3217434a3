"""The sampled posterior beside the linearised one: in result.json, in the report, and in a line."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from amhe_cli.estimation.offline.result import Identification, Sampled
from amhe_cli.report import numbers
from amhe_cli.report.page import Section, Statement
from amhe_cli.report.tables import NUMBER, STRONG, Table


def sampled_record(result: Identification) -> dict[str, Any] | None:
    """The key `sampled` of result.json; None where no posterior was sampled."""
    found = result.sampled
    if found is None:
        return None
    return {
        "draws": len(found.draws),
        "effective": found.effective,
        "rollouts": found.rollouts,
        "parameters": [
            {"name": p.name, "linearised": found.linearised[p.name], "differs": found.differs(p)}
            for p in result.parameters
        ],
    }


def sampled_lines(result: Identification) -> Iterator[str]:
    """How many draws, and which parameters' intervals are not the linearised ones."""
    if result.sampled is not None:
        yield f"sampled posterior: {_size(result.sampled)}"
        yield from _differences(result, result.sampled)


def sampled_statements(result: Identification) -> Iterator[Statement]:
    """A sentence for each parameter whose interval is not the linearised one."""
    if result.sampled is not None:
        for text in _differences(result, result.sampled):
            yield Statement("mixed", f"{text}: the response bends within the interval.")


def sampled_sections(result: Identification) -> Iterator[Section]:
    """The table of both intervals."""
    found = result.sampled
    if found is None:
        return
    rows = [
        (
            p.name,
            numbers.interval(p.lower, p.upper),
            numbers.interval(*found.linearised[p.name]),
            numbers.unit_of(p.unit),
            "differ" if found.differs(p) else "agree",
        )
        for p in result.parameters
    ]
    yield Section(
        "Sampled posterior",
        text=f"{_size(found)}. The draws follow the true cost of the clips; the linearised posterior is a "
        "Gaussian with the slopes at the estimate. Both have the same widening for what noise does not "
        "explain. samples.npz has the draws.",
        table=Table(
            ("parameter", "90 % of the draws", "linearised 90 % interval", "unit", ""),
            ("name", STRONG, NUMBER, "unit", "soft"),
            rows,
        ),
    )


def _size(found: Sampled) -> str:
    return f"{len(found.draws):,} draws ({found.effective:,.0f} effective) from {found.rollouts:,} rollouts"


def _differences(result: Identification, found: Sampled) -> Iterator[str]:
    for p in filter(found.differs, result.parameters):
        low, high = found.linearised[p.name]
        sampled = numbers.quantity(numbers.interval(p.lower, p.upper), p.unit)
        yield f"{p.name}: {sampled} by draws, {numbers.interval(low, high)} linearised"
