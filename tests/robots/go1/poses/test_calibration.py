"""Offsets from poses, and what is refused as none."""

from __future__ import annotations

import numpy as np
import pytest

from amhe_cli.core.rotations import exp, multiply
from amhe_cli.robots.go1.poses.calibration import average, check_pivot, offset_of, rigid_body
from amhe_cli.robots.go1.poses.frame import offset_pose
from amhe_cli.robots.go1.poses.source import PoseError

TRUE = (np.array([0.6, 0.1, 0.15]), exp(np.array([0.02, -0.01, 0.4])))
OFFSET = (0.05, -0.02, -0.1, 0.1, 0.2, -1.0)
SIZE = np.array([0.3, 0.5, 0.3])


def test_an_offset_leads_there_and_back() -> None:
    body = rigid_body(TRUE, OFFSET)
    np.testing.assert_allclose(offset_of(body, TRUE), OFFSET, atol=1e-12)
    place, turn = offset_pose(body, offset_of(body, TRUE))
    np.testing.assert_allclose(place, TRUE[0], atol=1e-12)
    np.testing.assert_allclose(turn, TRUE[1], atol=1e-12)


def test_noise_is_averaged_whatever_the_sign_of_the_quaternions() -> None:
    rng = np.random.default_rng(0)
    seen = [
        (
            TRUE[0] + 0.001 * rng.standard_normal(3),
            (-1.0) ** i * multiply(TRUE[1], exp(0.003 * rng.standard_normal(3))),
        )
        for i in range(200)
    ]
    place, turn = average(seen, "box")
    np.testing.assert_allclose(place, TRUE[0], atol=4e-4)
    np.testing.assert_allclose(abs(turn @ TRUE[1]), 1.0, atol=1e-6)


@pytest.mark.parametrize("step", [(np.array([0.02, 0.0, 0.0]), 0.0), (np.zeros(3), 0.05)])
def test_what_moves_is_refused(step: tuple[np.ndarray, float]) -> None:
    moved = (TRUE[0] + step[0], multiply(TRUE[1], exp(np.array([0.0, 0.0, step[1]]))))
    with pytest.raises(PoseError, match="'box' does not stand still"):
        average([TRUE] * 20 + [moved] * 20, "box")


@pytest.mark.parametrize(
    ("place", "message"), [([0.6, 0.15, -0.1], "up axis z"), ([0.0, 0.0, 0.3], "check its name"),
                        ([600.0, 100.0, 150.0], "metres")],
)  # fmt: skip
def test_a_pivot_that_is_elsewhere_is_refused(place: list[float], message: str) -> None:
    with pytest.raises(PoseError, match=message):
        check_pivot((np.array(place), TRUE[1]), TRUE, SIZE, "box")


def test_markers_may_stand_off() -> None:
    check_pivot((np.array([0.6, 0.1, 0.4]), TRUE[1]), TRUE, SIZE, "box")
