"""Messages of a live run that other logs do not have: plans, paths, diagnostics."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from amhe_cli.control.controller import Plan
from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.rotations import exp
from amhe_cli.logs import LogWriter

PLAN, TIMING = "amhe_msgs/msg/Plan", "amhe_msgs/msg/Timing"

_PLAN = """\
std_msgs/Header header
# rollouts of this cycle, and how many of them diverged
uint32 rollouts
uint32 diverged
# 1 where one sample decides, as many as samples where none does
float64 effective_samples
# least and mean cost of the last loop
float64 best_cost
float64 mean_cost
# cost of the best rollout by term
string[] terms
float64[] term_costs
# what the behaviour was told, channels included
float64[] command
"""
_TIMING = """\
std_msgs/Header header
# time that the cycle took to compute
float64 plan_ms
# control periods that began without a new plan, so far
uint32 deadline_misses
"""


def define(log: LogWriter) -> None:
    """Make the types of this module known to a log."""
    log.define(PLAN, _PLAN)
    log.define(TIMING, _TIMING)


def write_plan(log: LogWriter, topic: str, stamp_ns: int, plan: Plan) -> None:
    """Write how the sampling of a plan went; nothing for a plan that nobody sampled."""
    step = plan.step
    if step is None:
        return
    message = log.message(
        PLAN,
        header=log.header(""),
        rollouts=step.rollouts,
        diverged=step.diverged,
        effective_samples=step.effective_samples,
        best_cost=step.best,
        mean_cost=step.average,
        terms=list(step.terms),
        term_costs=_array(list(step.terms.values())),
        command=_array([] if plan.command is None else plan.command),
    )
    log.write(topic, PLAN, stamp_ns, message)


def write_timing(log: LogWriter, topic: str, stamp_ns: int, plan_ms: float, misses: int) -> None:
    """Write how long a cycle took: by the wall clock, unlike all else in a log."""
    message = log.message(TIMING, header=log.header(""), plan_ms=plan_ms, deadline_misses=misses)
    log.write(topic, TIMING, stamp_ns, message)


def write_path(log: LogWriter, topic: str, stamp_ns: int, points: FloatArray) -> None:
    """Write a nav_msgs/Path over the floor through points (n, 2) [m]."""
    name = "geometry_msgs/msg/"
    level = log.message(f"{name}Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
    poses = [
        log.message(
            f"{name}PoseStamped",
            header=log.header("world"),
            pose=log.message(
                f"{name}Pose",
                position=log.message(f"{name}Point", x=float(x), y=float(y), z=0.0),
                orientation=level,
            ),
        )
        for x, y in points
    ]
    message = log.message("nav_msgs/msg/Path", header=log.header("world"), poses=poses)
    log.write(topic, "nav_msgs/msg/Path", stamp_ns, message)


def write_floor_pose(
    log: LogWriter, topic: str, stamp_ns: int, place: FloatArray, heading: float, height: float = 0.0
) -> None:
    """Write a geometry_msgs/PoseStamped: a place (2,) [m] and a heading [rad]."""
    log.pose(topic, stamp_ns, (*place, height), exp(_array([0.0, 0.0, heading])))


def _array(values: ArrayLike) -> FloatArray:
    return np.array(values, dtype=np.float64)
