"""What a probe asks of a robot."""

from __future__ import annotations

import numpy as np
import pytest

from amhe_cli.robots.go1.probing.motions import MOTIONS, Motion, probe_task
from amhe_cli.robots.go1.run import RunOptions, open_run
from amhe_cli.robots.go1.settings import TripSettings
from amhe_cli.robots.go1.tasks import Believed, find_task


@pytest.mark.medium
@pytest.mark.parametrize("motion", MOTIONS, ids=lambda motion: motion.name)
def test_no_motion_takes_joint_targets_to_where_a_robots_link_trips(motion: Motion) -> None:
    own = Believed(4.0, 0.6)
    run = open_run(RunOptions("t1", "true", duration=6.0), probe_task(find_task("t1"), motion, 6.0, own, own))
    plans = [np.vstack((cycle.played, cycle.plan.targets)) for cycle in run.episode.cycles()]
    assert len(plans) == 300
    largest = max(np.abs(np.diff(rows, axis=0)).max() for rows in plans)
    assert largest < 0.95 * TripSettings().target_jump
