"""Inertias that were identified in log-Cholesky coordinates, in kg, m and kg m^2."""

from __future__ import annotations

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.estimation.core.result import BodyNumber
from amhe_cli.system.system import System

#: Draws of the posterior.
_DRAWS = 2000


def body_numbers(
    system: System, z: FloatArray, covariance: FloatArray, rng: np.random.Generator
) -> tuple[BodyNumber, ...]:
    """Mass, centre of mass and inertia of each body whose `pseudo_inertia` is a parameter.

    Their sd and intervals are those of draws of the posterior, since they are no linear function of z.

    Args:
        system: The system; its space is that of the search.
        z, covariance: The estimate (d,) and its covariance (d, d).
        rng: Source of the draws.
    """
    if not system.edits.bodies:
        return ()
    draws = rng.multivariate_normal(z, covariance, _DRAWS, method="cholesky")
    theta = np.stack([_model_values(system, one) for one in (z, np.zeros_like(z), *draws)])
    found = []
    for name, numbers in system.edits.inertias(theta):
        for label, (estimate, prior, *values) in numbers.items():
            lower, upper = np.quantile(values, (0.05, 0.95))
            unit = "kg" if label == "mass" else "m" if label.startswith("com") else "kg m^2"
            sd = float(np.std(values))
            found.append(BodyNumber(f"{name}.{label}", unit, estimate, sd, float(lower), float(upper), prior))
    return tuple(found)


def _model_values(system: System, z: FloatArray) -> FloatArray:
    """The model's free parameters at a point of the search; what is not searched is at its nominal value."""
    model = system.edits.space
    values = model.named(model.nominal) | system.space.named(system.space.theta_of(z))
    return np.array([values[name] for name in model.names])
