"""A live run as a log: every cycle goes into an MCAP file that `amhe identify` and any viewer opens.

Stamps are the run's own time, from zero: a seed gives the same log every time. Only /amhe/timing and
/diagnostics tell of the wall clock.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import TracebackType

import numpy as np
from numpy.typing import ArrayLike

from amhe_cli.control.controller import Plan
from amhe_cli.control.tasks import Task
from amhe_cli.core.arrays import FloatArray, IntArray
from amhe_cli.go1.legs import JOINTS
from amhe_cli.go1.state import Body, Measurements, State
from amhe_cli.live import messages
from amhe_cli.live.episode import Cycle
from amhe_cli.logs import LogWriter

#: Topics whose content is not a matter of the seed alone.
WALL_CLOCK = ("/amhe/timing", "/diagnostics")
#: Between two messages of what changes seldom, and of what never does [s].
_SELDOM, _NEVER = 0.1, 1.0
_PATH_POINTS = 49


class Recorder:
    """Writes one cycle after the other; use it as a context manager.

    The robot's own samples are thinned: 500 Hz of twelve joints are most of a log, and little of what an
    identification learns from it. Numbers are kept in single precision, as a Go1 sends them. The log begins
    with the first cycle's command: then the clock of our reader, which starts at the first sample, meets
    every command on a step of its own.

    Args:
        path: The .mcap file; whole and readable however the block ends.
        task: That is done.
        metadata: What the log says of itself.
        attachments: Texts by file name.
        period: Of control [s].
        sample_period: The least between two samples of joints and IMU [s].
    """

    def __init__(
        self,
        path: Path,
        task: Task,
        metadata: Mapping[str, str],
        attachments: Mapping[str, str],
        period: float,
        sample_period: float = 0.01,
    ) -> None:
        self._log = LogWriter(path, metadata)
        self._task, self._attachments = task, dict(attachments)
        self._period, self._sample_period = period, sample_period
        self._last: Cycle | None = None
        self._in_force: Plan | None = None
        self._told: dict[str, tuple[float, object]] = {}

    def __enter__(self) -> Recorder:
        self._log.__enter__()
        messages.define(self._log)
        for name, text in self._attachments.items():
            self._log.attach(name, "application/yaml", text.encode())
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._log.__exit__(kind, error, trace)

    def write(self, cycle: Cycle) -> None:
        """Append all that a cycle brought."""
        self._sensors(cycle.measured)
        self._poses(cycle.measured, cycle.estimate)
        self._commands(cycle)
        self._belief(cycle)
        self._intention(cycle)
        stamp = stamp_ns(cycle.estimate.time)
        messages.write_plan(self._log, "/amhe/plan", stamp, cycle.plan)
        messages.write_timing(self._log, "/amhe/timing", stamp, cycle.plan_ms, cycle.misses)
        self._last = cycle

    def say(self, time: float, level: int, text: str) -> None:
        """Put a word about the run itself into the diagnostics, after all that was told of that time."""
        messages.write_diagnostics(self._log, stamp_ns(time + 1e-3), level, text, {})

    # -- what was measured ----------------------------------------------------------------------------

    def _sensors(self, measured: Measurements) -> None:
        times = measured.robot_times
        for i in _thinned(times, self._sample_period):
            if self._too_early(float(times[i]), measured):
                continue
            stamp = stamp_ns(float(times[i]))
            joints, rates = _single(measured.joints[i]), _single(measured.joint_rates[i])
            self._log.joint_state("/joint_states", stamp, JOINTS, joints, rates)
            # no sensor of its own tells the orientation: it is in /odom
            gyro, force = _single(measured.gyro[i]), _single(measured.accelerometer[i])
            self._log.imu("/imu", stamp, None, gyro, force, frame="trunk")

    def _poses(self, measured: Measurements, estimate: State) -> None:
        """Measured poses, with the estimator's twists between the last cycle and this one."""
        seen = (
            ("/odom", "trunk", measured.trunk_position, measured.trunk_orientation),
            ("/box/odom", "box", measured.box_position, measured.box_orientation),
        )
        before = self._last.estimate if self._last else estimate
        for i, time in enumerate(measured.pose_times):
            if self._too_early(float(time), measured):
                continue
            stamp = stamp_ns(float(time))
            share = _share(time, before.time, estimate.time)
            poses = {}
            for topic, body, position, orientation in seen:
                place, turn = poses[body] = (_single(position[i]), _single(orientation[i]))
                velocity, rate = _twist(getattr(before, body), getattr(estimate, body), share)
                self._log.odometry(
                    topic, stamp, place, turn, _single(velocity), _single(rate), child_frame=body
                )
            if i == len(measured.pose_times) - 1:  # viewers need no more of them
                self._log.transform("/tf", stamp, poses)

    def _too_early(self, time: float, measured: Measurements) -> bool:
        """Whether a sample is older than the first command."""
        return self._last is None and time < measured.time - 1e-6

    # -- what was done, believed and wanted -----------------------------------------------------------

    def _commands(self, cycle: Cycle) -> None:
        """Joint targets, stamped when they took effect; also those of periods that had no new plan."""
        now, last = cycle.estimate.time, self._last
        if last is not None:
            for time in np.arange(last.estimate.time + self._period, now - 1e-6, self._period):
                played = last.played if self._in_force is None else self._in_force.at(float(time))
                self._command(float(time), played)
        self._command(now, cycle.played)
        # the plan of the last cycle is in force from now on
        self._in_force = last.plan if last is not None else None

    def _command(self, time: float, targets: FloatArray) -> None:
        self._log.joint_state("/joint_commands", stamp_ns(time), JOINTS, _single(targets))

    def _belief(self, cycle: Cycle) -> None:
        time = cycle.estimate.time
        for topic, values in (("/amhe/params", cycle.belief), ("/amhe/truth", cycle.parameters)):
            if values is not None and self._due(topic, time, _SELDOM, values):
                self._log.joint_state(topic, stamp_ns(time), values, list(values.values()))

    def _intention(self, cycle: Cycle) -> None:
        time, log, path = cycle.estimate.time, self._log, self._task.path
        stamp = stamp_ns(time)
        if self._due("/amhe/path", time, _NEVER):
            points = path.points(np.linspace(0.0, path.length, _PATH_POINTS if path.curvature else 2))
            messages.write_path(log, "/amhe/path", stamp, points)
            turn = path.heading + path.curvature * path.length
            messages.write_floor_pose(log, "/amhe/goal", stamp, path.goal, turn)
        reference = cycle.plan.reference
        if reference is not None and self._due("/amhe/reference", time, _SELDOM):
            messages.write_floor_pose(log, "/amhe/reference", stamp, reference.origin, reference.heading)
        if self._due("/diagnostics", time, _NEVER):
            late = cycle.misses > (self._told.get("misses") or (0.0, 0))[1]  # type: ignore[operator]
            self._told["misses"] = (time, cycle.misses)
            values = {"plan ms": f"{cycle.plan_ms:.1f}", "deadline misses": str(cycle.misses)}
            text, level = ("late", messages.WARN) if late else ("planning in time", messages.OK)
            messages.write_diagnostics(log, stamp, level, text, values)

    def _due(self, topic: str, time: float, period: float, content: object = None) -> bool:
        """Whether so much time has gone by since the topic's last message, or its content is another one."""
        if topic in self._told:
            last, told = self._told[topic]
            if time - last < period - 1e-6 and content == told:
                return False
        self._told[topic] = time, content
        return True


def stamp_ns(time: float) -> int:
    """A time [s] in nanoseconds, to the microsecond: sums of periods come out round."""
    return round(time * 1e6) * 1000


def _single(values: ArrayLike) -> FloatArray:
    """In single precision: half of a log's size, and more digits than any sensor has."""
    return np.asarray(values, dtype=np.float32).astype(np.float64)


def _thinned(times: FloatArray, period: float) -> IntArray:
    """Indices of samples that lie at the ends of periods [s]; all where they are further apart."""
    if times.size < 2:
        return np.arange(times.size)
    step = float(times[1] - times[0])
    number = np.floor(times / period + 1e-6)
    return np.flatnonzero(number > np.floor((times - step) / period + 1e-6))


def _share(time: float, start: float, end: float) -> float:
    return float(np.clip((time - start) / (end - start), 0.0, 1.0)) if end > start else 1.0


def _twist(before: Body, after: Body, share: float) -> tuple[FloatArray, FloatArray]:
    """Velocity and rate between two states."""
    return (
        before.velocity + share * (after.velocity - before.velocity),
        before.rate + share * (after.rate - before.rate),
    )
