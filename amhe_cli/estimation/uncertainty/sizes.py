"""Steps of z as people read them: shares of a value, or numbers with a unit."""

from __future__ import annotations

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.parameters import ParameterSpace
from amhe_cli.core.statistics import Z90


def size(space: ParameterSpace, i: int, dz: float) -> str:
    """A step in z in words: a percentage for log-scaled parameters, in the unit for linear ones."""
    p = space.parameters[i]
    if not p.log:
        return f"{dz * p.prior_sd:+.2g} {p.unit}"
    percent = 100.0 * np.expm1(dz * p.prior_sd)
    return f"{percent:+.0f}%" if abs(percent) >= 1.0 else f"{percent:+.1g}%"


def interval(space: ParameterSpace, z: FloatArray, sd: float, i: int) -> tuple[float, float]:
    """90 % interval of a parameter whose z has this sd, within its bounds."""
    p = space.parameters[i]
    ends = []
    for side in (-1.0, 1.0):
        moved = np.array(z)
        moved[i] += side * Z90 * sd
        ends.append(float(np.clip(space.theta_of(moved)[i], p.lower, p.upper)))
    return ends[0], ends[1]
