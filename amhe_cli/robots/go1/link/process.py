"""Processes of our own: the pipe to one, its priority, and the clock that all of them share.

The pipe keeps messages apart (SOCK_SEQPACKET), never blocks, and shows each side at once when the other
one has died, however it died: in this way a sender watches its parent.
"""

from __future__ import annotations

import contextlib
import math
import os
import pickle
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Self

from amhe_cli.robots.go1.link.packets import LinkError

#: The robot's clock begins again after so many ticks; a delay is forgotten after one or two of these [s].
_TICKS, _REMEMBERED = 2**32, 2.0


def ticks_ahead(tick: int, before: int) -> int:
    """Ticks from one state to another, past the clock's own end; negative: the first is the older one."""
    return (tick - before + _TICKS // 2) % _TICKS - _TICKS // 2


class Clock:
    """A clock in seconds that is the same for every process of this computer, and is never set.

    Args:
        slow: How many seconds of the wall clock one of ours takes. An emulated robot may run slowed down;
            then every process that talks to it uses the same slower clock.
    """

    def __init__(self, slow: float = 1.0) -> None:
        self.slow = slow

    def now(self) -> float:
        """Present time [s]."""
        return time.monotonic() / self.slow

    def sleep_until(self, then: float) -> None:
        """Sleep until a time on this clock [s]; not at all if it has passed."""
        time.sleep(max(0.0, (then - self.now()) * self.slow))


class ClockMap:
    """Offset of another machine's clock from ours.

    A message cannot arrive before it was sent, and some are hardly delayed: the least difference of arrival
    and stamp is the offset. It is estimated continually, since clocks drift.
    """

    def __init__(self) -> None:
        self._until = -math.inf
        self._last = self._least = math.inf

    def ahead(self, stamp: float, arrival: float) -> float:
        """How far a stamp is ahead of those before it [s]; 0 before the first, negative: it came late."""
        least = min(self._least, self._last)
        return least - (arrival - stamp) if math.isfinite(least) else 0.0

    def see(self, stamp: float, arrival: float) -> float:
        """Take in a message; its stamp on our clock [s], late by the shortest delay of a message so far."""
        if arrival > self._until:
            self._last = self._least if arrival < self._until + _REMEMBERED else math.inf
            self._least, self._until = math.inf, arrival + _REMEMBERED
        self._least = min(self._least, arrival - stamp)
        return stamp + min(self._least, self._last)


#: Real-time priorities of the planner, an emulated robot, a source of poses, the watch over the sender, and
#: the sender. The estimator has none.
PLANNER, ROBOT, POSES, WATCH, SENDER = 10, 20, 30, 40, 50
_LONGEST = 65536


class Pipe:
    """One end of a pipe between parent and child, which carries Python objects.

    Attributes:
        open: Whether the other side is alive.
    """

    def __init__(self, end: socket.socket) -> None:
        end.setblocking(False)
        self._end = end
        self.open = True

    def send(self, message: object) -> bool:
        """Hand a message over; False where the other side is gone, or so far behind that it is dropped."""
        try:
            self._end.send(pickle.dumps(message))
        except OSError:  # what it sent before it ended can still be read
            return False
        return True

    def received(self) -> Iterator[Any]:
        """All messages that have arrived since the last call."""
        while self.open:
            try:
                message = self._end.recv(_LONGEST)
            except BlockingIOError:
                return
            except ConnectionResetError:  # raised once, if the other side left a message of ours unread
                continue
            except OSError:
                message = b""
            if not message:
                self.open = False
                return
            yield pickle.loads(message)

    def close(self) -> None:
        """Close this end: the other side sees it."""
        self._end.close()
        self.open = False


class Opened:
    """A context manager of several parts: what is open is closed again where a later part fails to open."""

    def __enter__(self) -> Self:
        with ExitStack() as opening:
            self._open(opening)
            self._opened = opening.pop_all()
        return self

    def __exit__(self, *error: Any) -> None:
        self._opened.__exit__(*error)

    def _open(self, opening: ExitStack) -> None:
        raise NotImplementedError


class Child:
    """A module run by a Python of its own, in a session of its own: keys of a terminal do not suspend it.

    Args:
        module: Dotted name of the module; its `main` gets a pipe and what it is given from `begun`.
        given: What the child is to know.
        files: Descriptors that the child may use, by the same numbers: from 3 on, 0 to 2 are its own streams.
    """

    def __init__(self, module: str, given: object, files: Sequence[int] = ()) -> None:
        try:
            ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        except OSError as error:
            raise LinkError(f"the link to a robot needs Linux: no SOCK_SEQPACKET here ({error})") from None
        with theirs, ExitStack() as opening:
            opening.enter_context(ours)
            self.process = subprocess.Popen(
                [sys.executable, "-c", f"from {module} import main; main()", str(theirs.fileno())],
                pass_fds=(theirs.fileno(), *files), stdin=subprocess.DEVNULL, stdout=sys.__stderr__,
                env=_environment(), start_new_session=True,
            )  # fmt: skip
            opening.pop_all()  # ours stays open
        self.pipe = Pipe(ours)
        self.pipe.send(given)

    def end(self, patience: float) -> None:
        """Close the pipe, wait so long [s] for the child to end by itself, then kill it."""
        self.pipe.close()
        try:
            self.process.wait(patience)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


def _environment() -> dict[str, str]:
    """Environment of this process, with this very package on the path of the child."""
    ours = str(Path(__file__).parents[4])
    return os.environ | {"PYTHONPATH": os.pathsep.join([ours, *filter(None, [os.environ.get("PYTHONPATH")])])}


def begun() -> tuple[Pipe, Any]:
    """The child's pipe, and what it was given; to be called in the child."""
    end = socket.socket(fileno=int(sys.argv[1]))
    end.settimeout(10.0)
    first = end.recv(_LONGEST)
    if not first:
        raise LinkError("the parent has gone")
    return Pipe(end), pickle.loads(first)


def take_priority(level: int, anywhere: bool = False, longest: float = math.inf) -> bool:
    """Run this thread before others; True: always, False: only more often than others.

    Args:
        level: Priority among real-time threads; the highest goes first.
        anywhere: Run on any core; else, with real-time priority, on the last one, off which a planner keeps.
        longest: With real-time priority, the kernel kills this process where it computes so long [s] without
            a pause: on one core nobody else gets to run, to notice that it hangs.
    """
    # without its limit this process gets no real-time priority, and without that the limit does nothing
    if not (_limited(longest) and _real_time(level)):
        with contextlib.suppress(OSError):
            os.nice(-10)
        return False
    if not anywhere:
        with contextlib.suppress(OSError):
            os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    return True


@contextlib.contextmanager
def planning_first() -> Iterator[tuple[int, bool]]:
    """Run this thread, and those that it starts, before all without real-time priority, where it may.

    It then keeps off the last core, if there is another one: a rollout that sender, poses and an emulated
    robot interrupt every millisecond takes half as long again.

    Yields:
        Number of cores that it has, and whether it has real-time priority.
    """
    if not hasattr(os, "sched_getscheduler"):  # a link refuses what is not Linux in one line
        yield os.cpu_count() or 1, False
        return
    policy, priority, before = os.sched_getscheduler(0), os.sched_getparam(0), os.sched_getaffinity(0)
    if not _real_time(PLANNER):
        yield len(before), False
        return
    cores = before - {max(before)} or before
    try:
        os.sched_setaffinity(0, cores)
        yield len(cores), True
    finally:
        os.sched_setscheduler(0, policy, priority)
        os.sched_setaffinity(0, before)


def _real_time(level: int) -> bool:
    """Give this thread a real-time priority, if it may have one.

    Who may not have the highest gets none: a planner must never go before a sender that has none.
    """
    try:
        for each in (SENDER, level):
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(each))
    except (OSError, AttributeError):  # no right to it; not Linux
        return False
    return True


def _limited(longest: float) -> bool:
    """Let the kernel kill this process as `take_priority` says, if it does that."""
    if longest == math.inf:
        return True
    try:
        import resource  # no other operating system has it, and none comes here

        _, most = resource.getrlimit(resource.RLIMIT_RTTIME)
        limit = int(1e6 * longest) if most == resource.RLIM_INFINITY else min(int(1e6 * longest), most)
        resource.setrlimit(resource.RLIMIT_RTTIME, (limit, limit))
    except (OSError, ValueError):  # EPERM and EINVAL are raised as ValueErrors
        return False
    return True
