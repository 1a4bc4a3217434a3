"""Figures over time and over seeds: speed, cost, parameters."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator

from amhe_cli.core.arrays import FloatArray
from amhe_cli.report.figures import MUTED, Grid
from amhe_cli.report.study.drawing import TRUTH, StudyTask, color_of, legend, line, room
from amhe_cli.study.estimates import change_of
from amhe_cli.study.results import TRACE_STEP, CellResult
from amhe_cli.study.summary import Group, Groups

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
