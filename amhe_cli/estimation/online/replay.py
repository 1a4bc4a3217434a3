"""The estimator over a recorded log, as if it were live; and each window predicted by its own estimate."""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from amhe_cli.core.arrays import FloatArray, IntArray, to_host
from amhe_cli.core.belief import Belief
from amhe_cli.core.each_log import values_on
from amhe_cli.core.errors import EstimationError
from amhe_cli.core.log import Log, Window
from amhe_cli.core.settings import MheSettings
from amhe_cli.engine.open import open_engine
from amhe_cli.engine.rollout import Engine
from amhe_cli.estimation.core.result import Fit
from amhe_cli.estimation.online.horizon import LEAST, Estimate, MovingHorizon, check_window, cost_of, usable
from amhe_cli.estimation.online.updates import Gaussian, prior_of
from amhe_cli.estimation.validation.held_out import SHOWN, fit_of
from amhe_cli.logs.read import read_truth, truth_in_metadata
from amhe_cli.matching.readings import reading_of, state_errors
from amhe_cli.matching.windows import starts_of
from amhe_cli.system.system import System

logger = logging.getLogger(__name__)


#: Windows that are rolled out at once: enough for every thread without much memory.
_AT_ONCE = 16


@dataclass(eq=False)
class Replay:
    """The estimator over a log: the windows that it is to see, and its estimates after those it has seen.

    Args:
        system: The system whose parameters are estimated.
        engine: Engine of the rollouts.
        estimator: The estimator; it goes on from window to window.
        start: Prior of the first window.
        steps: The window of each update.
        true_values: Parameter -> true value at each window's end according to the log, shape (steps,); NaN
            where the log has none.
        begun: Time of row 0, from the start of the file [s].
        paced: Whether the update period follows from the window; see `paced`.
        estimates: Estimates so far; their times count from the log's start.
        seconds: Duration of the replay [s].
    """

    system: System
    engine: Engine
    estimator: MovingHorizon
    start: Gaussian
    steps: Sequence[Window]
    true_values: Mapping[str, FloatArray]
    begun: float
    paced: bool = False
    estimates: list[Estimate] = field(default_factory=list)
    seconds: float = 0.0

    def run(
        self,
        on_estimate: Callable[[Estimate], None] = lambda estimate: None,
        stopped: Callable[[], bool] = lambda: False,
    ) -> Replay:
        """Replay all of the log, or as much as there is until `stopped`; at least one window.

        Args:
            on_estimate: Called with each estimate.
            stopped: Called after each estimate; returns whether to stop.
        """
        begun = time.perf_counter()
        for estimate in replay(self.estimator, self.steps, self.begun):
            self.estimates.append(estimate)
            on_estimate(estimate)
            if stopped():
                break
        self.seconds = time.perf_counter() - begun
        return self

    @property
    def windows(self) -> Sequence[Window]:
        """The window of each estimate."""
        return self.steps[: len(self.estimates)]

    @property
    def truth(self) -> dict[str, FloatArray]:
        """Parameter -> true value at each estimate, shape (n,)."""
        return {name: values[: len(self.estimates)] for name, values in self.true_values.items()}

    @property
    def interrupted(self) -> bool:
        """Whether it was stopped before the last window."""
        return len(self.estimates) < len(self.steps)

    @property
    def times(self) -> FloatArray:
        """Time of each estimate from the log's start [s], shape (n,)."""
        return self.column("time")

    @property
    def real_time_factor(self) -> float:
        """Seconds of log replayed in one second."""
        first, last = self.windows[0], self.windows[-1]
        return (last.stop - first.start) * first.log.dt / max(self.seconds, 1e-9)

    @property
    def start_theta(self) -> FloatArray:
        """Mean of the prior as parameters, shape (d,)."""
        return self.system.space.theta_of(self.start.z)

    @property
    def update_ms(self) -> FloatArray:
        """Time of each update [ms], NaN where nothing was rolled out, shape (n,)."""
        return np.where(self.column("rollouts") > 0, self.column("update_ms"), np.nan)

    @cached_property
    def marks(self) -> Counter[str]:
        """Number of windows with each mark."""
        return Counter(e.mark for e in self.estimates)

    def column(self, field: str) -> FloatArray:
        """One field of every estimate, shape (n,) or (n, d)."""
        return np.array([getattr(e, field) for e in self.estimates])


def paced(system: System, before: MheSettings) -> System:
    """The system with an update period that suits a window longer than its own.

    The time of an update is proportional to its window. So the period keeps its share of the window, and an
    estimator that keeps up with real time keeps up with longer windows, too.

    Args:
        system: The system, whose window was chosen by the user and whose update period was not.
        before: Settings of the system before that choice.
    """
    mhe = system.settings.mhe
    period = before.update_period * max(1.0, mhe.window / before.window)
    changed = mhe.model_copy(update={"update_period": period})
    return replace(system, settings=system.settings.model_copy(update={"mhe": changed}))


