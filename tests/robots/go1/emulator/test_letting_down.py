"""A robot that walks when its run ends: state machine and emulated robot in step, without a network."""

from __future__ import annotations

import numpy as np
import pytest

from amhe_cli.robots.go1.behaviours.gait import Gait, walk
from amhe_cli.robots.go1.emulator.emulator import STEP, EmulatedBody
from amhe_cli.robots.go1.link.machine import Machine, tilt
from amhe_cli.robots.go1.link.mail import Inbox, Phase, Targets
from amhe_cli.robots.go1.link.packets import MotorCommand
from amhe_cli.robots.go1.settings import Go1Settings
from amhe_cli.robots.go1.tasks import find_task

SETTINGS = Go1Settings(gain_time=0.2, stand_speed=3.0, damp_time=0.3, arm="auto")
PERIOD, LONGEST = 0.02, 15.0
#: Ahead [m/s].
TWIST = np.array([0.2, 0.0, 0.0])


def trotting(start: float, now: float) -> Targets:
    """A plan of a trot on the spot that began at `start`."""
    times = now - start + PERIOD * np.arange(1, 17)
    return Targets(now, PERIOD, walk(Gait(), times, np.tile(TWIST, (16, 1))).targets)


def worst_tilt(walked: float, then: str) -> float:
    """The most that the trunk leans [rad] after a robot that trotted so long [s] is asked to end."""
    body, machine, inbox = EmulatedBody(find_task("t1"), np.random.default_rng(0)), Machine(SETTINGS), Inbox()
    inbox.stand = inbox.arm = True
    command, begun, leans = MotorCommand(), np.inf, 0.0
    for tick in range(round(LONGEST / STEP)):
        state, _ = body.obey(command)
        now = body.time
        inbox.state, inbox.state_time, inbox.pose_time = state, now, now
        if machine.phase == Phase.RUN:
            begun = min(begun, now)
            if now - begun < walked and tick % 20 == 0:
                inbox.plan, inbox.plan_time = trotting(begun, now), now
            inbox.finish = then == "finish" and now - begun >= walked
        if machine.phase in (Phase.PAUSE, Phase.SIT):
            leans = max(leans, tilt(state.quaternion))
        if machine.phase == Phase.OVER:
            assert machine.trip == {"finish": "", "plan lost": "plan_lost"}[then]
            return leans
        if tick % 2 == 0:
            command = machine.step(now, inbox)
    raise AssertionError(f"it never came to an end: {machine.phase.name}")


@pytest.mark.medium
@pytest.mark.parametrize(("then", "walked"), [("finish", 1.08), ("finish", 1.38), ("plan lost", 1.02)])
def test_a_robot_that_walks_puts_its_feet_down_before_it_sits(then: str, walked: float) -> None:
    assert worst_tilt(walked, then) < 0.25
