"""A sender that computes without a pause, much longer than it may, once it has sent commands for a while."""

from __future__ import annotations

import time

from amhe_cli.robots.go1.link import sender
from amhe_cli.robots.go1.link.packets import MotorCommand

_WELL, _LONG = 50, 5.0


class SpinningSender(sender.Sender):
    """See `Sender`."""

    _driven = 0

    def _send(self, command: MotorCommand, now: float) -> None:
        super()._send(command, now)
        self._driven += command.kp.max() > 0.0
        end = time.monotonic() + _LONG
        while self._driven > _WELL and time.monotonic() < end:
            pass


def main() -> None:
    """See `sender.main`."""
    sender.Sender = SpinningSender  # type: ignore[misc]
    sender.main()
