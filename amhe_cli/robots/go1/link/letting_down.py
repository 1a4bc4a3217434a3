"""The robot let down without the state machine: what is left to do when something broke."""

from __future__ import annotations

import numpy as np

from amhe_cli.robots.go1.link.clock import Clock
from amhe_cli.robots.go1.link.command import Command, encode
from amhe_cli.robots.go1.link.robot_socket import RobotSocket
from amhe_cli.robots.go1.settings import Go1Settings


def let_down(robot: RobotSocket, settings: Go1Settings, clock: Clock) -> None:
    """Damp the motors for `settings.damp_time` [s], then tell them to do nothing."""
    period, end = 1.0 / settings.rate, clock.now() + settings.damp_time
    damped = Command(velocity=np.zeros(12), kd=np.full(12, settings.damping))
    while clock.now() < end:
        robot.send(encode(damped, settings.crc))
        clock.sleep_until(clock.now() + period)
    robot.send(encode(Command(), settings.crc))
