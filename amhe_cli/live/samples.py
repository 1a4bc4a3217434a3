"""What a live run knows of itself, cycle by cycle: the same samples for its log and for its estimator."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from amhe_cli.control.controller import Plan
from amhe_cli.core.arrays import FloatArray, IntArray
from amhe_cli.live.episode import Cycle
from amhe_cli.robots.go1.state import Body, Measurements


@dataclass(frozen=True, slots=True, eq=False)
class CycleSamples:
    """Of one cycle, everything in single precision, as a Go1 sends it.

    Args:
        sensor_times: Of joints and IMU [s], shape (m,).
        joints, joint_rates: [rad], [rad/s], shape (m, 12).
        gyro, accelerometer: Of the trunk in its own frame [rad/s], [m/s^2], shape (m, 3).
        pose_times: Of the poses [s], shape (n,).
        bodies: 'trunk' and 'box': measured poses with the state estimator's twists, n of them each.
        command_times: Since when joint targets were followed [s], shape (c,).
        commands: The targets [rad], shape (c, 12).
    """

    sensor_times: FloatArray
    joints: FloatArray
    joint_rates: FloatArray
    gyro: FloatArray
    accelerometer: FloatArray
    pose_times: FloatArray
    bodies: dict[str, Body]
    command_times: FloatArray
    commands: FloatArray


#: Between two joint targets that were followed [s].
_FOLLOWED = 0.004


class Sampler:
    """Turns cycles into samples.

    The robot's own samples are thinned: 500 Hz of twelve joints are most of a log, and little of what an
    identification learns from it. Nothing is older than the first command: then the clock of our reader,
    which starts at the first sample, meets every command on a step of its own.

    Args:
        period: Of control [s].
        sample_period: One sample of joints and IMU is taken in each [s].
    """

    def __init__(self, period: float, sample_period: float = 0.01) -> None:
        self._period, self._sample_period = period, sample_period
        self._last: Cycle | None = None
        self._told = self._reached = -np.inf
        self._followed = (np.empty(0), np.empty((0, 12)))
        self._in_force: Plan | None = None

    def take(self, cycle: Cycle) -> CycleSamples:
        """The samples that a cycle brought; to be asked once for each cycle, in their order."""
        measured = cycle.measured
        rows = self._thinned(measured.robot_times)
        rows = rows[self._new(measured.robot_times[rows], measured)]
        poses = np.flatnonzero(self._new(measured.pose_times, measured))
        times, commands = self._commands(cycle)
        samples = CycleSamples(
            sensor_times=measured.robot_times[rows],
            joints=_single(measured.joints[rows]),
            joint_rates=_single(measured.joint_rates[rows]),
            gyro=_single(measured.gyro[rows]),
            accelerometer=_single(measured.accelerometer[rows]),
            pose_times=measured.pose_times[poses],
            bodies=self._bodies(cycle, poses),
            command_times=times,
            commands=_single(commands),
        )
        self._in_force = self._last.plan if self._last is not None else None  # from now on
        self._last = cycle
        return samples

    def _thinned(self, times: FloatArray) -> IntArray:
        """Indices of the first sample in each period: stamps jitter, and packets are lost."""
        number = np.floor(times / self._sample_period + 1e-6)
        reached = np.maximum.accumulate(np.append(self._reached, number))
        self._reached = float(reached[-1])
        return np.flatnonzero(number > reached[:-1])

    def _new(self, times: FloatArray, measured: Measurements) -> np.ndarray:
        """Samples that are not older than the first command."""
        if self._last is not None:
            return np.ones(times.size, dtype=bool)
        return times >= measured.time - 1e-6

    def _bodies(self, cycle: Cycle, rows: IntArray) -> dict[str, Body]:
        """Measured poses, with twists between those of the last cycle's estimate and this one's."""
        measured, now = cycle.measured, cycle.estimate
        before = self._last.estimate if self._last else now
        share = _share(measured.pose_times[rows], before.time, now.time)[:, None]
        bodies = {}
        for name, position, orientation in (
            ("trunk", measured.trunk_position, measured.trunk_orientation),
            ("box", measured.box_position, measured.box_orientation),
        ):
            velocity, rate = _twists(getattr(before, name), getattr(now, name), share)
            bodies[name] = Body(*map(_single, (position[rows], orientation[rows], velocity, rate)))
        return bodies

    def _commands(self, cycle: Cycle) -> tuple[FloatArray, FloatArray]:
        """Joint targets since when they were followed: those that were sent, where the target tells."""
        sent = cycle.measured.targets
        if self._last is None:
            self._told = cycle.estimate.time
            return np.array([self._told]), cycle.played[None]
        return self._planned(cycle, self._last) if sent is None else self._sent(cycle, sent)

    def _sent(self, cycle: Cycle, targets: FloatArray) -> tuple[FloatArray, FloatArray]:
        """A plan that is late begins late, a new one is blended into, and the motors' torque is limited.

        A reader holds each command until the next: it is what was followed in the middle of that time.
        """
        times = np.append(self._followed[0], cycle.measured.robot_times)
        values = np.vstack((self._followed[1], targets))
        self._followed = times[-1:], values[-1:]
        known = np.max(times, initial=self._told) - 0.5 * _FOLLOWED
        count = int((known - self._told) / _FOLLOWED + 1e-6)
        stamps = self._told + _FOLLOWED * np.arange(1, count + 1, dtype=np.float64)
        if not stamps.size:
            return stamps, np.empty((0, 12))
        self._told = float(stamps[-1])
        middles = stamps + 0.5 * _FOLLOWED
        return stamps, np.stack([np.interp(middles, times, column) for column in values.T], axis=1)

    def _planned(self, cycle: Cycle, last: Cycle) -> tuple[FloatArray, FloatArray]:
        """Joint targets when they took effect; also those of periods that had no new plan."""
        now = cycle.estimate.time
        missed = np.arange(last.estimate.time + self._period, now - 1e-6, self._period)
        played = [last.played if self._in_force is None else self._in_force.at(float(t)) for t in missed]
        return np.append(missed, now), np.array([*played, cycle.played])


def _share(times: FloatArray, start: float, end: float) -> FloatArray:
    return np.clip((times - start) / (end - start), 0.0, 1.0) if end > start else np.ones(times.size)


def _twists(before: Body, after: Body, share: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Velocities and rates between two states, shape (n, 3) each; `share` has shape (n, 1)."""
    return (
        before.velocity + share * (after.velocity - before.velocity),
        before.rate + share * (after.rate - before.rate),
    )


def _single(values: ArrayLike) -> FloatArray:
    """In single precision: half of a log's size, and more digits than any sensor has."""
    return np.asarray(values, dtype=np.float32).astype(np.float64)