def open_replay(
    system: System,
    log: Log,
    *,
    belief: Belief | None = None,
    seed: int = 0,
    threads: int = 1,
    kind: str = "cpu",
    begun: float = 0.0,
    paced: bool = False,
) -> Replay:
    """A replay of a log that is ready to run.

    Args:
        system: The system that is estimated.
        belief: Belief to start from; None: the system's prior.
        seed: Seed of the random numbers.
        threads: CPU threads; results do not depend on them.
        kind: What computes the rollouts: one of `engine.open.KINDS`.
        begun: Time at which the log was begun to be read, from the start of its file [s].
        paced: The update period follows from the window, see `paced`.

    Raises:
        EstimationError: The log is too short for any window.
    """
    steps = windows(system, log)
    engine = open_engine(system, threads=threads, kind=kind)
    return Replay(
        system=system,
        engine=engine,
        estimator=MovingHorizon(system, engine, np.random.default_rng(seed), belief),
        start=prior_of(system.space, belief, system.settings.mhe.start_sd),
        steps=steps,
        true_values=_truth(system, log, steps),
        begun=np.ceil(begun / log.dt - 1e-6) * log.dt,  # reading begins at a step of the clock
        paced=paced,
    )


def _truth(system: System, log: Log, steps: Sequence[Window]) -> dict[str, FloatArray]:
    """True parameters at the end of each window: over time where the log has them so, else once for all."""
    ends = np.array([step.stop for step in steps])
    stamps_ns = log.start_ns + np.round(ends * log.dt * 1e9).astype(np.int64)
    over_time = read_truth(log.file, stamps_ns, system.settings.logs) if log.file else {}
    once = {name: np.full(ends.size, value) for name, value in truth_in_metadata([log]).items()}
    return {name: values for name, values in (once | over_time).items() if name in system.space.names}


def windows(system: System, log: Log) -> list[Window]:
    """The window before each update, one update period apart; a log shorter than a window is one window.

    Raises:
        ConfigError: The window or the update period is too short.
        EstimationError: The log is too short for any window.
    """
    setting, dt = system.settings.mhe, log.dt
    check_window(setting, dt)
    length, every = round(setting.window / dt), round(setting.update_period / dt)
    longest = log.steps - 2
    if longest < LEAST:
        raise EstimationError(
            f"{log.source}: {log.duration:.3g} s hold no window; record a longer log, "
            f"or take more of it (`start`, `end`)"
        )
    if longest < length:
        logger.warning(
            "%s: its %.3g s hold no window of %g s, so one of %.3g s is used; choose a shorter window",
            log.source, log.duration, setting.window, longest * dt,
        )  # fmt: skip
        length = longest
    if every > length:
        logger.warning(
            "updates every %g s use windows of %g s, so the data between the windows are not used; choose a "
            "longer window or a shorter update period", every * dt, length * dt,
        )  # fmt: skip
    return [Window(log, stop - length, length) for stop in range(length, log.steps - 1, every)]


def replay(estimator: MovingHorizon, steps: Sequence[Window], begun: float = 0.0) -> Iterator[Estimate]:
    """Estimates after each window; `begun` is the time of row 0 [s]."""
    for window in steps:
        yield estimator.update(window, begun + window.stop * window.log.dt)


def caution(run: Replay) -> None:
    """Log warnings that a reader of the estimates must know."""
    source, count, marks = run.windows[0].log.source, len(run.windows), run.marks
    if marks["gap"]:
        logger.warning(
            "%s: %d of %d windows were skipped because a signal or an input is missing; the sd of the "
            "estimate grows there", source, marks["gap"], count,
        )  # fmt: skip
    if marks["diverged"]:
        logger.warning(
            "%s: %d of %d windows were skipped because their rollouts diverged",
            source,
            marks["diverged"],
            count,
        )
    if not any(e.updated for e in run.estimates):
        logger.warning("%s: no window was used: the estimate is still the initial one", source)
    took = run.update_ms[np.isfinite(run.update_ms)]
    usual, period = float(np.median(took)) if took.size else 0.0, 1e3 * run.system.settings.mhe.update_period
    if usual > period:
        logger.warning(
            "an update takes %.0f ms, but the update period is %g ms: this machine would not keep up with a "
            "live robot; choose a longer update period or a shorter window", usual, period,
        )  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """Part of a rollout, on the clock of the log that it started from.

    Args:
        rows: Rows of that log, shape (m,).
        values: Series of the log, such as 'box.position' -> its prediction, shape (m, k).
    """

    rows: IntArray
    values: Mapping[str, FloatArray]


