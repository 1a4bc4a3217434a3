"""Which kind of probe a system needs."""

from __future__ import annotations

import os

from amhe_cli.assembly import DEFAULT_SYSTEM
from amhe_cli.go1.model import SYSTEM
from amhe_cli.probing.drive import DriveProbe
from amhe_cli.probing.probe import Probe, ProbeOptions
from amhe_cli.probing.push import PushProbe
from amhe_cli.system import overrides
from amhe_cli.system.load import find_system


def open_probe(options: ProbeOptions) -> Probe:
    """A walking robot behind its box, or actuators that are driven as they are.

    Raises:
        ConfigError: Unknown system or task, nothing to drive, a belief, plant or setting that does not suit.
    """
    folder = find_system(options.system or DEFAULT_SYSTEM)
    if folder.resolve() == find_system(SYSTEM).resolve():
        return PushProbe(options)
    return DriveProbe(options, folder, overrides.gathered(options.config, os.environ, options.assignments))
