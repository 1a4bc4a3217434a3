"""Predictions of a replay's windows from their own estimates: for the written log, and for figures."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from amhe_cli.core.arrays import FloatArray, IntArray, to_host
from amhe_cli.core.each_log import values_on
from amhe_cli.core.log import Window
from amhe_cli.engine.rollout import Engine
from amhe_cli.estimation.core.result import Fit
from amhe_cli.estimation.online.horizon import cost_of, usable
from amhe_cli.estimation.online.replay import Replay
from amhe_cli.estimation.validation.fits import SHOWN, fit_of
from amhe_cli.matching.readings import reading_of, state_errors
from amhe_cli.matching.windows import starts_of
from amhe_cli.system.system import System

#: Windows that are rolled out at once: enough for every thread without much memory.
_AT_ONCE = 16


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """Part of a rollout, on the clock of the log that it started from.

    Args:
        rows: Rows of that log, shape (m,).
        values: Series of the log, such as 'box.position' -> its prediction, shape (m, k).
    """

    rows: IntArray
    values: Mapping[str, FloatArray]


def predictions(done: Replay, engine: Engine) -> list[Prediction | None]:
    """Roll each window out with the estimate after it, and keep the part that is new in it.

    Returns:
        One prediction for each window; None where a signal is missing at its start, or the rollout diverged.
    """
    system = done.system
    log = done.windows[0].log
    theta = values_on(log, system.edits.space, system.space, done.column("theta"))
    newest = round(system.settings.mhe.update_period / done.windows[0].log.dt)
    found: list[Prediction | None] = [None] * len(done.windows)
    if system.match == "effort":
        return [_efforts(done, engine, i, newest) for i in range(len(done.windows))]
    known = [i for i, window in enumerate(done.windows) if usable(system, window)]
    for start in range(0, len(known), _AT_ONCE):
        some = known[start : start + _AT_ONCE]
        ends = _ends(system, engine, [done.windows[i] for i in some], theta[some], newest)
        for i, end in zip(some, ends, strict=True):
            found[i] = end
    return found


def _efforts(done: Replay, engine: Engine, i: int, newest: int) -> Prediction | None:
    """Efforts along the newest part of a window's motion; NaN of joints that were not compared."""
    window, system = done.windows[i], done.system
    if (cost := cost_of(system, window, engine)) is None:
        return None
    (own,), observed = cost.clips.windows, cost.clips.observed
    predicted = cost.predict(system.space.z_of(done.estimates[i].theta)[None]).values
    compared = np.any([one.mask[0] for one in observed], axis=0)
    rows = observed[0].rows[0] + 1 + own.start
    some = np.flatnonzero(compared & (rows > own.stop - newest))
    series: dict[str, FloatArray] = {}
    for one, values in zip(observed, predicted, strict=True):
        width = len(own.log[one.channel.series].columns)
        into = series.setdefault(one.channel.series, np.full((some.size, width), np.nan))
        into[:, one.channel.part] = to_host(values)[0, 0, some, 0]
    return Prediction(rows[some] + window.start - own.start, series)


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


def replay_fits(done: Replay, engine: Engine) -> tuple[Fit, ...]:
    """Measured against predicted in the used windows of least, median and largest misfit, by channel.

    The initial prediction is from the belief before the replay, the identified one from the estimate after
    the window.
    """
    moved = done.column("updated")
    order = np.argsort(np.where(moved, done.column("misfit"), np.inf))[: int(moved.sum())]
    if not order.size:
        return ()
    picks = order[np.unique(np.linspace(0, order.size - 1, SHOWN).round().astype(int))]
    return tuple(fit for i in picks for fit in _fits(done, engine, int(i)))


def _fits(done: Replay, engine: Engine, i: int) -> Iterator[Fit]:
    window, estimate, system = done.windows[i], done.estimates[i], done.system
    cost = cost_of(system, window, engine)
    assert cost is not None, "the window was used"
    predicted = cost.predict(np.stack((done.start.z, system.space.z_of(estimate.theta))))
    end = done.times[i]
    label = (
        f"{end - window.duration:.2f} to {end:.2f} s: misfit {estimate.misfit:.2g}"
        f"{'' if estimate.mark == 'updated' else f', {estimate.mark}'}"
    )
    for observed, values in zip(cost.clips.observed, map(to_host, predicted.values), strict=True):
        if observed.mask[0].any():
            yield replace(fit_of(observed, values[:, 0], window, 0, held_out=False), clip=label)
