"""The figures of a study, as sections of its page."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.shown import Floor, outline
from amhe_cli.report.page import Section
from amhe_cli.report.study.tables import words_of
from amhe_cli.study.goals import change_of
from amhe_cli.study.results import TRACE_STEP, CellResult
from amhe_cli.study.summary import Ablation, Group, Groups
from amhe_cli.web.plots import Curve, Mark, Panel, figure

#: Task -> path and goal of its box.
Floors = Mapping[str, Floor]

#: Colour of each mode; of what is true or wanted.
_COLORS = {"true": "ink", "baseline": "before", "stale": "red", "adaptive": "after"}
_TRUTH = "green"
#: A mean over seeds is drawn where at least this share of them is still running.
_QUORUM = 0.5
#: Straight tasks show at least this much beside their path [m].
_BESIDE = 0.12
#: Length and width of the trunk as drawn [m]: the distances between the hips, and a margin.
_TRUNK = (0.436, 0.154)
#: Classes of a density.
_CLASSES = 60
#: A parameter of the box from a trace, as it was believed or as it truly was.
_Value = Callable[[Mapping[str, FloatArray], str], FloatArray]
_SHOWN: tuple[tuple[str, str, _Value], ...] = (
    ("mass m", "kg", lambda trace, of: trace[f"{of}/box_mass"]),
    ("floor friction mu", "", lambda trace, of: trace[f"{of}/floor_friction"]),
    ("mu m", "kg", lambda trace, of: trace[f"{of}/box_mass"] * trace[f"{of}/floor_friction"]),
)


def drawn(groups: Groups, tried: Sequence[Ablation], floors: Floors) -> list[Section]:
    """The figures that have something to show.

    Args:
        groups: Groups of the study.
        tried: Ablations of the study.
        floors: Path and goal of each task.
    """
    shown = [task for task in groups.tasks if task in floors]

    def of(*tasks: str) -> list[str]:
        return [task for task in shown if task in tasks]

    # in mode true, beliefs are the truth
    changed = [task for task in of("t3", "t4") if set(groups.modes_of([task])) - {"true"}]
    made: list[tuple[str, str, list[Panel], int]] = [
        (
            "Paths of the box",
            "Every seed; the cross is the goal. Distances beside the straight paths are stretched.",
            [_paths(groups, task, floors[task]) for task in of("t1", "t2", "t3")],
            3,
        ),
        (
            "Tracking of the forward speed",
            "Speed of the trunk in its own heading, averaged over 0.2 s; mean and sd over the seeds, as long "
            "as half of them are running.",
            [_speed(groups, task) for task in shown],
            3,
        ),
        (
            "Density of the running cost",
            "Over all states of all seeds, each 0.2 s. The cost rises by orders of magnitude when a push "
            "fails, hence the logarithm.",
            [_costs(groups, task) for task in of("t2", "t3")],
            2,
        ),
        (
            "Parameters over time",
            "Belief, mean and sd over the seeds, against the truth; time from the change of box or floor on. "
            "A steady push shows mu m; mu and m by themselves show only while the speed changes.",
            [_parameter(groups, task, *one) for task in changed for one in _SHOWN],
            3,
        ),
        *(
            (
                f"{task.upper()}: final configuration",
                "From above: trunk and box at the start (dotted) and the end, the goal, and the way of the "
                "foot that pushes, of seed 0. Dotted in colour: the box of the other seeds.",
                list(final(groups, task, floors[task])),
                3,
            )
            for task in shown
            if floors[task].one_leg
        ),
        (
            "What each setting does",
            "One setting is changed at a time: cost J, mean and sd over seeds; success with Wilson's 95 % "
            "interval. The line is the operating point.",
            [panel for one in tried for panel in _ablation(one)],
            2,
        ),
    ]
    return [
        Section(title, text, figure=figure(panels, across)) for title, text, panels, across in made if panels
    ]


def _color(mode: str) -> str:
    return _COLORS.get(mode, "soft")


def _speed(groups: Groups, task: str) -> Panel:
    """Forward speed of the robot against the command: mean and sd over seeds."""
    found = groups.of(task)
    lines = [_band(g, over_time(g.results, lambda r: r.trace["speed"])) for g in found]
    time, command, _ = over_time(found[0].results, lambda r: r.trace["command"])
    wanted = Curve(time, command, f"command ({found[0].mode})", _TRUTH, "dashed")
    return Panel(f"{task.upper()}: forward speed", [*lines, wanted], "m/s")


def _costs(groups: Groups, task: str) -> Panel:
    """How the running cost is spread over all states of all seeds."""
    costs = {
        g.mode: np.log10(np.maximum(np.concatenate([r.trace["running_cost"] for r in g.results]), 1e-3))
        for g in groups.of(task)
    }
    every = np.concatenate(list(costs.values()))
    edges = np.linspace(every.min() - 0.3, every.max() + 0.3, _CLASSES)
    lines = [
        Curve(edges[:-1], np.histogram(values, edges, density=True)[0], mode, _color(mode), "step")
        for mode, values in costs.items()
    ]
    title = f"{task.upper()}: density of log10 of the running cost"
    return Panel(title, lines, x="log10 of the running cost of a state", low=0.0)


def _parameter(groups: Groups, task: str, title: str, unit: str, value: _Value) -> Panel:
    """A believed parameter of the box against the true one; time from the change on."""
    found = [group for group in groups.of(task) if group.mode != "true"]
    changed = any(change_of(result) is not None for group in found for result in group.results)
    shown = [
        (group, [r for r in group.results if not changed or change_of(r) is not None]) for group in found
    ]  # runs that ended before the change have no time since it
    lines = [
        _band(group, over_time(results, lambda r: value(r.trace, "belief"), since_change))
        for group, results in shown
        if results
    ]
    every = [results for _, results in shown if results]
    longest = max(every, key=lambda results: max(r.trace["time"][-1] for r in results))
    time, truth, _ = over_time(longest, lambda r: value(r.trace, "truth"), since_change)
    return Panel(
        f"{task.upper()}: {title}",
        [*lines, Curve(time, truth, "truth", _TRUTH, "dashed")],
        unit,
        "time since the change [s]" if changed else "time [s]",
        [Mark(0.0)] * changed,
        low=0.0,
    )


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


def _band(group: Group, found: tuple[FloatArray, FloatArray, FloatArray]) -> Curve:
    time, mean, sd = found
    return Curve(time, mean, group.mode, _color(group.mode), band=(mean - sd, mean + sd))


def _paths(groups: Groups, task: str, floor: Floor) -> Panel:
    """The paths of the box, seed by seed; straight ones with their sides stretched."""
    lines = [
        Curve(r.trace["box_x"], r.trace["box_y"], group.mode, _color(group.mode))
        for group in groups.of(task)
        for r in group.results
    ]
    beside = None if floor.curved else max(_BESIDE, *(float(np.abs(line.y).max()) for line in lines))
    low = None if beside is None else -beside
    lines += [
        Curve(floor.path[:, 0], floor.path[:, 1], "path", "soft", "dashed"),
        _cross(floor.path[-1], float(np.ptp(floor.path, axis=0).max()), beside),
    ]
    return Panel(
        f"{task.upper()}: y", lines, "m", "x [m]", low=low, high=beside, equal=floor.curved, height=240
    )


def _cross(at: FloatArray, length: float, beside: float | None) -> Curve:
    """The goal of a path so long; `beside`: half the height of axes of two scales, None: they have one."""
    reach = 0.02 * length
    x, y = reach * np.array([-1.0, 1.0, 1.0, -1.0, 1.0]), np.array([-1.0, 1.0, np.nan, 1.0, -1.0])
    return Curve(at[0] + x, at[1] + (reach if beside is None else 0.1 * beside) * y, "goal", _TRUTH)


def final(groups: Groups, task: str, floor: Floor) -> Iterator[Panel]:
    """Robot and box from above at the end, one panel a mode."""
    for group in groups.of(task):
        color, first = _color(group.mode), group.results[0].trace
        length, width = dict(group.setting).get("boxes.box", floor.footprint)[:2]
        size = float(length), float(width)
        goal = outline(floor.path[-1], floor.goal_yaw, size)
        lines = [
            Curve(*_outline(first, 0, _TRUNK, "trunk"), "trunk at the start", "soft", "dotted"),
            Curve(*_outline(first, 0, size, "box"), "box at the start", "soft", "dotted"),
            Curve(*goal, "goal", _TRUTH, "dashed"),
            *(Curve(*_outline(r.trace, -1, size, "box"), "", color, "dotted") for r in group.results[1:]),
            Curve(*_outline(first, -1, size, "box"), f"box, {group.mode}", color),
            Curve(*_outline(first, -1, _TRUNK, "trunk"), "trunk", "ink"),
            Curve(first["foot_x"], first["foot_y"], "foot", "violet"),
        ]
        missed = group.spread("goal_error_m").mean
        yield Panel(f"{group.mode}, e_g {missed:.3f} m: y", lines, "m", "x [m]", equal=True)


def _outline(
    trace: Mapping[str, FloatArray], row: int, size: tuple[float, float], what: str
) -> tuple[FloatArray, FloatArray]:
    """The outline of a body in one row of a trace."""
    x, y, yaw = (trace[f"{what}_{name}"][row] for name in ("x", "y", "yaw"))
    return outline(np.array([x, y]), yaw, size)


def _ablation(ablation: Ablation) -> Iterator[Panel]:
    """Cost J and success over the values of a setting; words stand a step apart."""
    values = [words_of(value) for value in ablation.values]
    numeric = all(isinstance(value, int | float) for value in ablation.values)
    at = np.array(ablation.values if numeric else range(len(values)), dtype=np.float64)
    label = ablation.path if numeric else f"{ablation.path}: {', '.join(values)}"
    counts = sorted({group.n for group in ablation.groups})
    seeds = "n = " + " to ".join(str(n) for n in dict.fromkeys((counts[0], counts[-1])))
    marks = [] if ablation.default is None else [Mark(float(at[ablation.default]), "", _TRUTH)]
    for name, title, unit, factor in (("cost", "cost J", "", 1.0), ("success", "success", "%", 100.0)):
        spreads = [group.spread(name) for group in ablation.groups]
        mean = factor * np.array([one.mean for one in spreads])
        if name == "cost":
            sd = np.nan_to_num([one.sd for one in spreads])
            line, most = Curve(at, mean, band=(mean - sd, mean + sd)), None
        else:
            low, high = (factor * np.array([getattr(one, end) for one in spreads]) for end in ("low", "high"))
            line, most = Curve(at, mean, color="before", band=(low, high)), 104.0
        where = f"{title}: {ablation.task} {ablation.mode}, {seeds}"
        yield Panel(where, [line], unit, label, marks, low=0.0, high=most)
