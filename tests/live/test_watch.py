"""The estimator beside a source: it finds what a replay of the same log finds, and follows a change."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from amhe_cli.core.errors import ConfigError, EstimationError
from amhe_cli.core.log import Samples
from amhe_cli.engine.open import open_engine
from amhe_cli.estimation.online.horizon import Estimate, MovingHorizon
from amhe_cli.estimation.online.replay import open_replay
from amhe_cli.estimation.online.tracker import BEFORE
from amhe_cli.estimation.online.workers import InStep, News, Trouble
from amhe_cli.live import watch as live_watch
from amhe_cli.live.watch import Alarm, estimator_of, watch
from amhe_cli.logs import read_log
from amhe_cli.logs.containers.folder import open_log
from amhe_cli.logs.live import messages
from amhe_cli.logs.live.messages import LiveSource
from amhe_cli.logs.live.sources import Played
from amhe_cli.logs.messages.definitions import Definitions
from amhe_cli.system.system import System


@pytest.fixture(scope="module")
def pendulum() -> System:
    return System.load("pendulum")


def played(path: Path, system: System) -> LiveSource:
    transport = Played(open_log(path), {signal.topic for signal in system.signals}, 1.0)
    return LiveSource(transport, system.signals, Definitions(), system.settings.logs)


class Quick:
    """An estimator in step, whose answers are there at once."""

    def __init__(self, system: System) -> None:
        self.inner = InStep(partial(estimator_of, system, None, 0, "cpu"), 0.0)
        self.ready = True

    def submit(self, window, at: float) -> None:
        self.inner.submit(window, at)

    def poll(self, now: float) -> tuple[News, ...]:
        return self.inner.poll(np.inf)

    def close(self) -> None:
        self.inner.close()


class Idle(Quick):
    """An estimator that has nothing to say."""

    def submit(self, window, at: float) -> None:
        pass


@pytest.mark.slow
def test_it_finds_what_a_replay_of_the_log_finds(pendulum, pendulum_log, monkeypatch) -> None:
    """The clock is that of the test, so that a busy machine leaves nothing out."""
    clock = iter(np.arange(0.0, 1000.0, 0.005).tolist())
    monkeypatch.setattr("time.monotonic", lambda: next(clock))
    monkeypatch.setattr(messages, "STEP", 0.0)
    source = played(pendulum_log, pendulum)
    found = [one for one in watch(pendulum, source, Quick(pendulum)) if isinstance(one, Estimate)]
    monkeypatch.undo()
    done = open_replay(pendulum, read_log(pendulum_log, pendulum)).run()
    assert len(found) >= len(done.estimates) - 3
    last, again = found[-1], done.estimates[-1]
    assert np.all(np.abs(last.theta - again.theta) < last.sd + again.sd)
    assert source.stamp_ns(last.time) == pytest.approx(1_700_000_000_000_000_000 + last.time * 1e9, abs=10)


@pytest.mark.slow
def test_a_payload_is_a_jump_and_its_mass_is_found(pendulum, jumping, monkeypatch) -> None:
    """0.8 kg on 0.4 kg, at 4 s: a jump within 1.5 s, within 5 % after 2 s more, and the interval holds."""
    clock = iter(np.arange(0.0, 1000.0, 0.005).tolist())
    monkeypatch.setattr("time.monotonic", lambda: next(clock))
    monkeypatch.setattr(messages, "STEP", 0.0)
    events = list(watch(pendulum, played(jumping, pendulum), Quick(pendulum)))
    monkeypatch.undo()
    found = [one for one in events if isinstance(one, Estimate)]
    assert any(one.mark == "jump" and 4.0 < one.time < 5.5 for one in found)
    settled = [one for one in found if one.time > 6.0]
    assert len(settled) >= 4
    assert all(one.theta[0] == pytest.approx(1.2, rel=0.05) for one in settled)
    assert settled[-1].lower[0] < 1.2 < settled[-1].upper[0]


class Restarted:
    """A source whose clock is set back once."""

    def __init__(self, set_at: int = 60) -> None:
        self.looks, self.epoch, self.over, self.now = 0, 0, False, -np.inf
        self.set_at = set_at

    def wait(self) -> Samples:
        self.looks += 1
        self.now, self.epoch, self.over = 0.01 * self.looks, int(self.looks > self.set_at), self.looks > 100
        times = np.array([self.now])
        return {
            key: (times, np.zeros((1, 1)))
            for key in ("joints.position", "joints.velocity", "command.position")
        }

    def events(self) -> list[str]:
        return ["set back"] if self.looks == self.set_at + 1 else []


def test_the_first_look_does_not_reach_across_a_clock_that_was_set(pendulum: System, monkeypatch) -> None:
    looked: list[int] = []
    monkeypatch.setattr(live_watch, "_LOOKED_AT", 0.3)
    monkeypatch.setattr(live_watch, "first_look", lambda system, log, *_: looked.append(log.start_ns) or [])
    source = Restarted(set_at=20)
    list(watch(pendulum, source, Idle(pendulum)))
    (start,) = looked
    assert start / 1e9 + BEFORE > 0.2


def test_windows_do_not_reach_across_a_clock_that_was_set(pendulum: System) -> None:
    worker, found = Quick(pendulum), list[tuple[float, float]]()
    submit = worker.submit
    worker.submit = lambda window, at: (found.append((window.log.start_ns / 1e9, at)), submit(window, at))[1]
    happened = list(watch(pendulum, Restarted(), worker))
    assert "set back" in happened
    assert any(at > 0.6 + pendulum.settings.mhe.window for _, at in found) is False
    assert len(found) == 1, "after the restart there was not enough for another window"


def test_an_estimator_that_does_not_start_ends_the_watch_in_one_line(pendulum: System) -> None:
    class Broken(Quick):
        ready = False

        def __init__(self) -> None: ...

        def poll(self, now: float) -> tuple[News, ...]:
            return (Trouble(now, "the estimator failed: no model"),)

    with pytest.raises(EstimationError, match="no model"):
        list(watch(pendulum, Restarted(), Broken()))


def test_an_alarm_holds_once_the_whole_interval_is_beyond_its_limit(pendulum: System) -> None:
    estimate = MovingHorizon(pendulum, open_engine(pendulum), np.random.default_rng(0))._estimate(
        0.0, "still", None, 0.0
    )
    lower, upper = float(estimate.lower[0]), float(estimate.upper[0])
    for rule, holds in (
        (f"load_mass > {lower - 0.01}", True), (f"load_mass>{lower + 0.01}", False),
        (f"load_mass<{upper + 0.01}", True), (f"load_mass<{upper - 0.01}", False),
    ):  # fmt: skip
        assert Alarm.parsed(rule, pendulum.space.names).holds(estimate) is holds


@pytest.mark.parametrize(
    ("rule", "said"),
    [("load_mass", "no rule"), ("mass>1", "did you mean|there is"), ("damping>x", "no rule")],
)
def test_a_rule_that_is_none_is_refused(pendulum: System, rule: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        Alarm.parsed(rule, pendulum.space.names)


@pytest.mark.medium
def test_a_wrong_sign_is_said_at_the_start(pendulum, pendulum_log, monkeypatch) -> None:
    clock = iter(np.arange(0.0, 1000.0, 0.005).tolist())
    monkeypatch.setattr("time.monotonic", lambda: next(clock))
    monkeypatch.setattr(messages, "STEP", 0.0)
    monkeypatch.setattr(live_watch, "_LAST", 60.0)
    signals = [replace(s, reversed=(0,)) if s.is_input else s for s in pendulum.signals]
    wrong = replace(pendulum, signals=tuple(signals))
    said = [one for one in watch(wrong, played(pendulum_log, wrong), Idle(pendulum)) if isinstance(one, str)]
    assert any("the other sign" in text for text in said), said
