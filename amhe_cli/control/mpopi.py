"""MPOPI: MPPI whose sampling distribution is refined as in CMA-ES (the paper's section III-C, Algorithm 1).

A plan is a vector: K knots of a cubic spline for each of the joints, then a few channels that are held over
the horizon. Its distribution is a diagonal Gaussian about a mean that moves with time. One step samples,
rolls out, and moves the mean by MPPI's weights; after a switch of the contact mode it also refines the
Gaussian, one loop a step. The caller computes the costs of rollouts.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from amhe_cli.control.settings import ControlSettings
from amhe_cli.core.arrays import BoolArray, FloatArray
from amhe_cli.core.statistics import log_rank_weights


def spline_basis(at: FloatArray, knots: int) -> FloatArray:
    """Matrix that takes the values at K even knots over [0, 1] to those of their natural cubic spline.

    Outside of [0, 1] the spline keeps its end values.

    Args:
        at: Where to evaluate, between 0 and 1, shape (H,).
        knots: K, at least 2.

    Returns:
        Matrix of shape (H, K); rows sum to one.
    """
    x = np.clip(at, 0.0, 1.0)
    gap = 1.0 / (knots - 1)
    left = np.minimum((x / gap).astype(int), knots - 2)
    b = x / gap - left
    a = 1.0 - b
    curvature = _second_derivatives(knots, gap)
    rows = np.arange(x.size)
    basis = np.zeros((x.size, knots))
    basis[rows, left] = a
    basis[rows, left + 1] = b
    bend = gap**2 / 6.0 * (np.stack((a**3 - a, b**3 - b)))[..., None]
    return basis + bend[0] * curvature[left] + bend[1] * curvature[left + 1]


def shift_matrix(horizon: int, knots: int, steps: float) -> FloatArray:
    """Matrix (K, K) that moves a spline over H instants ahead by some steps; its end is held."""
    return spline_basis(np.linspace(0.0, 1.0, knots) + steps / (horizon - 1), knots)


def _second_derivatives(knots: int, gap: float) -> FloatArray:
    """Matrix (K, K) from values at the knots to second derivatives there, zero at both ends."""
    system, differences = np.eye(knots), np.zeros((knots, knots))
    for i in range(1, knots - 1):
        system[i, i - 1 : i + 2] = np.array([1.0, 4.0, 1.0]) * gap / 6.0
        differences[i, i - 1 : i + 2] = np.array([1.0, -2.0, 1.0]) / gap
    return np.asarray(np.linalg.solve(system, differences), dtype=np.float64)


#: A channel stays within this many of its start sigmas, whatever the samples like.
_CHANNEL_RANGE = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class Scores:
    """Costs of rollouts.

    Args:
        cost: Cost of each rollout, shape (n,); infinite where it diverged.
        terms: Parts of the cost, each shape (n,).
    """

    cost: FloatArray
    terms: Mapping[str, FloatArray]


@dataclass(frozen=True, slots=True, eq=False)
class MpopiStep:
    """Result and statistics of one step of MPOPI.

    Args:
        mean: The new mean, shape (d,).
        weights: Weights of the samples in the new mean, shape (n,); all zero where all samples diverged.
        rollouts, diverged: Number of rollouts, and how many of them diverged.
        effective_samples: 1 / sum of squared weights: 1 where one sample decides, n where none does.
        best, average: Least cost, and mean of the finite ones.
        terms: Parts of the least cost.
    """

    mean: FloatArray
    weights: FloatArray
    rollouts: int
    diverged: int
    effective_samples: float
    best: float
    average: float
    terms: dict[str, float]


class Mpopi:
    """The sampler; its state is the mean, the sigma and the best plan so far.

    Args:
        settings: Numbers of samples, knots, loops and so on.
        joint_sigma: Start sd of the noise on each joint's knots [rad], shape (n,).
        channel_sigma: Start sd of the noise on the channels, shape (c,).
        rng: Source of all samples.
    """

    def __init__(
        self,
        settings: ControlSettings,
        joint_sigma: FloatArray,
        channel_sigma: FloatArray,
        rng: np.random.Generator,
    ) -> None:
        self._settings, self._rng = settings, rng
        self._start_sigma = np.concatenate((np.tile(joint_sigma, settings.knots), channel_sigma))
        self._joints = joint_sigma.size
        self._knot_numbers = settings.knots * self._joints
        self._limit = _CHANNEL_RANGE * channel_sigma
        self._shift = shift_matrix(settings.horizon, settings.knots, 1.0)
        self.sigma = self._start_sigma.copy()
        self.mean = np.zeros_like(self.sigma)
        self._best: FloatArray | None = None
        self._loops_left = 0

    def split(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Knots (..., K, joints) and channels (..., c) of plans (..., d)."""
        knots = x[..., : self._knot_numbers]
        return knots.reshape(*x.shape[:-1], -1, self._joints), x[..., self._knot_numbers :]

    def step(self, evaluate: Callable[[FloatArray], Scores], switched: bool) -> MpopiStep:
        """Move ahead by one period, sample, and update the mean.

        Args:
            evaluate: Scores of plans (n, d), which come in the order of their worth; of the first ones alone
                where there is no time for more.
            switched: A contact has just switched. The L loops of the refinement that begins then are those of
                this and the following steps: so each has all of the samples, and no step takes longer.
        """
        self._move_ahead()
        self._begin_loops(switched)
        x, noisy = self._candidates()
        scores = evaluate(x)
        x, noisy = x[: len(scores.cost)], noisy[: len(scores.cost)]
        if self._loops_left > 0:
            self._loops_left -= 1
            self._refine(x, noisy, scores.cost)
        weights = mppi_weights(scores.cost, self._settings.temperature)
        best = int(np.argmin(scores.cost))
        finite = scores.cost[np.isfinite(scores.cost)]
        if finite.size:
            self._best = x[best]
            self.mean = weights @ x
        return MpopiStep(
            mean=self.mean,
            weights=weights,
            rollouts=len(x),
            diverged=len(x) - finite.size,
            effective_samples=float(1.0 / (weights @ weights)) if finite.size else 0.0,
            best=float(scores.cost[best]),
            average=float(finite.sum()) / finite.size if finite.size else float("inf"),
            terms={name: float(term[best]) for name, term in scores.terms.items()},
        )

    def _begin_loops(self, switched: bool) -> None:
        if self._settings.refine == "always":
            self._loops_left = 1
        elif self._settings.refine == "switch" and switched:
            self.sigma, self._loops_left = self._start_sigma.copy(), self._settings.loops

    def _move_ahead(self) -> None:
        self.mean = self._moved(self.mean)
        if self._best is not None:
            self._best = self._moved(self._best)

    def _moved(self, x: FloatArray) -> FloatArray:
        knots, channels = self.split(x)
        return np.concatenate(((self._shift @ knots).ravel(), channels))

    def _candidates(self) -> tuple[FloatArray, BoolArray]:
        """Plans (n, d), and which of their numbers carry noise.

        The mean itself, the previous best, the bare reference, then noise about the mean; half of that leaves
        the joints alone: noise on twelve joints hides what a channel does.
        """
        count = self._settings.samples
        noisy = np.ones((count, self.sigma.size), dtype=np.bool_)
        noisy[:3] = False
        noisy[3::2, : self._knot_numbers] = False
        x = self.mean + self.sigma * noisy * self._rng.standard_normal(noisy.shape)
        x[1] = self.mean if self._best is None else self._best
        x[2] = 0.0
        channels = x[:, self._knot_numbers :]
        channels[:] = np.minimum(np.maximum(channels, -self._limit), self._limit)
        return x, noisy

    def _refine(self, x: FloatArray, noisy: BoolArray, cost: FloatArray) -> None:
        """Move sigma towards the elites' spread, by log-rank weights.

        The variance is taken about the *old* mean (rank-mu update of CMA-ES): it does not collapse while
        the mean still moves. Each number has its own elites, of the plans that carry noise in it: the others
        do not show its spread.
        """
        s = self._settings
        order = np.argsort(cost)[: np.count_nonzero(np.isfinite(cost))]
        if order.size == 0:
            return
        rank = np.cumsum(noisy[order], axis=0, dtype=np.float64)
        elites = np.maximum(np.round(s.elites * rank[-1]), np.minimum(2, rank[-1]))
        weights = noisy[order] * log_rank_weights(rank, elites)
        total = weights.sum(axis=0)
        spread = (weights * (x[order] - self.mean) ** 2).sum(axis=0)
        variance = np.where(total > 0.0, spread / np.maximum(total, 1e-12), self.sigma**2)
        blended = (1.0 - s.learning_rate) * self.sigma**2 + s.learning_rate * variance
        low, high = s.sigma_range
        least, most = low * self._start_sigma, high * self._start_sigma
        self.sigma = np.minimum(np.maximum(np.sqrt(blended), least), most)


def mppi_weights(cost: FloatArray, temperature: float) -> FloatArray:
    """Weights exp(-(cost - least) / (temperature (median - least))) that sum to one, shape (n,).

    All zero where no cost is finite. The scale makes them indifferent to units and to a cost that all
    samples share.
    """
    count = np.count_nonzero(np.isfinite(cost))
    if count == 0:
        return np.zeros_like(cost)
    ordered = np.sort(cost)
    median = 0.5 * (ordered[(count - 1) // 2] + ordered[count // 2])  # np.median takes ten times as long
    weights = np.exp((ordered[0] - cost) / (temperature * (median - ordered[0]) + 1e-12))
    return weights / weights.sum()
