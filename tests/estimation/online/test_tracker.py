"""The online estimator: its updates and its tracker."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from amhe_cli.core.log import Log, Samples, Window, sampled
from amhe_cli.engine.open import open_engine
from amhe_cli.estimation.online.horizon import Estimate, MovingHorizon, usable
from amhe_cli.estimation.online.replay import replay, windows
from amhe_cli.estimation.online.tracker import Tracker
from amhe_cli.estimation.online.updates import learned
from amhe_cli.estimation.online.workers import InStep, News, Trouble
from amhe_cli.logs import read_log
from amhe_cli.system.system import System
from tests.estimation.online.conftest import DT, Drive


def portions(samples: Samples, period: float, end: float) -> list[tuple[float, Samples]]:
    """Time, and the samples of the period before it."""
    found = []
    for now in np.arange(period, end, period):
        part = {}
        for key, (times, values) in samples.items():
            rows = (times > now - period + 1e-9) & (times <= now + 1e-9)
            part[key] = times[rows], values[rows]
        found.append((float(now), part))
    return found


class Slow:
    """A worker that needs some polls for an update."""

    def __init__(self, polls: int) -> None:
        self.polls, self.left = polls, 0
        self.windows: list[tuple[Window, float]] = []

    @property
    def ready(self) -> bool:
        return self.left == 0

    def submit(self, window: Window, at: float) -> None:
        assert self.ready
        self.left = self.polls
        self.windows.append((window, at))

    def poll(self, now: float) -> tuple[News, ...]:
        self.left = max(0, self.left - 1)
        return ()

    def close(self) -> None:
        self.left = 0


def test_it_finds_the_mass(cart: System, drive: Drive) -> None:
    engine = open_engine(cart)
    estimator = MovingHorizon(cart, engine, np.random.default_rng(0))
    tracker = Tracker(cart, InStep(lambda _: estimator, latency=0.03))
    found = [
        (now, one) for now, part in portions(sampled(drive(4.0)), 0.01, 4.0) for one in tracker.feed(part)
    ]
    assert all(isinstance(one, Estimate) and now >= one.time + 0.03 - 1e-6 for now, one in found)
    last = found[-1][1]
    assert isinstance(last, Estimate)
    assert last.theta[0] == pytest.approx(2.0, rel=0.05), "from 1.5"


@pytest.mark.parametrize("period", [0.01, 0.045])
def test_windows_hold_what_was_measured_whatever_the_portions(
    period: float, cart: System, drive: Drive
) -> None:
    worker, log = Slow(0), drive(3.0)
    tracker = Tracker(cart, worker)
    for _, part in portions(sampled(log), period, 3.0):
        assert tracker.feed(part) == ()
    assert len(worker.windows) > 10
    assert np.diff([at for _, at in worker.windows]).min() > cart.settings.mhe.update_period - 1e-6
    for window, at in worker.windows:
        ours = slice(window.start, window.stop + 1)
        theirs = slice(round(at / DT) - window.length, round(at / DT) + 1)
        for key, series in log.series.items():
            mask = series.sampled[theirs]
            np.testing.assert_array_equal(window.log[key].sampled[ours], mask, key)
            np.testing.assert_allclose(
                window.log[key].values[ours][mask], series.values[theirs][mask], atol=1e-12
            )


@pytest.mark.parametrize("every", [1, 50, 100, 10**6], ids=["streamed", "4 Hz", "2 Hz", "once"])
def test_windows_hold_rare_commands_as_logs_do(every: int, cart: System, drive: Drive) -> None:
    """A command holds until the next, however long ago it was sent."""
    worker, samples = Slow(0), dict(sampled(drive(4.0)))
    times, force = (array[::every] for array in samples["force.effort"])
    samples["force.effort"] = times, force
    stamps = samples["state.position"][0]
    states = {key.split(".")[1]: values for key, (_, values) in samples.items() if key.startswith("state.")}
    arrays = {"state": {"time": stamps, **states}, "force": {"time": times, "effort": force}}
    log = Log.from_arrays(arrays, cart)
    tracker = Tracker(cart, worker)
    first = {key: (t[:1], v[:1]) for key, (t, v) in samples.items()}
    for now, part in [(0.0, first), *portions(samples, 0.01, 4.0)]:
        tracker.feed(part, now)
    assert len(worker.windows) > 10
    for window, at in worker.windows:
        assert usable(cart, window)
        ours = slice(window.start, window.stop + 1)
        theirs = slice(round(at / DT) - window.length, round(at / DT) + 1)
        for key, series in log.series.items():
            np.testing.assert_array_equal(window.log[key].valid[ours], series.valid[theirs], key)
            np.testing.assert_allclose(window.log[key].values[ours], series.values[theirs], atol=1e-12)


def test_a_stream_of_commands_that_breaks_off_is_not_held(cart: System, drive: Drive) -> None:
    worker, samples = Slow(0), dict(sampled(drive(4.0)))
    times, force = samples["force.effort"]
    samples["force.effort"] = times[times < 1.5], force[times < 1.5]
    tracker = Tracker(cart, worker)
    for now, part in portions(samples, DT, 4.0):
        tracker.feed(part, now)
    known = [(at, usable(cart, window)) for window, at in worker.windows]
    bridged = 1.5 + cart.settings.logs.max_gap
    assert {good for at, good in known if at < bridged - 0.02} == {True}
    assert {good for at, good in known if at > bridged + 0.02} == {False}


def test_windows_wait_for_every_signal_and_end_at_the_newest_sample(cart: System, drive: Drive) -> None:
    worker, samples = Slow(0), sampled(drive(2.0))
    tracker = Tracker(cart, worker)
    force = {key: series for key, series in samples.items() if key.startswith("force.")}
    state = {key: series for key, series in samples.items() if key.startswith("state.")}
    assert tracker.feed(force) == () and not worker.windows
    tracker.feed(state | {"stranger.value": (np.array([9.0]), np.zeros((1, 1)))})
    ((window, at),) = worker.windows
    assert at == pytest.approx(max(times[-1] for times, _ in samples.values()))
    assert set(window.log.series) == set(samples), "signals of others are passed over"
    assert window.length * window.log.dt == pytest.approx(cart.settings.mhe.window)


def test_updates_wait_while_the_computer_is_needed_and_those_left_out_are_reported(
    cart: System, drive: Drive
) -> None:
    period, worker = cart.settings.mhe.update_period, Slow(0)
    tracker, troubles = Tracker(cart, worker), 0
    for now, part in portions(sampled(drive(3.0)), 0.01, 3.0):
        news = tracker.feed(part, now, begin=not 1.0 < now < 2.0)
        troubles += sum(isinstance(one, Trouble) and "gave way" in one.text for one in news)
    ends = np.array([at for _, at in worker.windows])
    assert not ((ends > 1.0 + 1e-6) & (ends < 2.0 - 1e-6)).any()
    assert (ends <= 1.0 + 1e-6).any() and (ends > 2.0).any()
    assert troubles == pytest.approx(1.0 / period - 1.0, abs=1.0)


def test_a_late_estimator_is_reported_once_until_it_is_ready_again(cart: System, drive: Drive) -> None:
    period = cart.settings.mhe.update_period
    worker = Slow(polls=round(3.5 * period / 0.01))
    tracker = Tracker(cart, worker)
    troubles = [
        (now, one)
        for now, part in portions(sampled(drive(3.0)), 0.01, 3.0)
        for one in tracker.feed(part, now)
    ]
    assert all(isinstance(one, Trouble) and "late" in one.text for _, one in troubles)
    assert len(troubles) in (len(worker.windows), len(worker.windows) - 1), "once for each update"
    assert [now for now, _ in troubles] == [pytest.approx(one.time) for _, one in troubles]
    ends = np.array([at for _, at in worker.windows])
    assert np.diff(ends).min() > 3.0 * period, "no window waits in a queue: the newest is taken"


class Dies(Slow):
    """A worker that dies in its second update and then needs some polls to start again."""

    def poll(self, now: float) -> tuple[News, ...]:
        if len(self.windows) == 2 and self.polls == 1:
            self.left, self.polls = 60, 2
            return (Trouble(now, "the estimator died"),)
        return super().poll(now)


def test_an_estimator_that_died_is_not_reported_as_late_too(cart: System, drive: Drive) -> None:
    worker = Dies(polls=1)
    tracker = Tracker(cart, worker)
    news = [one for now, part in portions(sampled(drive(3.0)), 0.01, 3.0) for one in tracker.feed(part, now)]
    assert [one.text for one in news if isinstance(one, Trouble)] == ["the estimator died"]
    assert len(worker.windows) > 5, "it goes on once it has started again"


#: Mass of the load that is held, and how well somebody claims to know it [kg].
HELD, SD = 0.5, 0.02


def last(path: Path, **held: float) -> Estimate:
    """The last estimate of all but the load's mass."""
    given = {
        "unknowns": ["damping", "friction_loss", "armature"],
        "parameters": {"load_mass": held},
        "mhe": {"systematic": {}, "iterations": 1},
    }
    system = System.load("pendulum", given, warn=False)
    estimator = MovingHorizon(system, open_engine(system, threads=1), np.random.default_rng(0))
    return list(replay(estimator, windows(system, read_log(path, system))))[-1]


