"""What a viewer should show of a log: plots of each topic, and what has a place in three dimensions."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from amhe_cli.core.signals import QUANTITIES, Signal
from amhe_cli.core.text import printable
from amhe_cli.logs import Inspection, TopicSurvey
from amhe_cli.logs.containers.table_file import clock_of
from amhe_cli.logs.containers.text_dialect import Column
from amhe_cli.logs.messages.types import TYPES, TypeInfo

#: Curves of a plot, and plots of a topic: more than that nobody can read.
MOST_CURVES, MOST_PLOTS = 12, 8


@dataclass(frozen=True, slots=True)
class Curve:
    """One number of each message of a topic.

    Args:
        path: Its path in a message, such as 'position[0]'.
        label: What people call it.
        named: Its path where a viewer puts the names of joints into it, as PlotJuggler does; '': as `path`.
    """

    path: str
    label: str
    named: str = ""


@dataclass(frozen=True, slots=True)
class Plot:
    """Curves of one quantity over time, with its unit."""

    title: str
    quantity: str
    curves: tuple[Curve, ...]


@dataclass(frozen=True, slots=True)
class TopicPlots:
    """The plots of one topic.

    Args:
        topic: Name of the topic.
        kind: Type of its messages.
        table: Its messages are rows of a table.
        plots: Its plots.
    """

    topic: str
    kind: str
    table: bool
    plots: tuple[Plot, ...]


@dataclass(frozen=True, slots=True)
class Panels:
    """What to show of a log.

    Args:
        log: The log's file.
        topics: Topics with plots; those that the system reads come first.
        spatial: Topics that a 3-D panel can show.
        fixed_frame: The frame that stays still there; '' where the log does not say.
    """

    log: Path
    topics: tuple[TopicPlots, ...] = ()
    spatial: tuple[str, ...] = ()
    fixed_frame: str = ""


#: Last part of the types that 3-D panels show.
_SPATIAL = (
    "FrameTransform", "FrameTransforms", "Marker", "MarkerArray", "Path", "PointCloud", "PointCloud2",
    "PoseArray", "PoseInFrame", "PoseStamped", "PoseWithCovarianceStamped", "PosesInFrame", "SceneUpdate",
    "TFMessage", "tfMessage",
)  # fmt: skip


def panels_of(found: Inspection) -> Panels:
    """The panels of a log that was looked through, with those of a system's signals first."""
    read: dict[str, list[Signal]] = {}
    for check in found.checks:
        read.setdefault(check.signal.topic, []).append(check.signal)
    order = {topic: rank for rank, topic in enumerate(read)}
    survey = [topic for topic in found.survey.topics if topic.count and topic.problem is None]
    survey.sort(key=lambda topic: (order.get(topic.name, len(order)), topic.name))
    plots = [
        TopicPlots(topic.name, topic.type, topic.encoding == "table", shown)
        for topic in survey
        if (shown := tuple(_plots(topic, read.get(topic.name, ())))[:MOST_PLOTS])
    ]
    spatial = [topic for topic in survey if _is_spatial(topic)]
    ours = any(topic.type.endswith("SceneUpdate") and topic.name.startswith("/amhe/") for topic in spatial)
    names = tuple(topic.name for topic in spatial)
    return Panels(found.survey.path, tuple(plots), names, "world" if ours else "")


def _is_spatial(topic: TopicSurvey) -> bool:
    return topic.type.replace("/", ".").split(".")[-1] in _SPATIAL


def _plots(topic: TopicSurvey, signals: Sequence[Signal]) -> Iterator[Plot]:
    """The plots of a topic, at most MOST_CURVES curves each."""
    for quantity, curves in _curves(topic, signals).items():
        unit = QUANTITIES.get(quantity, "-")
        what = printable(f"{topic.name} {quantity}".strip())
        title = what if unit in ("-", "any") else f"{what} [{unit}]"
        for start in range(0, len(curves), MOST_CURVES):
            yield Plot(title, quantity, tuple(curves[start : start + MOST_CURVES]))


def _curves(topic: TopicSurvey, signals: Sequence[Signal]) -> Mapping[str, list[Curve]]:
    """Quantity, or path of a part of the messages -> its curves."""
    info = TYPES.get(topic.type)
    fields = {quantity: paths for signal in signals for quantity, paths in signal.fields.items()}
    if topic.encoding == "table":
        columns = [_column(entry) for entry in topic.entries]
        clock = clock_of([Column(name, "number" if count is None else "array") for name, count in columns])
        shown = [column for row, column in enumerate(columns) if row != clock and column[0]]
        return {"": [one for name, count in shown for one in _expanded(name, count)]}
    if fields:
        return {
            q: [one for p in paths for one in _expanded(p, topic.paths.get(p))] for q, paths in fields.items()
        }
    if info is None and _is_spatial(topic):
        return {}
    if info is None:
        groups: dict[str, list[Curve]] = {}
        for path, count in topic.paths.items():
            groups.setdefault(path.rpartition(".")[0], []).extend(_expanded(path, count))
        return groups
    if info.names is None and info.elements is not None:
        return {}  # transforms, which the 3-D panel shows too
    return {quantity: list(_known(topic, info, quantity)) for quantity in topic.quantities}


def _known(topic: TopicSurvey, info: TypeInfo, quantity: str) -> Iterator[Curve]:
    """The curves of a quantity of a built-in type."""
    if info.names is None:
        sizes = [int(entry[1:-1]) for entry in topic.entries if entry.startswith("[")]
        for path in info.fields[quantity]:
            yield from _expanded(path, sizes[0] if sizes else None)
        return
    head = f"{info.elements}[0]." if info.elements else ""
    for row, name in enumerate(topic.entries):
        path = f"{head}{info.fields[quantity][0]}[{row}]"
        if topic.type.endswith("JointStates"):
            path = f"joints[{row}].{quantity}"
        yield Curve(path, printable(name), "" if info.elements else f"{name}/{quantity}")


def _expanded(path: str, count: int | None) -> list[Curve]:
    paths = [path] if count is None else [f"{path}[{row}]" for row in range(count)]
    return [Curve(one, printable(one)) for one in paths]


def _column(entry: str) -> tuple[str, int | None]:
    """Name and size of the column 'positions[6]'; None for one number."""
    name, opened, size = entry.removesuffix("]").rpartition("[")
    return (name, int(size)) if opened and entry.endswith("]") and size.isdigit() else (entry, None)
