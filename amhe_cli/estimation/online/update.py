"""What both updates of the moving-horizon estimator take and give."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.settings import MheSettings
from amhe_cli.estimation.online.arrival import Arrival
from amhe_cli.matching.cost import MatchingCost, Residuals

#: Share of the newest window in what is remembered of the noise; and by how much one window may exceed it:
#: what does not fit after a jump, or far from the truth, is no noise.
_NEW, _MOST = 0.2, 2.0


@dataclass(frozen=True, slots=True)
class Noise:
    """What the residuals of earlier windows have shown of each channel.

    Args:
        square: Channel -> mean squared residual, in declared variances.
        time: Channel -> autocorrelation time [samples].
    """

    square: Mapping[str, float] = field(default_factory=dict)
    time: Mapping[str, float] = field(default_factory=dict)

    def heard(self, square: Mapping[str, float], time: Mapping[str, float]) -> Noise:
        """With one more window, of which the oldest fade."""
        return Noise(_faded(self.square, square), _faded(self.time, time))

    def at_least(self, square: Mapping[str, float]) -> Noise:
        """For a window whose residuals are this large (channel -> mean square), whatever was remembered."""
        return Noise(
            {key: max(value, square.get(key, value)) for key, value in self.square.items()}, self.time
        )


def _faded(old: Mapping[str, float], new: Mapping[str, float]) -> dict[str, float]:
    """Before the first window the noise is as declared, and white: 1."""
    faded = dict(old)
    for key, value in new.items():
        before = old.get(key, 1.0)
        faded[key] = (1.0 - _NEW) * before + _NEW * min(value, _MOST * before)
    return faded


@dataclass(frozen=True, slots=True, eq=False)
class Task:
    """One window to learn from.

    Args:
        cost: Matching cost on the one window.
        arrival: Belief before it.
        surprised: The same, by how many sd off the window wants the parameters: wider after a jump.
        noise: Of the windows before it.
        share: Of the window that is new: overlapping windows say the rest again.
        settings: Of the estimator.
        samples: B of an iteration; no more than there is time for.
        rng: For samples.
        late: Whether the time for this update is up: stop at the next iteration.
    """

    cost: MatchingCost
    arrival: Arrival
    surprised: Callable[[float], Arrival]
    noise: Noise
    share: float
    settings: MheSettings
    samples: int
    rng: np.random.Generator
    late: Callable[[], bool]


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """What an update made of a window.

    Args:
        arrival: Belief after it.
        noise: Of the windows up to this one.
        before: Rms residual of the belief before, in noise sd; inf where it diverged.
        after: The same as the update expects it: of the best sample, or of the linearised step, which is not
            rolled out again.
        surprise: How far from the belief the window wants the parameters, in sd; 0 where nobody asks.
        excitation: Rms move of the predictions under the samples, in noise sd.
        rollouts, diverged: How many were run, and how many of them diverged.
        iterations: How many were done.
    """

    arrival: Arrival
    noise: Noise
    before: float
    after: float
    surprise: float
    excitation: float
    rollouts: int
    diverged: int
    iterations: int


class Update(Protocol):
    """One way to learn from a window."""

    def __call__(self, task: Task) -> Outcome:
        """Roll samples out on the window, and move the belief."""
        ...


def excitation(residuals: Residuals, counts: FloatArray) -> float:
    """Rms move of the residuals of the samples against those of the last one, the mean of them.

    Args:
        residuals: Of p samples on one window.
        counts: Numbers measured in the window, shape (1,).
    """
    done = residuals.completed[:-1, 0]
    if not done.any() or not residuals.completed[-1, 0]:
        return float("inf") if not residuals.completed.all() else 0.0
    moved = residuals.flat[:-1, 0][done] - residuals.flat[-1, 0]
    return float(np.sqrt((moved**2).sum(axis=1).mean() / counts[0]))


def rms(residual: FloatArray, counts: FloatArray) -> float:
    """Of one window's residuals (R,), of which `counts` (1,) were measured."""
    return float(np.sqrt((residual**2).sum() / counts[0]))
