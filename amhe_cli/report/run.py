"""A run in sentences and figures, on a page and on a terminal, and its files besides the log."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from markupsafe import Markup
from rich.console import Console
from rich.text import Text

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.files import json_text
from amhe_cli.core.shown import Floor, outline
from amhe_cli.report import numbers
from amhe_cli.report.folder import write_page
from amhe_cli.report.page import Section, Statement, Tone, print_result, result_page
from amhe_cli.report.tables import STRONG, Table
from amhe_cli.web.plots import Curve, Mark, Panel, figure


@dataclass(frozen=True, slots=True, eq=False)
class TaskFacts:
    """What a report states about the task of a run.

    Args:
        title: The task in a few words.
        floor: Path and goal of the box.
        changes: What changes during the run, each in a few words.
        on_time: A success that takes no longer than this counts as on time [s].
        close_enough: A final distance from the goal up to this one is a success [m].
        units: Unit of each parameter, by name.
        period: Control period by the wall clock [s].
    """

    title: str
    floor: Floor
    changes: Sequence[str]
    on_time: float
    close_enough: float
    units: Mapping[str, str]
    period: float


def write_run(
    folder: Path,
    task: TaskFacts,
    columns: Mapping[str, FloatArray],
    record: Mapping[str, Any],
    provenance: Mapping[str, Any],
) -> None:
    """Write result.json and report.html.

    Args:
        folder: Folder of the run's log.
        columns: Numbers of each cycle by name, shape (cycles,) each; {} if there was no cycle.
        record: Content of result.json.
        provenance: Versions, hashes, seed and command.
    """
    (folder / "result.json").write_text(json_text(record), encoding="utf-8")
    write_page(folder, lambda: run_page(task, columns, record, provenance))


def print_run(record: Mapping[str, Any], task: TaskFacts, folder: Path, console: Console) -> None:
    """Print the verdict, the measures, what the page states, and where it is."""
    tone, text = verdict(record)
    if record["trip"]:  # its reason was printed when it came
        text = f"stopped by trip {record['trip']}"
    style = {"good": "green", "mixed": "yellow", "bad": "red"}[tone]
    line = Text.assemble((f"{record['task']} ({task.title}), mode {record['mode']}: "), (text, style))
    print_result(line, measure_table(record), statements(record, task), folder, console)


def run_page(
    task: TaskFacts,
    columns: Mapping[str, FloatArray],
    record: Mapping[str, Any],
    provenance: Mapping[str, Any],
) -> str:
    """The page as HTML; for the arguments see `write_run`."""
    name = record["task"].upper() if record["task"].startswith("t") else record["task"]
    text = verdict(record)[1]
    return result_page(
        record,
        provenance,
        title=f"{name}: {task.title}",
        facts=(
            f"mode {record['mode']}",
            f"target {record['target']}",
            f"seed {record['seed']}",
            f"{record['cycles']} cycles in {record['seconds']:.1f} s",
        ),
        headline=f"{text[0].upper()}{text[1:]}.",
        statements=list(statements(record, task)),
        sections=list(_sections(task, columns, record)),
    )


def verdict(record: Mapping[str, Any]) -> tuple[Tone, str]:
    """How the run ended, and whether that is good."""
    if record["error"]:
        return "bad", f"stopped by an error: {record['error']}"
    if record["fell"]:
        return "bad", "the robot fell"
    if record["interrupted"]:
        return "mixed", "interrupted: the numbers end there"
    if record["success"] and not record["arrived"]:
        return "good", f"success: the box is close enough to its goal after {record['duration']:g} s"
    if record["success"]:
        return "good", "success, on time" if record["on_time"] else "success, but late"
    if record["cut_short"]:
        return "mixed", f"stopped after {record['duration']:g} s, before the task was done"
    return "bad", "failed: the box is not at its goal, or it strayed from its path"


def statements(record: Mapping[str, Any], task: TaskFacts) -> Iterator[Statement]:
    """What a reader should know first."""
    if record["goal_error_m"] is not None:
        near = record["goal_error_m"] <= task.close_enough
        yield Statement(
            "good" if near else "mixed",
            f"The box is {number(record['goal_error_m'], '{:.3f}')} m from its goal; up to "
            f"{task.close_enough:g} m is close enough.",
        )
    if record["success"] and record["arrived"]:
        yield Statement(
            "good" if record["on_time"] else "mixed",
            f"The run took {record['time_s']:.1f} s; up to {task.on_time:.1f} s is on time.",
        )
    yield from _belief(record)
    if estimator := record.get("estimator"):
        yield from (Statement("mixed", f"Estimator: {trouble}.") for trouble in estimator["troubles"])
    yield from _pace(record, task.period)


def _belief(record: Mapping[str, Any]) -> Iterator[Statement]:
    if record["belief"]:
        estimator, truth = record.get("estimator") or {}, record["truth"]
        sd = estimator.get("sd", {})
        values = [
            f"{name} {value:.3g}"
            + (f" ± {sd[name]:.2g}" if name in sd else "")
            + (f" ({truth[name]:.3g})" if name in truth else "")
            for name, value in record["belief"].items()
        ]
        about = "Belief (truth)" if truth else "Belief"
        learnt = not estimator or estimator["marks"].get("updated") or estimator["marks"].get("jump")
        why = "" if learnt else "; no window has changed it yet"
        yield Statement("good" if learnt else "mixed", f"{about} at the end: {', '.join(values)}{why}.")


def _pace(record: Mapping[str, Any], period: float) -> Iterator[Statement]:
    """A warning if some cycles take longer than the control period."""
    slow = record["cycle_ms"]["p99"]
    if slow is None or slow <= 1e3 * period:
        return
    late = record["deadline_misses"]
    effect = (
        "The simulation waits for each plan (lock-step); a robot would not."
        if record["lock_step"]
        else f"{late} of {record['cycles'] + late} periods went on with an older plan."
    )
    yield Statement(
        "mixed",
        f"One cycle in a hundred took longer than {slow:.0f} ms; the control period is {1e3 * period:g} ms. "
        f"{effect}",
    )


def measure_table(record: Mapping[str, Any]) -> Table:
    """The numbers of a run, with their units."""
    ms = record["cycle_ms"]
    rows = [
        ("time", number(record["time_s"], "{:.2f}"), "s"),
        ("distance of the box from its goal", number(record["goal_error_m"], "{:.3f}"), "m"),
        ("speed error, rms", number(record["speed_rmse"], "{:.3f}"), "m/s"),
        ("path error, rms", number(record["path_rmse_m"], "{:.3f}"), "m"),
        ("cost J", number(record["cost"], "{:,.0f}"), ""),
        ("cycle time, median", number(ms["p50"], "{:.1f}"), "ms"),
        ("cycle time, 99th percentile", number(ms["p99"], "{:.1f}"), "ms"),
    ]
    if not record["lock_step"]:
        rows.append(("missed deadlines", str(record["deadline_misses"]), ""))
        mean = record["rollouts"] / max(1, record["cycles"])
        rows.append(("rollouts of a cycle, mean (least)", f"{mean:.1f} ({record['least_rollouts']})", ""))
    rows.append(("diverged rollouts", f"{record['diverged']:,} of {record['rollouts']:,}", ""))
    if estimator := record.get("estimator"):
        used = sum(estimator["marks"].get(mark, 0) for mark in ("updated", "jump"))
        rows += [
            ("windows used by the estimator", f"{used} of {estimator['updates']}", ""),
            ("update time, median", number(estimator["update_ms"]["p50"], "{:.0f}"), "ms"),
        ]
    return Table(("measure", "value", "unit"), ("", STRONG, "unit"), rows)


def number(value: float | None, form: str) -> str:
    """A number in a format of `str.format`, or a dash where there is none."""
    return numbers.MISSING if value is None else form.format(value)


def _sections(
    task: TaskFacts, columns: Mapping[str, FloatArray], record: Mapping[str, Any]
) -> Iterator[Section]:
    if columns:
        yield Section("From above", text="; ".join(task.changes), figure=path_figure(columns, task.floor))
        yield Section("Motion", figure=motion_figure(columns))
        yield Section("Belief", figure=belief_figure(columns, task.units))
    states = (
        "All numbers are computed from the true states of the simulation, which the controller never sees."
        if record["truth"]
        else "All numbers are computed from the states that the robot's sensors and motion capture measure; "
        "the true states are not known."
    )
    yield Section(
        "Numbers",
        table=measure_table(record),
        note=f"{states} J is the sum of the running cost at 50 Hz; if the box does not arrive, its last "
        "value is charged until the task's time is over.",
    )


Columns: TypeAlias = Mapping[str, FloatArray]

#: Outlines of the box along its path.
_OUTLINES = 5


def path_figure(c: Columns, floor: Floor) -> Markup:
    """From above: the path and the goal, and the tracks of box and robot, or of the foot that pushes."""
    rows = np.linspace(0, c["time"].size - 1, _OUTLINES).astype(int)
    boxes = [
        outline(np.array([c["box_x"][row], c["box_y"][row]]), float(c["box_yaw"][row]), floor.footprint)
        for row in rows
    ]
    goal = outline(floor.path[-1], floor.goal_yaw, floor.footprint)
    lines = [
        Curve(floor.path[:, 0], floor.path[:, 1], "path", "soft", "dashed"),
        *(Curve(*box, "", "amber", "area") for box in boxes),
        Curve(*goal, "goal of the box", "green", "area"),
        Curve(c["trunk_x"], c["trunk_y"], "robot", "after"),
        Curve(c["box_x"], c["box_y"], "box", "amber"),
    ]
    lines += [Curve(c["foot_x"], c["foot_y"], "front right foot", "ink")] if floor.one_leg else []
    other = [] if floor.other_floor is None else [(floor.other_floor, max(one.x.max() for one in lines))]
    marks = [Mark(ends, "other floor", "good") for ends in other] + [Mark(x, "change") for x in floor.marks]
    return figure([Panel("y [m]", lines, x="x [m]", marks=marks, equal=True)], 1)


def motion_figure(c: Columns) -> Markup:
    """Over time: speed and command, distance from the goal, distance from the path."""
    time, marks = c["time"], list(_changes(c))
    speed = [
        Curve(time, c["speed"], "robot"),
        Curve(time, c["command"], "commanded speed", "before", "dashed"),
    ]
    goal, left = (Curve(time, values, "box", "amber") for values in (c["to_goal"], 1e3 * c["left"]))
    return figure(
        [
            Panel("forward speed of the robot", speed, "m/s", marks=marks),
            Panel("box from the goal", [goal], "m", marks=marks, low=0.0),
            Panel("box left of its path", [left], "mm", marks=[*marks, Mark(0.0, axis="y")]),
        ]
    )


def belief_figure(c: Columns, units: Mapping[str, str]) -> Markup:
    """Each parameter over time, as the controller believed it and as it was."""
    panels, time = [], c["time"]
    for name in (key.removeprefix("belief/") for key in c if key.startswith("belief/")):
        believed, true = c[f"belief/{name}"], c.get(f"truth/{name}")
        band = (c[f"lower/{name}"], c[f"upper/{name}"]) if f"lower/{name}" in c else None
        lines = [] if true is None else [Curve(time, true, "true", "ink", "step")]
        text = "believed, with its 90 % interval" if band else "believed"
        lines.append(Curve(time, believed, text, "after", "step", band))
        highest = max(float(np.nanmax(one.y)) for one in lines)
        low = 0.0 if min(float(np.nanmin(one.y)) for one in lines) > 0.0 else None
        most = 2.0 * highest if low is not None and band and np.nanmax(band[1]) > 2.0 * highest else None
        panels.append(Panel(name, lines, numbers.unit_of(units.get(name, "")), low=low, high=most))
    return figure(panels)


def _changes(c: Columns) -> Iterator[Mark]:
    """A dotted line wherever a true parameter changes."""
    for name, values in c.items():
        if name.startswith("truth/"):
            for row in np.flatnonzero(np.diff(values)):
                yield Mark(float(c["time"][row + 1]), "change of box or floor")
