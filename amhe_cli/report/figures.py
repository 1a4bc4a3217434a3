"""Figures of the report as inline SVG: no network, sharp at any size; complete without the page's script."""

from __future__ import annotations

import io
import json
import logging
import re
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, Literal

import matplotlib
import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, to_rgb
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.text import printable
from amhe_cli.estimation.core.result import Fit, Iteration, MissingRow, ParameterResult
from amhe_cli.report import numbers
from amhe_cli.report.page import Key

logging.getLogger("matplotlib").setLevel(logging.ERROR)  # its notes on its font cache are of no use to users

#: Colour of texts and of what is true.
INK = "#1e293b"
#: Colour of what stands back.
MUTED = "#64748b"
#: Colour of rules and grids.
RULE = "#e2e8f0"
#: Colour of what identified parameters predict.
IDENTIFIED = "#2563eb"
#: Colour of what initial parameters predict.
INITIAL = "#d97706"
#: Colour of what was measured.
MEASURED = "#475569"

#: Colours as in report.css.
FONTS = "Inter, 'Segoe UI', 'Helvetica Neue', Arial, 'DejaVu Sans', sans-serif"

#: Colours of lines of one kind, and the shapes of those that use a colour again.
SERIES = (
    IDENTIFIED, INITIAL, "#15803d", "#7e22ce", "#b91c1c", "#0e7490", MEASURED, "#a16207",
)  # fmt: skip
_SHAPES: Sequence[Literal["solid", "dashed", "dotted"]] = ("solid", "dashed", "dotted")

#: Colours of correlations from -1 to 1.
_SIGNED = LinearSegmentedColormap.from_list(
    "signed", ["#c2620a", "#fef3e2", "#ffffff", "#e0eafd", IDENTIFIED]
)

#: Width of the page's figures [inch].
WIDTH = 10.4

#: Of more parameters than this, correlations are colours alone, and those that rest on the prior get no cost.
MANY = 24

#: Panels of one clip; if there are more columns, those that move most are shown.
MAX_PANELS = 9

#: Points of one line: a clip has thousands, but a panel is only hundreds of pixels wide.
MAX_POINTS = 240

#: Coordinates in paths.
_PATH = re.compile(r' d="[^"]*"')
#: Digits below a hundredth of a point, which are too small to see.
_DIGITS = re.compile(r"(\.\d\d)\d+")

_STYLE = {
    "path.simplify": False,  # it would drop lines without length
    "svg.fonttype": "none",  # text stays text: small files, and it can be searched
    "font.family": "DejaVu Sans",  # matplotlib brings it; the page says what is really used
    "font.size": 9.0,
    "axes.edgecolor": RULE,
    "axes.labelcolor": MUTED,
    "axes.titlesize": 9.5,
    "axes.titlecolor": INK,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#f1f5f9",
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.major.size": 0.0,
    "ytick.major.size": 0.0,
    "lines.linewidth": 1.5,
    "legend.frameon": False,
    "text.parse_math": False,  # a '$' in a name is a '$'
}


