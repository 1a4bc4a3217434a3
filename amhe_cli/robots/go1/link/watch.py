"""The program's watch over the sender: it takes in what the sender sends, and damps the motors if that stops.

It has a thread of its own, so that a plan that takes long does not hold it up.
"""

from __future__ import annotations

import math
import socket
import threading
import time
from collections import deque
from dataclasses import replace
from typing import Any

import numpy as np

from amhe_cli.robots.go1.link.child import WATCH, Child, take_priority
from amhe_cli.robots.go1.link.clock import Clock
from amhe_cli.robots.go1.link.mail import SAMPLE, Phase, SenderReport
from amhe_cli.robots.go1.link.robot_socket import RobotSocket, let_down
from amhe_cli.robots.go1.settings import Go1Settings

#: Time between two looks [s], and the least time for which motors are damped in place of the sender [s].
_STEP, _DAMP = 0.005, 2.0
_DIED = "the process that talks to the robot has died"
_ENDLESS = "the process that talks to the robot does not end"


class SenderWatch:
    """Watches a sender from its first report to its last.

    Args:
        child: The sender's process.
        robot: The sender's own socket. The watch has a duplicate, open until the robot is down: in an
            emergency none can fail to open, and no Ctrl-C closes it.
        settings: Settings of the robot.
        clock: The program's clock.

    Attributes:
        report: The newest report of the sender; if it was lost, of what is done in its place.
        driven: Whether the robot has been commanded to move.
        realtime: Whether it has real-time priority.
    """

    def __init__(self, child: Child, robot: socket.socket, settings: Go1Settings, clock: Clock) -> None:
        self._child, self._settings, self._clock = child, settings, clock
        self._robot = robot.dup()
        self._samples: deque[Any] = deque()
        self._closing = False
        self.report = SenderReport()
        self.driven = self.realtime = False
        # no daemon: Python itself does not end before the robot is down
        threading.Thread(target=self._run, name="watch over the sender").start()

    def samples(self) -> list[Any]:
        """States that arrived since the last call, as records of `mail.SAMPLE`."""
        return [self._samples.popleft() for _ in range(len(self._samples))]

    def close(self) -> None:
        """End the watch, once the robot is down; a sender that has not ended by now is lost, too."""
        self._closing = True
        while self.report.phase != Phase.OVER:  # after a `join` that Ctrl-C interrupts Python would end first
            time.sleep(_STEP)

    def _run(self) -> None:
        fault = "the program's own watch failed"
        try:
            self.realtime = take_priority(
                WATCH, anywhere=True
            )  # a sender that hangs may take all of its core
            fault = self._lost()
        finally:
            with self._robot:
                if fault:
                    self._stand_in(fault)

    def _lost(self) -> str:
        """Take in messages until the last phase is over: '', or until the sender is lost: how."""
        last = math.inf  # a sender that starts is not late
        while self.report.phase != Phase.OVER:
            now = self._clock.now()  # before the look: this process itself may be stopped after it
            messages = list(self._child.pipe.received())
            for message in messages:
                self._take(message)
            if messages:
                last = now
            elif not self._child.pipe.open:
                return _DIED
            elif now - last > self._settings.trips.report_age:
                return f"the process that talks to the robot hangs: no report for {1e3 * (now - last):.0f} ms"
            elif self._closing:
                return _ENDLESS
            else:
                time.sleep(_STEP)
        return ""

    def _take(self, message: SenderReport | bytes) -> None:
        if isinstance(message, SenderReport):
            self.report = message
        else:
            self._samples.append(np.frombuffer(message, SAMPLE)[0])

    def _stand_in(self, fault: str) -> None:
        """Let the robot down in place of a lost sender: motors keep their last command permanently."""
        first = {"trip": self.report.trip or "sender_lost", "reason": self.report.reason or fault}
        self.report = replace(self.report, phase=Phase.DAMP, **first)
        try:
            self._child.process.kill()  # one that hangs may wake up, and go on
            if self.driven:
                let_down(RobotSocket(self._robot, self._clock), self._settings, self._clock, _DAMP)
        finally:
            self.report = replace(self.report, phase=Phase.OVER)
