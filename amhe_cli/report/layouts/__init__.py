"""Layouts for log viewers: files that open a log with the right panels."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from amhe_cli.core.errors import ConfigError, LogError, one_of
from amhe_cli.logs import Inspection
from amhe_cli.report.layouts.foxglove import foxglove_layout
from amhe_cli.report.layouts.panels import Panels, panels_of
from amhe_cli.report.layouts.plotjuggler import plotjuggler_layout
from amhe_cli.report.layouts.rerun import rerun_layout

#: Viewer -> what writes its layout.
VIEWERS: Mapping[str, Callable[[Panels], str]] = {
    "foxglove": foxglove_layout,  # of Lichtblick too
    "plotjuggler": plotjuggler_layout,
    "rerun": rerun_layout,
}


def layout_of(found: Inspection, viewer: str) -> str:
    """The text of a layout for a log that was looked through.

    Raises:
        ConfigError: There is no such viewer.
        LogError: The log holds nothing that can be plotted or shown in three dimensions.
    """
    if viewer not in VIEWERS:
        raise ConfigError(one_of("viewer", viewer, VIEWERS))
    panels = panels_of(found)
    if not panels.topics and not panels.spatial:
        raise LogError(f"{found.survey.path}: no topic of it can be plotted; `amhe inspect` says why")
    return VIEWERS[viewer](panels)
