"""What a run writes while it goes on: the log and the task's own messages in it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from amhe_cli import __version__
from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.rotations import exp
from amhe_cli.core.signals import Signal
from amhe_cli.core.yaml_file import merged
from amhe_cli.live.episode import Cycle
from amhe_cli.live.recorder import NEVER, SELDOM, Recorder, Throttle, stamp_ns
from amhe_cli.logs import LogWriter
from amhe_cli.robots.go1.run import Run, measured
from amhe_cli.system.provenance import attachments

#: Recorded in addition to the system's own signals. It measures no orientation, which is in /odom.
_IMU = Signal(
    "imu",
    "/imu",
    ("angular_velocity", "linear_acceleration"),
    type="sensor_msgs/msg/Imu",
    child_frame="trunk",
)
_PATH_POINTS = 49


def recorder_of(run: Run, path: Path) -> Recorder:
    """The recorder of a run's log, with the metadata that say what the log shows.

    Args:
        run: The run.
        path: Path of the log.
    """
    options = run.options
    metadata = {
        "system": run.system.name,
        "seed": str(options.seed),
        "task": options.task,
        "mode": options.mode,
        "target": options.target,
        "version": __version__,
    }
    known = {key: value for key, value in run.options.settings.items() if key == "parameters"}
    if stated := merged(measured(run.task), known):  # so that the reader of the log has the same model
        metadata["overrides"] = json.dumps(stated)
    if run.first_truth and not run.task.changes:  # values that change are in /amhe/truth
        metadata["truth"] = json.dumps(run.first_truth)
    signals = (*run.system.signals, _IMU)
    return Recorder(path, signals, metadata, attachments(run.system), RunMessages(run))


class RunMessages:
    """Writes path, goal and reference of a run's task, for viewers."""

    def __init__(self, run: Run) -> None:
        self._path, self._throttle = run.task.path, Throttle()

    def write(self, log: LogWriter, cycle: Cycle) -> None:
        """Write the messages that are due in a cycle."""
        path, stamp, reference = self._path, stamp_ns(cycle.time), cycle.plan.reference
        if self._throttle.due("/amhe/path", cycle.time, NEVER):
            points = path.points(np.linspace(0.0, path.length, _PATH_POINTS if path.curvature else 2))
            _write_path(log, stamp, points)
            turn = path.heading + path.curvature * path.length
            _write_floor_pose(log, "/amhe/goal", stamp, path.goal, turn)
        if reference is not None and self._throttle.due("/amhe/reference", cycle.time, SELDOM):
            _write_floor_pose(log, "/amhe/reference", stamp, reference.origin, reference.heading)


def _write_floor_pose(log: LogWriter, topic: str, stamp: int, place: FloatArray, heading: float) -> None:
    """A place on the floor (2,) [m] and a heading [rad]."""
    log.pose(topic, stamp, (*place, 0.0), exp(np.array([0.0, 0.0, heading])))


def _write_path(log: LogWriter, stamp: int, points: FloatArray) -> None:
    """A nav_msgs/Path over the floor through points (n, 2) [m]."""
    header, level = {"frame_id": "world"}, (0.0, 0.0, 0.0, 1.0)
    poses = [{"header": header, "pose": ((x, y, 0.0), level)} for x, y in points]
    log.write("/amhe/path", "nav_msgs/msg/Path", stamp, {"header": header, "poses": poses})
