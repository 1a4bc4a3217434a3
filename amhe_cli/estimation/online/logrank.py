"""The paper's update (Algorithm 1, MHE-Estimate): elites of a diagonal Gaussian, log-rank weighted."""

from __future__ import annotations

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.statistics import log_rank_weights
from amhe_cli.estimation.online.arrival import Arrival
from amhe_cli.estimation.online.update import Outcome, Task, excitation, rms


def logrank_update(task: Task) -> Outcome:
    """Draw, roll out, learn from the elites; until the iterations are done or the samples lie close.

    The reported sd is that of the samples, as in the paper. It is no posterior: it shrinks with every
    iteration, whatever the window says.
    """
    cost, setting, space = task.cost, task.settings, task.cost.system.space
    weight, counts = np.array(setting.weights(space.names)), cost.clips.counts
    mean = arrived = task.arrival.z  # line 24
    sigma = space.in_z(setting.sigma)
    floor = space.in_z(setting.sigma_floor)
    rollouts = diverged = done = 0
    before = after = excited = np.nan
    for _ in range(setting.iteration_count):  # line 25
        if done and task.late():
            break
        drawn = mean + sigma * task.rng.standard_normal((task.samples - 1, len(space)))
        samples = space.clip(np.concatenate((drawn, mean[None])))  # line 26; the mean itself never gets lost
        residuals = cost.residuals(samples)
        costs = (
            cost.clip_costs(residuals)[:, 0] + ((samples - arrived) ** 2) @ weight
        )  # line 27, equation (5)
        if not done:
            excited = excitation(residuals, counts)
            before = rms(residuals.flat[-1, 0], counts) if residuals.completed[-1, 0] else np.inf
        best = int(np.argmin(costs))
        after = rms(residuals.flat[best, 0], counts) if np.isfinite(costs[best]) else np.inf
        mean, sigma = learned(samples, costs, mean, sigma, setting.elites, setting.learning_rate)  # line 28
        rollouts, diverged = rollouts + costs.size, diverged + int((~residuals.completed).sum())
        done += 1
        if (sigma <= floor).all():  # lines 29-32
            break
    belief = Arrival(mean, np.diag(sigma**2))  # line 33
    return Outcome(belief, task.noise, before, after, 0.0, excited, rollouts, diverged, done)


def learned(
    samples: FloatArray, costs: FloatArray, mean: FloatArray, sigma: FloatArray, share: float, rate: float
) -> tuple[FloatArray, FloatArray]:
    """Mean and sd (d,) moved towards the elites, whose variance is taken about the old mean.

    Args:
        samples: Shape (b, d).
        costs: Shape (b,); inf for those that diverged, which teach nothing.
        mean, sigma: Of the samples, shape (d,).
        share: Of the samples that are elites.
        rate: alpha.
    """
    order = np.argsort(costs)
    count = min(max(2, round(share * len(samples))), int(np.isfinite(costs).sum()))
    if count == 0:
        return mean, sigma
    elites = samples[order[:count]]
    weights = log_rank_weights(np.arange(1.0, count + 1.0), np.array(float(count)))
    weights = weights / weights.sum()
    variance = weights @ (elites - mean) ** 2
    return mean + rate * (weights @ elites - mean), np.sqrt((1.0 - rate) * sigma**2 + rate * variance)
