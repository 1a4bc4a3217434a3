"""What a film shows of a task besides robot and box."""

from __future__ import annotations

import numpy as np

from amhe_cli.robots.go1.tasks import Task
from amhe_cli.robots.go1.video import Scenery


def scenery_of(task: Task) -> Scenery:
    """Path, goal and floor of a task, and a camera that sees them."""
    path = task.path
    points = path.points(np.linspace(0.0, path.length, 61 if path.curvature else 2))
    yaw = task.box.yaw + path.curvature * path.length
    floors = [c.beyond_x for c in task.changes if c.floor_friction is not None and c.beyond_x is not None]
    return Scenery(
        path=points,
        goal_yaw=yaw,
        footprint=task.box.size[:2],
        other_floor=min(floors, default=None),
        distance=2.2 if task.one_leg else 3.0,
        azimuth=188.0 if task.one_leg else 108.0,
        elevation=-24.0 if task.one_leg else -20.0,
    )
