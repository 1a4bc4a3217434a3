"""Parameters, what of them each log has for itself, and their values read back from a result."""

from __future__ import annotations

import logging
import pickle
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import amhe_cli as amhe
from amhe_cli.cli.main import run
from amhe_cli.core import rotations
from amhe_cli.core.belief import belief_of, systematic_of, with_prior
from amhe_cli.core.corrections import corrected, resolution, spikes, updates
from amhe_cli.core.each_log import acting, check_logs, named, searched, trended, values_on
from amhe_cli.core.errors import ConfigError
from amhe_cli.core.log import Log
from amhe_cli.core.parameters import Parameter, ParameterSpace
from amhe_cli.core.signals import Series, Signal

SPACE = ParameterSpace(
    (Parameter("mass", "kg", 4.0, 0.5, 20.0, True, 0.5), Parameter("offset", "m", 0.1, -1.0, 1.0, False, 0.2))
)


BOX: Any = SimpleNamespace(name="box", space=SPACE, fixed={}, parts={}, sets={})


@given(st.floats(0.5, 20.0), st.floats(-1.0, 1.0))
def test_theta_survives_the_way_to_z_and_back(mass, offset):
    theta = np.array([mass, offset])
    assert SPACE.theta_of(SPACE.z_of(theta)) == pytest.approx(theta, rel=1e-12, abs=1e-12)


def test_one_prior_sd_is_one():
    assert SPACE.theta_of(np.array([1.0, -1.0])) == pytest.approx([4.0 * np.exp(0.5), -0.1])


def test_a_belief_becomes_the_prior_of_what_it_knows():
    belief = belief_of(BOX, np.array([1.0, 0.5]), np.diag([0.04, 0.25]))
    space = with_prior(SPACE, belief)
    assert space.nominal == pytest.approx(belief.estimate)
    assert space.prior_sd == pytest.approx([0.5 * 0.2, 0.2 * 0.5])


def test_what_a_belief_owes_to_the_model_is_known_of_the_prior():
    belief = belief_of(BOX, np.zeros(2), np.diag([0.04, 0.25]), systematic=np.diag([0.03, 0.0]))
    space = with_prior(SPACE, belief)
    assert np.array(space.prior_systematic) == pytest.approx(np.diag([0.75, 0.0]))
    assert np.diag(space.loose_precision) == pytest.approx([1.0 / (1.0 + 75.0), 1.0])
    assert systematic_of(space, belief) == pytest.approx(np.diag([0.75, 0.0]))
    one = space.without([SPACE.names[1]])
    assert one.prior_systematic == ((pytest.approx(0.75),),)
    assert SPACE.loose_precision is SPACE.prior_precision


def test_nobody_can_change_what_a_space_keeps():
    for kept in (SPACE.log, SPACE.prior_covariance):
        with pytest.raises(ValueError, match="read-only"):
            kept[0] = 0


def test_a_belief_has_sd_and_interval_in_units():
    belief = belief_of(BOX, np.zeros(2), np.diag([0.04, 0.25]))
    assert belief.sd == pytest.approx([0.4, 0.1])
    lower, upper = belief.interval
    assert lower == pytest.approx([4.0 * np.exp(-0.16448536), 0.1 - 0.16448536])
    assert upper == pytest.approx([4.0 * np.exp(0.16448536), 0.1 + 0.16448536])


MODEL = ParameterSpace(
    (
        Parameter("gain", "-", 1.0, 0.1, 10.0, True, 0.5),
        Parameter("friction", "N m", 0.2, 0.01, 1.0, True, 0.5),
        Parameter("bias", "rad", 0.0, -1.0, 1.0, False, 0.1),
    ),
    ((1.0, 0.0, 0.3), (0.0, 1.0, 0.0), (0.3, 0.0, 1.0)),
)


def log(name: str = "run", **stated: Any) -> Log:
    return Log(0.01, {}, name).with_(**stated)


def test_logs_that_say_nothing_change_nothing() -> None:
    assert searched(MODEL, [log(), log()]) is MODEL
    theta = np.ones((2, 3))
    assert values_on(log(), MODEL, MODEL, theta) is theta


