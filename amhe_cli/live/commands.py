"""The commands that a robot followed, as samples: those that were sent, or else those that were planned."""

from __future__ import annotations

import numpy as np

from amhe_cli.control.controller import Plan
from amhe_cli.core.arrays import FloatArray

#: Time between two samples of the commands that were sent [s].
_SENT_PERIOD = 0.004


class Commands:
    """Joint targets with the times since when they were followed; a reader holds each until the next.

    Args:
        period: Control period [s].
    """

    def __init__(self, period: float) -> None:
        self._period = period
        self._last: tuple[float, FloatArray, Plan] | None = None
        self._acting: Plan | None = None
        self._sampled_until = -np.inf
        self._newest_sent: tuple[FloatArray, FloatArray] | None = None

    def take(
        self, time: float, played: FloatArray, plan: Plan, sent: tuple[FloatArray, FloatArray] | None
    ) -> tuple[FloatArray, FloatArray]:
        """The commands of one cycle; call it once for each, in their order.

        Args:
            time: Time of the cycle [s].
            played: Joint targets in force while it planned [rad], shape (n,).
            plan: The plan that it made.
            sent: Times [s] (m,) at which the robot followed targets [rad] (m, n); None: unknown, and the
                plans count as followed.

        Returns:
            Times [s], shape (c,), and joint targets [rad], shape (c, n).
        """
        if self._last is None:
            self._sampled_until = time
            taken = np.array([time]), played[None]
        elif sent is None:
            taken = self._planned(time, played, *self._last)
        else:
            taken = self._sent(*sent)
        self._acting = self._last[2] if self._last else None
        self._last = time, played, plan
        return taken

    def _planned(
        self, time: float, played: FloatArray, last_time: float, last_played: FloatArray, _: Plan
    ) -> tuple[FloatArray, FloatArray]:
        """Joint targets when they took effect; also those of periods that had no new plan."""
        missed = np.arange(last_time + self._period, time - 1e-6, self._period)
        between = [last_played if self._acting is None else self._acting.at(float(t)) for t in missed]
        return np.append(missed, time), np.array([*between, played])

    def _sent(self, times: FloatArray, targets: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Targets in the middle of each short period, since a reader holds them for that period.

        They differ from the plans: one that is late begins late, a new one is blended into, and the motors'
        torque is limited.
        """
        if self._newest_sent is not None:
            times = np.append(self._newest_sent[0], times)
            targets = np.vstack((self._newest_sent[1], targets))
        self._newest_sent = times[-1:], targets[-1:]
        known = np.max(times, initial=self._sampled_until) - 0.5 * _SENT_PERIOD
        count = int((known - self._sampled_until) / _SENT_PERIOD + 1e-6)
        stamps = self._sampled_until + _SENT_PERIOD * np.arange(1, count + 1, dtype=np.float64)
        if not stamps.size:
            return stamps, np.empty((0, targets.shape[1]))
        self._sampled_until = float(stamps[-1])
        middles = stamps + 0.5 * _SENT_PERIOD
        return stamps, np.stack([np.interp(middles, times, column) for column in targets.T], axis=1)
