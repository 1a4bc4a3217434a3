"""The figures of a study: in one style, each as SVG for the page, PNG and PDF for elsewhere."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol, TypeAlias

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.floor import Floor, outline
from amhe_cli.report.figures import IDENTIFIED, INITIAL, INK, MUTED, Grid, styled, svg
from amhe_cli.report.page import Section
from amhe_cli.study.ablations import Ablation
from amhe_cli.study.estimates import change_of
from amhe_cli.study.results import TRACE_STEP, CellResult
from amhe_cli.study.summary import Group, Groups

#: Colour of each mode, everywhere; a mode of another name is grey.
COLORS = {"true": INK, "baseline": "#d97706", "stale": "#b91c1c", "adaptive": "#2563eb"}
#: Colour of what is true or wanted.
TRUTH = "#15803d"
#: Colour of the operating point.
DEFAULT = "#15803d"
#: Colour of the path that the box is to take.
PATH = "#94a3b8"
#: Height of the legend below the panels [inch].
_STRIP = 0.34


class StudyTask(Protocol):
    """Properties of a task that figures need."""

    @property
    def name(self) -> str:
        """Name of the task in the study's cells."""
        ...

    @property
    def title(self) -> str:
        """The task in a few words."""
        ...

    @property
    def floor(self) -> Floor:
        """Path and goal of the box."""
        ...


@dataclass(frozen=True, slots=True)
class Drawing:
    """A figure that is still to be drawn.

    Args:
        name: Name of its files.
        title: Title of the figure.
        caption: Caption: how to read it.
        draw: Function that draws it.
    """

    name: str
    title: str
    caption: str
    draw: Callable[[], Figure]


def drawn(drawings: Sequence[Drawing], folder: Path) -> list[Section]:
    """Draw figures, write each as PNG and PDF, and return them as sections of a page.

    Args:
        drawings: The figures to draw.
        folder: Folder of the files; made where there is something to draw.
    """
    sections = []
    for drawing in drawings:
        folder.mkdir(exist_ok=True)
        with styled(drawing.name):
            figure = drawing.draw()
            element = svg(figure)
            figure.savefig(
                folder / f"{drawing.name}.png", dpi=200, facecolor="white", metadata={"Software": None}
            )
            figure.savefig(folder / f"{drawing.name}.pdf", metadata={"CreationDate": None})
        sections.append(
            Section(drawing.title, drawing.caption, figure=element, natural=True, name=drawing.name)
        )
    return sections


def color_of(mode: str) -> str:
    """Colour of a mode."""
    return COLORS.get(mode, MUTED)


def room(grid: Grid) -> Figure:
    """A figure of the grid's cells, with a strip for the legend below them."""
    figure = grid.figure()
    figure.set_figheight(figure.get_figheight() + _STRIP)
    return figure


def legend(figure: Figure, modes: Sequence[str], *others: Line2D) -> None:
    """A legend for all panels, below them: modes by their colour, and other lines."""
    lines = [Line2D([], [], color=color_of(mode), linewidth=1.8, label=mode) for mode in modes]
    handles = [*lines, *others]
    figure.legend(handles=handles, loc="lower center", ncols=len(handles), fontsize=8.5, handlelength=1.8)


def line(label: str, color: str, style: Literal["--", ":"] = "--") -> Line2D:
    """An entry of a legend."""
    return Line2D([], [], color=color, linestyle=style, linewidth=1.3, label=label)


#: A mean over seeds is drawn where at least this share of them is still running.
_QUORUM = 0.5
#: A parameter of the box from a trace, as it was believed or as it truly was.
_Value = Callable[[Mapping[str, FloatArray], str], FloatArray]
_SHOWN: tuple[tuple[str, _Value], ...] = (
    ("mass m [kg]", lambda trace, of: trace[f"{of}/box_mass"]),
    ("floor friction mu [-]", lambda trace, of: trace[f"{of}/floor_friction"]),
    ("mu m [kg]", lambda trace, of: trace[f"{of}/box_mass"] * trace[f"{of}/floor_friction"]),
)
#: Points of a density.
_POINTS = 200