def test_what_every_log_knows_is_not_searched() -> None:
    space = searched(MODEL, [log(known={"gain": 2.0}), log(known={"gain": 3.0})])
    assert space.names == ("friction", "bias")
    np.testing.assert_allclose(space.prior_covariance, np.eye(2))
    values = values_on(log(known={"gain": 3.0}), MODEL, space, np.array([[0.3, 0.1]]))
    np.testing.assert_array_equal(values, [[3.0, 0.3, 0.1]])


def test_what_one_log_knows_is_searched_in_the_others() -> None:
    one, other = log(known={"gain": 2.0}), log()
    space = searched(MODEL, [one, other])
    assert space is MODEL
    theta = np.array([[5.0, 0.3, 0.1]])
    np.testing.assert_array_equal(values_on(one, MODEL, space, theta), [[2.0, 0.3, 0.1]])
    np.testing.assert_array_equal(values_on(other, MODEL, space, theta), theta)
    np.testing.assert_array_equal(acting(one, MODEL, space), [False, True, True])


def test_each_log_has_an_unknown_of_its_own() -> None:
    logs = named([log("a", own=["friction"]), log("a", own=["friction"]), log("b", own={"friction": "B"})])
    space = searched(MODEL, logs)
    assert space.names == ("gain", "friction[a]", "friction[a 2]", "friction[B]", "bias")
    assert space.prior_covariance[0, 4] == 0.3
    assert {p.nominal for p in space.parameters if p.name.startswith("friction")} == {0.2}
    theta = np.array([[1.0, 0.1, 0.2, 0.4, 0.0]])
    assert [values_on(one, MODEL, space, theta)[0, 1] for one in logs] == [0.1, 0.2, 0.4]
    np.testing.assert_array_equal(acting(logs[1], MODEL, space), [True, False, True, False, True])
    stranger = values_on(log("c", own=["friction"]), MODEL, space, theta)
    assert stranger[0, 1] == pytest.approx(0.2)  # the geometric mean of the others


def test_what_the_prior_owes_to_the_model_stays_with_its_parameters() -> None:
    model = replace(MODEL, prior_systematic=((0.5, 0.0, 0.2), (0.0, 0.4, 0.0), (0.2, 0.0, 0.3)))
    space = searched(model, named([log("a", own=["friction"]), log("b", own=["friction"])]))
    assert space.names == ("gain", "friction[a]", "friction[b]", "bias")
    expected = [[0.5, 0.0, 0.0, 0.2], [0.0] * 4, [0.0] * 4, [0.2, 0.0, 0.0, 0.3]]
    np.testing.assert_array_equal(space.prior_systematic, expected)


def test_logs_of_one_owner_share_a_value() -> None:
    logs = [log(own={"bias": "A"}), log(own={"bias": "A"}), log(own=["bias"]), log(known={"bias": 0.1})]
    check_logs(logs, [log()], MODEL)  # one that is held out has the common mean
    assert searched(MODEL, named(logs)).names == ("gain", "friction", "bias[A]", "bias[run]")


