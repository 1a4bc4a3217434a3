"""The process that sends to the robot: a packet every 2 ms, whatever planner and estimator do meanwhile.

It is a process of its own so that nothing can hold it up, and so that it outlives a program that dies: it
then lets the robot down (motors damped) and ends.
"""

from __future__ import annotations

import gc
import math
import os
import select
import signal
import socket
import traceback
from contextlib import suppress
from dataclasses import replace

import numpy as np

from amhe_cli.robots.go1.link import state, wire
from amhe_cli.robots.go1.link.child import SENDER, Pipe, begun, take_priority
from amhe_cli.robots.go1.link.clock import Clock, ClockMap, ticks_ahead
from amhe_cli.robots.go1.link.command import MotorCommand, encode
from amhe_cli.robots.go1.link.first_contact import Contact, Share
from amhe_cli.robots.go1.link.machine import Machine
from amhe_cli.robots.go1.link.mail import SAMPLE, Inbox, Phase, SenderReport
from amhe_cli.robots.go1.link.motion import Sent
from amhe_cli.robots.go1.link.robot_socket import RobotSocket, let_down
from amhe_cli.robots.go1.link.state import RobotState
from amhe_cli.robots.go1.settings import Go1Settings

_BIN, _BINS = 1e-5, 10_000
#: Reports are sent at every change, and at least so often [s]: the program takes silence for our end.
_REPORT_PERIOD = 0.02
#: Every second state is passed on: 500 Hz, evenly spaced by the robot's own clock.
_PASS_ON = 2
#: Signals by which the operator ends the run, and those that would suspend the sender while it drives motors.
_STOPPING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)
_SUSPENDING = (signal.SIGTSTP, signal.SIGTTIN, signal.SIGTTOU)
#: The most keys, or signals, that are read at one go.
_MANY = 64
_DRIVEN = (
    "the robot's motors are driven already: another program talks to it, or died there; end it, and try again"
)


class DrivenError(wire.LinkError):
    """Another program drives the robot: then it is not ours to let down either."""


class Intervals:
    """A histogram of the time between packets, fine enough for quantiles and of one size for ever."""

    def __init__(self) -> None:
        self._counts = np.zeros(_BINS, dtype=np.int64)
        self._last = math.nan
        self._longest = 0.0

    def see(self, time: float) -> None:
        """A packet at a time [s]."""
        interval = time - self._last
        self._last = time
        if interval >= 0.0:
            self._counts[min(int(interval / _BIN), _BINS - 1)] += 1
            self._longest = max(self._longest, interval)

    def summary(self) -> dict[str, float]:
        """Number of packets, and quantiles of the time between them [ms]."""
        total = int(self._counts.sum())
        if not total:
            return {"packets": 0}
        upto = np.cumsum(self._counts) / total
        quantiles = {
            name: round(1e3 * _BIN * (int(np.searchsorted(upto, share)) + 1), 2)
            for name, share in (("p50_ms", 0.5), ("p99_ms", 0.99), ("p999_ms", 0.999))
        }
        return {"packets": total + 1, **quantiles, "max_ms": round(1e3 * self._longest, 2)}


