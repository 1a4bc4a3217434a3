"""Calibration of rigid bodies, from poses that a test makes up."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from amhe_cli.core.go1_settings import Go1Settings
from amhe_cli.go1.model import Box
from amhe_cli.go1_link.clock import Clock
from amhe_cli.live.go1_calibration import Calibration
from amhe_cli.poses.feed import TimedPose
from amhe_cli.poses.source import PoseError

NOTHING: Any = SimpleNamespace(connect=lambda: None, samples=list)


class Cameras:
    """See the trunk so many times a second.

    Args:
        rate: [Hz].
    """

    def __init__(self, rate: float) -> None:
        self._clock, self._period = Clock(), 1.0 / rate
        self._last = self._clock.now()

    def first(self) -> dict[str, TimedPose]:
        return {}

    def poses(self) -> list[TimedPose]:
        new = int((self._clock.now() - self._last) / self._period)
        self._last += new * self._period
        return [TimedPose("go1", 0.0, np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))] * new


def test_a_look_too_short_for_slow_cameras_says_so() -> None:
    cameras: Any = Cameras(rate=10.0)
    calibration = Calibration(NOTHING, cameras, Go1Settings(), Clock(), Box())
    with pytest.raises(PoseError, match=r"\d poses of 'go1' came in 0.5 s, and 20 are needed: look longer"):
        calibration.offsets(lambda text: None, 0.5)
