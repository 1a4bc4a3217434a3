"""The program's end of the link: starts the sender and watches it, hands over plans, hands out what it says.

The watch has a thread of its own, so that a plan that takes long does not hold it up: it damps the motors if
the sender's reports stop.
"""

from __future__ import annotations

import fcntl
import math
import os
import signal
import socket
import subprocess
import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import replace
from typing import Any

import numpy as np

from amhe_cli.robots.go1.link.mail import SAMPLE, Phase, SenderReport, Targets
from amhe_cli.robots.go1.link.packets import STATE, LinkError
from amhe_cli.robots.go1.link.process import WATCH, Child, Clock, Opened, take_priority
from amhe_cli.robots.go1.link.sender import RobotSocket, connected, let_down
from amhe_cli.robots.go1.settings import Go1Settings

#: Time between two looks [s], and the least time for which motors are damped in place of the sender [s].
_LOOK, _DAMP = 0.005, 2.0
_DIED = "the process that talks to the robot has died"
_ENDLESS = "the process that talks to the robot does not end"


class SenderWatch:
    """Watches a sender from its first report to its last.

    Args:
        child: The sender's process.
        robot: The sender's own socket. The watch has a duplicate, open until the robot is down: in an
            emergency none can fail to open, and no Ctrl-C closes it.

    Attributes:
        report: The newest report of the sender; if it was lost, of what is done in its place.
        looked: When the sender's messages were taken in for the last time [s].
        driven: Whether the robot has been commanded to move.
        realtime: Whether it has real-time priority.
    """

    def __init__(self, child: Child, robot: socket.socket, settings: Go1Settings, clock: Clock) -> None:
        self._child, self._settings, self._clock = child, settings, clock
        self._robot = robot.dup()
        self._samples: deque[Any] = deque()
        self._closing = False
        self.report, self.looked = SenderReport(), math.inf
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
            time.sleep(_LOOK)

    def _run(self) -> None:
        fault = "the program's own watch failed"
        try:
            self.realtime = take_priority(WATCH, anywhere=True)  # a sender that hangs may take all of a core
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
            self.looked = now
            if messages:
                last = now
            elif not self._child.pipe.open:
                return _DIED
            elif now - last > self._settings.trips.report_age:
                return f"the process that talks to the robot hangs: no report for {1e3 * (now - last):.0f} ms"
            elif self._closing:
                return _ENDLESS
            else:
                time.sleep(_LOOK)
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


#: Number of states after which a robot counts as found.
_ENOUGH = 200
_HIGH_LEVEL = 1087
#: Longest time for the start of a process, and time between two checks whether it has started [s].
_START, _STEP = 20.0, 0.005


