"""A layout of rerun: a Python script, as its blueprints are binary and made by rerun itself."""

from __future__ import annotations

from collections.abc import Iterator

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
    lines = [f"        rrb.Spatial3DView({', '.join(_scene(panels))}),\n"] if panels.spatial else []
    if panels.topics:
        lines.append("        rrb.Tabs(\n")
        lines += [f"            {_tab(topic)},\n" for topic in panels.topics]
        lines.append("        ),\n")
    return _HEAD + "".join(lines) + _TAIL.format(log=ascii(str(panels.log.resolve())))


def _scene(panels: Panels) -> Iterator[str]:
    """Arguments of the 3-D view: rerun draws no scene of foxglove_msgs, so axes of frames do."""
    yield from ('name="3-D"', 'origin="/"')
    if panels.fixed_frame:
        yield f"spatial_information=rrb.SpatialInformation(target_frame={panels.fixed_frame!a})"
    if axes := [topic for topic in panels.spatial if topic.strip("/") in ("tf", "tf_static")]:
        yield f"overrides={{{', '.join(f'{topic!a}: rr.TransformAxes3D(0.2)' for topic in axes)}}}"


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
