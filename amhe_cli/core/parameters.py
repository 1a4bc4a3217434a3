"""The unknowns theta, their prior, and the coordinates z they are searched in.

z = (phi(theta) - phi(nominal)) / prior_sd with phi = log for log-scaled parameters and phi = identity
for linear ones: the prior is the standard normal, and one unit of z is one prior standard deviation
of any parameter.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from amhe_cli.core.arrays import FloatArray, sealed

Rows = tuple[tuple[float, ...], ...]
#: Factor on the systematic variance that is added to a prior where that must not count.
LOOSE = 100.0


@dataclass(frozen=True, slots=True)
class Parameter:
    """One unknown number.

    Args:
        name: Name, as the user wrote it.
        unit: SI unit, '-' for none.
        nominal: Prior mean (median, on the log scale); strictly within the bounds.
        lower, upper: Hard bounds of the value.
        log: Whether it is searched on the logarithmic scale.
        prior_sd: Prior standard deviation of log(theta) if `log`, else of theta.
        drift: How much it may change while the system works, per square root of a second: a share of its
            value if `log`, else of its prior sd. Only the online estimator allows for it.
        owner: Whose value it is, where logs have values of their own; '': it is that of all logs. The name of
            an owner's value is made by `owned_by`.
    """

    name: str
    unit: str
    nominal: float
    lower: float
    upper: float
    log: bool
    prior_sd: float
    drift: float = 0.05
    owner: str = ""

    def owned_by(self, owner: str) -> Parameter:
        """An owner's value of this parameter, such as friction[run1], with the same prior."""
        return replace(self, name=f"{self.name}[{owner}]", owner=owner)

    @property
    def of_model(self) -> str:
        """Name of the model's parameter that it is a value of."""
        return self.name.removesuffix(f"[{self.owner}]") if self.owner else self.name


def phi_of(log: ArrayLike, theta: FloatArray) -> FloatArray:
    """Scaled values: log(theta) where log-scaled, else theta; shape (..., d)."""
    with np.errstate(divide="ignore"):
        return np.where(log, np.log(np.where(log, theta, 1.0)), theta)


def theta_of(log: ArrayLike, phi: FloatArray) -> FloatArray:
    """The inverse of `phi_of`."""
    return np.where(log, np.exp(np.where(log, phi, 0.0)), phi)


def rows_of(matrix: FloatArray) -> Rows:
    """A matrix as rows, which can be compared and hashed."""
    return tuple(tuple(map(float, row)) for row in matrix)


@dataclass(frozen=True)
class ParameterSpace:
    """An ordered set of parameters; arrays of theta and z have shape (..., d).

    Args:
        parameters: The parameters in column order.
        prior_correlation: Prior correlation of z, as rows; None: independent.
        prior_systematic: Part of the prior covariance of z that comes from the model, as that of a belief
            does, as rows; None: none is known.
        prior_owed: Of this part, the errors of z of known causes: each cause, and its error of one sd.
    """

    parameters: tuple[Parameter, ...]
    prior_correlation: Rows | None = None
    prior_systematic: Rows | None = None
    prior_owed: tuple[tuple[str, tuple[float, ...]], ...] = ()

    def __len__(self) -> int:
        return len(self.parameters)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names, in column order."""
        return tuple(p.name for p in self.parameters)

    @cached_property
    def nominal(self) -> FloatArray:
        """Prior mean theta0, shape (d,)."""
        return sealed([p.nominal for p in self.parameters])

    @cached_property
    def log(self) -> np.ndarray:
        """Which columns are log-scaled, shape (d,)."""
        return sealed([p.log for p in self.parameters], np.bool_)

    @cached_property
    def prior_sd(self) -> FloatArray:
        """Prior sd of phi, shape (d,)."""
        return sealed([p.prior_sd for p in self.parameters])

    @cached_property
    def drift(self) -> FloatArray:
        """Sd of z that drift brings in a second, shape (d,)."""
        return sealed(self.in_z([p.drift for p in self.parameters]))

    @cached_property
    def prior_covariance(self) -> FloatArray:
        """Prior covariance of z, shape (d, d): ones on the diagonal."""
        return sealed(np.eye(len(self)) if self.prior_correlation is None else self.prior_correlation)

    @cached_property
    def prior_precision(self) -> FloatArray:
        """Inverse of `prior_covariance`: the prior's information on z, shape (d, d)."""
        return sealed(np.linalg.inv(self.prior_covariance))

    @cached_property
    def loose_precision(self) -> FloatArray:
        """The prior's information on z with its systematic part counted as almost unknown, shape (d, d).

        The mass of a belief may rest on a gain; it must not make that gain look known.
        """
        if self.prior_systematic is None:
            return self.prior_precision
        return sealed(np.linalg.inv(self.prior_covariance + LOOSE * np.array(self.prior_systematic)))

    @cached_property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper bounds in z, each (d,)."""
        lower = self.z_of(np.array([p.lower for p in self.parameters]))
        upper = self.z_of(np.array([p.upper for p in self.parameters]))
        return sealed(lower), sealed(upper)

    def phi_of(self, theta: FloatArray) -> FloatArray:
        """Scaled value: log(theta) where log-scaled, else theta."""
        return phi_of(self.log, np.asarray(theta, dtype=np.float64))

    def z_of(self, theta: FloatArray) -> FloatArray:
        """Search coordinates of theta."""
        return (self.phi_of(theta) - self.phi_of(self.nominal)) / self.prior_sd

    def theta_of(self, z: FloatArray) -> FloatArray:
        """Parameters in SI units of search coordinates z."""
        return theta_of(self.log, self.phi_of(self.nominal) + np.asarray(z) * self.prior_sd)

    def in_z(self, share: ArrayLike) -> FloatArray:
        """A share of each parameter's value, or of a linear one's prior sd, in z, shape (d,)."""
        return np.where(self.log, np.asarray(share) / self.prior_sd, share)

    def named(self, theta: FloatArray) -> dict[str, float]:
        """Parameters theta (d,) by name."""
        return dict(zip(self.names, map(float, theta), strict=True))

    def clip(self, z: FloatArray) -> FloatArray:
        """The nearest z within the bounds."""
        return np.clip(z, *self.bounds)

    def without(self, names: Collection[str]) -> ParameterSpace:
        """The space without some parameters; the others keep their prior."""
        kept = [i for i, name in enumerate(self.names) if name not in names]
        if len(kept) == len(self):
            return self
        matrices = (self.prior_correlation, self.prior_systematic)
        rows = (
            None if matrix is None else rows_of(np.array(matrix)[np.ix_(kept, kept)]) for matrix in matrices
        )
        owed = tuple((cause, tuple(error[i] for i in kept)) for cause, error in self.prior_owed)
        return ParameterSpace(tuple(self.parameters[i] for i in kept), *rows, prior_owed=owed)


class Described(Protocol):
    """What a belief can be about: a system."""

    @property
    def name(self) -> str:
        """Name of the system."""
        ...

    @property
    def space(self) -> ParameterSpace:
        """Parameters of the system that are free."""
        ...

    @property
    def fixed(self) -> Mapping[str, float]:
        """Values of the parameters that are fixed, by name."""
        ...

    @property
    def parts(self) -> Mapping[str, str]:
        """Hash of each part of the model."""
        ...

    @property
    def sets(self) -> Mapping[str, str]:
        """What each parameter, free or fixed, sets in the model, in words."""
        ...
