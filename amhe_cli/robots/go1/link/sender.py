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
import statistics
import traceback
from collections import Counter, deque
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import Any

import numpy as np

from amhe_cli.robots.go1.link.machine import Machine
from amhe_cli.robots.go1.link.mail import SAMPLE, Inbox, Phase, SenderReport, Sent
from amhe_cli.robots.go1.link.packets import (
    DAMPED,
    SERVO,
    LinkError,
    MotorCommand,
    PacketError,
    RobotState,
    decode_state,
    encode_command,
)
from amhe_cli.robots.go1.link.process import SENDER, Clock, ClockMap, Pipe, begun, take_priority, ticks_ahead
from amhe_cli.robots.go1.settings import Go1Settings

#: Largest datagram, and the most that are read at one go: a flood does not hold packets up.
_LARGEST, _MOST = 2048, 1000


class RobotSocket:
    """A UDP socket for one address only; it ignores all others.

    Attributes:
        refused: How often the other computer reported that no program listens there.
        empty: When there was nothing to read for the last time [s]: what is read next arrived later.
    """

    def __init__(self, connected: socket.socket, clock: Clock) -> None:
        self._socket, self._clock = connected, clock
        self.refused = 0
        self.empty = -math.inf

    def send(self, packet: bytes) -> bool:
        """Send a packet; False where the network did not take it."""
        try:
            self._socket.send(packet)
        except ConnectionRefusedError:
            self.refused += 1
            return False
        except OSError:
            return False
        return True

    def received(self, until: float) -> Iterator[tuple[bytes, float]]:
        """All datagrams that arrive until a time [s], each with the time at which it was read [s].

        The kernel's own stamps are not used: they are of a clock that may be set.
        """
        for _ in range(_MOST):
            now = self._clock.now()
            try:
                datagram = self._socket.recv(_LARGEST)
            except ConnectionRefusedError:
                self.refused += 1
            except OSError:
                self.empty = now
                if now >= until:
                    return
                select.select([self._socket], [], [], (until - now) * self._clock.slow)
            else:
                yield datagram, self._clock.now()


def connected(host: str, port: int) -> socket.socket:
    """A UDP socket for a robot's address.

    Raises:
        LinkError: There is no such host, or no way to it.
    """
    opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    opened.setblocking(False)
    try:
        opened.connect((host, port))
    except OSError as error:
        opened.close()
        raise LinkError(f"no way to {host}:{port}: {error.strerror or error}") from error
    return opened


def let_down(robot: RobotSocket, settings: Go1Settings, clock: Clock, least: float = 0.0) -> None:
    """Let the robot down without the state machine, after a failure.

    Damps the motors for `settings.damp_time`, but no shorter than `least` [s]; then commands them to do
    nothing.
    """
    period, end = 1.0 / settings.rate, clock.now() + max(settings.damp_time, least)
    damped = MotorCommand(velocity=np.zeros(12), kd=np.full(12, settings.damping))
    while clock.now() < end:
        robot.send(encode_command(damped, settings.crc))
        clock.sleep_until(clock.now() + period)
    robot.send(encode_command(MotorCommand(), settings.crc))


#: Turns of the motors' mode whose echoes are timed, and the time given to one [s].
_TURNS, _PATIENCE = 10, 0.1
#: The robot's clock is compared with ours over times of this length [s], and so many of them.
_PACED, _PACES = 0.25, 5
#: How far the pace may be from 1: clocks differ by far less, a forgotten `slow` by far more.
_PACE_ERROR = 0.05
#: Motors that nobody drives have less torque than this [N m].
_DRIVING = 2.0
#: Number of states over which the share is taken, and the most missing ones that a pause counts as.
_SPAN, _PAUSE = 200, 10


class Share:
    """Share of the robot's states that reach us: with a second program at the same robot it is about a half.

    A long pause counts little, because it is another fault and is reported as that.
    """

    def __init__(self) -> None:
        self._gaps: deque[tuple[int, int]] = deque()
        self._last: int | None = None

    def see(self, tick: int) -> float:
        """Take in the tick of a state; the share of the last 200 that came, from 0 to 1."""
        missing = 0 if self._last is None else tick - self._last - 1
        self._last = tick
        if missing > 0:
            self._gaps.append((tick, min(missing, _PAUSE)))
        while self._gaps and tick - self._gaps[0][0] >= _SPAN:
            self._gaps.popleft()
        return 1.0 - min(1.0, sum(gap for _, gap in self._gaps) / _SPAN)