class Link(Opened):
    """A robot at the end of a wire; use it as a context manager: whatever happens, the robot is let down.

    Args:
        host, port: Address of the robot.
        keys: Descriptor of a terminal whose keys arm and stop; -1: none.
    """

    def __init__(self, host: str, port: int, settings: Go1Settings, clock: Clock, keys: int = -1) -> None:
        self._where, self._settings, self._clock, self._keys = (host, port), settings, clock, keys
        self._child: Child | None = None
        self._watch: SenderWatch | None = None

    def _open(self, opening: ExitStack) -> None:
        robot = opening.enter_context(closing(connected(*self._where)))
        incoming, outgoing = opening.enter_context(_nonblocking_pipe())
        with _as_file(self._keys) as keys:
            files = [robot.fileno(), incoming, *keys]
            given = (self._settings, self._clock.slow, *files)
            self._child = Child("amhe_cli.robots.go1.link.sender", given, files)
        opening.callback(self._child.end, 5.0 * self._clock.slow)
        self._watch = SenderWatch(self._child, robot, self._settings, self._clock)
        opening.callback(self._watch.close)
        if threading.current_thread() is threading.main_thread():
            # the signal itself informs the sender, even while our thread is deep in a rollout
            before = signal.set_wakeup_fd(outgoing, warn_on_full_buffer=False)
            opening.callback(signal.set_wakeup_fd, before)
        opening.callback(self.finish)

    @property
    def report(self) -> SenderReport:
        """The newest report of the sender."""
        return self._watch.report if self._watch else SenderReport()

    @property
    def process(self) -> subprocess.Popen[bytes]:
        """The process of the sender."""
        assert self._child is not None, "the link is open"
        return self._child.process

    @property
    def late(self) -> list[str]:
        """What has no real-time priority, of the sender and the watch over it."""
        both = {"sender": self.report, "watch": self._watch}
        return [name for name, one in both.items() if one and not one.realtime]

    # -- the phases -----------------------------------------------------------------------------------

    def connect(self) -> SenderReport:
        """Wait until the robot answers as it should. Nothing moves.

        Raises:
            LinkError: It does not; the text says what arrived instead.
        """
        end = time.monotonic() + _START
        while not (self.report.contact or self.report.reason) and time.monotonic() < end:
            time.sleep(_STEP)  # the process has not begun yet
        end = time.monotonic() + self._settings.connect_time * max(1.0, self._clock.slow)
        while time.monotonic() < end:
            report = self.report
            seen = report.contact.get("complete") and report.contact["states"] >= _ENOUGH
            if report.phase != Phase.CONNECT or (seen and report.contact["in_step"] and not report.unfit):
                break
            time.sleep(_STEP)
        self._check_contact()
        return self.report

    def stand(self) -> None:
        """Let the robot stand up."""
        if self._watch:
            self._watch.driven = True
        self._send(stand=True)

    def arm(self) -> None:
        """Let plans take effect, as the operator's key does."""
        self._send(arm=True)

    def reached(self, phase: Phase) -> bool:
        """Whether the sender has reached a phase.

        Raises:
            StoppedError, OperatorStopError: A trip, or the operator, ended the run before that.
        """
        report = self.report
        if report.phase > phase:
            raise report.stop
        return report.phase == phase

    def play(self, plan: Targets, pose_time: float) -> None:
        """Hand over the newest plan.

        Args:
            plan: Joint targets, with times on our clock.
            pose_time: Time of the older one of the newest poses of trunk and box [s].
        """
        self._send(plan=plan, pose_time=pose_time, plan_time=self._clock.now())

    def doubt(self, why: str) -> None:
        """Say why poses cannot be believed any more: a robot that runs holds, and sits down."""
        self._send(doubt=why)

    def contradict(self, why: str) -> None:
        """Say what contradicts the poses: the motors of a robot that runs are damped."""
        self._send(contradiction=why)

    def samples(self) -> list[Any]:
        """States that arrived since the last call, as records of `mail.SAMPLE`."""
        return self._watch.samples() if self._watch else []

    @property
    def looked(self) -> float:
        """When the states that `samples` has were taken from the sender [s]."""
        return self._watch.looked if self._watch else math.inf

    def finish(self) -> SenderReport:
        """Let the robot sit down and switch its motors off; wait until this is done."""
        s = self._settings
        self._send(finish=True)
        longest = s.hold_time + s.sit_time + s.damp_time + 2.0
        end = time.monotonic() + longest * max(1.0, self._clock.slow)
        while self.report.phase != Phase.OVER and time.monotonic() < end:
            time.sleep(_STEP)
        return self.report

    # -- the pipe ----------------------------------------------------------------------------------

    def _send(self, **news: Any) -> None:
        """Fields of the sender's `Inbox`."""
        if self._child:
            self._child.pipe.send(news)

    def _check_contact(self) -> None:
        host, port = self._where
        where, contact, report = f"{host}:{port}", self.report.contact, self.report
        states = contact.get("states", 0)
        if report.trip == "error":
            raise LinkError(report.reason)
        if report.phase != Phase.CONNECT:
            raise report.stop
        if not states and contact.get("strange"):
            raise LinkError(_strange(where, contact["strange_size"], contact["strange_why"]))
        if not states and report.refused:
            raise LinkError(f"nobody listens on {where}: is it the robot's address, and is the robot on?")
        if not states:
            raise LinkError(
                f"nothing answers from {where}: check `host`, the cable, and that this computer has an "
                "address in the robot's network"
            )
        if not contact["complete"]:
            raise LinkError(
                f"the robot on {where} sends states but follows no commands: another program talks to it, or "
                "it wants the other checksum (`go1.crc=encrypted`)"
            )
        if report.unfit:
            raise LinkError(f"the robot cannot be driven: {report.unfit}")
        if not contact["in_step"]:
            raise LinkError(
                f"the robot's clock does {contact['pace']:.2f} s in one of ours: give amhe emulate and this "
                "command the same `go1.slow`, and a larger one where the computer is too slow for it"
            )


@contextmanager
def _as_file(keys: int) -> Iterator[list[int]]:
    """The terminal's descriptor by another number: a child's own standard streams take 0 to 2."""
    if keys < 0:
        yield []
        return
    again = fcntl.fcntl(keys, fcntl.F_DUPFD_CLOEXEC, 3)
    try:
        yield [again]
    finally:
        os.close(again)


@contextmanager
def _nonblocking_pipe() -> Iterator[tuple[int, int]]:
    """Both ends of a pipe that this process keeps: a signal is never written to where nobody reads."""
    ends = os.pipe()
    try:
        for end in ends:
            os.set_blocking(end, False)
        yield ends
    finally:
        for end in ends:
            os.close(end)


def _strange(where: str, size: int, why: str) -> str:
    if size == _HIGH_LEVEL:
        return (
            f"the robot on {where} is in high-level mode: on the remote L2+A, L2+A, L2+B, L1+L2+START, with "
            "the robot lying or hanging (docs/go1.md)"
        )
    if size == STATE.itemsize:
        return f"{where} sends what is no state: {why}"
    return f"what answers from {where} is no Go1: datagrams of {size} bytes"
