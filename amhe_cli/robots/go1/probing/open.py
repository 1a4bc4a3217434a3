"""Which kind of probe a system needs."""

from __future__ import annotations

import os
from pathlib import Path

from amhe_cli.assembly import DEFAULT_SYSTEM
from amhe_cli.core.errors import ConfigError
from amhe_cli.estimation.design.drive import DriveProbe
from amhe_cli.estimation.design.probe import Probe, ProbeOptions
from amhe_cli.robots.go1.model import SYSTEM
from amhe_cli.robots.go1.probing.motions import STEADY
from amhe_cli.robots.go1.probing.push import PushProbe
from amhe_cli.robots.go1.probing.robot import Go1OnLink
from amhe_cli.robots.go1.run import Run
from amhe_cli.system import overrides
from amhe_cli.system.load import find_system


def open_probe(options: ProbeOptions, robot: Go1OnLink | None = None) -> Probe:
    """A walking robot behind its box, or actuators that are driven as they are.

    Args:
        options: As given.
        robot: To probe in place of a simulation.

    Raises:
        ConfigError: Unknown system or task, nothing to drive, a belief, plant or setting that does not suit.
    """
    folder = _driven(options, robot)
    if folder is None:
        return PushProbe(options, robot)
    return DriveProbe(options, folder, overrides.gathered(options.config, os.environ, options.assignments))


def _driven(options: ProbeOptions, robot: Go1OnLink | None) -> Path | None:
    """Folder of the system that is driven as it is, or None: the Go1 walks. Refuses what a system has not."""
    folder = find_system(options.system or DEFAULT_SYSTEM)
    if folder.resolve() == find_system(SYSTEM).resolve():
        return None
    for flag, value in (("--box", options.box), ("--task", options.task)):
        if value:
            raise ConfigError(f"{flag}: {options.system} has none; leave it out")
    if robot:
        raise ConfigError(f"--target go1 pushes boxes: leave out --system {options.system}")
    return folder


def robot_to_probe(options: ProbeOptions, robot: Go1OnLink) -> Run:
    """The robot behind the box that it is to probe, for checks; nothing is sent yet.

    Raises:
        ConfigError: See `open_probe`.
    """
    _driven(options, robot)
    return PushProbe(options, robot).on_robot(STEADY, options.seconds, robot)
