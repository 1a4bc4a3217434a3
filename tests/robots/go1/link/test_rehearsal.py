"""What a dry run says of this computer's pace."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from amhe_cli.robots.go1.link.open import pace
from amhe_cli.robots.go1.link.packets import LinkError


def cycles(ms: float, rollouts: int) -> list:
    step = SimpleNamespace(rollouts=rollouts)
    return [SimpleNamespace(plan_ms=ms, plan=SimpleNamespace(step=step))] * 100


def test_a_pace_that_is_held_is_said_in_numbers() -> None:
    found = pace(cycles(14.0, 8) + cycles(17.0, 6), 8, 0.02)
    assert found == "7.0 of 8 rollouts in a cycle (6 at least), 16 ms of 20 ms (99 %: 17 ms)"


def test_a_computer_on_which_the_least_does_not_fit_is_refused_with_the_numbers() -> None:
    with pytest.raises(LinkError, match=r"4 rollouts .* takes 34 ms, the median of 100, .* is 20 ms"):
        pace(cycles(34.0, 4), 8, 0.02)
    assert pace(cycles(34.0, 8), 8, 0.16).endswith("34 ms of 160 ms (99 %: 34 ms)")
