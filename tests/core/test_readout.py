"""Spikes and repeats are left out, impacts and slow motions are not; gaps and smoothing of signals."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import amhe_cli as amhe
from amhe_cli.cli.main import run
from amhe_cli.core import rotations
from amhe_cli.core.corrections import corrected, resolution, spikes, updates
from amhe_cli.core.signals import Series, Signal

ROOT = Path(__file__).parents[2]
TIMES = np.arange(0.0, 6.0, 0.005)


def swing(rng: np.random.Generator, noise: float = 0.001) -> np.ndarray:
    """A quantised swing with noise, shape (n, 1) [rad]."""
    angle = 1.2 * np.sin(3.0 * TIMES) + rng.normal(0.0, noise, TIMES.size)
    return 0.0015 * np.round(angle[:, None] / 0.0015)


@given(
    st.integers(0, 2**16), st.lists(st.integers(3, TIMES.size - 4), max_size=5, unique=True), st.booleans()
)
def test_spikes_are_found_and_nothing_else(seed: int, rows: list[int], wraps: bool) -> None:
    rng = np.random.default_rng(seed)
    kept = [row for row in sorted(rows) if all(abs(row - other) > 10 for other in rows if other != row)]
    clean = swing(rng)
    sizes = rng.uniform(0.5, 3.1, len(kept)) * rng.choice([-1.0, 1.0], len(kept))
    values = clean.copy()
    values[kept, 0] += sizes
    found, off = spikes((values + np.pi) % (2 * np.pi) - np.pi if wraps else values, wraps=wraps)
    np.testing.assert_array_equal(found, kept)
    np.testing.assert_allclose(off, np.abs(sizes), atol=0.06)  # in units of what the swing moves by


@pytest.mark.parametrize("noise", [0.0, 1e-3])
def test_a_bounce_is_no_spike(noise: float) -> None:
    rng = np.random.default_rng(1)
    height, speed, rows = 1.0, 0.0, []
    for _ in range(1000):
        speed -= 9.81 * 0.005
        height += 0.005 * speed
        if height < 0.0:
            height, speed = -height, -0.8 * speed
        rows.append((height, speed))
    track = np.array(rows) + rng.normal(0.0, noise, (1000, 2))
    assert not spikes(track)[0].size


def test_an_orientation_that_changes_sign_is_no_spike_and_one_that_leaps_is() -> None:
    half = 0.3 * np.sin(2.0 * TIMES)
    quaternions = np.stack([np.cos(half), 0 * half, 0 * half, np.sin(half)], axis=1)
    quaternions[100] *= -1.0
    quaternions[300:] *= -1.0
    assert not spikes(quaternions, turns=True)[0].size
    quaternions[500] = [0.0, 1.0, 0.0, 0.0]
    assert spikes(quaternions, turns=True)[0].tolist() == [500]


def test_repeats_of_a_slow_sensor_are_no_news_and_a_slow_motion_is() -> None:
    rng = np.random.default_rng(2)
    speed = 0.0767 * np.round(3.6 * np.cos(3.0 * TIMES + 0.01 * rng.normal(size=TIMES.size)) / 0.0767)
    fresh, every = updates(np.repeat(speed[::4], 4)[:, None])
    assert every == 4
    np.testing.assert_array_equal(np.flatnonzero(fresh), np.arange(0, TIMES.size, 4))
    slow = 0.0015 * np.round(0.1 * TIMES[:, None] / 0.0015)  # a new value in every third sample
    assert updates(slow)[1] == 1
    assert updates(swing(rng))[1] == 1
    assert resolution(slow[:, 0]) == pytest.approx(0.0015)
    assert resolution(np.sin(TIMES)) == 0.0


def write(path: Path, position: np.ndarray, velocity: np.ndarray) -> Path:
    table = np.column_stack([TIMES, position, velocity, np.sin(TIMES)])
    np.savetxt(path, table, delimiter=",", header="time,position,velocity,torque", comments="")
    return path


def test_a_log_is_read_without_them_and_says_so(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(3)
    position, velocity = swing(rng)[:, 0], np.repeat(3.6 * np.cos(3.0 * TIMES)[::4], 4)
    position[862] = 3.14
    path = write(tmp_path / "log.csv", position, velocity)
    system = ROOT / "examples" / "systems" / "simple_pendulum"
    with caplog.at_level(logging.WARNING):
        log = amhe.read_log(path, amhe.System.load(system))
    assert "1 sample of position left out, the largest 2." in caplog.text
    assert "rad at 4.31 s" in caplog.text
    assert "velocity is updated in every 4th message: 900 repeats are no data" in caplog.text
    angle = log["joints.position"]
    row = round(4.31 / log.dt)
    assert not angle.sampled[row] and angle.valid[row]
    assert angle.values[row, 0] == pytest.approx(0.5 * (position[861] + position[863]), abs=0.01)
    assert log["joints.velocity"].sampled.sum() == pytest.approx(TIMES.size / 4, abs=2)
    kept = amhe.System.load(system, {"logs": {"spikes": "keep", "repeats": "keep"}})
    assert amhe.read_log(path, kept)["joints.position"].values[row, 0] == pytest.approx(3.14)
    assert run(["inspect", str(path), "--system", str(system)]) == 0
    assert "1 sample of position left out" in capsys.readouterr().err


def test_init_takes_the_resolution_for_the_least_noise(tmp_path: Path) -> None:
    coarse = 0.6 * np.round(3.6 * np.cos(0.7 * TIMES) / 0.6)  # most third differences are none
    path = write(tmp_path / "log.csv", 1.2 * np.sin(0.7 * TIMES), coarse)
    model = ROOT / "examples" / "systems" / "simple_pendulum" / "model.xml"
    assert run(["init", str(model), str(path), "-o", str(tmp_path / "system"), "-q"]) == 0
    noise = {c.key: c.noise for c in amhe.System.load(tmp_path / "system").channels}
    assert 0.03 < noise["joints.velocity"] <= 0.6 / np.sqrt(12.0) + 0.01


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
