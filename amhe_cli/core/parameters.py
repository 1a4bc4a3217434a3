"""The unknowns theta, their prior, and the coordinates z they are searched in.

z = (phi(theta) - phi(nominal)) / prior_sd with phi = log for log-scaled parameters and phi = identity
for linear ones: the prior is the standard normal, and one unit of z is one prior standard deviation
of any parameter.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from amhe_cli.core.arrays import FloatArray, sealed, sealed_mask
from amhe_cli.core.shown import Displayed
from amhe_cli.core.statistics import Z90

if TYPE_CHECKING:
    from amhe_cli.core.described import Described


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
    """

    name: str
    unit: str
    nominal: float
    lower: float
    upper: float
    log: bool
    prior_sd: float
    drift: float = 0.05


def _phi(log: ArrayLike, theta: FloatArray) -> FloatArray:
    """Scaled values: log(theta) where log-scaled, else theta; shape (..., d)."""
    with np.errstate(divide="ignore"):
        return np.where(log, np.log(np.where(log, theta, 1.0)), theta)


def _theta(log: ArrayLike, phi: FloatArray) -> FloatArray:
    """The inverse of `_phi`."""
    return np.where(log, np.exp(np.where(log, phi, 0.0)), phi)


@dataclass(frozen=True)
class ParameterSpace:
    """An ordered set of parameters; arrays of theta and z have shape (..., d).

    Args:
        parameters: The parameters in column order.
        prior_correlation: Prior correlation of z, as rows; None: independent.
    """

    parameters: tuple[Parameter, ...]
    prior_correlation: tuple[tuple[float, ...], ...] | None = None

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
        return sealed_mask([p.log for p in self.parameters])

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
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper bounds in z, each (d,)."""
        lower = self.z_of(np.array([p.lower for p in self.parameters]))
        upper = self.z_of(np.array([p.upper for p in self.parameters]))
        return sealed(lower), sealed(upper)

    def phi_of(self, theta: FloatArray) -> FloatArray:
        """Scaled value: log(theta) where log-scaled, else theta."""
        return _phi(self.log, np.asarray(theta, dtype=np.float64))

    def z_of(self, theta: FloatArray) -> FloatArray:
        """Search coordinates of theta."""
        return (self.phi_of(theta) - self.phi_of(self.nominal)) / self.prior_sd

    def theta_of(self, z: FloatArray) -> FloatArray:
        """Parameters in SI units of search coordinates z."""
        return _theta(self.log, self.phi_of(self.nominal) + np.asarray(z) * self.prior_sd)

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
        rows = self.prior_correlation
        correlation = None if rows is None else tuple(tuple(rows[i][j] for j in kept) for i in kept)
        return ParameterSpace(tuple(self.parameters[i] for i in kept), correlation)

    def gaussian_of(self, belief: Belief) -> tuple[FloatArray, FloatArray]:
        """Mean z (d,) and covariance (d, d) of a belief; what it does not know has its prior."""
        known = self.with_prior(belief)
        scale = known.prior_sd / self.prior_sd
        return self.z_of(known.nominal), known.prior_covariance * np.outer(scale, scale)

    def with_prior(self, belief: Belief) -> ParameterSpace:
        """The same parameters with a belief's estimate and covariance as their prior.

        Parameters that the belief does not know keep their own prior.
        """
        known = {name: i for i, name in enumerate(belief.names)}
        sd = np.sqrt(np.diag(belief.covariance))
        shared = [(column, known[name]) for column, name in enumerate(self.names) if name in known]
        correlation = np.eye(len(self))
        for i, a in shared:
            for j, b in shared:
                if i != j and sd[a] * sd[b] > 0.0:
                    correlation[i, j] = belief.covariance[a, b] / (sd[a] * sd[b])
        return ParameterSpace(
            tuple(
                p
                if p.name not in known
                else replace(
                    p, nominal=float(belief.estimate[known[p.name]]), prior_sd=float(sd[known[p.name]])
                )
                for p in self.parameters
            ),
            tuple(tuple(float(c) for c in row) for row in correlation),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Belief(Displayed):
    """A Gaussian belief over parameters, in scaled coordinates phi.

    Args:
        system: Name of the system it is about.
        names: Parameter names, length d.
        units: Units of the parameters.
        log: Which are log-scaled: for those, phi = log(theta).
        estimate: Estimated values theta, shape (d,).
        covariance: Covariance of phi, shape (d, d).
        provenance: Origin of the belief: versions, hashes, seed, command.
        model: Hash of each part of the system's model; empty for a belief that was written without them.
        sets: What each parameter sets in the model, in words.
        fixed: Parameters that had fixed values, which the belief rests on.
    """

    system: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    log: tuple[bool, ...]
    estimate: FloatArray
    covariance: FloatArray
    provenance: dict[str, object] = field(default_factory=dict)
    model: Mapping[str, str] = field(default_factory=dict)
    sets: Mapping[str, str] = field(default_factory=dict)
    fixed: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "estimate", sealed(self.estimate))
        object.__setattr__(self, "covariance", sealed(self.covariance))

    @classmethod
    def load(
        cls, path: str | Path, system: Described | None = None, *, belief_anyway: bool = False
    ) -> Belief:
        """Read a `belief.yaml`.

        Args:
            path: The file.
            system: The system that the belief must be about; None: any.
            belief_anyway: Take a belief about another model too, and only warn of what has changed.

        Raises:
            ConfigError: The file holds no belief, or none that suits the system; one line for each mistake,
                `file:line:column: what, what would be valid`.
        """
        from amhe_cli.core.belief_file import read_belief

        return read_belief(Path(path), system, belief_anyway)

    def save(self, path: str | Path) -> None:
        """Write a `belief.yaml`, whole or not at all."""
        from amhe_cli.core.belief_file import belief_text
        from amhe_cli.core.files import write_whole

        write_whole(Path(path), belief_text(self))

    @property
    def logs(self) -> dict[str, str]:
        """Hash of each log that the belief was made of, by its path; {} where that is not known."""
        logs = self.provenance.get("logs")
        return {str(log): str(digest) for log, digest in logs.items()} if isinstance(logs, dict) else {}

    @property
    def sd(self) -> FloatArray:
        """Standard deviation of each parameter in its own unit, shape (d,)."""
        return np.sqrt(np.diag(self.covariance)) * np.where(self.log, self.estimate, 1.0)

    @property
    def interval(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper end of each parameter's central 90 % interval, shape (d,) each."""
        far = Z90 * np.sqrt(np.diag(self.covariance))
        factor, away = np.exp(np.where(self.log, far, 0.0)), np.where(self.log, 0.0, far)
        return self.estimate / factor - away, self.estimate * factor + away

    def sample(self, n: int, rng: np.random.Generator | int = 0) -> FloatArray:
        """Draw parameters from the belief.

        Args:
            n: Number of draws.
            rng: Generator, or a seed for one.

        Returns:
            Parameters in their units, shape (n, d), columns in the order of `names`. Bounds of the search
            do not limit them.
        """
        middle = _phi(self.log, self.estimate)
        phi = np.random.default_rng(rng).multivariate_normal(middle, self.covariance, n, method="cholesky")
        return _theta(self.log, phi)

    def about(self, names: Iterable[str]) -> Belief:
        """The belief about those of these parameters that it knows, in their order."""
        rows = [self.names.index(name) for name in names if name in self.names]
        return replace(
            self,
            names=tuple(self.names[i] for i in rows),
            units=tuple(self.units[i] for i in rows),
            log=tuple(self.log[i] for i in rows),
            estimate=self.estimate[rows],
            covariance=self.covariance[np.ix_(rows, rows)],
        )

    def without(self, names: Collection[str]) -> Belief:
        """The belief about the other parameters, whatever the values of these."""
        return self.about(name for name in self.names if name not in names)

    def given(self, values: Mapping[str, float]) -> Belief:
        """The belief about the other parameters where these have known values.

        The conditional of a Gaussian: mean m + C_of C_ff^-1 (phi - m_f), covariance C_oo - C_of C_ff^-1 C_fo.
        """
        f = [i for i, name in enumerate(self.names) if name in values]
        o = [i for i, name in enumerate(self.names) if name not in values]
        if not f:
            return self
        theta = np.array([values.get(n, own) for n, own in zip(self.names, self.estimate, strict=True)])
        away = (_phi(self.log, theta) - _phi(self.log, self.estimate))[f]
        gain = np.linalg.solve(self.covariance[np.ix_(f, f)], self.covariance[np.ix_(f, o)]).T
        log, step, own = np.array(self.log)[o], gain @ away, self.estimate[o]
        return replace(
            self.without(values),
            estimate=np.where(log, own * np.exp(np.where(log, step, 0.0)), own + step),
            covariance=self.covariance[np.ix_(o, o)] - gain @ self.covariance[np.ix_(f, o)],
            fixed={**self.fixed, **{self.names[i]: values[self.names[i]] for i in f}},
        )


def belief_of(
    system: Described, z: FloatArray, covariance: FloatArray, provenance: dict[str, object] | None = None
) -> Belief:
    """Belief about a system's parameters, of an estimate z (d,) with covariance (d, d) in z."""
    space = system.space
    return Belief(
        system=system.name,
        names=space.names,
        units=tuple(p.unit for p in space.parameters),
        log=tuple(p.log for p in space.parameters),
        estimate=space.theta_of(z),
        covariance=covariance * np.outer(space.prior_sd, space.prior_sd),
        provenance=provenance or {},
        model=system.parts,
        sets=system.sets,
        fixed=system.fixed,
    )


def completed(belief: Belief, system: Described) -> Belief:
    """A belief over all parameters of a system: what it does not know has its prior."""
    return belief_of(system, *system.space.gaussian_of(belief), dict(belief.provenance))
