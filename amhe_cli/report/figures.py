"""Figures of what was identified: measured against predicted, costs, ellipses."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from markupsafe import Markup

from amhe_cli.core.arrays import FloatArray
from amhe_cli.estimation.core.result import Fit, Identification, MissingRow, ParameterResult
from amhe_cli.report import numbers
from amhe_cli.web.plots import Curve, Mark, Panel, evenly, figure, shown_unit

#: Panels of one clip; if there are more columns, those that move most are shown.
MAX_PANELS = 9
#: Inputs that are drawn below a clip.
MAX_INPUTS = 2
#: Corners of an ellipse.
_ROUND = 60


def fit_figure(fits: Sequence[Fit], large: bool = False) -> Markup:
    """Measured against predicted for the channels of one clip, its inputs below.

    Args:
        fits: The channels.
        large: The column in which the first values go farthest from the measured ones has a row of its own,
            and another one for what is left of it.
    """
    share = max(1, MAX_PANELS // len(fits))
    cells = [(fit, column) for fit in fits for column in _liveliest(fit, share)][:MAX_PANELS]
    if not large:
        return figure([_overlay(*cell) for cell in cells])
    worst = max(cells, key=lambda cell: _gap(*cell))
    others = [_overlay(*cell) for cell in cells if cell is not worst]
    below = [_rest(*worst), *_inputs(worst[0])]
    return figure([_overlay(*worst, height=280)], 1) + figure(below, 1) + figure(others)


def _overlay(fit: Fit, column: int, height: int = 150) -> Panel:
    factor, unit = shown_unit(fit.units[column % len(fit.units)])
    rows = evenly(len(fit.time))  # the same of all lines: the pointer shows their difference
    time = fit.time[rows]
    measured, before, after = (
        factor * one[rows, column] for one in (fit.measured, fit.initial, fit.identified)
    )
    return Panel(
        fit.channel if len(fit.columns) == 1 else f"{fit.channel} {fit.columns[column]}",
        [
            Curve(time, before, "before", "before", "dashed", leads=False),
            Curve(time, after, "after"),
            Curve(time, measured, "measured", "measured", "dots"),
        ],
        unit,
        height=height,
    )


def _rest(fit: Fit, column: int) -> Panel:
    factor, unit = shown_unit(fit.units[column % len(fit.units)])
    error, noise = factor * (fit.measured - fit.identified)[:, column], factor * fit.noise
    line = Curve(fit.time, error, "what is left", "after", "dots")
    band = Mark((-noise, noise), "declared noise, one sd", "given", "y")
    return Panel("measured − after", [line], unit, marks=[band], height=110)


def _inputs(fit: Fit) -> Iterator[Panel]:
    """What drove the clip: the inputs that change most."""
    rows = evenly(len(fit.time))
    moved = [float(np.ptp(values[np.isfinite(values)])) if values.size else 0.0 for *_, values in fit.inputs]
    for i in sorted(np.argsort(-np.array(moved), kind="stable")[:MAX_INPUTS].tolist()):
        name, unit, values = fit.inputs[i]
        factor, unit = shown_unit(unit)
        line = Curve(fit.time[rows], factor * values[rows], color="soft", shape="step")
        yield Panel(f"input: {name}", [line], unit, height=80)


def widest_gap(fits: Sequence[Fit]) -> float:
    """How far the first values miss a clip's worst column, in sd of the noise."""
    return max(_gap(fit, column) for fit in fits for column in range(len(fit.columns)))


def _gap(fit: Fit, column: int) -> float:
    """How far the first values miss a column, in sd of the noise."""
    away = (fit.initial - fit.measured)[:, column]
    away = away[np.isfinite(away)]
    return float(np.sqrt(np.mean(away**2)) / (fit.noise or 1.0)) if away.size else 0.0


def _liveliest(fit: Fit, count: int) -> list[int]:
    """The `count` columns with the widest motion, in their own order."""
    moved = fit.measured.std(axis=0)
    return sorted(np.argsort(-np.nan_to_num(moved), kind="stable")[:count].tolist())


def away(values: FloatArray, origin: float, parameter: ParameterResult, log: bool) -> FloatArray:
    """How far values (n,) of a parameter are from another one, in prior sd on its own scale."""
    if log:
        return np.log(values / origin) * parameter.prior / parameter.prior_sd
    return (values - origin) / parameter.prior_sd


def ellipse_figure(result: Identification, pairs: Sequence[tuple[str, str]]) -> Markup:
    """Where 90 % of the prior and of the posterior of two parameters lie, a panel for each pair.

    Args:
        result: The identification.
        pairs: Names of the parameters.
    """
    rows = {p.name: i for i, p in enumerate(result.parameters)}
    return figure([_ellipse(result, rows[one], rows[other]) for one, other in pairs], 3)


def _ellipse(result: Identification, *pair: int) -> Panel:
    known = [result.parameters[i] for i in pair]
    logs = [result.belief.log[i] for i in pair]
    around = np.linspace(0.0, 2.0 * np.pi, _ROUND)
    circle = 2.146 * np.stack((np.cos(around), np.sin(around)))  # holds 90 % of a plane's normal distribution
    rho = np.clip(float(result.correlations[pair]), -0.99999, 0.99999)
    turned = np.array([circle[0], rho * circle[0] + np.sqrt(1.0 - rho**2) * circle[1]])

    def ends(middles: Sequence[float], sds: Sequence[float], shape: FloatArray) -> list[FloatArray]:
        return [
            m * np.exp(sd / m * one) if log and m > 0.0 else m + sd * one
            for m, sd, log, one in zip(middles, sds, logs, shape, strict=True)
        ]

    prior = ends([p.prior for p in known], [p.prior_sd for p in known], circle)
    after = ends([p.estimate for p in known], [p.sd for p in known], turned)
    middle = [np.array([p.estimate]) for p in known]
    (x, y), (p, q), (m, n) = after, prior, middle
    lines = [
        Curve(p, q, "before", "before", "dashed", leads=False),
        Curve(x, y, "after", "after", "area"),
        Curve(m, n, "estimate", "ink", "dots"),
    ]
    names = [numbers.quantity(p.name, f"[{u}]" if (u := numbers.unit_of(p.unit)) else "") for p in known]
    return Panel(names[1], lines, x=names[0], height=230)


def missing_figure(rows: Sequence[MissingRow]) -> Markup:
    """Force that nothing else explains, against the variable of each cause; '' where there is none."""
    drawn = [(row, *row.against) for row in rows if row.against is not None]
    panels = []
    for row, name, values, force, explained in drawn:
        some = evenly(len(values))
        lines = [
            Curve(values[some], force[some], "not explained without it", "measured", "dots"),
            Curve(values[some], explained[some], "the cause", "after", "dots"),
        ]
        panels.append(Panel(f"{row.place}: {row.kind}", lines, x=name, height=200))
    return figure(panels)
