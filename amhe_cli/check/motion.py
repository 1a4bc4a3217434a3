"""Where a log's motion is: the range and the speed of each joint that it measures."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from amhe_cli.check.findings import Finding
from amhe_cli.core.log import Log
from amhe_cli.system.system import System

#: A joint whose range is within this many noise sd stands still, as for clips.
_STILL = 9.0


@dataclass(frozen=True, slots=True)
class JointMotion:
    """The motion of one joint over some logs.

    Args:
        joint: Its name.
        low, high: Lowest and highest position [rad or m].
        share: Share of the joint's range; None where it has none.
        speed: Largest speed [rad/s or m/s], but for 1 % of the time.
        noise: Noise sd of its sensor [rad or m].
    """

    joint: str
    low: float
    high: float
    share: float | None
    speed: float
    noise: float


def motions(system: System, logs: Sequence[Log]) -> tuple[JointMotion, ...]:
    """The motion of each hinge and slide that the logs measure."""
    found = []
    for channel in system.channels:
        if channel.source != "qpos" or channel.kind == "rotation":
            continue
        for i, column in enumerate(channel.columns):
            series = [log[channel.key] for log in logs]
            values = [one.values[one.valid & one.sampled, i] for one in series]
            both = np.concatenate(values) if values else np.zeros(0)
            if not both.size:
                continue
            number = int(np.searchsorted(system.model.jnt_qposadr, column, side="right")) - 1
            if system.model.jnt_type[number] < int(mujoco.mjtJoint.mjJNT_SLIDE):
                continue  # a body that is free, or a ball
            speeds = [np.abs(np.diff(one.values[one.valid, i])) / system.dt for one in series]
            joint = system.model.joint(number)
            span = float(np.ptp(joint.range)) if system.model.jnt_limited[joint.id] else 0.0
            low, high = float(both.min()), float(both.max())
            speed = float(np.quantile(np.concatenate(speeds), 0.99))
            found.append(
                JointMotion(
                    joint.name, low, high, (high - low) / span if span else None, speed, channel.noise or 0.0
                )
            )
    return tuple(found)


def still(found: Sequence[JointMotion]) -> Iterator[Finding]:
    """Joints that a log does not move: it says nothing of their drives and links."""
    for one in found:
        if one.high - one.low <= _STILL * one.noise:
            yield Finding(
                "still", one.joint, "it stands still in these logs", 1.0,
                "move it: `amhe probe` writes an excitation",
            )  # fmt: skip
