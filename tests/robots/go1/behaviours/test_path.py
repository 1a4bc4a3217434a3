"""Lines and arcs against geometry."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from amhe_cli.core.arrays import FloatArray
from amhe_cli.robots.go1.behaviours.objective import Course, wrapped
from amhe_cli.robots.go1.tasks import find_task

FEW = settings(max_examples=25, deadline=None)

ANGLE = st.floats(-7.0, 7.0)
START = st.tuples(st.floats(-5.0, 5.0), st.floats(-5.0, 5.0))
#: Bends of either sense, from a circle of 0.5 m to one of 20 m, and the line.
CURVATURE = st.one_of(st.just(0.0), st.floats(0.05, 2.0), st.floats(-2.0, -0.05))
#: Share of what leaves the path unambiguous.
SHARE = st.floats(0.0, 1.0)


def beside(path: Course, progress: float, left: float) -> tuple[FloatArray, float]:
    """The point so far along and left of a path, from the circle's centre; and the heading there."""
    x, y = path.start
    if path.curvature == 0.0:
        heading = path.heading
        foot = np.array([x + progress * np.cos(heading), y + progress * np.sin(heading)])
    else:
        radius = 1.0 / path.curvature
        centre = np.array([x - radius * np.sin(path.heading), y + radius * np.cos(path.heading)])
        heading = path.heading + progress / radius
        foot = centre + radius * np.array([np.sin(heading), -np.cos(heading)])
    return foot + left * np.array([-np.sin(heading), np.cos(heading)]), heading


def length_of(curvature: float, share: float) -> float:
    """Up to 0.95 of a full circle; up to 10 m of a line."""
    return 0.1 + share * (9.9 if curvature == 0.0 else 0.95 * 2.0 * np.pi / abs(curvature) - 0.1)


@FEW
@given(start=START, heading=ANGLE, curvature=CURVATURE, share=SHARE, along=SHARE, aside=st.floats(-0.9, 0.9))
def test_points_are_found_again(
    start: tuple[float, float], heading: float, curvature: float, share: float, along: float, aside: float
) -> None:
    path = Course(start, heading, length_of(curvature, share), curvature)
    progress, left = along * path.length, aside * (1.0 if curvature == 0.0 else 1.0 / abs(curvature))
    point, there = beside(path, progress, left)
    place = path.place(point)
    assert float(place.progress) == pytest.approx(progress, abs=1e-9)
    assert float(place.left) == pytest.approx(left, abs=1e-9)
    assert float(place.heading) == pytest.approx(there, abs=1e-9)
    on, _ = beside(path, progress, 0.0)
    np.testing.assert_allclose(path.points(np.array(progress)), on, atol=1e-9)


@FEW
@given(
    start=START, heading=ANGLE, curvature=CURVATURE, share=SHARE,
    beyond=st.floats(0.0, 0.45), after=st.booleans(),
)  # fmt: skip
def test_beyond_its_ends_a_path_goes_on(
    start: tuple[float, float], heading: float, curvature: float, share: float, beyond: float, after: bool
) -> None:
    """A circle goes on up to the point opposite to the path's middle."""
    path = Course(start, heading, length_of(curvature, share), curvature)
    rest = 10.0 if curvature == 0.0 else 2.0 * np.pi / abs(curvature) - path.length
    progress = path.length + beyond * rest if after else -beyond * rest
    place = path.place(beside(path, progress, 0.02)[0])
    assert float(place.progress) == pytest.approx(progress, abs=1e-8)
    assert float(place.left) == pytest.approx(0.02, abs=1e-9)


def test_the_half_circle_of_the_second_task_ends_opposite_to_its_start() -> None:
    path = find_task("t2").path
    np.testing.assert_allclose(path.goal, [0.6, 3.0], atol=1e-12)
    np.testing.assert_allclose(path.points(np.array(0.5 * path.length)), [2.1, 1.5], atol=1e-12)
    assert float(path.place(path.goal).heading) == pytest.approx(np.pi)
    radii = np.hypot(*(path.points(np.linspace(0.0, path.length, 50)) - [0.6, 1.5]).T)
    np.testing.assert_allclose(radii, 1.5)


@FEW
@given(heading=ANGLE, curvature=CURVATURE)
def test_points_move_along_the_heading_by_what_is_gone(heading: float, curvature: float) -> None:
    path = Course((0.3, -0.2), heading, length_of(curvature, 0.7), curvature)
    at, step = np.linspace(0.0, path.length, 12), 1e-6
    points = path.points(at)
    moved = (path.points(at + step) - points) / step
    headings = path.place(points).heading
    np.testing.assert_allclose(moved, np.stack((np.cos(headings), np.sin(headings)), -1), atol=1e-5)
    np.testing.assert_allclose(points[0], path.start, atol=1e-12)
    np.testing.assert_allclose(points[-1], path.goal, atol=1e-12)
    assert float(wrapped(headings[0] - heading)) == pytest.approx(0.0, abs=1e-9)


@FEW
@given(
    heading=ANGLE, tiny=st.floats(1e-7, 1e-4), sign=st.sampled_from([-1.0, 1.0]), left=st.floats(-1.0, 1.0)
)
def test_a_tiny_curvature_is_nearly_a_line(heading: float, tiny: float, sign: float, left: float) -> None:
    """Off by k s^2 / 2 aside and by k s l along: no jump at k = 0."""
    arc, line = Course((1.0, 2.0), heading, 3.0, sign * tiny), Course((1.0, 2.0), heading, 3.0)
    at = np.linspace(-1.0, 4.0, 11)
    np.testing.assert_allclose(arc.points(at), line.points(at), atol=10.0 * tiny)
    points = np.stack([beside(line, s, left)[0] for s in at])
    a, b = arc.place(points), line.place(points)
    np.testing.assert_allclose(a.progress, b.progress, atol=1e-8 + 20.0 * tiny)
    np.testing.assert_allclose(a.left, b.left, atol=1e-8 + 20.0 * tiny)
    np.testing.assert_allclose(a.heading, b.heading, atol=1e-8 + 20.0 * tiny)


def test_the_left_of_a_bend_is_its_inside_where_it_turns_left() -> None:
    for curvature, inside in ((0.5, 1.0), (-0.5, -1.0)):
        place = Course((0.0, 0.0), 0.0, 2.0, curvature).place(np.array([0.0, inside]))
        assert float(place.left) == pytest.approx(inside)


def test_many_points_at_once() -> None:
    path = find_task("t2").path
    grid = path.points(np.linspace(0.0, 4.0, 12).reshape(3, 4))
    assert grid.shape == (3, 4, 2)
    np.testing.assert_allclose(path.place(grid).progress, np.linspace(0.0, 4.0, 12).reshape(3, 4))
