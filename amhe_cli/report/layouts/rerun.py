"""A layout of rerun: a Python script, as its blueprints are binary and made by rerun itself."""

from __future__ import annotations

from amhe_cli.report.layouts.panels import Panels, TopicPlots

_HEAD = '''\
"""Shows a log in rerun: python THIS_FILE [LOG]"""

from sys import argv

import rerun as rr
import rerun.blueprint as rrb

blueprint = rrb.Blueprint(
    rrb.Horizontal(
'''
_TAIL = """\
    ),
    collapse_panels=True,
)

if __name__ == "__main__":
    rr.init("amhe", spawn=True)
    rr.log_file_from_path(argv[1] if len(argv) > 1 else {log})
    rr.send_blueprint(blueprint)
"""
#: Types that rerun turns into curves; of others it shows the numbers.
_PLOTTED = ("Imu", "JointState", "Float32", "Float64", "Float64MultiArray")


def rerun_layout(panels: Panels) -> str:
    """The script: a 3-D view where there is something to see in it, and a tab of plots for each topic."""
    lines = ['        rrb.Spatial3DView(name="3-D", origin="/"),\n'] if panels.spatial else []
    if panels.topics:
        lines.append("        rrb.Tabs(\n")
        lines += [f"            {_tab(topic)},\n" for topic in panels.topics]
        lines.append("        ),\n")
    return _HEAD + "".join(lines) + _TAIL.format(log=ascii(panels.log))


def _tab(topic: TopicPlots) -> str:
    entity = topic.topic.strip("/")
    kind = topic.kind.split("/")[-1]
    if kind not in _PLOTTED:
        return f"rrb.DataframeView(name={topic.topic!a}, origin={'/' + entity!a})"
    parts = [f"/{plot.quantity}" for plot in topic.plots] if kind == "JointState" else [""]
    views = [
        f"rrb.TimeSeriesView(name={topic.topic + part!a}, origin={'/' + entity + part!a})"
        for part in dict.fromkeys(parts)
    ]
    return f"rrb.Vertical({', '.join(views)}, name={topic.topic!a})"
