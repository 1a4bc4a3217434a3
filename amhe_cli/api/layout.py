"""A layout that opens a log in a viewer."""

from __future__ import annotations

from pathlib import Path

from amhe_cli.logs.read import inspect_log
from amhe_cli.report.layout import layout_of
from amhe_cli.system.system import System


def layout(
    path: str | Path,
    viewer: str = "foxglove",
    system: System | None = None,
    *,
    msg_path: str | Path | None = None,
) -> str:
    """Make a layout for a viewer of logs: plots of each topic, and a 3-D panel where there are poses.

    Args:
        path: The log.
        viewer: 'foxglove', for Lichtblick too.
        system: System whose topics come first; of types that are not built in, only its fields are plotted.
        msg_path: Folder of .msg files for types that the log does not define.

    Returns:
        The content of the layout's file, JSON.

    Raises:
        ConfigError: The path does not exist, or there is no such viewer.
        LogError: It is no log, or nothing of it can be plotted.
    """
    found = inspect_log(Path(path), system, msg_path=None if msg_path is None else Path(msg_path))
    return layout_of(found, viewer)
