"""Options of the commands that listen to a running system."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import click

from amhe_cli.cli import options, parsing

#: Where messages come from.
where = parsing.stacked(
    click.option(
        "--source",
        metavar="SOURCE",
        required=True,
        help="ros2; zenoh; mcap, with --follow; udp://HOST:PORT or - (stdin): lines of JSON; or a LOG, which "
        "is played. See docs/watch.md.",
    ),
    click.option(
        "--follow",
        type=click.Path(path_type=Path),
        metavar="FILE",
        help="mcap: a file that a recorder still writes, or the folder that it writes to.",
    ),
    options.setting(
        "live.domain",
        type=parsing.WholeNumber(0, 232),
        metavar="N",
        envvar="ROS_DOMAIN_ID",
        help="ros2, zenoh: ROS_DOMAIN_ID of the robot.  [default: ROS_DOMAIN_ID, or 0]",
    ),
    options.setting(
        "live.peers",
        metavar="ADDRESS,ADDRESS",
        help="ros2: look for the robot at these addresses, without multicast.",
    ),
    options.setting(
        "live.connect",
        metavar="ENDPOINT",
        help="zenoh: the router.  [default: tcp/localhost:7447]",
    ),
)


def for_seconds(about: str) -> Callable[[parsing.F], parsing.F]:
    """How long a command listens [s]; None: until it is stopped."""
    kind = parsing.Number(min=0, min_open=True)
    return click.option("--for", "seconds", type=kind, metavar="S", help=about)
