"""The process that holds a pose source, and its reader in the program."""

from __future__ import annotations

import ctypes
import signal
import sys
import time
from contextlib import ExitStack
from dataclasses import dataclass
from typing import NamedTuple

from amhe_cli.core.arrays import FloatArray
from amhe_cli.robots.go1.link.process import POSES, Child, Clock, ClockMap, Opened, Pipe, begun, take_priority
from amhe_cli.robots.go1.poses.sources import MotionCapture, NatNet, PoseError, PoseSource, Sighting, UdpPoses
from amhe_cli.robots.go1.settings import Go1Settings

KINDS = ("natnet", "motioncapture", "udp")
_WAIT, _STEP, _START = 0.05, 0.005, 20.0
#: A stamp further ahead than this is wrong [s], unless so many in a row are.
_AHEAD, _AGAIN = 0.25, 100
_PR_SET_PDEATHSIG = 1


def _source_of(kind: str, host: str, port: int, settings: Go1Settings) -> PoseSource:
    match kind:
        case "natnet":
            return NatNet(host, port, _patience(settings), settings.poses.data_port)
        case "udp":
            return UdpPoses(host, port, settings.poses.peer)
        case _:
            return MotionCapture(*host.split(":", 1))


def _patience(settings: Go1Settings) -> float:
    """Longest wait for the first poses [s of the wall clock]."""
    return settings.connect_time * max(1.0, settings.slow)


@dataclass(frozen=True, slots=True, eq=False)
class TimedPose:
    """A pose on our clock, in the source's frame.

    Args:
        time: Time of the exposure [s].
        position: Position [m], shape (3,).
        orientation: Unit quaternion w, x, y, z, shape (4,).
        flaw: Why it cannot be believed; '' if nothing is known against it.
    """

    body: str
    time: float
    position: FloatArray
    orientation: FloatArray
    flaw: str = ""


class _Begun(NamedTuple):
    """The process has started: whom it listens to, in words, and whether it has real-time priority."""

    about: str
    realtime: bool


class PoseFeed(Opened):
    """A source of poses in a process of its own; use it as a context manager.

    Args:
        kind: One of `KINDS`.
        host: natnet: Motive's host; motioncapture: KIND:HOST, such as vicon:192.168.1.5; udp: own address to
            listen on.
        port: Port of natnet or udp.
        settings: The bodies' names, how long to wait for them, and who may send poses.

    Attributes:
        about: Whom the source listens to, in words.
        realtime: Whether it has real-time priority.
    """

    def __init__(self, kind: str, host: str, port: int, settings: Go1Settings) -> None:
        self._given, self._kind, self._settings = (kind, host, port, settings), kind, settings
        self._bodies = settings.trunk, settings.box
        self.about, self.realtime = "", False
        self._child: Child | None = None

    def _open(self, opening: ExitStack) -> None:
        self._child = Child("amhe_cli.robots.go1.poses.feed", self._given)
        opening.callback(self._child.end, 0.5)

    def first(self) -> dict[str, TimedPose]:
        """Wait until every body has been seen; the newest pose of each, by name.

        Raises:
            PoseError: A body was not seen, or the source cannot be reached.
        """
        seen: dict[str, TimedPose] = {}
        end = time.monotonic() + _START
        while time.monotonic() < end and not set(self._bodies) <= set(seen):
            for message in self._messages():
                if isinstance(message, TimedPose):
                    seen[message.body] = message
                else:  # its Python has started: the wait begins now
                    self.about, self.realtime = message
                    end = time.monotonic() + _patience(self._settings)
            time.sleep(_STEP)
        if missing := [name for name in self._bodies if name not in seen]:
            raise PoseError(self._absent(missing, set(seen) - set(self._bodies)))
        return seen

    def poses(self) -> list[TimedPose]:
        """All poses that have arrived since the last call.

        Raises:
            PoseError: The source has died.
        """
        return [message for message in self._messages() if isinstance(message, TimedPose)]

    def _messages(self) -> list[TimedPose | _Begun]:
        if self._child is None:
            raise PoseError("the pose source is not open")
        messages = list(self._child.pipe.received())
        for message in messages:
            if isinstance(message, PoseError):
                raise message
        if not self._child.pipe.open:
            raise PoseError(f"the pose source {self._kind} has died")
        return messages

    def _absent(self, missing: list[str], others: set[str]) -> str:
        known = f"it has: {', '.join(sorted(others))}" if others else "it sends no body at all"
        return (
            f"{self._kind} sends no pose of {' and '.join(map(repr, missing))} within "
            f"{self._settings.connect_time:g} s; {known}. Name them with `go1.trunk=NAME` `go1.box=NAME`"
        )


class _Sender:
    """The child's side: stamps sightings on our clock and passes them on."""

    def __init__(self, pipe: Pipe, clock: Clock) -> None:
        self._pipe, self._clock, self._map = pipe, clock, ClockMap()
        self._last: dict[str, bytes] = {}
        self._strange = 0

    def pass_on(self, seen: list[Sighting]) -> None:
        """Pass on what was seen since the last look.

        Poses without stamps that have waited together were exposed nobody knows when: the last one counts.
        """
        last = {one.body: one for one in seen}
        for one in seen:
            if one.stamp is not None or one is last[one.body]:
                self._pass_on(one)

    def _pass_on(self, seen: Sighting) -> None:
        pose, before = seen.position.tobytes() + seen.orientation.tobytes(), self._last.get(seen.body)
        self._last[seen.body] = pose
        if seen.stamp is None and pose == before:  # a camera is never so still: the source has frozen
            return
        arrival = self._clock.now()
        flaw = self._flaw(seen.stamp, arrival)
        # the least delay from a stamp to us is at least the age that the source gives
        stamped = arrival if seen.stamp is None or flaw else self._map.see(seen.stamp, arrival)
        self._pipe.send(TimedPose(seen.body, stamped - seen.age, seen.position, seen.orientation, flaw))

    def _flaw(self, stamp: float | None, arrival: float) -> str:
        """What is wrong with a stamp: a single one far ahead would make all later ones look old.

        Many in a row are a clock that was set: then they count again, for a source that is not in use yet.
        """
        ahead = 0.0 if stamp is None else self._map.ahead(stamp, arrival)
        self._strange = self._strange + 1 if ahead > _AHEAD else 0
        if self._strange >= _AGAIN:
            self._map, self._strange = ClockMap(), 0
        return f"its stamp is {ahead:.3g} s ahead of the ones before" if self._strange else ""


def main() -> None:
    """Send poses to the program until it closes the pipe."""
    for number in (signal.SIGINT, signal.SIGTERM):  # meant for the program, which needs poses to sit down
        signal.signal(number, signal.SIG_IGN)
    if sys.platform == "linux":  # a source that waits for ever does not notice that the program has ended
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    pipe, given = begun()
    sender, source = _Sender(pipe, Clock(given[-1].slow)), _source_of(*given)
    realtime = take_priority(POSES)  # a late pose looks like a lost one
    pipe.send(_Begun(source.about, realtime))
    try:
        source.connect()
        while pipe.open:
            sender.pass_on(source.wait(_WAIT))
            list(pipe.received())  # nothing comes; at the end of the program it is closed
    except PoseError as error:
        pipe.send(error)
    finally:
        source.close()