class Sender:
    """The sender's loop; see `run`.

    Args:
        settings: Settings of the robot.
        robot: Socket to the robot.
        pipe: Pipe to the program.
        clock: The program's clock.
        signals: Descriptor from which numbers of signals to the program are read.
        keys: Descriptor of a terminal whose keys are read; -1: none.
        realtime: Whether it has real-time priority.
    """

    def __init__(
        self,
        settings: Go1Settings,
        robot: RobotSocket,
        pipe: Pipe,
        clock: Clock,
        signals: int,
        keys: int,
        realtime: bool,
    ) -> None:
        self._settings, self._robot, self._pipe, self._clock = settings, robot, pipe, clock
        self._signals, self._keys, self._realtime = signals, keys, realtime
        self._machine, self._inbox, self._contact = Machine(settings), Inbox(), Contact()
        self._share = Share()
        self._ticks = ClockMap()
        self._tick: int | None = None
        self._sent = Sent(self._machine.commanded)
        self._intervals = Intervals()
        self._reported = (-np.inf, Phase.OVER)

    def run(self) -> None:
        """Send until the last phase is over.

        Raises:
            DrivenError: Another program drives the robot; no packet is sent any more.
        """
        period = 1.0 / self._settings.rate
        due = self._clock.now()
        while self._machine.phase != Phase.OVER:
            self._read_robot(due)
            self._read_pipe()
            self._read_signals()
            self._read_keys()
            now = self._clock.now()
            self._send(self._machine.step(now, self._inbox), now)
            self._report(now)
            due = next_tick(due, now, period)

    def stop(self, reason: str) -> None:
        """Damp the motors at the next tick."""
        self._inbox.stop = self._inbox.stop or reason

    def stop_on(self, number: int) -> None:
        """Damp the motors at the next tick, if a signal to us or the program is to end the run."""
        if number in _STOPPING:
            self.stop(signal.Signals(number).name)
        elif number in _SUSPENDING:
            self.stop(f"{signal.Signals(number).name} would suspend the sender")

    def say(self, reason: str, phase: Phase = Phase.OVER) -> None:
        """Report an end for a reason, which is the last of our reports if its phase is the last."""
        self._machine.trip, self._machine.reason = (
            self._machine.trip or "error",
            self._machine.reason or reason,
        )
        self._machine.phase = phase
        self._report(self._clock.now())

    # -- what comes in --------------------------------------------------------------------------------

    def _read_robot(self, until: float) -> None:
        for datagram, arrival in self._robot.received(until):
            try:
                read = state.decode(datagram, self._settings.crc)
            except wire.PacketError as error:
                self._inbox.bad_packets += 1
                self._contact.see_strange(len(datagram), str(error))
                continue
            self._inbox.bad_packets = 0
            step = 1 if self._tick is None else ticks_ahead(read.tick, self._tick)
            if step > 0:  # old states, and a robot whose clock stands still, give no new information
                self._tick = read.tick if self._tick is None else self._tick + step
                self._take(replace(read, tick=self._tick), arrival)

    def _take(self, read: RobotState, arrival: float) -> None:
        self._inbox.state, self._inbox.state_time = read, self._robot.empty
        self._inbox.share = self._share.see(read.tick)
        time = self._ticks.see(1e-3 * read.tick, arrival) - 0.5 * self._contact.round_trip
        if self._machine.phase == Phase.CONNECT:
            self._contact.see(read, arrival)
            if self._contact.driven:
                raise DrivenError(_DRIVEN)
        if read.tick % _PASS_ON == 0:
            # packets take time to arrive: take those that the robot followed when it sent its state
            followed = self._sent.by(time - 0.5 * self._contact.round_trip)
            sample = (
                time, self._machine.phase, read.quaternion, read.gyro, read.accelerometer, read.joints,
                read.joint_rates, followed,
            )  # fmt: skip
            self._pipe.send(np.array(sample, dtype=SAMPLE).tobytes())

    def _read_pipe(self) -> None:
        for message in self._pipe.received():
            self._inbox.take(message)
        if not self._pipe.open:
            self.stop("the program has died")

    def _read_signals(self) -> None:
        with suppress(BlockingIOError):
            for number in os.read(self._signals, _MANY):
                self.stop_on(number)

    def _read_keys(self) -> None:
        if self._keys < 0 or not select.select([self._keys], [], [], 0.0)[0]:
            return
        try:
            keys = os.read(self._keys, _MANY)
        except OSError:  # the terminal has been closed
            keys = b""
        if not keys:
            self._keys = -1
            self.stop("the terminal is gone")
        elif self._machine.phase == Phase.READY and keys in (b"\n", b"\r"):
            self._inbox.arm = True
        else:
            self.stop("key")

    # -- what goes out --------------------------------------------------------------------------------

    def _send(self, command: MotorCommand, now: float) -> None:
        if self._machine.phase == Phase.CONNECT:
            command = MotorCommand(self._contact.turn(now))
        if self._clock.now() - now > self._settings.trips.packet_gap:  # we stalled just now: too old to send
            return
        if self._robot.send(encode(command, self._settings.crc)):
            self._intervals.see(now)
            self._sent.add(now, self._machine.commanded)

    def _report(self, now: float) -> None:
        machine = self._machine
        last, phase = self._reported
        if machine.phase == phase and now - last < _REPORT_PERIOD:
            return
        self._reported = now, machine.phase
        looked_at = machine.phase == Phase.CONNECT and self._contact.complete
        self._pipe.send(
            SenderReport(
                machine.phase, machine.trip, machine.reason, self._contact.report, self._robot.refused,
                self._intervals.summary() if machine.phase >= Phase.PAUSE else {},
                self._inbox.state, self._realtime, machine.unfit(now, self._inbox) if looked_at else "",
            )
        )  # fmt: skip


def next_tick(due: float, now: float, period: float) -> float:
    """Time at which the next packet is due [s], after one that was due at `due` and was sent `now`.

    Lost time is not made up for: two packets at once are of no use.
    """
    return max(due + period, now + 0.5 * period)


def main() -> None:
    """Read settings and descriptors from the pipe, and send."""
    pipe, (settings, slow, robot_file, signals, *keys) = begun()
    clock = Clock(slow)
    robot = RobotSocket(socket.socket(fileno=robot_file), clock)
    gc.freeze()
    gc.disable()  # no code here makes reference cycles
    realtime = take_priority(SENDER, longest=settings.trips.report_age * clock.slow)
    sender = Sender(settings, robot, pipe, clock, signals, max(keys, default=-1), realtime)
    for number in (*_STOPPING, *_SUSPENDING):
        signal.signal(number, lambda number, _: sender.stop_on(number))
    try:
        sender.run()
    except DrivenError as error:
        sender.say(str(error))
    except BaseException as error:
        traceback.print_exception(error)
        sender.say(f"{type(error).__name__}: {error}", Phase.DAMP)  # if we hang now, the program damps
        let_down(robot, settings, clock)
        sender.say("")
    finally:
        pipe.close()
