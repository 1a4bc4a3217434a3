"""The figures of a study: in one style, each as SVG for the page, PNG and PDF for elsewhere."""

from __future__ import annotations

import io
import logging
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.errors import printable
from amhe_cli.core.shown import Floor, outline
from amhe_cli.report.page import Section
from amhe_cli.report.study.tables import words_of
from amhe_cli.study.goals import change_of
from amhe_cli.study.results import TRACE_STEP, CellResult
from amhe_cli.study.summary import Ablation, Group, Groups

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
INITIAL = "#b45309"
#: Colours as in style.css.
FONTS = "Inter, 'Segoe UI', 'Helvetica Neue', Arial, 'DejaVu Sans', sans-serif"

#: Width of the page's figures [inch].
WIDTH = 10.4

#: Coordinates in paths.
_DRAWN = re.compile(r' d="[^"]*"')
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
    "figure.constrained_layout.w_pad": 0.1,
    "text.parse_math": False,  # a '$' in a name is a '$'
}


def _cells(count: int, across: int, height: float) -> tuple[Figure, list[Axes]]:
    """A figure of so many cells over the width of the page, each so high [inch]."""
    down = -(-count // across)
    figure = Figure(figsize=(WIDTH, height * down), layout="constrained")
    cells = figure.subplots(down, across, squeeze=False).ravel()
    for empty in cells[count:]:
        empty.remove()
    return figure, [*cells[:count]]


def styled(salt: str, **more: Any) -> AbstractContextManager[None]:
    """The style of a figure; `salt` makes the ids of figures on the same page differ."""
    style: Any = {**_STYLE, "svg.hashsalt": salt, **more}
    return matplotlib.rc_context(style)


def svg(figure: Figure) -> Markup:
    """A figure for the page, which sets its size."""
    text = io.StringIO()
    figure.savefig(text, format="svg", transparent=True, metadata={"Date": None})
    whole = printable(text.getvalue(), keep="\n")
    whole = whole[whole.index("<svg") :].replace("'DejaVu Sans'", FONTS)
    return Markup("<figure class=drawn>{}</figure>").format(
        Markup(_DRAWN.sub(lambda path: _DIGITS.sub(r"\1", path[0]), whole))
    )


#: Task -> path and goal of its box.
Floors = Mapping[str, Floor]
#: Name, title and caption of a figure, and what draws it.
Drawing = tuple[str, str, str, Callable[[], Figure]]

#: Colour of each mode; of what is true or wanted, and the operating point; of the path of the box.
_COLORS = {"true": INK, "baseline": "#b45309", "stale": "#b91c1c", "adaptive": "#2563eb"}
_TRUTH, _PATH = "#15803d", "#94a3b8"
#: A mean over seeds is drawn where at least this share of them is still running.
_QUORUM = 0.5
#: Straight tasks show at least this much beside their path [m].
_BESIDE = 0.12
#: Length and width of the trunk as drawn [m]: the distances between the hips, and a margin.
_TRUNK = np.array([0.436, 0.154])
#: Classes of a density.
_CLASSES = 60
#: A parameter of the box from a trace, as it was believed or as it truly was.
_Value = Callable[[Mapping[str, FloatArray], str], FloatArray]
_SHOWN: tuple[tuple[str, _Value], ...] = (
    ("mass m [kg]", lambda trace, of: trace[f"{of}/box_mass"]),
    ("floor friction mu [-]", lambda trace, of: trace[f"{of}/floor_friction"]),
    ("mu m [kg]", lambda trace, of: trace[f"{of}/box_mass"] * trace[f"{of}/floor_friction"]),
)


def drawn(groups: Groups, tried: Sequence[Ablation], floors: Floors, folder: Path) -> list[Section]:
    """Draw the figures that have something to show, each as PNG and PDF, and as a section of a page.

    Args:
        groups: Groups of the study.
        tried: Ablations of the study.
        floors: Path and goal of each task.
        folder: Folder of the files; made where there is something to draw.
    """
    sections = []
    for name, title, caption, draw in drawings(groups, tried, floors):
        folder.mkdir(exist_ok=True)
        with styled(name):
            figure = draw()
            element = svg(figure)
            figure.savefig(folder / f"{name}.png", dpi=200, facecolor="white", metadata={"Software": None})
            figure.savefig(folder / f"{name}.pdf", metadata={"CreationDate": None})
        sections.append(Section(title, caption, figure=element))
    return sections


def drawings(groups: Groups, tried: Sequence[Ablation], floors: Floors) -> Iterator[Drawing]:
    """The figures that have something to show."""
    shown = [task for task in groups.tasks if task in floors]

    def of(*tasks: str) -> list[str]:
        return [task for task in shown if task in tasks]

    if straight := of("t1", "t2", "t3"):
        yield (
            "paths", "Paths of the box",
            "Every seed; the cross is the goal. Distances beside the straight paths are stretched.",
            partial(_paths, groups, straight, floors),
        )  # fmt: skip
    if shown:
        yield (
            "speed", "Tracking of the forward speed",
            "Speed of the trunk in its own heading, averaged over 0.2 s; mean and sd over the seeds, as long "
            "as half of them are running.",
            partial(_speeds, groups, shown),
        )  # fmt: skip
    if pushed := of("t2", "t3"):
        yield (
            "costs", "Density of the running cost",
            "Over all states of all seeds, each 0.2 s. The cost rises by orders of magnitude when a push "
            "fails, hence the logarithm.",
            partial(_costs, groups, pushed),
        )  # fmt: skip
    # in mode true, beliefs are the truth
    if changed := [task for task in of("t3", "t4") if set(groups.modes_of([task])) - {"true"}]:
        yield (
            "parameters", "Parameters over time",
            "Belief, mean and sd over the seeds, against the truth; time from the change of box or floor on. "
            "A steady push shows mu m; mu and m by themselves show only while the speed changes.",
            partial(_parameters, groups, changed),
        )  # fmt: skip
    for task in (task for task in shown if floors[task].one_leg):
        yield (
            "final", f"{task.upper()}: final configuration",
            "From above: trunk and box at the start (dotted) and the end, the goal (dashed), and the way of "
            "the foot that pushes, of seed 0. Thin: the box of the other seeds.",
            partial(one_leg_figure, groups, task, floors[task]),
        )  # fmt: skip
    if tried:
        yield (
            "ablations", "Ablations",
            "One setting is changed at a time. Solid: cost J, mean and sd over seeds; dotted: success with "
            "Wilson's 95 % interval; dashed: the operating point.",
            partial(_ablations, tried),
        )  # fmt: skip


def _panels(
    groups: Groups,
    tasks: Sequence[str],
    height: float,
    draw: Callable[[Axes, str], None],
    *others: tuple[str, str],
) -> Figure:
    """A panel for each task; below, a legend of modes and of other lines (label, colour)."""
    figure, cells = _cells(len(tasks), max(2, min(3, len(tasks))), height)
    for axes, task in zip(cells, tasks, strict=True):
        draw(axes, task)
    _legend(figure, groups.modes_of(tasks), *others)
    return figure


def _legend(figure: Figure, modes: Sequence[str], *others: tuple[str, str]) -> None:
    handles = [Line2D([], [], color=_color(mode), linewidth=1.8, label=mode) for mode in modes]
    handles += [
        Line2D([], [], color=color, linestyle="--", linewidth=1.3, label=label) for label, color in others
    ]
    figure.legend(
        handles=handles, loc="outside lower center", ncols=len(handles), fontsize=8.5, handlelength=1.8
    )


def _color(mode: str) -> str:
    return _COLORS.get(mode, MUTED)


def _speeds(groups: Groups, tasks: Sequence[str]) -> Figure:
    """Forward speed of the robot against the command: mean and sd over seeds."""

    def draw(axes: Axes, task: str) -> None:
        found = groups.of(task)
        for group in found:
            _band(axes, *over_time(group.results, lambda r: r.trace["speed"]), _color(group.mode))
        time, command, _ = over_time(found[0].results, lambda r: r.trace["command"])
        axes.plot(time, command, "--", color=_TRUTH, linewidth=1.2)
        axes.set_title(f"{task.upper()}: forward speed [m/s]")
        axes.set_xlabel("time [s]")

    return _panels(groups, tasks, 2.7, draw, (f"command ({groups.modes_of(tasks)[0]})", _TRUTH))


def _costs(groups: Groups, tasks: Sequence[str]) -> Figure:
    """How the running cost is spread over all states of all seeds."""

    def draw(axes: Axes, task: str) -> None:
        costs = {
            g.mode: np.maximum(np.concatenate([r.trace["running_cost"] for r in g.results]), 1e-3)
            for g in groups.of(task)
        }
        every = np.concatenate(list(costs.values()))
        edges = np.geomspace(every.min() / 2.0, every.max() * 2.0, _CLASSES)
        for mode, values in costs.items():
            share = np.full(values.size, 1.0 / values.size / np.log10(edges[1] / edges[0]))
            axes.hist(values, edges, weights=share, color=_color(mode), alpha=0.15)
            axes.hist(values, edges, weights=share, color=_color(mode), histtype="step", linewidth=1.5)
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.xaxis.set_major_formatter("{x:g}")
        axes.minorticks_off()
        axes.set_title(f"{task.upper()}: density of log10 of the running cost")
        axes.set_xlabel("running cost of a state [-]")

    return _panels(groups, tasks, 2.7, draw)


def _parameters(groups: Groups, tasks: Sequence[str]) -> Figure:
    """Believed parameters of the box against the true ones; time from the change on."""
    figure, cells = _cells(len(_SHOWN) * len(tasks), len(_SHOWN), 2.5)
    for axes, (task, (title, value)) in zip(cells, product(tasks, _SHOWN), strict=True):
        _parameter_panel(axes, [group for group in groups.of(task) if group.mode != "true"], value)
        axes.set_title(f"{task.upper()}: {title}")
    _legend(figure, [mode for mode in groups.modes_of(tasks) if mode != "true"], ("truth", _TRUTH))
    return figure


def _parameter_panel(axes: Axes, found: Sequence[Group], value: _Value) -> None:
    changed = any(change_of(result) is not None for group in found for result in group.results)
    shown = {
        group.mode: [r for r in group.results if not changed or change_of(r) is not None] for group in found
    }  # runs that ended before the change have no time since it
    shown = {mode: results for mode, results in shown.items() if results}
    for mode, results in shown.items():
        _band(axes, *over_time(results, lambda r: value(r.trace, "belief"), since_change), _color(mode))
    longest = max(shown.values(), key=lambda results: max(r.trace["time"][-1] for r in results))
    time, truth, _ = over_time(longest, lambda r: value(r.trace, "truth"), since_change)
    axes.plot(time, truth, "--", color=_TRUTH, linewidth=1.3)
    if changed:
        axes.axvline(0.0, color=MUTED, linewidth=0.8, linestyle=":")
    axes.set_ylim(0.0, 1.08 * axes.get_ylim()[1])
    axes.set_xlabel("time since the change [s]" if changed else "time [s]")


def over_time(
    results: Sequence[CellResult],
    values: Callable[[CellResult], FloatArray],
    origin: Callable[[CellResult], float] = lambda result: 0.0,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Time [s], mean and sd over seeds (m,), where at least half of them are running.

    Args:
        results: Results of one group.
        values: A column over a result's own time.
        origin: Time of a result that is to be zero [s].
    """
    times = [result.trace["time"] - origin(result) for result in results]
    low, high = min(t[0] for t in times), max(t[-1] for t in times)
    time = np.arange(low, high + 0.5 * TRACE_STEP, TRACE_STEP)
    table = np.array(
        [
            np.interp(time, t, values(result), left=np.nan, right=np.nan)
            for t, result in zip(times, results, strict=True)
        ]
    )
    kept = np.isfinite(table).sum(axis=0) >= max(1.0, _QUORUM * len(results))
    return time[kept], np.nanmean(table[:, kept], axis=0), np.nanstd(table[:, kept], axis=0)


def since_change(result: CellResult) -> float:
    """Time of the first change of box or floor [s]; 0 where nothing changed."""
    return change_of(result) or 0.0


def _band(axes: Axes, time: FloatArray, mean: FloatArray, sd: FloatArray, color: str) -> None:
    axes.fill_between(time, mean - sd, mean + sd, color=color, alpha=0.15, linewidth=0)
    axes.plot(time, mean, color=color, linewidth=1.4)


def _paths(groups: Groups, tasks: Sequence[str], floors: Floors) -> Figure:
    """The paths of the box, seed by seed; straight ones with their sides stretched."""

    def draw(axes: Axes, task: str) -> None:
        floor = floors[task]
        axes.plot(*floor.path.T, "--", color=_PATH, linewidth=1.2)
        axes.plot(*floor.path[-1], "x", color=_TRUTH, markersize=7, markeredgewidth=1.8)
        for group in groups.of(task):
            look = {"color": _color(group.mode), "linewidth": 0.9, "alpha": 0.65}
            for result in group.results:
                axes.plot(result.trace["box_x"], result.trace["box_y"], **look)
        if floor.curved:
            axes.set_aspect("equal", adjustable="datalim")
        else:
            low, high = axes.get_ylim()
            axes.set_ylim(min(low, -_BESIDE), max(high, _BESIDE))
        axes.set_title(f"{task.upper()}: y [m]")
        axes.set_xlabel("x [m]")

    return _panels(groups, tasks, 3.3, draw, ("path", _PATH))


def one_leg_figure(groups: Groups, task: str, floor: Floor) -> Figure:
    """Robot and box from above at the end, one panel a mode."""
    found = groups.of(task)
    figure, cells = _cells(len(found), min(4, max(3, len(found))), 3.4)
    for axes, group in zip(cells, found, strict=True):
        color, first = _color(group.mode), group.results[0].trace
        size = np.array(dict(group.setting).get("boxes.box", floor.footprint)[:2])
        _outline(axes, first, 0, _TRUNK, "trunk", color=MUTED, linewidth=0.9, linestyle=":")
        _outline(axes, first, 0, size, "box", color=MUTED, linewidth=0.9, linestyle=":")
        goal = outline(floor.path[-1], floor.goal_yaw, (size[0], size[1]))
        axes.plot(*goal, color=_TRUTH, linewidth=1.6, linestyle="--")
        for number, result in enumerate(group.results):
            faint = {"alpha": 0.35, "linewidth": 0.8} if number else {"alpha": 0.9, "linewidth": 1.6}
            _outline(axes, result.trace, -1, size, "box", color=color, **faint)
        _outline(axes, first, -1, _TRUNK, "trunk", color=INK, linewidth=1.4)
        axes.plot(first["foot_x"], first["foot_y"], color=INK, linewidth=0.8)
        axes.plot(first["foot_x"][-1], first["foot_y"][-1], "o", color=INK, markersize=4)
        axes.set_aspect("equal", adjustable="datalim")
        axes.set_title(f"{group.mode}, y [m]; e_g {group.spread('goal_error_m').mean:.3f} m")
        axes.set_xlabel("x [m]")
    return figure


def _outline(
    axes: Axes, trace: Mapping[str, FloatArray], row: int, size: FloatArray, what: str, **style: Any
) -> None:
    """Draw the outline of a body in one row of a trace."""
    x, y, yaw = (trace[f"{what}_{name}"][row] for name in ("x", "y", "yaw"))
    axes.plot(*outline(np.array([x, y]), yaw, (size[0], size[1])), **style)


def _ablations(tried: Sequence[Ablation]) -> Figure:
    """One panel a setting: J to the left, with its sd; success to the right, with its interval."""
    figure, cells = _cells(len(tried), min(3, len(tried)), 2.95)
    for axes, ablation in zip(cells, tried, strict=True):
        _ablation_panel(axes, ablation)
    return figure


def _ablation_panel(axes: Axes, ablation: Ablation) -> None:
    at, dots = np.arange(len(ablation.values), dtype=float), {"markersize": 4, "capsize": 2.5}
    costs, rates = ([group.spread(name) for group in ablation.groups] for name in ("cost", "success"))
    sd = np.nan_to_num([cost.sd for cost in costs])
    axes.errorbar(at - 0.05, [c.mean for c in costs], sd, fmt="o-", color=IDENTIFIED, **dots)
    axes.set_ylabel("cost J [-]", color=IDENTIFIED)
    axes.set_ylim(bottom=0.0)
    right = axes.twinx()
    share = 100.0 * np.array([rate.mean for rate in rates])
    reach = 100.0 * np.array([[r.mean - r.low for r in rates], [r.high - r.mean for r in rates]])
    right.errorbar(at + 0.05, share, np.maximum(reach, 0.0), fmt="s:", color=INITIAL, **dots)
    right.set_ylim(-4.0, 104.0)
    right.set_ylabel("success [%]", color=INITIAL)
    right.grid(visible=False)
    if ablation.default is not None:
        axes.axvline(ablation.default, color=_TRUTH, linestyle="--", linewidth=1.3)
    axes.set_xticks(at, [words_of(value) for value in ablation.values])
    axes.set_xlim(-0.4, len(at) - 0.6)
    n = sorted({group.n for group in ablation.groups})
    seeds = f"n = {n[0]}" if len(n) == 1 else f"n = {n[0]} to {n[-1]}"
    axes.set_title(f"{ablation.path}\n{ablation.task} {ablation.mode}, {seeds}", fontsize=8.5)
