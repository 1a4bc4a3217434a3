"""Clips under given values, their first states fitted: how well do they explain the clips?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from amhe_cli.core.arrays import FloatArray, to_host
from amhe_cli.estimation.core.information import Information, channel_times, information
from amhe_cli.estimation.core.linearise import FirstStates
from amhe_cli.estimation.offline.problem import Problem
from amhe_cli.matching.cost import MatchingCost, Residuals

#: Shares of the step to the best first states that are tried on each clip.
LINE = np.array([1.0, 0.5, 0.0])


@dataclass(frozen=True, slots=True, eq=False)
class Scored:
    """c clips under one z, their first states fitted.

    Args:
        residuals: Residuals in the noise of the cost that was given, each channel (1, c, samples, k).
        losses: Robust loss of each channel, shape (c,) each; infinite where the clip diverged.
        first: Squared first-state errors, shape (c,).
        times: Autocorrelation time of each channel's residuals, in samples.
        information: What the clips know of z.
    """

    residuals: Residuals
    losses: list[FloatArray]
    times: tuple[float, ...]
    first: FloatArray
    information: Information

    def misfit(self, times: Sequence[float]) -> FloatArray:
        """Losses as of independent samples for some autocorrelation times, and first-state errors, (c,)."""
        return self.first + np.sum(
            [loss / time for loss, time in zip(self.losses, times, strict=True)], axis=0
        )


def scored(problem: Problem, cost: MatchingCost, z: FloatArray, shape: FloatArray) -> Scored:
    """Fit the first states of clips under z (d,): the step that a linearisation gives, as far as it helps.

    Args:
        problem: The problem.
        cost: Cost on the clips.
        z: The values.
        shape: Shape of the samples of z, (d, d).
    """
    nx = fitted_errors(problem, cost)
    first = FirstStates.recorded(len(cost.clips.windows), nx)
    slopes = problem.linearised(cost, z, first, shape, problem.rng(5), straight=not problem.touches)
    found = information(slopes)
    tried = LINE[:, None, None] * found.nuisance
    residuals = cost.residuals(np.repeat(z[None], len(LINE), axis=0), tried if nx else None)
    losses = cost.losses(residuals)
    errors = np.einsum("pcx,pcx->pc", tried, tried)
    total, times = errors, channel_times(cost, found.residual, slopes.completed)
    for loss, time in zip(losses, times, strict=True):
        total = total + loss / time
    total = np.where(residuals.completed, total, np.inf)
    best = total.argmin(axis=0), np.arange(total.shape[1])
    done = residuals.completed[best]
    kept = tuple(to_host(values)[best][None] for values in residuals.values)
    own = [np.where(done, one[best], np.inf) for one in losses]
    return Scored(Residuals(kept, done[None]), own, times, errors[best], found)


def fitted_errors(problem: Problem, cost: MatchingCost) -> int:
    """Number of first-state errors that are fitted."""
    return 0 if problem.settings.identify.first_state == "never" else cost.nx
