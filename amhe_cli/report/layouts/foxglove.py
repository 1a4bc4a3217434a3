"""A layout of Foxglove and Lichtblick: JSON, by the type LayoutData of Lichtblick's suite-base."""

from __future__ import annotations

import json
import re
from typing import Any

from amhe_cli.report.layouts.panels import Panels, Plot, TopicPlots

#: Share of the window that the 3-D panel takes [%].
_SPATIAL_SHARE = 45
#: A name that stands in a message path without quotes.
_PLAIN = re.compile(r"[\w-]+(\[\d+\])?\Z", re.ASCII)


def foxglove_layout(panels: Panels) -> str:
    """The layout: a 3-D panel where there is something to see in it, and a tab of plots for each topic."""
    found: dict[str, dict[str, Any]] = {}
    tabs = []
    for number, topic in enumerate(panels.topics):
        names = [f"Plot!t{number}p{row}" for row in range(len(topic.plots))]
        found |= {name: _plot(topic, plot) for name, plot in zip(names, topic.plots, strict=True)}
        tabs.append({"title": topic.topic, "layout": _stacked(names)})
    shown: list[str] = []
    if panels.spatial:
        found["3D!scene"] = _scene(panels)
        shown.append("3D!scene")
    if tabs:
        found["Tab!topics"] = {"activeTabIdx": 0, "tabs": tabs}
        shown.append("Tab!topics")
    both = {"direction": "row", "first": shown[0], "second": shown[-1], "splitPercentage": _SPATIAL_SHARE}
    layout = {
        "configById": found,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": both if len(shown) == 2 else shown[0],
    }
    return json.dumps(layout, indent=2) + "\n"


def _plot(topic: TopicPlots, plot: Plot) -> dict[str, Any]:
    paths = [
        {
            "value": message_path(topic, curve.path),
            "label": curve.label,
            "enabled": True,
            "timestampMethod": "receiveTime",
        }
        for curve in plot.curves
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
        "foxglovePanelTitle": plot.title,
        "lichtblickPanelTitle": plot.title,
    }


def message_path(topic: TopicPlots, path: str) -> str:
    """A message path such as '/joint_states.position[0]'; names with other characters stand in quotes.

    The rows of a table are messages on '/table', as `convert` writes them.
    """
    name = f"/{topic.topic.strip('/')}" if topic.table else topic.topic
    head = name if re.fullmatch(r"[\w/-]+", name, re.ASCII) else json.dumps(name, ensure_ascii=False)
    steps = [path] if topic.table else path.split(".")
    return ".".join((head, *(step if _PLAIN.match(step) else json.dumps(step) for step in steps)))


def _scene(panels: Panels) -> dict[str, Any]:
    """A 3-D panel with everything that has a place; transforms need no entry, but their frames do no harm."""
    frame = {"followTf": panels.fixed_frame} if panels.fixed_frame else {}
    return {
        "cameraState": {
            "perspective": True, "distance": 3.5, "phi": 65, "thetaOffset": 35, "targetOffset": [0, 0, 0],
            "target": [0, 0, 0], "targetOrientation": [0, 0, 0, 1], "fovy": 45, "near": 0.05, "far": 5000,
        },
        "followMode": "follow-none",
        **frame,
        "scene": {},
        "transforms": {},
        "topics": {topic: {"visible": True} for topic in panels.spatial},
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
