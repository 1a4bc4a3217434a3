"""What stretches of a log tell about the parameters: Fisher information by the matching cost."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.trajectory import Window
from amhe_cli.engine.rollout import RolloutEngine
from amhe_cli.estimation.linearised import Information, information, linearise
from amhe_cli.estimation.shape import sampling_width
from amhe_cli.matching import MatchingCost
from amhe_cli.system.system import System

#: Gauss-Newton steps from the belief to where a log points: at most so many, until one is this small [sd].
MOST_STEPS, SETTLED = 10, 0.5


def information_at(
    system: System, windows: Sequence[Window], engine: RolloutEngine, z: FloatArray, rng: np.random.Generator
) -> Information:
    """Information of each window on z (d,): `matrix` has shape (c, d, d).

    First states are fitted along where the system's settings always fit them, else taken as recorded: those
    of a robot would take a hundred rollouts a window. The noise is what the residuals show, their
    autocorrelation included; the samples are as wide as the jitter of contacts asks for.
    """
    plain = MatchingCost(system, windows, engine, system.settings.cost)
    cost = MatchingCost(system, windows, engine, system.settings.cost, _noise_scale(plain, z))
    setting = system.settings.identify
    first = np.zeros((len(windows), cost.nx if setting.first_state == "always" else 0))
    shape = np.diag(sampling_width(system.space, setting.step))
    return information(linearise(cost, z, first, shape, 0, rng))


def _noise_scale(cost: MatchingCost, z: FloatArray) -> dict[str, float]:
    """Residual sd over declared noise sd of each channel in the middling window."""
    found = cost.residuals(z[None])
    scale = {}
    for observed, values in zip(cost.clips.observed, found.values, strict=True):
        counts = np.maximum(observed.mask.sum(axis=1) * observed.width, 1)
        squares = (values[0] ** 2).sum(axis=(1, 2)) / counts
        kept = squares[found.completed[0]]
        scale[observed.channel.key] = float(np.sqrt(np.median(kept))) if kept.size else 1.0
    return scale


def information_where_it_points(
    system: System, windows: Sequence[Window], engine: RolloutEngine, rng: np.random.Generator
) -> FloatArray:
    """Information (d, d) of all windows together, at the estimate that a few steps from the belief reach.

    What a log tells is to be asked where its truth is; a belief may be far from it.
    """
    space = system.space
    z, hessian = np.zeros(len(space)), space.prior_precision
    for _ in range(MOST_STEPS):
        found = information_at(system, windows, engine, z, rng)
        hessian = found.matrix.sum(axis=0) + space.prior_precision
        step = -np.linalg.solve(hessian, found.score.sum(axis=0) + space.prior_precision @ z)
        z = space.clip(z + step)
        if step @ hessian @ step < SETTLED**2:
            break
    return hessian - space.prior_precision