@pytest.mark.medium
def test_an_error_of_a_held_number_is_in_the_interval_as_far_as_it_acts(pendulum_log: Path) -> None:
    exact, considered = last(pendulum_log, held=HELD), last(pendulum_log, held=HELD, held_sd=SD)
    off = last(pendulum_log, held=HELD + SD)
    np.testing.assert_array_equal(exact.theta, considered.theta)
    added = np.sqrt(np.diag(considered.belief.covariance) - np.diag(exact.belief.covariance))
    moved = np.abs(np.log(off.theta / exact.theta))
    assert moved[1] > 0.4, "the load's weight is mistaken for dry friction"
    np.testing.assert_allclose(added[1], moved[1], rtol=0.3)
    assert (added > 0.3 * moved).all()


def test_by_hand() -> None:
    samples = np.array([[1.0], [3.0], [-2.0], [9.0]])
    costs = np.array([2.0, 1.0, 7.0, np.inf])
    mean, sigma = learned(samples, costs, np.array([0.0]), np.array([2.0]), share=0.5, rate=0.5)
    first, second = np.log(2.5), np.log(2.5) - np.log(2.0)
    weights = np.array([first, second]) / (first + second)
    assert mean == pytest.approx([0.5 * (weights @ [3.0, 1.0])])
    assert sigma == pytest.approx([np.sqrt(0.5 * 4.0 + 0.5 * (weights @ [9.0, 1.0]))])


def test_only_diverged_samples_teach_nothing() -> None:
    mean, sigma = learned(np.ones((4, 2)), np.full(4, np.inf), np.zeros(2), np.ones(2), 0.3, 0.5)
    assert mean == pytest.approx([0.0, 0.0]) and sigma == pytest.approx([1.0, 1.0])


@given(st.integers(0, 2**32 - 1), st.floats(0.05, 1.0), st.floats(0.1, 1.0))
def test_the_mean_stays_among_the_samples(seed: int, share: float, rate: float) -> None:
    rng = np.random.default_rng(seed)
    samples, costs = rng.standard_normal((12, 3)), rng.random(12)
    centre = samples.mean(axis=0)
    mean, sigma = learned(samples, costs, centre, np.ones(3), share, rate)
    assert (mean >= samples.min(axis=0) - 1e-12).all() and (mean <= samples.max(axis=0) + 1e-12).all()
    # a mixture of the old variance and the elites' mean square distance from the old mean
    furthest = ((samples - centre) ** 2).max(axis=0)
    assert (sigma > 0.0).all()
    assert (sigma**2 >= 1.0 - rate - 1e-12).all() and (sigma**2 <= 1.0 - rate + rate * furthest + 1e-12).all()