def predictions(run: Replay) -> list[Prediction | None]:
    """Roll each window out with the estimate after it, and keep the part that is new in it.

    Returns:
        One prediction for each window; None where a signal is missing at its start, or the rollout diverged.
    """
    system = run.system
    log = run.windows[0].log
    theta = values_on(log, system.edits.space, system.space, run.column("theta"))
    newest = round(system.settings.mhe.update_period / run.windows[0].log.dt)
    shown: list[Prediction | None] = [None] * len(run.windows)
    if system.match == "effort":
        return [_efforts(run, i, newest) for i in range(len(run.windows))]
    rows = [i for i, window in enumerate(run.windows) if usable(system, window)]
    for start in range(0, len(rows), _AT_ONCE):
        some = rows[start : start + _AT_ONCE]
        ends = _ends(system, run.engine, [run.steps[i] for i in some], theta[some], newest)
        for i, end in zip(some, ends, strict=True):
            shown[i] = end
    return shown


def _efforts(run: Replay, i: int, newest: int) -> Prediction | None:
    """Efforts along the newest part of a window's motion; NaN of joints that were not compared."""
    window, system = run.steps[i], run.system
    if (cost := cost_of(system, window, run.engine)) is None:
        return None
    (alone,), observed = cost.clips.windows, cost.clips.observed
    predicted = cost.predict(system.space.z_of(run.estimates[i].theta)[None]).values
    compared = np.any([channel.mask[0] for channel in observed], axis=0)
    rows = observed[0].rows[0] + 1 + alone.start
    some = np.flatnonzero(compared & (rows > alone.stop - newest))
    series: dict[str, FloatArray] = {}
    for channel, values in zip(observed, predicted, strict=True):
        width = len(alone.log[channel.channel.series].columns)
        into = series.setdefault(channel.channel.series, np.full((some.size, width), np.nan))
        into[:, channel.channel.part] = to_host(values)[0, 0, some, 0]
    return Prediction(rows[some] + window.start - alone.start, series)


def _ends(
    system: System, engine: Engine, windows: Sequence[Window], theta: FloatArray, newest: int
) -> list[Prediction | None]:
    """The last `newest` rows of windows of one length, each rolled out with its own theta (windows, d)."""
    smoothing = system.settings.cost.smoothing
    starts = [starts_of(system, [window], smoothing) for window in windows]
    delays = system.edits.delays(theta) / system.model.opt.timestep
    length = windows[0].length
    numbers = system.edits.numbers(theta)
    states = [
        start.states(system.model, 1, state_errors(system, theta[i : i + 1], start))
        for i, start in enumerate(starts)
    ]
    rollouts = engine.rollout(
        theta,
        np.concatenate([qpos[0] for qpos, _ in states]),
        np.concatenate([qvel[0] for _, qvel in states]),
        np.concatenate([start.inputs_under(delays[i : i + 1]) for i, start in enumerate(starts)]),
        np.full(len(windows), length),
    )
    end = slice(max(length - newest, 0), length)
    return [
        Prediction(
            # row k of a rollout is the instant k + 1
            window.start + 1 + np.arange(end.start, end.stop),
            {
                c.key: reading_of(
                    c,
                    system.calibration.readings.get(c.key),
                    numbers[i : i + 1],
                    getattr(rollouts, c.source)[i : i + 1, end][..., list(c.columns)],
                )[0]
                for c in system.channels
            },
        )
        if rollouts.completed[i]
        else None
        for i, window in enumerate(windows)
    ]


def replay_fits(run: Replay) -> tuple[Fit, ...]:
    """Measured against predicted in the used windows of least, median and largest misfit, by channel.

    The initial prediction is from the belief before the replay, the identified one from the estimate after
    the window.
    """
    moved = run.column("updated")
    order = np.argsort(np.where(moved, run.column("misfit"), np.inf))[: int(moved.sum())]
    if not order.size:
        return ()
    picks = order[np.unique(np.linspace(0, order.size - 1, SHOWN).round().astype(int))]
    return tuple(fit for i in picks for fit in _fits(run, int(i)))


def _fits(run: Replay, i: int) -> Iterator[Fit]:
    window, estimate, system = run.steps[i], run.estimates[i], run.system
    cost = cost_of(system, window, run.engine)
    assert cost is not None, "the window was used"
    predicted = cost.predict(np.stack((run.start.z, system.space.z_of(estimate.theta))))
    end = run.times[i]
    label = (
        f"{end - window.duration:.2f} to {end:.2f} s: misfit {estimate.misfit:.2g}"
        f"{'' if estimate.mark == 'updated' else f', {estimate.mark}'}"
    )
    for observed, values in zip(cost.clips.observed, map(to_host, predicted.values), strict=True):
        if observed.mask[0].any():
            yield replace(fit_of(observed, values[:, 0], window, 0, held_out=False), clip=label)
