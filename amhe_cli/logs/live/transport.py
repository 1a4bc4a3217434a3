"""What brings the messages of a running system."""

from __future__ import annotations

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
