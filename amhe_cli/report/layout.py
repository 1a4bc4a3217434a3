"""A layout of Foxglove and Lichtblick for a log: JSON, by the type LayoutData of Lichtblick's suite-base."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from amhe_cli.core.errors import ConfigError, LogError, one_of
from amhe_cli.core.signals import QUANTITIES, Signal
from amhe_cli.core.text import printable
from amhe_cli.logs import Inspection, TopicSurvey
from amhe_cli.logs.containers.table_file import clock_among
from amhe_cli.logs.messages.types import TYPES, TypeInfo

#: Viewers with layouts; those of Foxglove are Lichtblick's, too.
VIEWERS = ("foxglove",)
#: Curves of a plot: more than that nobody can read.
MOST_CURVES = 12
#: Plots of a topic.
MOST_PLOTS = 8

#: Last part of the types that 3-D panels show.
_SPATIAL = (
    "FrameTransform", "FrameTransforms", "Marker", "MarkerArray", "Path", "PointCloud", "PointCloud2",
    "PoseArray", "PoseInFrame", "PoseStamped", "PoseWithCovarianceStamped", "PosesInFrame", "SceneUpdate",
    "TFMessage", "tfMessage",
)  # fmt: skip
#: Share of the window that the 3-D panel takes [%].
_SPATIAL_SHARE = 45
#: A name that stands in a message path without quotes.
_PLAIN = re.compile(r"[\w-]+(\[\d+\])?\Z", re.ASCII)

#: Path of a number in a message, such as 'position[0]', and what people call it.
Curve = tuple[str, str]


def layout_of(found: Inspection, viewer: str) -> str:
    """The text of a layout for a log that was looked through.

    It has a 3-D panel where there is something to see in it, and a tab of plots for each topic; those of the
    system's signals come first.

    Raises:
        ConfigError: There is no such viewer.
        LogError: The log holds nothing that can be plotted or shown in three dimensions.
    """
    if viewer not in VIEWERS:
        raise ConfigError(one_of("viewer", viewer, VIEWERS))
    read: dict[str, list[Signal]] = {}
    for check in found.checks:
        read.setdefault(check.signal.topic, []).append(check.signal)
    order = {topic: rank for rank, topic in enumerate(read)}
    survey = [topic for topic in found.survey.topics if topic.count and topic.problem is None]
    survey.sort(key=lambda topic: (order.get(topic.name, len(order)), topic.name))
    panels: dict[str, dict[str, Any]] = {}
    tabs = []
    for topic in survey:
        plots = list(_plots(topic, read.get(topic.name, ())))[:MOST_PLOTS]
        names = [f"Plot!t{len(tabs)}p{row}" for row in range(len(plots))]
        panels |= zip(names, plots, strict=True)
        tabs += [{"title": topic.name, "layout": _stacked(names)}] if names else []
    shown: list[str] = []
    if spatial := [topic for topic in survey if _is_spatial(topic)]:
        panels["3D!scene"] = _scene(spatial)
        shown.append("3D!scene")
    if tabs:
        panels["Tab!topics"] = {"activeTabIdx": 0, "tabs": tabs}
        shown.append("Tab!topics")
    if not shown:
        raise LogError(f"{found.survey.path}: no topic of it can be plotted; `amhe inspect` says why")
    both = {"direction": "row", "first": shown[0], "second": shown[-1], "splitPercentage": _SPATIAL_SHARE}
    layout = {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": both if len(shown) == 2 else shown[0],
    }
    return json.dumps(layout, indent=2) + "\n"


def _is_spatial(topic: TopicSurvey) -> bool:
    return topic.type.replace("/", ".").split(".")[-1] in _SPATIAL


def _plots(topic: TopicSurvey, signals: Sequence[Signal]) -> Iterator[dict[str, Any]]:
    """The plots of a topic, at most MOST_CURVES curves each."""
    for quantity, curves in _curves(topic, signals).items():
        unit = QUANTITIES.get(quantity, "-")
        what = printable(f"{topic.name} {quantity}".strip())
        title = what if unit in ("-", "any") else f"{what} [{unit}]"
        for start in range(0, len(curves), MOST_CURVES):
            yield _plot(topic, title, curves[start : start + MOST_CURVES])


def _plot(topic: TopicSurvey, title: str, curves: Sequence[Curve]) -> dict[str, Any]:
    paths = [
        {
            "value": _message_path(topic, path),
            "label": label,
            "enabled": True,
            "timestampMethod": "receiveTime",
        }
        for path, label in curves
    ]
    return {
        "paths": paths,
        "showXAxisLabels": True,
        "showYAxisLabels": True,
        "showLegend": True,
        "legendDisplay": "floating",
        "showPlotValuesInLegend": False,
        "isSynced": True,
        "xAxisVal": "timestamp",
        "sidebarDimension": 240,
        "foxglovePanelTitle": title,
        "lichtblickPanelTitle": title,
    }


def _message_path(topic: TopicSurvey, path: str) -> str:
    """A message path such as '/joint_states.position[0]'; names with other characters stand in quotes.

    The rows of a table are messages on '/table', as `convert` writes them.
    """
    table = topic.encoding == "table"
    name = f"/{topic.name.strip('/')}" if table else topic.name
    head = name if re.fullmatch(r"[\w/-]+", name, re.ASCII) else json.dumps(name, ensure_ascii=False)
    steps = [path] if table else path.split(".")
    return ".".join((head, *(step if _PLAIN.match(step) else json.dumps(step) for step in steps)))


def _scene(spatial: Sequence[TopicSurvey]) -> dict[str, Any]:
    """A 3-D panel with everything that has a place; transforms need no entry, but their frames do no harm."""
    ours = any(topic.type.endswith("SceneUpdate") and topic.name.startswith("/amhe/") for topic in spatial)
    return {
        "cameraState": {
            "perspective": True, "distance": 3.5, "phi": 65, "thetaOffset": 35, "targetOffset": [0, 0, 0],
            "target": [0, 0, 0], "targetOrientation": [0, 0, 0, 1], "fovy": 45, "near": 0.05, "far": 5000,
        },
        "followMode": "follow-none",
        **({"followTf": "world"} if ours else {}),
        "scene": {},
        "transforms": {},
        "topics": {topic.name: {"visible": True} for topic in spatial},
        "layers": {"grid": {"layerId": "foxglove.Grid", "instanceId": "grid", "visible": True, "order": 1}},
        "publish": {},
        "imageMode": {},
    }  # fmt: skip


def _stacked(names: list[str]) -> Any:
    """Panels one below the other, of equal height."""
    if len(names) == 1:
        return names[0]
    share = round(100 / len(names), 2)
    return {"direction": "column", "first": names[0], "second": _stacked(names[1:]), "splitPercentage": share}


def _curves(topic: TopicSurvey, signals: Sequence[Signal]) -> Mapping[str, list[Curve]]:
    """Quantity, or path of a part of the messages -> its curves."""
    info = TYPES.get(topic.type)
    fields = {quantity: paths for signal in signals for quantity, paths in signal.fields.items()}
    if topic.encoding == "table":
        columns = [_column(entry) for entry in topic.entries]
        clock = clock_among(dict(columns))
        shown = [column for column in columns if column[0] not in ("", clock)]
        return {"": [curve for name, count in shown for curve in _expanded(name, count)]}
    if fields:
        return {
            quantity: [curve for path in paths for curve in _expanded(path, topic.paths.get(path))]
            for quantity, paths in fields.items()
        }
    if info is None:
        groups: dict[str, list[Curve]] = {}
        for path, count in topic.paths.items() if not _is_spatial(topic) else ():
            groups.setdefault(path.rpartition(".")[0], []).extend(_expanded(path, count))
        return groups
    if info.names is None and info.elements is not None:
        return {}  # transforms, which the 3-D panel shows too
    return {quantity: list(_built_in(topic, info, quantity)) for quantity in topic.quantities}


def _built_in(topic: TopicSurvey, info: TypeInfo, quantity: str) -> Iterator[Curve]:
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
        yield path, printable(name)


def _expanded(path: str, count: int | None) -> list[Curve]:
    paths = [path] if count is None else [f"{path}[{row}]" for row in range(count)]
    return [(path, printable(path)) for path in paths]


def _column(entry: str) -> tuple[str, int | None]:
    """Name and size of the column 'positions[6]'; None for one number."""
    name, opened, size = entry.removesuffix("]").rpartition("[")
    return (name, int(size)) if opened and entry.endswith("]") and size.isdigit() else (entry, None)
