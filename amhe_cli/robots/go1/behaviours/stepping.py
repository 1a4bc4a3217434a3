"""Where feet land: a robot that drifts aside steps to that side, or it topples over its diagonal.

Two feet of a trot do not balance; the trunk falls about their line until the next two land. They stop it
where they land at the capture point, sqrt(h / g) times the velocity beside the trunk (Pratt et al. 2006;
Raibert 1986 for the rule). The planner's horizon is shorter than a stride: it cannot find this out itself.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from amhe_cli.core.arrays import BoolArray, FloatArray


@dataclass(slots=True, eq=False)
class Stepping:
    """Remembers how far beside neutral each foot stands.

    Args:
        gain: Distance per speed [s]; sqrt(h / g) is 0.17.
        limit: Greatest distance [m].
        settling: A flying foot turns to a new place in this time [s]: velocities are noisy.
    """

    gain: float = 0.12
    limit: float = 0.1
    settling: float = 0.05
    _left: FloatArray = field(default_factory=lambda: np.zeros(4))
    _time: float | None = None

    def update(self, time: float, drift: float, standing: BoolArray) -> FloatArray:
        """Places of the feet left of neutral [m], shape (4,); those that stand stay.

        Args:
            time: Now [s].
            drift: Speed of the trunk to the left, more than commanded [m/s].
            standing: Feet on the floor, shape (4,).
        """
        passed, self._time = 0.0 if self._time is None else time - self._time, time
        wanted = np.clip(self.gain * drift, -self.limit, self.limit)
        share = min(1.0, max(0.0, passed) / self.settling)
        self._left = np.where(standing, self._left, self._left + share * (wanted - self._left))
        return self._left
