"""A live run as a log: every cycle goes into an MCAP file that `amhe identify` and any viewer opens.

Stamps are the run's own time, from zero: a seed gives the same log every time. Only /amhe/timing and
/diagnostics tell of the wall clock.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import TracebackType

import numpy as np

from amhe_cli.estimation.online import messages as estimates
from amhe_cli.live import messages
from amhe_cli.live.episode import Cycle
from amhe_cli.live.samples import CycleSamples, Sampler
from amhe_cli.logs import LogWriter
from amhe_cli.logs.messages.writer import OK, WARN
from amhe_cli.robots.go1.kinematics import JOINTS
from amhe_cli.robots.go1.tasks import Task

#: Topics whose content is not a matter of the seed alone.
WALL_CLOCK = ("/amhe/timing", "/diagnostics")
#: Of all that is written.
_TYPES = (
    "sensor_msgs/msg/JointState", "sensor_msgs/msg/Imu", "nav_msgs/msg/Odometry", "nav_msgs/msg/Path",
    "geometry_msgs/msg/PoseStamped", "tf2_msgs/msg/TFMessage", "diagnostic_msgs/msg/DiagnosticArray",
    messages.PLAN, messages.TIMING, estimates.ESTIMATE,
)  # fmt: skip
#: Between two messages of what changes seldom, and of what never does [s].
_SELDOM, _NEVER = 0.1, 1.0
_PATH_POINTS = 49


class Recorder:
    """Writes one cycle after the other; use it as a context manager.

    Args:
        path: The .mcap file; whole and readable however the block ends.
        task: That is done.
        metadata: What the log says of itself.
        attachments: Texts by file name.
        period: Of control [s].
    """

    def __init__(
        self,
        path: Path,
        task: Task,
        metadata: Mapping[str, str],
        attachments: Mapping[str, str],
        period: float,
    ) -> None:
        self._log = LogWriter(path, metadata)
        self._task, self._attachments = task, dict(attachments)
        self._sampler = Sampler(period)
        self._told: dict[str, tuple[float, object]] = {}

    def __enter__(self) -> Recorder:
        self._log.__enter__()
        messages.define(self._log)
        estimates.define(self._log)
        self._log.prepare(_TYPES)  # a robot that has begun does not wait
        for name, text in self._attachments.items():
            self._log.attach(name, "application/yaml", text.encode())
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._log.__exit__(kind, error, trace)

    def write(self, cycle: Cycle) -> None:
        """Append all that a cycle brought."""
        samples = self._sampler.take(cycle)
        self._sensors(samples)
        self._poses(samples)
        for time, targets in zip(samples.command_times, samples.commands, strict=True):
            self._log.joint_state("/joint_commands", stamp_ns(float(time)), JOINTS, targets)
        self._belief(cycle)
        self._news(cycle)
        self._intention(cycle)
        stamp = stamp_ns(cycle.estimate.time)
        messages.write_plan(self._log, "/amhe/plan", stamp, cycle.plan)
        messages.write_timing(self._log, "/amhe/timing", stamp, cycle.plan_ms, cycle.misses)

    def say(self, time: float, level: int, text: str) -> None:
        """Put a word about the run itself into the diagnostics, after all that was told of that time."""
        self._log.diagnostics(stamp_ns(time + 1e-3), level, text, {})

    # -- what was measured ----------------------------------------------------------------------------

    def _sensors(self, samples: CycleSamples) -> None:
        for i, time in enumerate(samples.sensor_times):
            stamp = stamp_ns(float(time))
            self._log.joint_state("/joint_states", stamp, JOINTS, samples.joints[i], samples.joint_rates[i])
            # no sensor of its own tells the orientation: it is in /odom
            self._log.imu("/imu", stamp, None, samples.gyro[i], samples.accelerometer[i], frame="trunk")

    def _poses(self, samples: CycleSamples) -> None:
        last = len(samples.pose_times) - 1
        for i, time in enumerate(samples.pose_times):
            stamp = stamp_ns(float(time))
            for topic, name in (("/odom", "trunk"), ("/box/odom", "box")):
                body = samples.bodies[name]
                self._log.odometry(
                    topic, stamp, body.position[i], body.orientation[i], body.velocity[i], body.rate[i],
                    child_frame=name,
                )  # fmt: skip
            if i == last:  # viewers need no more of them
                poses = {name: (b.position[i], b.orientation[i]) for name, b in samples.bodies.items()}
                self._log.transform("/tf", stamp, poses)

    # -- what was believed and wanted -----------------------------------------------------------------

    def _belief(self, cycle: Cycle) -> None:
        time = cycle.estimate.time
        for topic, values in (("/amhe/params", cycle.belief), ("/amhe/truth", cycle.parameters)):
            if values is not None and self._due(topic, time, _SELDOM, values):
                self._log.joint_state(topic, stamp_ns(time), values, list(values.values()))

    def _news(self, cycle: Cycle) -> None:
        """What came from the estimator: estimates at the time from which they were in force."""
        stamp = stamp_ns(cycle.estimate.time)
        for news in cycle.news:
            if news.estimate is not None:
                estimates.write_estimate(self._log, stamp, news.estimate)
            if news.text:
                self._log.diagnostics(stamp, WARN, news.text, {}, of="estimator")

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
            text, level = ("late", WARN) if late else ("planning in time", OK)
            log.diagnostics(stamp, level, text, values)

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
