"""Inertias of bodies as a table, for a page and for a terminal."""

from __future__ import annotations

from collections.abc import Sequence

from amhe_cli.estimation.core.result import BodyNumber
from amhe_cli.report import numbers
from amhe_cli.report.tables import NUMBER, STRONG, Table


def body_table(bodies: Sequence[BodyNumber]) -> Table:
    """Inertias that were identified as a whole, in kg, m and kg m^2."""
    rows = [
        (
            b.name,
            numbers.with_sd(b.estimate, b.sd),
            b.unit,
            numbers.interval(b.lower, b.upper),
            f"{b.prior:.3g}",
        )
        for b in bodies
    ]
    looks = ("name", STRONG, "unit", NUMBER, f"{NUMBER} soft")
    return Table(("inertia", "estimate ± sd", "unit", "90 % interval", "prior"), looks, rows)
