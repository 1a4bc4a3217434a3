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
from amhe_cli.estimation.core.information import channel_times, split
from amhe_cli.estimation.core.linearise import FirstStates, Linearisation, linearise
from amhe_cli.estimation.core.shape import bounded, sampling_width
from amhe_cli.estimation.online.arrival import Arrival
from amhe_cli.estimation.online.update import Noise, Outcome, Task, rms
from amhe_cli.matching.cost import MatchingCost

#: Of a window's squared residuals, what its own fit may leave after a jump of the parameters.
_JUMP_LEAVES = 0.5


def linearised_update(task: Task) -> Outcome:
    """Each iteration samples about the mean so far, and starts again from the same arrival cost.

    The last is the one whose step is shorter than an sd.
    """
    cost, arrival, counts = task.cost, task.arrival, task.cost.clips.counts
    moved, noise, done = arrival, task.noise, 0
    rollouts = diverged = 0
    before = after = surprise = excited = np.inf
    nx = cost.nx if task.settings.first_state == "estimated" else 0
    shape, first = _shape(task), FirstStates.recorded(1, nx)
    while done < task.settings.iteration_count and not (done and task.late()):
        slopes = linearise(cost, moved.z, first, shape, task.samples, task.rng)
        rollouts, diverged, done = rollouts + slopes.rollouts, diverged + slopes.diverged, done + 1
        if not slopes.completed[0]:
            after = np.inf
            break
        said, noise = _said(task, slopes, shape)
        if done == 1:
            before, surprise = rms(slopes.residual[0], counts), _surprise(task, said)
            arrival = task.surprised(surprise)
            excited = rms(shape.T @ slopes.gain[0, : moved.z.size], counts)
        step, covariance = _step(task, arrival, said, moved.z)
        after = rms(said.start + step @ said.slope, counts)
        moved = Arrival(cost.system.space.clip(moved.z + step), covariance)
        if step @ np.linalg.solve(covariance, step) < 1.0:
            break  # slopes from there would hardly be others
    return Outcome(moved, noise, before, after, surprise, excited, rollouts, diverged, done)


def _step(task: Task, arrival: Arrival, said: _Said, z: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Gauss-Newton step of the tempered information and the arrival cost, and the covariance after it.

    A prior weight shortens the step and is no knowledge: the covariance is that of a step so short
    (Joseph's form), as of parameters that are considered more than estimated (Schmidt 1966).
    """
    share = task.share * task.settings.information
    told, before = share * said.known, np.linalg.inv(arrival.covariance)
    before_and_weight = before + np.diag(task.settings.weights(task.cost.system.space.names))
    gain: FloatArray = np.asarray(np.linalg.inv(told + before_and_weight), dtype=np.float64)
    kept = np.eye(z.size) - gain @ told
    covariance = kept @ arrival.covariance @ kept.T + gain @ told @ gain.T
    return -gain @ (share * said.score + before_and_weight @ (z - arrival.z)), covariance


def _shape(task: Task) -> FloatArray:
    """Samples in the shape of the belief, no narrower than the jitter of contacts allows."""
    space = task.cost.system.space
    floor = sampling_width(space, task.settings.step)
    return bounded(task.arrival.covariance, floor, np.ones(len(space), dtype=bool))


@dataclass(frozen=True, slots=True, eq=False)
class _Said:
    """What a window says by itself, its first-state errors fitted along and eliminated.

    Args:
        known: Its information on z, shape (d, d).
        score: Gradient of half its weighted squared residuals, shape (d,).
        start: Residuals before any step, shape (R,).
        slope: Of the residuals by z, first states moved along, shape (d, R).
        wanted: The step that it would take alone, shape (d,).
    """

    known: FloatArray
    score: FloatArray
    start: FloatArray
    slope: FloatArray
    wanted: FloatArray

    @property
    def left(self) -> FloatArray:
        """Residuals that this step leaves, shape (R,): what parameters explain is no noise."""
        return self.start + self.wanted @ self.slope


def _said(task: Task, slopes: Linearisation, shape: FloatArray) -> tuple[_Said, Noise]:
    """Fit the window alone, whose samples had a shape (d, d), twice: the weights need what the fit leaves.

    A window that no parameters explain says less than its sensors promise.
    """
    cost, residual, d = task.cost, slopes.residual[0], len(shape)
    nuisances = _nuisances(slopes, shape, task.arrival.covariance)
    first = _alone(slopes, d, nuisances, _weights(cost, residual, task.noise))
    noise, own = _heard(task.noise, cost, first.left)
    said = _alone(slopes, d, nuisances, _weights(cost, first.left, noise.at_least(own)))
    return said, _heard(task.noise, cost, said.left)[0]


def _nuisances(slopes: Linearisation, shape: FloatArray, covariance: FloatArray) -> FloatArray:
    """What bends the window as a whole, each with a factor ~ N(0, 1) of its own, shape (n, R).

    The errors of the first state, and what is not linear in the samples: as white noise alone it would be
    averaged away over the window, and what is learnt far from the truth be believed for good. z ~ N(0, P)
    makes of a bend z^2 / 2 a mean square of 3 P^2 / 4; samples have a quarter, and lie
    nearer where P is wide. Where first states are taken as recorded, `mhe.information` stands for all this.
    """
    first = slopes.gain[0, len(shape) :]
    if not len(first):
        return first
    inside = np.linalg.inv(shape)
    further = np.trace(inside @ covariance @ inside.T) / len(shape)
    curves = max(1.0, float(further)) * np.sqrt(3.0 / len(slopes.curves)) * slopes.curves[:, 0]
    return np.concatenate((first, curves))


def _alone(slopes: Linearisation, d: int, nuisances: FloatArray, weight: FloatArray) -> _Said:
    """Under one weight of each residual (R,); the system's prior keeps apart what the window cannot tell."""
    residual, gz, gx = slopes.residual[0], slopes.gain[0, :d], nuisances
    heard = weight / (1.0 + slopes.bend[0])
    wz, wx = gz * heard, gx * heard
    ridge: FloatArray = np.linalg.solve(
        wx @ gx.T + np.eye(len(gx)), np.column_stack((wx @ residual, wx @ gz.T))
    )
    start, slope = residual - ridge[:, 0] @ gx, gz - ridge[:, 1:].T @ gx
    known, score = wz @ slope.T, wz @ start
    return _Said(known, score, start, slope, -np.linalg.solve(known + np.eye(d), score))


def _surprise(task: Task, said: _Said) -> float:
    """How far from the belief the window wants the parameters, in sd of both: its normalised innovation.

    0 where that step leaves most of the misfit: what parameters do not explain is no jump of theirs.
    """
    if (said.left**2).sum() > _JUMP_LEAVES * (said.start**2).sum():
        return 0.0
    d = said.wanted.size
    alone = np.linalg.inv(task.settings.information * said.known + np.eye(d))
    return float(np.sqrt(said.wanted @ np.linalg.solve(task.arrival.covariance + alone, said.wanted)))


def _heard(before: Noise, cost: MatchingCost, fitted: FloatArray) -> tuple[Noise, dict[str, float]]:
    """The noise with this window's residuals (R,), and its own mean squares by channel."""
    times = channel_times(cost, fitted[None], np.array([True]))
    square, time = {}, {}
    for observed, values, own in zip(cost.clips.observed, split(cost, fitted[None]), times, strict=True):
        key, count = observed.channel.key, max(int(observed.mask.sum()) * observed.width, 1)
        square[key], time[key] = float((values**2).sum() / count), own
    return before.heard(square, time), square


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