def speed_figure(groups: Groups, tasks: Sequence[StudyTask]) -> Figure:
    """Forward speed of the robot against the command: mean and sd over seeds."""
    grid = Grid(len(tasks), min(3, len(tasks)), height=2.7)
    figure = room(grid)
    for index, task in enumerate(tasks):
        axes = grid.axes(figure, index)
        found = groups.of(task.name)
        for group in found:
            _band(axes, *over_time(group.results, lambda r: r.trace["speed"]), color_of(group.mode))
        time, command, _ = over_time(found[0].results, lambda r: r.trace["command"])
        axes.plot(time, command, "--", color=TRUTH, linewidth=1.2)
        axes.set_title(f"{task.name.upper()}: forward speed [m/s]")
        axes.set_xlabel("time [s]")
    modes = groups.modes_of(task.name for task in tasks)
    legend(figure, modes, line(f"command ({modes[0]})", TRUTH))
    return figure


def cost_figure(groups: Groups, tasks: Sequence[StudyTask]) -> Figure:
    """How the running cost is spread over all states of all seeds."""
    grid = Grid(len(tasks), max(2, min(3, len(tasks))), height=2.7)
    figure = room(grid)
    for index, task in enumerate(tasks):
        axes = grid.axes(figure, index)
        found = groups.of(task.name)
        costs = {g.mode: np.concatenate([r.trace["running_cost"] for r in g.results]) for g in found}
        everything = np.log10(np.maximum(np.concatenate(list(costs.values())), 1e-3))
        at = np.linspace(everything.min() - 0.3, everything.max() + 0.3, _POINTS)
        for mode, values in costs.items():
            density = _density(np.log10(np.maximum(values, 1e-3)), at)
            axes.fill_between(10.0**at, density, color=color_of(mode), alpha=0.15, linewidth=0)
            axes.plot(10.0**at, density, color=color_of(mode), linewidth=1.5)
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.xaxis.set_major_formatter("{x:g}")
        axes.minorticks_off()
        axes.set_ylim(bottom=0.0)
        axes.set_title(f"{task.name.upper()}: density of log10 of the running cost")
        axes.set_xlabel("running cost of a state [-]")
    legend(figure, groups.modes_of(task.name for task in tasks))
    return figure


def parameter_figure(groups: Groups, tasks: Sequence[StudyTask]) -> Figure:
    """Believed parameters of the box against the true ones; time from the change on."""
    grid = Grid(len(_SHOWN) * len(tasks), len(_SHOWN), height=2.5)
    figure = room(grid)
    for row, task in enumerate(tasks):
        found = [group for group in groups.of(task.name) if group.mode != "true"]
        for column, (title, value) in enumerate(_SHOWN):
            axes = grid.axes(figure, len(_SHOWN) * row + column)
            _parameter_panel(axes, found, value)
            axes.set_title(f"{task.name.upper()}: {title}")
    modes = groups.modes_of(task.name for task in tasks)
    legend(figure, [mode for mode in modes if mode != "true"], line("truth", TRUTH))
    return figure


def _parameter_panel(axes: Axes, found: Sequence[Group], value: _Value) -> None:
    changed = any(change_of(result) is not None for group in found for result in group.results)
    shown = {
        group.mode: [r for r in group.results if not changed or change_of(r) is not None] for group in found
    }  # runs that ended before the change have no time since it
    shown = {mode: results for mode, results in shown.items() if results}
    for mode, results in shown.items():
        _band(axes, *over_time(results, lambda r: value(r.trace, "belief"), since_change), color_of(mode))
    longest = max(shown.values(), key=lambda results: max(r.trace["time"][-1] for r in results))
    time, truth, _ = over_time(longest, lambda r: value(r.trace, "truth"), since_change)
    axes.plot(time, truth, "--", color=TRUTH, linewidth=1.3)
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
    rows = [
        np.interp(time, t, values(result), left=np.nan, right=np.nan)
        for t, result in zip(times, results, strict=True)
    ]
    table = np.array(rows)
    running = np.isfinite(table).sum(axis=0)
    kept = running >= max(1.0, _QUORUM * len(results))
    return time[kept], np.nanmean(table[:, kept], axis=0), np.nanstd(table[:, kept], axis=0)


def since_change(result: CellResult) -> float:
    """Time of the first change of box or floor [s]; 0 where nothing changed."""
    return change_of(result) or 0.0


def _band(axes: Axes, time: FloatArray, mean: FloatArray, sd: FloatArray, color: str) -> None:
    axes.fill_between(time, mean - sd, mean + sd, color=color, alpha=0.15, linewidth=0)
    axes.plot(time, mean, color=color, linewidth=1.4)


