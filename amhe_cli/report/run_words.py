"""What the numbers of a run mean, in words: for the terminal and the page alike."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from amhe_cli.report import numbers
from amhe_cli.robots.go1.judge import CLOSE_ENOUGH, ON_TIME
from amhe_cli.robots.go1.tasks import Task

#: Terms of the running cost, as a reader knows them.
TERMS = {
    "box_speed": "speed of the box",
    "robot_speed": "speed of the robot",
    "box_left": "box beside its path",
    "robot_left": "robot beside the box",
    "yaw": "heading of the robot",
    "box_yaw": "heading of the box",
    "height": "height of the trunk",
    "tilt": "tilt of the trunk",
    "box_tilt": "tilt of the box",
    "knots": "plan off the reference",
}


def verdict(record: Mapping[str, Any]) -> tuple[str, str]:
    """How the run ended: good, mixed or bad, and in words."""
    if record["error"]:
        return "bad", f"stopped: {record['error']}"
    if record["fell"]:
        return "bad", "the robot fell"
    if record["interrupted"]:
        return "mixed", "interrupted: these are the numbers up to there"
    if record["success"] and not record["arrived"]:
        return "good", f"success: close enough to the goal, though not at it in {record['duration']:g} s"
    if record["success"]:
        return "good", "success, on time" if record["on_time"] else "success, but late"
    if record["cut_short"]:
        return "mixed", f"not done in the {record['duration']:g} s that it was given"
    return "bad", "not done: the box is not at its goal, or strayed from its path"


def headline(record: Mapping[str, Any]) -> str:
    """The outcome in one line."""
    text = verdict(record)[1]
    return f"{text[0].upper()}{text[1:]}."


def statements(record: Mapping[str, Any], task: Task, period: float) -> list[tuple[str, str]]:
    """What a reader should know first: tone and sentence."""
    said = []
    if record["goal_error_m"] is not None:
        near = record["goal_error_m"] <= CLOSE_ENOUGH
        text = f"The box is {number(record['goal_error_m'], '{:.3f}')} m from its goal"
        said.append(("good" if near else "mixed", f"{text}; within {CLOSE_ENOUGH:g} m is close enough."))
    if record["success"] and record["arrived"]:
        late = ON_TIME * task.nominal_time
        said.append(
            ("good" if record["on_time"] else "mixed",
             f"It took {record['time_s']:.1f} s; on time is up to {late:.1f} s."),
        )  # fmt: skip
    said += _belief(record)
    if estimator := record.get("estimator"):
        said += [("mixed", f"Estimator: {trouble}.") for trouble in estimator["troubles"]]
    slow = record["cycle_ms"]["p99"]
    if slow is not None and slow > 1e3 * period:
        said.append(
            ("mixed",
             f"One cycle in a hundred took longer than {slow:.0f} ms, and the control period is "
             f"{1e3 * period:g} ms: {_waiting(record)}."),
        )  # fmt: skip
    return said


def _waiting(record: Mapping[str, Any]) -> str:
    """What it means that a cycle takes longer than the control period."""
    if record["lock_step"]:
        return "in lock-step the simulation waits, a robot would not"
    late = record["deadline_misses"]
    return f"{late} of {record['cycles'] + late} periods went on with an older plan"


def _belief(record: Mapping[str, Any]) -> list[tuple[str, str]]:
    truth = record["truth"]
    wrong = [
        f"{name} {value:.3g} for {truth[name]:.3g}"
        for name, value in record["belief"].items()
        if name in truth and abs(value - truth[name]) > 0.02 * abs(truth[name])
    ]
    return [("mixed", f"At the end the controller believed {' and '.join(wrong)}.")] if wrong else []


def changes(task: Task) -> list[str]:
    """What changes on the way, in words."""
    told = []
    for change in task.changes:
        where = (
            f"at {change.at_time:g} s" if change.at_time is not None else f"from x = {change.beyond_x:g} m"
        )
        if change.mass is not None:
            told.append(f"{where}: box of {change.mass:g} kg")
        if change.floor_friction is not None:
            told.append(f"{where}: floor friction {change.floor_friction:g}")
    return told


def is_failure(record: Mapping[str, Any]) -> bool:
    """Whether the run failed: a fall, an error, or the task not done though it had all its time."""
    return verdict(record)[0] == "bad"


def measures(record: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Name, value and unit of what matters."""
    ms = record["cycle_ms"]
    rows = [
        ("time", number(record["time_s"], "{:.2f}"), "s"),
        ("box from the goal", number(record["goal_error_m"], "{:.3f}"), "m"),
        ("speed error, rms", number(record["speed_rmse"], "{:.3f}"), "m/s"),
        ("path error, rms", number(record["path_rmse_m"], "{:.3f}"), "m"),
        ("cost J", number(record["cost"], "{:,.0f}"), ""),
        ("time of a cycle, median", number(ms["p50"], "{:.1f}"), "ms"),
        ("time of a cycle, 99 %", number(ms["p99"], "{:.1f}"), "ms"),
    ]
    if not record["lock_step"]:
        rows.append(("deadlines missed", str(record["deadline_misses"]), ""))
    rows.append(("rollouts diverged", f"{record['diverged']:,} of {record['rollouts']:,}", ""))
    if estimator := record.get("estimator"):
        took = number(estimator["update_ms"]["p50"], "{:.0f}")
        moved = sum(estimator["marks"].get(mark, 0) for mark in ("updated", "jump"))
        rows += [
            ("windows that moved the belief", f"{moved} of {estimator['updates']}", ""),
            ("time of an update, median", took, "ms"),
        ]
    return rows


def number(value: float | None, form: str) -> str:
    """A number, or a dash where there is none."""
    return numbers.MISSING if value is None else form.format(value)