@dataclass(frozen=True, slots=True)
class Grid:
    """Cells of equal size over the width of the page; twice as fast as matplotlib's layout engine."""

    count: int
    across: int
    height: float  # of a cell [inch]

    def figure(self) -> Figure:
        """An empty figure with room for the cells."""
        return Figure(figsize=(WIDTH, self.height * -(-self.count // self.across)))

    def axes(self, figure: Figure, index: int, bottom: float = 0.42, top: float = 0.26) -> Axes:
        """Axes in one cell, `bottom` and `top` inches from its lower and upper edge."""
        row, column = divmod(index, self.across)
        total = figure.get_figheight()
        low = total - (row + 1) * self.height + bottom
        width = WIDTH / self.across
        box = (column * width + 0.55, low, width - 0.67, self.height - bottom - top)
        return figure.add_axes((box[0] / WIDTH, box[1] / total, box[2] / WIDTH, box[3] / total))


def styled(salt: str, **more: Any) -> AbstractContextManager[None]:
    """The style of a figure; `salt` makes the ids of figures on the same page differ."""
    style: Any = {**_STYLE, "svg.hashsalt": salt, **more}
    return matplotlib.rc_context(style)


def fit_figure(fits: Sequence[Fit]) -> Markup:
    """Measured against predicted, with residuals below, for the channels of one clip."""
    share = max(1, MAX_PANELS // len(fits))
    cells = [(fit, column) for fit in fits for column in _liveliest(fit, share)][:MAX_PANELS]
    grid = Grid(len(cells), 4 if len(cells) in (4, 7, 8) else min(3, len(cells)), height=2.7)
    with styled(fits[0].clip):
        figure = grid.figure()
        for index, (fit, column) in enumerate(cells):
            above = grid.axes(figure, index, bottom=1.1)
            below = grid.axes(figure, index, top=1.75)
            above.tick_params(labelbottom=False)
            above.sharex(below)
            _draw_fit(above, below, fit, column)
            below.set_xlabel("time [s]")
        return svg(figure)


def _draw_fit(above: Axes, below: Axes, fit: Fit, column: int) -> None:
    shown = np.flatnonzero(fit.valid)
    shown = shown[:: max(1, shown.size // MAX_POINTS)]
    measured = fit.measured[:, column]
    _dots(above, fit.time[shown], measured[shown], MEASURED)
    above.plot(*thinned(fit.time, fit.initial[:, column]), "--", color=INITIAL, linewidth=1.2)
    above.plot(*thinned(fit.time, fit.identified[:, column]), color=IDENTIFIED, linewidth=1.2)
    _frame(above, measured[fit.valid], fit.identified[:, column])
    name = fit.channel if len(fit.columns) == 1 else f"{fit.channel} {fit.columns[column]}"
    above.set_title(f"{name} [{fit.unit}]")
    below.axhspan(-fit.noise, fit.noise, color="#dbeafe", linewidth=0)
    error = (measured - fit.identified[:, column])[shown]
    _dots(below, fit.time[shown], error, IDENTIFIED)
    _frame(below, error, np.array([-1.5, 1.5]) * fit.noise)


def _dots(axes: Axes, x: FloatArray, y: FloatArray, color: str) -> None:
    """Points as one path of lines without length: a tenth of the file size of markers."""
    gap = np.full(x.size, np.nan)
    axes.plot(
        np.stack((x, x, gap), axis=1).ravel(),
        np.stack((y, y, gap), axis=1).ravel(),
        color=color,
        linewidth=2.2,
        solid_capstyle="round",
        alpha=0.75,
    )


def _frame(axes: Axes, *shown: FloatArray) -> None:
    """Set limits that hold the given values; other curves may leave the picture."""
    values = np.concatenate([s[np.isfinite(s)] for s in shown])
    low, high = (values.min(), values.max()) if values.size else (0.0, 1.0)
    margin = 0.15 * (high - low) or 0.1 * abs(high) or 1.0
    axes.set_ylim(low - margin, high + margin)


def _liveliest(fit: Fit, count: int) -> list[int]:
    """The `count` columns with the widest motion, in their own order."""
    spread = (
        np.nan_to_num(fit.measured[fit.valid].std(axis=0)) if fit.valid.any() else np.zeros(len(fit.columns))
    )
    return sorted(np.argsort(-spread, kind="stable")[:count].tolist())


def thinned(time: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Some MAX_POINTS points that keep every peak and gap: the extremes of many short stretches."""
    values = np.where(np.isfinite(values), values, np.nan)
    if values.size <= MAX_POINTS:
        return time, values
    kept = {0, values.size - 1}
    for stretch in np.array_split(np.arange(values.size), MAX_POINTS // 2):
        part = values[stretch]
        if np.isfinite(part).any():
            kept |= {int(stretch[np.nanargmin(part)]), int(stretch[np.nanargmax(part)])}
        else:
            kept.add(int(stretch[0]))
    index = np.array(sorted(kept))
    return time[index], values[index]


def convergence_figure(
    iterations: Sequence[Iteration], parameters: Sequence[ParameterResult], log: Sequence[bool]
) -> Markup:
    """Cost, sampling width, and distances of the parameters from their final values over the iterations.

    Args:
        iterations: The iterations.
        parameters: The parameters, as in their theta.
        log: Whether the scale of each is logarithmic.
    """
    number = np.arange(1, len(iterations) + 1)
    theta = np.array([i.theta for i in iterations])
    grid = Grid(3, 3, height=2.6)
    with styled("convergence"):
        figure = grid.figure()
        cost, sigma, values = (grid.axes(figure, index) for index in range(3))
        cost.semilogy(number, [i.cost for i in iterations], "o-", color=IDENTIFIED, markersize=3)
        cost.set_title("cost")
        sigma.semilogy(number, [i.sigma for i in iterations], "o-", color=MEASURED, markersize=3)
        sigma.set_title("sampling sd, in prior sd")
        for i, (one, own) in enumerate(zip(parameters, log, strict=True)):
            color, shape = _line_of(i)
            apart = away(theta[:, i], one.estimate, one, own)
            values.plot(number, apart, color=color, linestyle=shape, linewidth=1.2)
        values.set_title("away from final value, in prior sd")
        for axes in (cost, sigma):  # ticks that a range of less than a decade has too
            axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axes.yaxis.set_major_formatter("{x:g}")
        for axes in (cost, sigma, values):
            axes.set_xlabel("iteration")
            axes.minorticks_off()
            axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        return svg(figure)


def away(values: FloatArray, origin: float, parameter: ParameterResult, log: bool) -> FloatArray:
    """How far values (n,) of a parameter are from another one, in prior sd on its own scale."""
    if log:
        return np.log(values / origin) * parameter.prior / parameter.prior_sd
    return (values - origin) / parameter.prior_sd


def convergence_legend(names: Sequence[str]) -> tuple[Key, ...]:
    """Legend of the parameters' lines in `convergence_figure`."""
    return tuple(Key(name, *_line_of(i)) for i, name in enumerate(names))


def _line_of(i: int) -> tuple[str, Literal["solid", "dashed", "dotted"]]:
    """Colour and shape of line i: no two of the first 24 are alike."""
    return SERIES[i % len(SERIES)], _SHAPES[i // len(SERIES) % len(_SHAPES)]


def correlation_figure(names: Sequence[str], correlations: FloatArray) -> Markup:
    """Heat map of the posterior correlations; of more than `MANY` parameters without numbers."""
    size, few = len(names), len(names) <= MANY
    font, across, down = (9.0, 0.62, 0.5) if few else (6.0, 0.12, 0.12)
    label = 0.2 + font / 120.0 * max(len(name) for name in names)  # [inch]
    below = label * (0.6 if few else 1.0)
    wide, high = label + across * size + 0.1, below + down * size + 0.1
    with styled("correlation", **{"axes.grid": False}):
        figure = Figure(figsize=(wide, high))
        axes = figure.add_axes((label / wide, below / high, across * size / wide, down * size / high))
        axes.pcolormesh(
            correlations[::-1], cmap=_SIGNED, vmin=-1.0, vmax=1.0, edgecolors="white", linewidth=2.0 * few
        )
        for row, column in np.ndindex(size, size) if few else ():
            value = correlations[row, column]
            axes.text(
                column + 0.5, size - row - 0.5, f"{value:.2f}".replace("-0.00", "0.00"),
                ha="center", va="center", color=_readable_on(_SIGNED(float(0.5 + 0.5 * value))), fontsize=8,
            )  # fmt: skip
        centres = np.arange(size) + 0.5
        # the page moves a name by its anchor, which is at its tick
        turned = 30 if few else 90
        axes.set_xticks(centres, names, rotation=turned, ha="right", rotation_mode="anchor", fontsize=font)
        axes.set_yticks(centres, list(names)[::-1], fontsize=font)
        for spine in axes.spines.values():
            spine.set_visible(False)
        return svg(figure)


def _readable_on(tile: Sequence[float]) -> str:
    """White or ink, whichever has more contrast with a colour (red, green, blue between 0 and 1)."""
    back, ink = luminance(tile), luminance(to_rgb(INK))
    return "white" if 1.05 / (back + 0.05) > (back + 0.05) / (ink + 0.05) else INK


def luminance(color: Sequence[float]) -> float:
    """Relative luminance of a colour in sRGB, between 0 and 1 (WCAG)."""
    channels = np.array(color[:3])
    linear = np.where(channels <= 0.04045, channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4)
    return float(linear @ (0.2126, 0.7152, 0.0722))


def profile_figure(parameters: Sequence[ParameterResult]) -> Markup | None:
    """Cost along each parameter; None if no profile was computed.

    Of more than `MANY`, those that the logs hardly narrow are left out.
    """
    told = [p for p in parameters if len(parameters) <= MANY or p.verdict != "prior"]
    drawn = [(p, *p.profile) for p in told if p.profile is not None]
    if not drawn:
        return None
    grid = Grid(len(drawn), min(4, max(3, len(drawn))), height=2.3)
    with styled("profile"):
        figure = grid.figure()
        for index, (parameter, values, costs) in enumerate(drawn):
            axes = grid.axes(figure, index)
            _draw_profile(axes, parameter, values, np.where(np.isfinite(costs), costs, np.nan))
        return svg(figure)


def _draw_profile(axes: Axes, parameter: ParameterResult, values: FloatArray, costs: FloatArray) -> None:
    axes.axvspan(parameter.lower, parameter.upper, color="#dbeafe", linewidth=0)
    axes.axvline(parameter.estimate, color=IDENTIFIED, linewidth=1.0)
    if values.min() <= parameter.prior <= values.max():
        axes.axvline(parameter.prior, color=INITIAL, linewidth=1.0, linestyle="--")
    axes.plot(values, costs, "o-", color=INK, markersize=2.5, linewidth=1.0)
    edge = 0.03 * float(np.ptp(values))  # so that the last dots are seen whole
    axes.set_xlim(values.min() - edge, values.max() + edge)
    low, high = (np.nanmin(costs), np.nanmax(costs)) if np.isfinite(costs).any() else (0.0, 1.0)
    if high - low < 0.02 * abs(high):  # flat: show it flat, not its rounding errors
        axes.set_ylim(low - 0.5 * abs(high) - 1e-9, high + 0.5 * abs(high) + 1e-9)
    unit = numbers.unit_of(parameter.unit)
    axes.set_title(f"{parameter.name} [{unit}]" if unit else parameter.name)
    axes.locator_params(nbins=5)


def svg(figure: Figure) -> Markup:
    """The SVG element of a figure; the page sets its size."""
    text = io.StringIO()
    figure.savefig(text, format="svg", transparent=True, metadata={"Date": None})
    whole = printable(text.getvalue(), keep="\n")
    whole = whole[whole.index("<svg") :].replace("'DejaVu Sans'", FONTS)
    whole = whole.replace("<svg", f"<svg data-axes='{json.dumps(_places(figure))}'", 1)
    return Markup(_PATH.sub(lambda path: _DIGITS.sub(r"\1", path[0]), whole))


def _places(figure: Figure) -> list[dict[str, Any]]:
    """Where axes with numbers lie in the SVG element [pt], and their ends: what the page's script needs."""
    wide, high = (72.0 * size for size in figure.get_size_inches())
    found = []
    for axes in figure.axes:
        at = axes.get_position()
        box = (at.x0 * wide, (1.0 - at.y1) * high, at.x1 * wide, (1.0 - at.y0) * high)
        ends = {
            name: (*map(float, limits), scale == "log")
            for name, limits, scale in (
                ("x", axes.get_xlim(), axes.get_xscale()),
                ("y", axes.get_ylim(), axes.get_yscale()),
            )
        }
        found.append({"box": [round(edge, 1) for edge in box], **ends})
    return found


def fit_legend(initial: str, identified: str) -> tuple[Key, ...]:
    """Legend of `fit_figure`; what the two predictions are made with, in words."""
    return (
        Key("measured", MEASURED, "dot"),
        Key(f"predicted with {initial}", INITIAL, "dashed"),
        Key(f"predicted with {identified}", IDENTIFIED),
        Key("below: measured minus the latter, and the declared noise (band)", shape=""),
    )


def missing_figure(rows: Sequence[MissingRow]) -> Markup | None:
    """Force that nothing else explains, against the variable of each cause; None where there is none."""
    drawn = [(row, *row.against) for row in rows if row.against is not None]
    if not drawn:
        return None
    grid = Grid(len(drawn), min(3, len(drawn)), height=2.6)
    with styled("missing"):
        figure = grid.figure()
        for index, (row, name, values, force, explained) in enumerate(drawn):
            axes = grid.axes(figure, index, bottom=0.5)
            some = np.linspace(0, len(values) - 1, min(len(values), 2 * MAX_POINTS)).astype(int)
            _dots(axes, values[some], force[some], MEASURED)
            _dots(axes, values[some], explained[some], IDENTIFIED)
            axes.set_title(f"{row.place}: {row.kind}")
            axes.set_xlabel(name)
            axes.locator_params(nbins=5)
        return svg(figure)