def _density(values: FloatArray, at: FloatArray) -> FloatArray:
    """Gaussian kernels of Silverman's width about values (n,), at points (m,)."""
    quartiles = np.quantile(values, (0.25, 0.75))
    scale = min(float(values.std()), float(np.diff(quartiles)[0]) / 1.349) or float(values.std()) or 1.0
    width = max(0.9 * scale * values.size**-0.2, 0.02)
    kernels = np.exp(-0.5 * ((at[:, None] - values) / width) ** 2)
    return kernels.mean(axis=1) / (width * np.sqrt(2.0 * np.pi))


#: Straight tasks show at least this much beside their path [m].
_BESIDE = 0.12
#: Length and width of the trunk as drawn [m]: the distances between the hips, and a margin.
_TRUNK = np.array([0.436, 0.154])


def path_figure(groups: Groups, tasks: Sequence[StudyTask]) -> Figure:
    """The paths of the box, seed by seed; straight ones with their sides stretched."""
    grid = Grid(len(tasks), 3, height=3.3)
    figure = room(grid)
    for index, task in enumerate(tasks):
        axes = grid.axes(figure, index)
        path = task.floor.path
        axes.plot(path[:, 0], path[:, 1], "--", color=PATH, linewidth=1.2)
        axes.plot(*path[-1], "x", color=TRUTH, markersize=7, markeredgewidth=1.8)
        for group in groups.of(task.name):
            for result in group.results:
                trace = result.trace
                axes.plot(
                    trace["box_x"], trace["box_y"], color=color_of(group.mode), linewidth=0.9, alpha=0.65
                )
        if task.floor.curved:
            axes.set_aspect("equal", adjustable="datalim")
        else:
            low, high = axes.get_ylim()
            axes.set_ylim(min(low, -_BESIDE), max(high, _BESIDE))
        axes.set_title(f"{task.name.upper()}: {task.title}, y [m]")
        axes.set_xlabel("x [m]")
    legend(figure, groups.modes_of(task.name for task in tasks), line("path", PATH))
    return figure


def one_leg_figure(groups: Groups, task: StudyTask) -> Figure:
    """Robot and box from above at the end, one panel a mode."""
    found = groups.of(task.name)
    grid = Grid(len(found), min(4, max(3, len(found))), height=3.4)
    figure = grid.figure()
    for index, group in enumerate(found):
        axes = grid.axes(figure, index)
        color = color_of(group.mode)
        first, size = group.results[0].trace, _box_size(group, task)
        _outline(axes, first, 0, _TRUNK, "trunk", color=MUTED, linewidth=0.9, linestyle=":")
        _outline(axes, first, 0, size, "box", color=MUTED, linewidth=0.9, linestyle=":")
        goal = outline(task.floor.path[-1], task.floor.goal_yaw, (size[0], size[1]))
        axes.plot(*goal, color=TRUTH, linewidth=1.6, linestyle="--")
        for number, result in enumerate(group.results):
            faint = {"alpha": 0.9 if number == 0 else 0.35, "linewidth": 1.6 if number == 0 else 0.8}
            _outline(axes, result.trace, -1, size, "box", color=color, **faint)
        _outline(axes, first, -1, _TRUNK, "trunk", color=INK, linewidth=1.4)
        axes.plot(first["foot_x"], first["foot_y"], color=INK, linewidth=0.8)
        axes.plot(first["foot_x"][-1], first["foot_y"][-1], "o", color=INK, markersize=4)
        axes.set_aspect("equal", adjustable="datalim")
        error = group.spread("goal_error_m")
        axes.set_title(f"{group.mode}, y [m]; e_g {error.mean:.3f} m")
        axes.set_xlabel("x [m]")
    return figure


def _box_size(group: Group, task: StudyTask) -> FloatArray:
    """Depth and width of the box [m], shape (2,): those of the task, or those of the setting."""
    return np.array(dict(group.setting).get("boxes.box", task.floor.footprint)[:2])


def _outline(
    axes: Axes, trace: Mapping[str, FloatArray], row: int, size: FloatArray, what: str, **style: Any
) -> None:
    """Draw the outline of a body in one row of a trace."""
    x, y, yaw = (trace[f"{what}_{name}"][row] for name in ("x", "y", "yaw"))
    axes.plot(*outline(np.array([x, y]), yaw, (size[0], size[1])), **style)


def ablation_figure(tried: Sequence[Ablation]) -> Figure:
    """One panel a setting: J to the left, with its sd; success to the right, with its interval."""
    grid = Grid(len(tried), min(3, len(tried)), height=2.95)
    figure = grid.figure()
    for index, ablation in enumerate(tried):
        axes = grid.axes(figure, index, bottom=0.5, top=0.45)
        place = axes.get_position()
        axes.set_position((place.x0, place.y0, place.width - 0.045, place.height))
        _panel(axes, ablation)
    return figure


