"""What a run or a replay recorded of its estimates and its plans, read back from its log."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.curves import TimeCurve
from amhe_cli.logs import Fields, read_topic

#: Numbers of a run -> topic, field and unit.
_RUN = {
    "speed": ("/odom", "twist.twist.linear.x", "m/s"),
    "cost": ("/amhe/plan", "best_cost", ""),
    "cycle time": ("/amhe/timing", "plan_ms", "ms"),
}


def recorded_curves(
    path: Path, start_ns: int, units: Mapping[str, str]
) -> tuple[list[TimeCurve], FloatArray]:
    """Parameters over time with their 90 % bands and other numbers; and the times of jumps [s], shape (j,).

    Args:
        path: `log.mcap` of `amhe run`, or `estimates.mcap` of `amhe mhe-replay`.
        start_ns: The instant from which times are counted [ns].
        units: Name of each parameter -> its unit; empty: it has none.

    Raises:
        LogError: The log cannot be read.
    """
    rows: dict[tuple[str, str], list[tuple[float, ...]]] = defaultdict(list)  # time, value and its band

    def messages(topic: str) -> Iterator[tuple[float, Fields]]:
        return (((stamp - start_ns) / 1e9, fields) for stamp, fields in read_topic(path, topic))

    jumps = []
    for time, fields in messages("/amhe/estimate"):
        for one in _places(fields, "parameters[{}].name"):
            numbers = (float(fields[one.replace("name", part)]) for part in ("value", "lower", "upper"))
            rows["parameters", str(fields[one])].append((time, *numbers))
        rows["estimator", "misfit"].append((time, float(fields["misfit"])))
        if fields["mark"] == "jump":
            jumps.append(time)
    if not rows:  # the belief was fixed
        for time, fields in messages("/amhe/params"):
            for name, value in _believed(fields).items():
                rows["parameters", name].append((time, value))
    for name, (topic, field, _) in _RUN.items():
        rows["run", name] = [(time, float(fields[field])) for time, fields in messages(topic)]
    known = {**units, **{name: unit for name, (_, _, unit) in _RUN.items()}}
    curves = []
    for (group, name), own in rows.items():
        if own:
            times, values, *band = np.array(own).T
            unit = known.get(name, "")
            curves.append(TimeCurve(name, group, unit, times, values, np.array(band) if band else None))
    return curves, np.array(jumps)


def first_belief(path: Path) -> dict[str, float]:
    """The parameters that a run began with, by name; {} where its log has none.

    Args:
        path: `log.mcap` of `amhe run`.

    Raises:
        LogError: The log cannot be read.
    """
    return next((_believed(fields) for _, fields in read_topic(path, "/amhe/params")), {})


def _believed(fields: Fields) -> dict[str, float]:
    """The values in one message of /amhe/params."""
    pairs = ((one, one.replace("name", "position")) for one in _places(fields, "name[{}]"))
    return {str(fields[one]): float(fields[other]) for one, other in pairs if other in fields}


def _places(fields: Fields, place: str) -> Iterator[str]:
    """The paths of a name in each element of an array."""
    return (path for i in range(len(fields)) if (path := place.format(i)) in fields)
