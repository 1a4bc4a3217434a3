"""The default update: one Gauss-Newton step of cost plus arrival cost, from samples, without a derivative.

docs/estimation.md derives it. Differences from SPI's use of the same linearisation
(`estimation.linearised`): one window, whose first state is taken from the state estimator as it is; noise
remembered from window to window; and only the new share of overlapping windows counts as information.
"""

from __future__ import annotations

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.statistics import pseudo_huber_weight
from amhe_cli.estimation.linearised import Linearisation, channel_times, linearise, split
from amhe_cli.estimation.shape import WIDEST, bounded
from amhe_cli.matching import MatchingCost
from amhe_cli.online.arrival import Arrival, in_z
from amhe_cli.online.update import Noise, Outcome, Task, rms


def linearised_update(task: Task) -> Outcome:
    """Each iteration samples about the mean so far, and starts again from the same arrival cost."""
    cost, arrival, counts = task.cost, task.arrival, task.cost.clips.counts
    moved, noise, done = arrival, task.noise, 0
    rollouts = diverged = 0
    before = excited = np.nan
    shape = _shape(task)
    while done < task.settings.iteration_count and not (done and task.late()):
        slopes = linearise(cost, moved.z, np.zeros((1, 0)), shape, task.settings.sample_count, task.rng)
        rollouts, diverged, done = rollouts + slopes.rollouts, diverged + slopes.diverged, done + 1
        if done == 1:
            before = rms(slopes.residual[0], counts) if slopes.completed[0] else np.inf
            excited = rms(shape.T @ slopes.gain[0], counts) if slopes.completed[0] else np.inf
        if not slopes.completed[0]:
            break
        step, noise, covariance = _step(task, slopes, moved.z)
        moved = Arrival(cost.system.space.clip(moved.z + step), covariance)
    after = np.inf if not slopes.completed[0] else rms(slopes.residual[0] + step @ slopes.gain[0], counts)
    return Outcome(moved, noise, before, after, excited, rollouts, diverged, done)


def _shape(task: Task) -> FloatArray:
    """Samples in the shape of the belief, no narrower than the jitter of contacts allows."""
    space = task.cost.system.space
    floor = np.minimum(in_z(space, task.settings.step), WIDEST)
    return bounded(task.arrival.covariance, floor, np.ones(len(space), dtype=bool))


def _step(task: Task, slopes: Linearisation, z: FloatArray) -> tuple[FloatArray, Noise, FloatArray]:
    """Step, noise with this window, posterior covariance; the weights need the residuals after the step."""
    cost, gain, start = task.cost, slopes.gain[0], slopes.residual[0]
    precision = np.linalg.inv(task.arrival.covariance) + np.diag(
        task.settings.weights(cost.system.space.names)
    )
    straight = 1.0 / (1.0 + slopes.bend[0])
    step, noise = np.zeros(z.size), task.noise
    for _ in range(2):
        fitted = start + step @ gain
        noise = _heard(task.noise, cost, fitted)
        weighted = gain * (_weights(cost, fitted, noise) * straight)
        hessian = task.share * weighted @ gain.T + precision
        gradient = task.share * weighted @ start + precision @ (z - task.arrival.z)
        step = -np.linalg.solve(hessian, gradient)
    return step, noise, np.linalg.inv(hessian)


def _heard(before: Noise, cost: MatchingCost, fitted: FloatArray) -> Noise:
    """The noise with this window's residuals (R,)."""
    times = channel_times(cost, fitted[None], np.array([True]))
    square, time = {}, {}
    for observed, values, own in zip(cost.clips.observed, split(cost, fitted[None]), times, strict=True):
        key, count = observed.channel.key, max(int(observed.mask.sum()) * observed.width, 1)
        square[key], time[key] = float((values**2).sum() / count), own
    return before.heard(square, time)


def _weights(cost: MatchingCost, fitted: FloatArray, noise: Noise) -> FloatArray:
    """Weight of each residual (R,): robust, and by the noise and the memory that its channel has shown."""
    parts = []
    for observed, values in zip(cost.clips.observed, split(cost, fitted[None]), strict=True):
        key = observed.channel.key
        variance = max(noise.square[key], 1.0)
        squared = np.einsum("sk,sk->s", values[0], values[0]) / variance
        weight = pseudo_huber_weight(squared, cost.settings.huber) / (variance * noise.time[key])
        parts.append(np.repeat(weight, values.shape[2]))
    return np.concatenate(parts)
