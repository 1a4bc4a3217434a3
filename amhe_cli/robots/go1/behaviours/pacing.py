"""How much more speed to ask for: soft feet, slip and gears make a robot slower than its model says.

The planner never learns of it, so what is missing on average is integrated, as offset-free MPC does with the
disturbances that its model lacks (Maeder, Borrelli and Morari 2009).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

#: After a pause, no more than this is made up for [s].
_LONGEST = 0.05


@dataclass(slots=True, eq=False)
class Pacing:
    """Remembers which share of the speed is missing.

    Args:
        gain: Share added, per missing share and second [1/s]: slower than any stride.
        free: Share that may be missing, for the mean of a pulsing speed wanders by that; once asked for too
            much, nothing is free.
        smoothing: The speed is averaged over this time [s].
        limit: Greatest share.
        share: To be asked for beside what is wanted.
    """

    gain: float = 0.6
    free: float = 0.1
    smoothing: float = 0.5
    limit: float = 0.4
    share: float = 0.0
    _missing: float = 0.0
    _time: float | None = None

    def update(self, time: float, missing: float) -> None:
        """Take in one cycle of pushing.

        Args:
            time: Now [s].
            missing: Share of the commanded speed that is not there.
        """
        passed = 0.0 if self._time is None else min(max(time - self._time, 0.0), _LONGEST)
        self._time = time
        self._missing += (missing - self._missing) * passed / self.smoothing
        unasked = self._missing * self.share >= 0.0
        beyond = self._missing - unasked * float(np.clip(self._missing, -self.free, self.free))
        self.share = float(np.clip(self.share + self.gain * passed * beyond, -self.limit, self.limit))
