"""What held parameters that somebody measured leave open in the estimates: considered, not estimated.

Schmidt's filter (1966): a number c ~ N(0, 1) that the model has wrong by c of its sd moves each window's own
estimate by T c, and the recursion passes on the error s c of the estimate. With K = I - gain M of an update

    s  <-  K s + (I - K) T,        T = -(M + I)^-1 G' W dr/dc

The same c acts in all windows, so that s s' does not average out.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.engine.rollout import Engine
from amhe_cli.estimation.online.updates import WindowFit
from amhe_cli.matching.cost import MatchingCost
from amhe_cli.system.system import System

#: Every so many updates the effect on a window is computed anew: it takes a rollout for each number.
_EVERY = 10


@dataclass(slots=True, eq=False)
class Considered:
    """Errors of an online estimate by held parameters; changes in place.

    Args:
        system: The system, with its held parameters.
        engine: Engine of the rollouts.
    """

    system: System
    engine: Engine
    _variants: list[tuple[System, Engine]] | None = None
    _own: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    _error: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    _updates: int = 0

    @property
    def covariance(self) -> FloatArray | float:
        """What the held parameters add to the covariance of z, shape (d, d); 0 where nobody measured any."""
        return self._error @ self._error.T if self._error.size else 0.0

    def after(self, cost: MatchingCost, z: FloatArray, fit: WindowFit, kept: FloatArray) -> None:
        """Take in an update.

        Args:
            cost: Matching cost of its window.
            z: Where the window was linearised, shape (d,).
            fit: The window, linearised.
            kept: How much of an error before the update is left after it, shape (d, d).
        """
        if self._variants is None:
            self._variants = [_moved(self.system, self.engine, *one) for one in _measured(self.system)]
            self._error = np.zeros((z.size, len(self._variants)))
        if not self._variants:
            return
        if self._updates % _EVERY == 0:
            self._own = self._of_window(cost, z, fit)
        self._updates += 1
        self._error = kept @ self._error + (np.eye(z.size) - kept) @ self._own

    def _of_window(self, cost: MatchingCost, z: FloatArray, fit: WindowFit) -> FloatArray:
        """T, how far each number moves the window's own estimate, shape (d, k)."""
        found, before = fit.information, cost.residuals(z[None])
        assert self._variants is not None and found is not None
        moves = np.zeros((z.size, len(self._variants)))
        for column, (system, engine) in enumerate(self._variants):
            after = cost.upon(engine, system).residuals(z[None])
            if before.completed.all() and after.completed.all():
                change = (after.flat - before.flat)[0, 0]
                pull = fit.slope @ (found.weight[0] * change)
                moves[:, column] = -np.linalg.solve(found.matrix[0] + np.eye(z.size), pull)
        return moves


def _measured(system: System) -> list[tuple[str, float]]:
    """Names of the held parameters that somebody measured, each with its value moved by an sd."""
    return [(p.name, held.value + held.sd) for p, held, _, _ in system.edits.considered()]


def _moved(system: System, engine: Engine, name: str, value: float) -> tuple[System, Engine]:
    other = system.fixing({name: value})
    return other, engine.upon(other.model, other.edits)
