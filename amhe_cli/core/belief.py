"""What is believed of parameters: an estimate, and how sure it is."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from amhe_cli.core.arrays import FloatArray, sealed
from amhe_cli.core.parameters import phi_of, theta_of
from amhe_cli.core.shown import Displayed
from amhe_cli.core.statistics import Z90

if TYPE_CHECKING:
    from amhe_cli.core.described import Described


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
        systematic: The part of the covariance that comes from the model and not from the logs' noise, so that
            more logs do not narrow it, shape (d, d); None: none is known.
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
    systematic: FloatArray | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "estimate", sealed(self.estimate))
        object.__setattr__(self, "covariance", sealed(self.covariance))
        if self.systematic is not None:
            object.__setattr__(self, "systematic", sealed(self.systematic))

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
        middle = phi_of(self.log, self.estimate)
        phi = np.random.default_rng(rng).multivariate_normal(middle, self.covariance, n, method="cholesky")
        return theta_of(self.log, phi)

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
            systematic=None if self.systematic is None else self.systematic[np.ix_(rows, rows)],
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
        away = (phi_of(self.log, theta) - phi_of(self.log, self.estimate))[f]
        gain = np.linalg.solve(self.covariance[np.ix_(f, f)], self.covariance[np.ix_(f, o)]).T
        log, step, own = np.array(self.log)[o], gain @ away, self.estimate[o]
        left = np.zeros((len(o), len(self.names)))  # errors of the others, less what those known tell of them
        left[:, o], left[:, f] = np.eye(len(o)), -gain
        return replace(
            self.without(values),
            estimate=np.where(log, own * np.exp(np.where(log, step, 0.0)), own + step),
            covariance=self.covariance[np.ix_(o, o)] - gain @ self.covariance[np.ix_(f, o)],
            fixed={**self.fixed, **{self.names[i]: values[self.names[i]] for i in f}},
            systematic=None if self.systematic is None else left @ self.systematic @ left.T,
        )


def belief_of(
    system: Described,
    z: FloatArray,
    covariance: FloatArray,
    provenance: dict[str, object] | None = None,
    systematic: FloatArray | None = None,
) -> Belief:
    """Belief about a system's parameters, of an estimate z (d,) with covariance (d, d) in z.

    `systematic` is the part of the covariance that comes from the model, likewise in z.
    """
    space = system.space
    scale = np.outer(space.prior_sd, space.prior_sd)
    return Belief(
        system=system.name,
        names=space.names,
        units=tuple(p.unit for p in space.parameters),
        log=tuple(p.log for p in space.parameters),
        estimate=space.theta_of(z),
        covariance=covariance * scale,
        provenance=provenance or {},
        model=system.parts,
        sets=system.sets,
        fixed=system.fixed,
        systematic=None if systematic is None else systematic * scale,
    )


def completed(belief: Belief, system: Described) -> Belief:
    """A belief over all parameters of a system: what it does not know has its prior."""
    systematic = None if belief.systematic is None else system.space.systematic_of(belief)
    return belief_of(system, *system.space.gaussian_of(belief), dict(belief.provenance), systematic)