def _panel(axes: Axes, ablation: Ablation) -> None:
    at = np.arange(len(ablation.values), dtype=float)
    costs = [group.spread("cost") for group in ablation.groups]
    rates = [group.spread("success") for group in ablation.groups]
    sd = np.nan_to_num([cost.sd for cost in costs])
    axes.errorbar(
        at - 0.05, [c.mean for c in costs], sd, fmt="o-", color=IDENTIFIED, markersize=4, capsize=2.5
    )
    axes.set_ylabel("cost J [-]", color=IDENTIFIED, labelpad=1.0)
    axes.set_ylim(bottom=0.0)
    right = axes.twinx()
    share = 100.0 * np.array([rate.mean for rate in rates])
    reach = 100.0 * np.array([[r.mean - r.low for r in rates], [r.high - r.mean for r in rates]])
    right.errorbar(
        at + 0.05, share, np.maximum(reach, 0.0), fmt="s:", color=INITIAL, markersize=4, capsize=2.5
    )
    right.set_ylim(-4.0, 104.0)
    right.set_ylabel("success [%]", color=INITIAL, labelpad=1.0)
    right.grid(visible=False)
    if ablation.default is not None:
        axes.axvline(ablation.default, color=DEFAULT, linestyle="--", linewidth=1.3)
    axes.set_xticks(at, [v if isinstance(v, str) else json.dumps(v) for v in ablation.values])
    axes.set_xlim(-0.4, len(at) - 0.6)
    n = sorted({group.n for group in ablation.groups})
    seeds = f"n = {n[0]}" if len(n) == 1 else f"n = {n[0]} to {n[-1]}"
    axes.set_title(f"{ablation.path}\n{ablation.task} {ablation.mode}, {seeds}", fontsize=8.5)


_Draw: TypeAlias = Callable[[Groups, Sequence[StudyTask]], Figure]
#: Figures of several tasks: name, title, caption, the tasks (none named: all), what draws it.
_FIGURES: tuple[tuple[str, str, str, tuple[str, ...], _Draw], ...] = (
    (
        "paths", "Paths of the box",
        "Every seed; the cross is the goal. Distances beside the straight paths are stretched.",
        ("t1", "t2", "t3"), path_figure,
    ),
    (
        "speed", "Tracking of the forward speed",
        "Speed of the trunk in its own heading, averaged over 0.2 s; mean and sd over the seeds, as long as "
        "half of them are running.",
        (), speed_figure,
    ),
    (
        "costs", "Density of the running cost",
        "Over all states of all seeds, each 0.2 s. The cost rises by orders of magnitude when a push fails, "
        "hence the logarithm.",
        ("t2", "t3"), cost_figure,
    ),
    (
        "parameters", "Parameters over time",
        "Belief, mean and sd over the seeds, against the truth; time from the change of box or floor on. "
        "A steady push shows mu m; mu and m by themselves show only while the speed changes.",
        ("t3", "t4"), parameter_figure,
    ),
)  # fmt: skip


def drawings(groups: Groups, tried: Sequence[Ablation], tasks: Mapping[str, StudyTask]) -> list[Drawing]:
    """The figures that have something to show.

    Args:
        groups: Groups of the study.
        tried: Ablations of the study.
        tasks: All tasks.
    """
    made = []
    for name, title, caption, wanted, draw in _FIGURES:
        shown = [tasks[task] for task in groups.tasks if task in (wanted or groups.tasks) and task in tasks]
        if name == "parameters":  # in mode true, beliefs are the truth
            shown = [task for task in shown if set(groups.modes_of([task.name])) - {"true"}]
        if shown:
            made.append(Drawing(name, title, caption, lambda d=draw, s=shown: d(groups, s)))
    for task in (tasks[name] for name in groups.tasks if name in tasks and tasks[name].floor.one_leg):
        caption = (
            "From above: trunk and box at the start (dotted) and the end, the goal (dashed), and the way of "
            "the foot that pushes, of seed 0. Thin: the box of the other seeds."
        )
        title = f"{task.name.upper()}: final configuration"
        made.append(Drawing("final", title, caption, lambda t=task: one_leg_figure(groups, t)))
    if tried:
        caption = (
            "One setting is changed at a time. Solid: cost J, mean and sd over seeds; dotted: success with "
            "Wilson's 95 % interval; dashed: the operating point."
        )
        made.append(Drawing("ablations", "Ablations", caption, lambda: ablation_figure(tried)))
    return made
