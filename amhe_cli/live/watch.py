"""The estimator beside any system that runs: samples of a source in, estimates out."""

from __future__ import annotations

import re
import time
from collections.abc import Collection, Iterator
from contextlib import suppress
from dataclasses import dataclass
from threading import Thread

import numpy as np

from amhe_cli.core.belief import Belief
from amhe_cli.core.errors import AmheError, ConfigError, EstimationError, one_of
from amhe_cli.core.log import Samples, Window
from amhe_cli.engine.cpu import hush_mujoco
from amhe_cli.engine.open import open_engine
from amhe_cli.estimation.explain.inputs import first_look
from amhe_cli.estimation.online.horizon import Estimate, MovingHorizon
from amhe_cli.estimation.online.tracker import Buffer, Tracker
from amhe_cli.estimation.online.workers import Trouble, Worker
from amhe_cli.logs.live.messages import LiveSource
from amhe_cli.system.system import System

#: So much of the first samples is looked at for a wrong sign, order or unit [s].
_LOOKED_AT = 5.0
#: After the end of a source, its last estimate is waited for so long [s].
_LAST = 2.0


def estimator_of(
    system: System, start: Belief | None, seed: int, kind: str, again: Belief | None = None
) -> MovingHorizon:
    """The estimator of a watch; its arguments are all it needs, also in another process.

    Args:
        start: Belief to start from; None: the system's prior.
        seed: Seed of the random numbers.
        kind: What computes the rollouts.
        again: Belief from which to go on after an estimator has ended; None: `start`.
    """
    hush_mujoco()
    engine = open_engine(system, threads=1, kind=kind)
    return MovingHorizon(system, engine, np.random.default_rng(seed), again or start)


def watch(system: System, source: LiveSource, worker: Worker) -> Iterator[Estimate | str | None]:
    """What happens until the source is over: estimates, events in words, and None after each look.

    Args:
        source: Gives the samples.
        worker: Runs the estimator.

    Raises:
        EstimationError: The estimator does not start.
    """
    while not worker.ready:
        yield None
        for trouble in worker.poll(0.0):
            raise EstimationError(getattr(trouble, "text", "the estimator does not start"))
        time.sleep(0.01)
    tracker, epoch, end = Tracker(system, worker), source.epoch, np.inf
    look = _FirstLook(system)
    while time.monotonic() < end and not (source.over and worker.ready):
        samples = source.wait()
        if source.epoch != epoch:  # its clock was set back: samples of before and after do not mix
            tracker, epoch = Tracker(system, worker), source.epoch
            look.forget()
        if np.isfinite(source.now):
            now = float(np.floor(source.now / system.dt + 1e-6)) * system.dt  # in phase with the samples
            for news in worker.poll(now) if source.over else tracker.feed(samples, now):
                yield news.text if isinstance(news, Trouble) else news
            yield from look.remarks(samples, now)
        yield from source.events()
        yield None
        end = min(end, time.monotonic() + _LAST) if source.over else end
    yield from (news for news in worker.poll(source.now + 1.0) if isinstance(news, Estimate))
    yield from look.rest()


class _FirstLook:
    """Says what is plainly wrong with the first samples, such as a sign; a thread looks, and nobody waits."""

    def __init__(self, system: System) -> None:
        self._system = system
        self._thread: Thread | None = None
        self._found: list[str] = []
        self.forget()

    def forget(self) -> None:
        """Begin again with the samples that come now."""
        system = self._system
        self._kept = Buffer(system.signals, _LOOKED_AT, system.dt, system.settings.logs.max_gap)

    def remarks(self, samples: Samples, now: float) -> list[str]:
        """What has been found since the last call, with the next samples up to a time [s]."""
        if self._thread is None:
            self._kept.append(samples)
            if (window := self._kept.window(now)) is not None:
                self._thread = Thread(target=self._look, args=(window,), daemon=True)
                self._thread.start()
        found, self._found = self._found, []
        return found

    def rest(self) -> list[str]:
        """What a look that is under way finds."""
        if self._thread is not None:
            self._thread.join(_LAST)
        return self._found

    def _look(self, window: Window) -> None:
        with suppress(AmheError):  # too little of a motion, say: there is nothing to be said then
            self._found = [*first_look(self._system, window.log)]


@dataclass(frozen=True, slots=True)
class Alarm:
    """A limit that a parameter should keep: the alarm holds once its 90 % interval is wholly beyond it.

    Args:
        name: The parameter.
        sign: '>' where values above the limit alarm, '<' where those below do.
        limit: The limit, in the parameter's unit.
    """

    name: str
    sign: str
    limit: float

    @classmethod
    def parsed(cls, text: str, names: Collection[str]) -> Alarm:
        """Read a rule such as 'load_mass>1.2'.

        Raises:
            ConfigError: It is none, or there is no such parameter.
        """
        found = re.fullmatch(r"\s*([\w.\-]+)\s*([<>])\s*([-+]?[\d.]+(?:[eE][-+]?\d+)?)\s*", text)
        if found is None:
            raise ConfigError(f"`alarm`: {text!r} is no rule; write NAME>VALUE or NAME<VALUE")
        if found[1] not in names:
            raise ConfigError(f"`alarm`: {one_of('parameter', found[1], names)}")
        return cls(found[1], found[2], float(found[3]))

    def holds(self, estimate: Estimate) -> bool:
        """Whether the interval of an estimate is beyond the limit."""
        i = estimate.belief.names.index(self.name)
        return bool(estimate.lower[i] > self.limit if self.sign == ">" else estimate.upper[i] < self.limit)

    def __str__(self) -> str:
        return f"{self.name} {self.sign} {self.limit:g}"
