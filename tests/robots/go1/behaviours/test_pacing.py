"""Integral action on the walking speed: nothing for a robot that walks as planned, enough for a slow one."""

from __future__ import annotations

import numpy as np
import pytest

from amhe_cli.robots.go1.behaviours.walking import Pacing

PERIOD = 0.02


def paced(pacing: Pacing, efficiency: float, seconds: float, pulse: float = 0.0, start: float = 0.0) -> float:
    """Share asked for by the end, of a robot that reaches so much of what it is asked, in pulses."""
    for k in range(round(seconds / PERIOD)):
        time = start + k * PERIOD
        reached = efficiency * (1.0 + pacing.share) + pulse * np.sin(2.0 * np.pi * time / 0.4)
        pacing.update(time, 1.0 - reached)
    return pacing.share


def test_a_slow_robot_is_asked_for_more_until_it_is_nearly_fast_enough() -> None:
    pacing = Pacing()
    share = paced(pacing, 0.75, 30.0)
    assert 0.75 * (1.0 + share) == pytest.approx(1.0 - pacing.free, abs=0.01)
    assert paced(Pacing(), 0.3, 60.0) == Pacing().limit


def test_the_pulse_of_a_trot_is_no_missing_speed() -> None:
    assert abs(paced(Pacing(), 0.98, 20.0, pulse=0.4)) < 0.01


def test_what_was_asked_too_much_is_taken_back() -> None:
    pacing = Pacing(share=0.2)
    assert paced(pacing, 1.0, 20.0) < 0.02


def test_a_pause_counts_for_nothing() -> None:
    pacing = Pacing()
    pacing.update(0.0, 1.0)
    pacing.update(1000.0, 1.0)
    assert pacing.share < 0.01
