"""A layout of PlotJuggler: one XML file for the versions 3 and 4.

Version 3 finds a curve by its whole name, version 4 by topic and field; each skips what it does not know.
"""

from __future__ import annotations

from itertools import cycle
from xml.etree import ElementTree

from amhe_cli.core.text import printable
from amhe_cli.report.layouts.panels import Curve, Panels, TopicPlots

_COLORS = ("#1f77b4", "#d62728", "#1ac938", "#ff7f0e", "#f14cc1", "#9467bd", "#17becf", "#bcbd22")


def plotjuggler_layout(panels: Panels) -> str:
    """The layout: a tab for each topic, its plots one below the other."""
    root = ElementTree.Element("root", format="PlotJuggler", pj4_version="4")
    window = ElementTree.SubElement(root, "tabbed_widget", {"parent": "main_window", "name": "Main Window"})
    for number, topic in enumerate(panels.topics):
        about = {"id": f"tab{number}", "tab_name": printable(topic.topic), "containers": "1"}
        tab = ElementTree.SubElement(window, "Tab", about)
        count = len(topic.plots)
        split = {"orientation": "-", "count": str(count), "sizes": ";".join([f"{1 / count:.6f}"] * count)}
        rows = ElementTree.SubElement(ElementTree.SubElement(tab, "Container"), "DockSplitter", split)
        for row, shown in enumerate(topic.plots):
            area = ElementTree.SubElement(rows, "DockArea", id=f"area{number}_{row}", name=shown.title)
            about = {"id": f"plot{number}_{row}", "mode": "TimeSeries", "style": "Lines"}
            plot = ElementTree.SubElement(area, "plot", about | {"flip_x": "false", "flip_y": "false"})
            ElementTree.SubElement(plot, "limitY")
            for curve, color in zip(shown.curves, cycle(_COLORS), strict=False):
                ElementTree.SubElement(plot, "curve", _names(panels, topic, curve) | {"color": color})
    ElementTree.SubElement(window, "currentTabIndex", index="0")
    ElementTree.SubElement(root, "use_relative_time_offset", enabled="1")
    for empty in ("Plugins", "customMathEquations", "snippets"):
        ElementTree.SubElement(root, empty)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode", xml_declaration=True) + "\n"


def _names(panels: Panels, topic: TopicPlots, curve: Curve) -> dict[str, str]:
    """How the two versions call a curve; columns of a table have no topic in version 3."""
    field = printable(curve.named or curve.path.replace(".", "/"))
    if topic.table:
        return {
            "name": printable(curve.path),
            "topic": panels.log.stem,
            "field": printable(curve.path),
        }
    name = printable(topic.topic)
    return {"name": f"{name}/{field}", "topic": name, "field": field}
