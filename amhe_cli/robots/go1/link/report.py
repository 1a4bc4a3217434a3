"""What the sender reports, and the error that an early end is."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from amhe_cli.core.errors import AmheError, OperatorStopError
from amhe_cli.robots.go1.link.mail import Phase

#: What the operator stops a run with, as the sender names it.
_OPERATOR = ("key", "the terminal is gone", "SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT")


class StoppedError(AmheError):
    """A trip ended the run; the robot has been let down, or is being.

    Args:
        reason: Why, in words.
        trip: Name of the trip; '': none ended it.
    """

    def __init__(self, reason: str, trip: str = "") -> None:
        super().__init__(f"trip {trip}: {reason}" if trip else reason)
        self.trip = trip


@dataclass(slots=True)
class SenderReport:
    """The newest report of the sender: see `sender.Sender._report`."""

    phase: Phase = Phase.CONNECT
    trip: str = ""
    reason: str = ""
    contact: dict[str, Any] = field(default_factory=dict)
    refused: int = 0
    intervals: dict[str, float] = field(default_factory=dict)
    robot: dict[str, Any] = field(default_factory=dict)
    realtime: bool = True
    unfit: str = ""

    @property
    def stop(self) -> AmheError:
        """Why the run ended before its end, as an error to raise."""
        if self.trip == "remote" or self.reason in _OPERATOR:
            return OperatorStopError(f"stopped by the operator: {self.reason}")
        return StoppedError(self.reason, self.trip) if self.trip else StoppedError("the run was ended")
