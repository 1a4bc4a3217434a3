"""What brings the messages of a running system: live topics, a file that grows, or a log that is played."""

from __future__ import annotations

import time
from collections.abc import Collection
from dataclasses import replace

import numpy as np

from amhe_cli.logs.containers.folder import StoredLog
from amhe_cli.logs.containers.raw import Batch, Connection

#: Time between two looks at a transport [s]: what comes meanwhile is decoded at once.
STEP = 0.01
#: Notes that a sender can cause.
_NOTES = 50


class Transport:
    """Brings messages as they are, and holds no more than a bounded number of them.

    Args:
        about: Whom it listens to, in words.

    Attributes:
        over: Whether nothing more will come.
        connections: Topics that are offered, wanted or not.
    """

    def __init__(self, about: str) -> None:
        self.about, self.over = about, False
        self.connections: list[Connection] = []
        self._told: dict[str, bool] = {}

    def receive(self) -> list[Batch]:
        """The messages since the last call; does not wait."""
        raise NotImplementedError

    def note(self, text: str) -> None:
        """Remember to say something, once."""
        if len(self._told) < _NOTES:
            self._told.setdefault(text, False)

    def notes(self) -> list[str]:
        """What is to be said since the last call."""
        fresh = [text for text, told in self._told.items() if not told]
        self._told |= dict.fromkeys(fresh, True)
        return fresh

    def announce(self, topic: str, msgtype: str) -> None:
        """Say that messages will be sent, where who listens would miss the first one otherwise."""

    def publish(self, topic: str, msgtype: str, message: bytes) -> None:
        """Send a message in CDR to whoever listens, where the transport can."""

    def close(self) -> None:
        """Let go of what was opened."""


class Played(Transport):
    """A log as if it were live: messages come when they were received, or so many times as fast.

    Args:
        log: The log.
        topics: Topics that are wanted.
        speed: Seconds of the log in one second.

    Raises:
        LogError: The log cannot be read.
    """

    def __init__(self, log: StoredLog, topics: Collection[str], speed: float) -> None:
        super().__init__(str(log.path))
        found = [(np.argsort(batch.log_ns, kind="stable"), batch) for batch in log.batches(topics)]
        self._batches = [(batch.log_ns[order], order, batch) for order, batch in found if order.size]
        self.connections = log.connections
        for problem in log.problems:
            self.note(f"{log.path}: {problem}")
        self._start_ns = min((int(stamps[0]) for stamps, *_ in self._batches), default=0)
        self._end_ns = max((int(stamps[-1]) for stamps, *_ in self._batches), default=0)
        self._speed, self._begun, self._reached = speed, -1.0, self._start_ns - 1

    def receive(self) -> list[Batch]:
        """See `Transport`."""
        self._begun = time.monotonic() if self._begun < 0.0 else self._begun
        before = self._reached
        self._reached = self._start_ns + round(1e9 * self._speed * (time.monotonic() - self._begun))
        self.over = self._reached >= self._end_ns
        found = []
        for stamps, order, batch in self._batches:
            first, last = np.searchsorted(stamps, (before, self._reached), side="right")
            if last > first:
                cut = {name: getattr(batch, name)[order[first:last]] for name in _EACH}
                found.append(replace(batch, **cut))
        return found


#: What a batch has of each message.
_EACH = ("log_ns", "publish_ns", "starts", "lengths")
