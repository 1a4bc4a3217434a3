"""Pooled beliefs as a table and as JSON."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from amhe_cli.core.belief import Belief
from amhe_cli.core.files import plain
from amhe_cli.estimation.core.agreement import Agreement
from amhe_cli.report import numbers
from amhe_cli.report.tables import NUMBER, STRONG, Table

#: Beliefs that have a column of their own.
_SHOWN = 4


def pool_table(
    sources: Sequence[str],
    beliefs: Sequence[Belief],
    pooled: Belief,
    differences: Sequence[tuple[str, str, str, float]],
) -> Table:
    """Each parameter in each belief and in the pooled one, and the two that differ most.

    Args:
        sources, beliefs: Paths or names of the beliefs, and the beliefs.
        pooled: What they say together.
        differences: Parameter, the two sources that differ most, and by how many sd.
    """
    shown = list(zip(sources, beliefs, strict=True)) if len(beliefs) <= _SHOWN else []
    farthest = {name: (one, other, size) for name, one, other, size in differences}
    rows = [
        (
            name,
            *(_with_sd(belief, name) for _, belief in shown),
            _with_sd(pooled, name),
            unit if unit != "-" else "",
            f"{farthest[name][2]:.1f} sd",
            *(() if len(beliefs) == 2 else (" and ".join(map(_short, farthest[name][:2])),)),
        )
        for name, unit in zip(pooled.names, pooled.units, strict=True)
    ]
    between = () if len(beliefs) == 2 else ("between",)
    head = (
        "parameter",
        *(_short(source) for source, _ in shown),
        "pooled ± sd",
        "unit",
        "differ by",
        *between,
    )
    looks = ("", *(NUMBER for _ in shown), STRONG, "", NUMBER, *("" for _ in between))
    return Table(head, looks, rows)


def pool_record(
    sources: Sequence[str],
    pooled: Belief,
    found: Agreement,
    differences: Sequence[tuple[str, str, str, float]],
) -> dict[str, Any]:
    """The keys of `amhe pool --json`."""
    return plain(
        {
            "beliefs": sources,
            "chi_square": found.chi_square,
            "freedom": found.freedom,
            "chance": found.chance,
            "parameters": [
                {"name": name, "estimate": estimate, "sd": sd}
                for name, estimate, sd in zip(pooled.names, pooled.estimate, pooled.sd, strict=True)
            ],
            "differences": [
                {"name": name, "between": [one, other], "sd": size} for name, one, other, size in differences
            ],
        }
    )


def _with_sd(belief: Belief, name: str) -> str:
    if name not in belief.names:
        return numbers.MISSING
    row = belief.names.index(name)
    return numbers.with_sd(float(belief.estimate[row]), float(belief.sd[row]))


def _short(source: str) -> str:
    """'monday' of monday/belief.yaml."""
    path = Path(source)
    return path.parent.name if path.name == "belief.yaml" and path.parent.name else path.stem
