"""Measured against predicted in a few windows of a replay, for figures."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from amhe_cli.engine.rollout import Engine
from amhe_cli.estimation.offline.fits import SHOWN, fit_of
from amhe_cli.estimation.offline.result import Fit
from amhe_cli.estimation.online.replay import Replay
from amhe_cli.matching.cost import MatchingCost


def replay_fits(done: Replay, engine: Engine) -> tuple[Fit, ...]:
    """Of the windows that moved the belief those of least, middling and largest misfit, each channel a Fit.

    Their initial prediction is that of the belief before the replay, the identified one that of the
    estimate which the window led to.
    """
    moved = done.column("updated")
    order = np.argsort(np.where(moved, done.column("misfit"), np.inf))[: int(moved.sum())]
    if not order.size:
        return ()
    picks = order[np.unique(np.linspace(0, order.size - 1, SHOWN).round().astype(int))]
    return tuple(fit for i in picks for fit in _fits(done, engine, int(i)))


def _fits(done: Replay, engine: Engine, i: int) -> Iterator[Fit]:
    window, estimate, system = done.windows[i], done.estimates[i], done.system
    cost = MatchingCost(system, [window], engine, system.settings.cost)
    predicted = cost.predict(np.stack((done.start.z, system.space.z_of(estimate.theta))))
    end = done.times[i]
    label = (
        f"{end - window.duration:.2f} to {end:.2f} s: misfit {estimate.misfit:.2g}"
        f"{'' if estimate.mark == 'updated' else f', {estimate.mark}'}"
    )
    for observed, values in zip(cost.clips.observed, predicted.values, strict=True):
        if observed.mask[0].any():
            yield replace(fit_of(observed, values[:, 0], window, 0, held_out=False), clip=label)