@dataclass(slots=True)
class Contact:
    """Counts what arrives before anything moves, and times echoes.

    A state contains each motor's mode. Servo mode without gains and damping mode both leave a motor alone, so
    that switching from one to the other moves nothing, and the echo gives the round-trip time.

    Attributes:
        mode: Mode to command now.
        driven: Whether another program drives the motors.
    """

    mode: int = DAMPED
    driven: bool = False
    _least: tuple[float, float] = (math.inf, math.inf)
    _former: tuple[float, float] | None = None
    _paces: deque[float] = field(default_factory=lambda: deque(maxlen=_PACES))
    _echoes: dict[int, list[float]] = field(default_factory=lambda: {DAMPED: [], SERVO: []})
    _turned: float = -1.0
    _good: int = 0
    _strange: Counter[tuple[int, str]] = field(default_factory=Counter)

    def turn(self, now: float) -> int:
        """The motors' mode to command at a time [s]."""
        if self._turned < 0.0 or now - self._turned > _PATIENCE:
            self._turned = now
            self.mode = DAMPED if self.mode == SERVO else SERVO
        if self.complete:
            self.mode = SERVO
        return self.mode

    def see(self, state: RobotState, arrival: float) -> None:
        """Take in a good state."""
        self._good += 1
        if not self.complete and self._turned >= 0.0 and (state.modes == self.mode).all():
            self._echoes[self.mode].append(arrival - self._turned)
            self._turned = -1.0
        self.driven = bool((state.modes == SERVO).all() and np.abs(state.torques).max() > _DRIVING)
        self._see_pace(state.tick, arrival)

    def _see_pace(self, tick: int, arrival: float) -> None:
        """Compare the clocks by states of the least delay: a busy computer reads most of them late."""
        began, least = self._least
        late = arrival - 1e-3 * tick
        if arrival - began < _PACED:
            self._least = min(began, arrival), min(least, late)
            return
        if self._former is not None:
            self._paces.append(1.0 - (least - self._former[1]) / (began - self._former[0]))
        self._former, self._least = self._least, (arrival, late)

    def see_strange(self, size: int, why: str) -> None:
        """Count a datagram of so many bytes that is not a state, and why it is none."""
        self._strange[size, why] += 1

    @property
    def complete(self) -> bool:
        """Whether enough echoes of either mode have come: a robot that never leaves one follows nothing."""
        return min(map(len, self._echoes.values())) >= _TURNS // 2

    @property
    def round_trip(self) -> float:
        """Time for a command to go there and back [s]; 0 before the first echo."""
        return statistics.median(echoes) if (echoes := list(chain(*self._echoes.values()))) else 0.0

    @property
    def pace(self) -> float:
        """Recent seconds of the robot's clock per second of ours; 0: not known yet.

        The median of several times, of which one pause of this computer spoils two at most.
        """
        return statistics.median(self._paces) if self._paces else 0.0

    @property
    def in_step(self) -> bool:
        """Whether the robot's time goes as fast as ours."""
        return abs(self.pace - 1.0) <= _PACE_ERROR

    @property
    def report(self) -> dict[str, Any]:
        """The findings as plain values."""
        (size, why), _ = (self._strange.most_common(1) or [((0, ""), 0)])[0]
        return {
            "complete": self.complete,
            "pace": round(self.pace, 3),
            "in_step": self.in_step,
            "round_trip_ms": round(1e3 * self.round_trip, 2),
            "states": self._good,
            "strange": sum(self._strange.values()),
            "strange_size": size,
            "strange_why": why,
        }


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


class DrivenError(LinkError):
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
        shares = {"p50_ms": 0.5, "p99_ms": 0.99, "p999_ms": 0.999}
        bins = {name: int(np.searchsorted(upto, share)) for name, share in shares.items()}
        quantiles = {name: round(1e3 * _BIN * (at + 1), 2) for name, at in bins.items()}
        return {"packets": total + 1, **quantiles, "max_ms": round(1e3 * self._longest, 2)}


class Sender:
    """The sender's loop; see `run`.

    Args:
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
        machine = self._machine
        machine.trip, machine.reason, machine.phase = machine.trip or "error", machine.reason or reason, phase
        self._report(self._clock.now())

    # -- what comes in --------------------------------------------------------------------------------

    def _read_robot(self, until: float) -> None:
        for datagram, arrival in self._robot.received(until):
            try:
                read = decode_state(datagram, self._settings.crc)
            except PacketError as error:
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
        if self._robot.send(encode_command(command, self._settings.crc)):
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
                machine.phase, machine.trip, machine.reason,
                self._contact.report | {"share": self._inbox.share}, self._robot.refused,
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
