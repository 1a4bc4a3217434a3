"""The default update: one Gauss-Newton step of cost plus arrival cost, from samples, without a derivative.

docs/estimation.md derives it. Differences from SPI's use of the same linearisation
(`estimation.linearised`): one window; noise remembered from window to window; and only the new share of
overlapping windows counts as information.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.statistics import pseudo_huber_weight
from amhe_cli.estimation.linearised import (
    FirstStates,
    Linearisation,
    channel_times,
    linearise,
    split,
)
from amhe_cli.estimation.shape import bounded, sampling_width
from amhe_cli.matching import MatchingCost
from amhe_cli.online.arrival import Arrival
from amhe_cli.online.update import Noise, Outcome, Task, rms


def linearised_update(task: Task) -> Outcome:
    """Each iteration samples about the mean so far, and starts again from the same arrival cost."""
    cost, arrival, counts = task.cost, task.arrival, task.cost.clips.counts
    moved, noise, done = arrival, task.noise, 0
    rollouts = diverged = 0
    before = after = excited = np.inf
    nx = cost.nx if task.settings.first_state == "estimated" else 0
    shape, first = _shape(task), FirstStates.recorded(1, nx)
    while done < task.settings.iteration_count and not (done and task.late()):
        slopes = linearise(cost, moved.z, first, shape, task.settings.sample_count, task.rng)
        rollouts, diverged, done = rollouts + slopes.rollouts, diverged + slopes.diverged, done + 1
        if not slopes.completed[0]:
            after = np.inf
            break
        if done == 1:
            before = rms(slopes.residual[0], counts)
            arrival = task.surprised(before)
            excited = rms(shape.T @ slopes.gain[0, : moved.z.size], counts)
        found = _step(task, arrival, slopes, moved.z)
        noise, after = found.noise, rms(found.fitted, counts)
        moved = Arrival(cost.system.space.clip(moved.z + found.step), found.covariance)
    return Outcome(moved, noise, before, after, excited, rollouts, diverged, done)


def _shape(task: Task) -> FloatArray:
    """Samples in the shape of the belief, no narrower than the jitter of contacts allows."""
    space = task.cost.system.space
    floor = sampling_width(space, task.settings.step)
    return bounded(task.arrival.covariance, floor, np.ones(len(space), dtype=bool))


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    """What a linearised window says: step and covariance of z, residuals (R,) after the step, noise."""

    step: FloatArray
    covariance: FloatArray
    fitted: FloatArray
    noise: Noise


def _step(task: Task, arrival: Arrival, slopes: Linearisation, z: FloatArray) -> _Found:
    """Gauss-Newton step from z (d,), the errors of the first state fitted along and eliminated."""
    cost, start, d = task.cost, slopes.residual[0], z.size
    gz, gx = slopes.gain[0, :d], slopes.gain[0, d:]
    precision = np.linalg.inv(arrival.covariance) + np.diag(task.settings.weights(cost.system.space.names))
    straight, share = 1.0 / (1.0 + slopes.bend[0]), task.share * task.settings.information
    step, noise, fitted = np.zeros(d), task.noise, start
    hessian = precision
    for _ in range(2):  # first with the noise of earlier windows: what the belief misses is no noise
        weight = _weights(cost, fitted, noise) * straight
        wz, wx = gz * weight, gx * weight
        ridge: FloatArray = np.linalg.solve(
            wx @ gx.T + np.eye(len(gx)), np.column_stack((wx @ start, wx @ gz.T))
        )
        score = wz @ start - wz @ gx.T @ ridge[:, 0]
        hessian = share * (wz @ gz.T - wz @ gx.T @ ridge[:, 1:]) + precision
        step = -np.linalg.solve(hessian, share * score + precision @ (z - arrival.z))
        fitted = start + step @ gz - (ridge[:, 0] + ridge[:, 1:] @ step) @ gx
        noise = _heard(task.noise, cost, fitted)
    covariance = np.asarray(np.linalg.inv(hessian), dtype=np.float64)
    return _Found(step, covariance, fitted, noise)


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
        variance = max(noise.square.get(key, 1.0), 1.0)
        squared = np.einsum("sk,sk->s", values[0], values[0]) / variance
        weight = pseudo_huber_weight(squared, cost.settings.huber) / (variance * noise.time.get(key, 1.0))
        parts.append(np.repeat(weight, values.shape[2]))
    return np.concatenate(parts)