@pytest.mark.parametrize(
    ("logs", "text"),
    [
        ([log("a", own=["bias"]), log("b", own=["bias"]), log("c")], "c: `own`: bias is a's own; give it to"),
        ([log("a", own={"bias": "A"}), log("b", own={"bias": "A"})], "a: `own`: bias has one owner"),
        ([log("a", own=["bias"]), log("b", known={"bias": 0.1})], "a: `own`: bias has one owner"),
    ],
)
def test_values_of_some_logs_only_are_refused(logs: list[Log], text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        check_logs(logs, [], MODEL)


def test_logs_that_know_everything_leave_nothing_to_search() -> None:
    known = {"gain": 1.0, "friction": 0.2, "bias": 0.0}
    with pytest.raises(ConfigError, match="`known`: the logs know every parameter: leave one unknown"):
        check_logs([log(known=known), log(known=known)], [], MODEL)


def test_a_log_keeps_what_is_said_of_it() -> None:
    one = log(known={"gain": 2.0}, own=["bias"], held_out=True)
    again = pickle.loads(pickle.dumps(one.with_()))
    assert (again.known, again.own, again.held_out) == ({"gain": 2.0}, {"bias": ""}, True)
    assert one.digest() != log().digest()


@pytest.mark.parametrize(
    ("stated", "text"),
    [
        ({"known": {"gian": 1.0}}, "run: `known`: no parameter 'gian' (did you mean 'gain'?)"),
        ({"known": {"gain": 99.0}}, "run: `known`: gain is 99; between 0.1 and 10 would be valid"),
        ({"own": ["drag"]}, "run: `own`: no parameter 'drag'"),
        ({"own": ["gain"], "known": {"gain": 1.0}}, "run: `own`: gain is known in this log"),
    ],
)
def test_what_the_system_does_not_have_is_refused(stated: dict[str, Any], text: str) -> None:
    with pytest.raises(ConfigError) as raised:
        check_logs([log(**stated)], [], MODEL)
    assert text in str(raised.value)


def test_a_held_out_log_needs_what_the_others_know() -> None:
    with pytest.raises(ConfigError, match="test: `known`: gain is known in every fitted log"):
        check_logs([log(known={"gain": 1.0})], [log("test")], MODEL)


def test_a_trend_is_two_unknowns_between_which_each_log_has_its_place() -> None:
    logs = [log(trend={"friction": at, "bias": at}) for at in (0.0, 0.25, 1.0)] + [
        log(known={"friction": 0.5})
    ]
    logs[-1] = logs[-1].with_(trend={"bias": 0.5, "friction": 0.5})
    check_logs(logs, [log()], MODEL)
    space = searched(MODEL, logs)
    assert space.names == ("gain", "friction[start]", "friction[end]", "bias[start]", "bias[end]")
    theta = np.array([[1.0, 0.1, 0.4, 0.0, 0.8]])
    found = np.array([values_on(one, MODEL, space, theta)[0, 1:] for one in logs])
    np.testing.assert_allclose(found[:, 0], [0.1, 0.1 * 4**0.25, 0.4, 0.5])  # straight in the logarithm
    np.testing.assert_allclose(found[:, 1], [0.0, 0.2, 0.8, 0.4])
    np.testing.assert_allclose(values_on(log(), MODEL, space, theta)[0, 1:], [0.2, 0.4])  # the middle
    assert logs[1].digest() != logs[2].digest()


def test_the_places_on_a_trend_are_those_of_the_stamps() -> None:
    hour = 3600 * 10**9
    logs = [replace(log(), start_ns=1_700_000_000 * 10**9 + hours * hour) for hours in (2, 0, 8)]
    assert [one.trend for one in trended(logs, ["gain"])] == [{"gain": at} for at in (0.25, 0.0, 1.0)]
    with pytest.raises(ConfigError, match="`trend`: gain: needs logs, or parts of one, of different times"):
        trended(logs[:1], ["gain"])


@pytest.mark.parametrize("more", [{}, {"trend": {"bias": 0.0}}, {"own": ["bias"], "trend": {"bias": 1.0}}])
def test_a_trend_of_some_logs_only_is_refused(more: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match="run: `trend`: bias needs two places or more"):
        check_logs([log(trend={"bias": 0.0}), log(**more)], [], MODEL)


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


@pytest.mark.medium
def test_the_impacts_of_real_tosses_are_no_spikes() -> None:
    """Sixty logs of a cube that hits a board, not part of the project, are read the same to the bit."""
    if not (paths := sorted((ROOT.parent / "shared" / "data" / "cube_tosses").glob("toss_*.mcap"))):
        pytest.skip("the cube tosses are not here")
    dropped, kept = (amhe.System.load("cube_toss", {"logs": {"spikes": way}}) for way in ("drop", "keep"))
    for path in paths:
        for key, series in amhe.read_log(path, kept).series.items():
            found = amhe.read_log(path, dropped)[key]
            np.testing.assert_array_equal(found.values, series.values)
            np.testing.assert_array_equal(found.sampled, series.sampled)


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


@pytest.mark.medium
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
