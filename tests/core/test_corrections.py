"""Gaps where a signal is not active, and smoothing of what drives a model."""

from __future__ import annotations

import numpy as np

from amhe_cli.core import rotations
from amhe_cli.core.corrections import corrected
from amhe_cli.core.signals import Series, Signal

DT = 0.01


def series(values: np.ndarray) -> Series:
    everywhere = np.ones(len(values), dtype=bool)
    return Series(values, everywhere, everywhere, tuple("abcd"[: values.shape[1]]))


def test_a_signal_counts_within_its_stretches_alone() -> None:
    pose = Signal("pose", "/pose", ("position",), active=((0.5, 0.6), (0.9, 2.0)))
    given = {"pose.position": series(np.zeros((100, 3)))}
    on = corrected(given, [pose], DT)["pose.position"].valid
    np.testing.assert_array_equal(np.flatnonzero(on), [*range(50, 61), *range(90, 100)])
    later = corrected(given, [pose], DT, begun=0.4)["pose.position"]  # a part of the log: times stay its own
    np.testing.assert_array_equal(np.flatnonzero(later.valid), [*range(10, 21), *range(50, 100)])
    assert not later.sampled[0]
    assert corrected(given, [pose], DT, begun=None)["pose.position"].valid.all()


def test_a_signal_counts_where_another_has_a_value() -> None:
    switch, command = (
        Signal("on", "/on", ("value",)),
        Signal("u", "/u", ("effort",), switch=("on.value", 1.0)),
    )
    on = np.repeat([0.0, 1.0, 0.0], [10, 20, 5])[:, None]
    found = corrected({"on.value": series(on), "u.effort": series(np.ones((35, 1)))}, [switch, command], DT)
    np.testing.assert_array_equal(np.flatnonzero(found["u.effort"].valid), range(10, 30))
    assert found["on.value"].valid.all()


def test_smoothing_keeps_a_parabola_and_removes_noise() -> None:
    time = DT * np.arange(200)[:, None]
    true = 1.0 + 2.0 * time - 3.0 * time**2
    noise = 0.01 * np.random.default_rng(0).normal(size=true.shape)
    signal = Signal("tip", "/tip", ("position",), smooth=0.1)
    exact = corrected({"tip.position": series(true)}, [signal], DT)["tip.position"].values
    np.testing.assert_allclose(exact, true, atol=1e-12)
    smooth = corrected({"tip.position": series(true + noise)}, [signal], DT)["tip.position"].values
    # the middle of a parabola through 21 samples has sqrt(0.107) of their noise (Savitzky and Golay)
    assert np.std((smooth - true)[10:-10]) < 0.4 * 0.01


def test_smoothing_of_turns_ignores_signs_and_stops_at_gaps() -> None:
    angle = 2.0 * DT * np.arange(100)
    true = rotations.exp(angle[:, None] * np.array([0.0, 0.0, 1.0]))
    flipped = true * np.where(np.arange(100) % 7 == 0, -1.0, 1.0)[:, None]
    valid = np.ones(100, dtype=bool)
    valid[40:45] = False
    flipped[40:45] = 0.0
    given = Series(flipped, valid, valid, ("w", "x", "y", "z"))
    signal = Signal("tip", "/tip", ("orientation",), smooth=0.05)
    found = corrected({"tip.orientation": given}, [signal], DT)["tip.orientation"].values[valid]
    np.testing.assert_allclose(rotations.difference(found, true[valid]), 0.0, atol=1e-5)
