"""What is believed of parameters: an estimate, and how sure it is; in memory, and in a file `belief.yaml`.

The covariance is that of phi: log(value) for parameters of scale log, the value itself for linear ones.
"""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat

from amhe_cli.core.arrays import FloatArray, sealed
from amhe_cli.core.errors import ConfigError, one_of
from amhe_cli.core.files import write_whole
from amhe_cli.core.mistakes import validated
from amhe_cli.core.parameters import Described, ParameterSpace, phi_of, rows_of, theta_of
from amhe_cli.core.shown import Displayed
from amhe_cli.core.statistics import Z90
from amhe_cli.core.yaml_file import Place, YamlFile, dumped

logger = logging.getLogger(__name__)


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
        owed: Of this part, the errors of known causes, such as a number that the model takes for granted:
            each cause, and the error of phi that one sd of it makes, shape (d,). Other logs have the same.
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
    owed: Mapping[str, FloatArray] = field(default_factory=dict)

    def __repr__(self) -> str:
        values = zip(self.names, self.estimate, self.sd, self.units, strict=True)
        told = [
            f"{name} {value:.4g} ± {sd:.2g} {unit}".removesuffix(" -") for name, value, sd, unit in values
        ]
        return f"Belief({self.system!r}: {', '.join(told)})"

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
        return _read(Path(path), system, belief_anyway)

    def save(self, path: str | Path) -> None:
        """Write a `belief.yaml`, whole or not at all."""
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

    def sample(self, n: int, rng: np.random.Generator | int | None = None) -> FloatArray:
        """Draw parameters from the belief.

        Args:
            n: Number of draws.
            rng: Generator, or a seed for one; None: other draws each time.

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
            owed={cause: error[rows] for cause, error in self.owed.items()},
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
            owed={cause: left @ error for cause, error in self.owed.items()},
        )


def belief_of(
    system: Described,
    z: FloatArray,
    covariance: FloatArray,
    provenance: dict[str, object] | None = None,
    systematic: FloatArray | None = None,
    owed: Mapping[str, FloatArray] | None = None,
) -> Belief:
    """Belief about a system's parameters, of an estimate z (d,) with covariance (d, d) in z.

    `systematic` is the part of the covariance that comes from the model, and `owed` its errors of known
    causes, likewise in z.
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
        owed={cause: error * space.prior_sd for cause, error in (owed or {}).items()},
    )


def with_prior(space: ParameterSpace, belief: Belief) -> ParameterSpace:
    """The same parameters with a belief's estimate and covariance as their prior.

    Parameters that the belief does not know keep their own prior.
    """
    known, own = {name: i for i, name in enumerate(belief.names)}, _own(space, belief)
    sd = np.sqrt(np.diag(belief.covariance))
    scale = np.outer(sd, sd)
    correlation = own @ (belief.covariance / np.where(scale > 0.0, scale, 1.0)) @ own.T
    np.fill_diagonal(correlation, 1.0)
    parameters = tuple(
        replace(p, nominal=float(belief.estimate[known[p.name]]), prior_sd=float(sd[known[p.name]]))
        if p.name in known
        else p
        for p in space.parameters
    )
    found = ParameterSpace(parameters, rows_of(correlation))
    if belief.systematic is None:
        return found
    owed = tuple((cause, tuple(error.tolist())) for cause, error in _owed_of(found, belief).items())
    return replace(found, prior_systematic=rows_of(systematic_of(found, belief)), prior_owed=owed)


def gaussian_of(space: ParameterSpace, belief: Belief) -> tuple[FloatArray, FloatArray]:
    """Mean z (d,) and covariance (d, d) of a belief; what it does not know has its prior."""
    known = with_prior(space, belief)
    scale = known.prior_sd / space.prior_sd
    return space.z_of(known.nominal), known.prior_covariance * np.outer(scale, scale)


def systematic_of(space: ParameterSpace, belief: Belief) -> FloatArray:
    """The systematic part of a belief's covariance in z, shape (d, d); 0 of what it does not know."""
    if belief.systematic is None:
        return np.zeros((len(space), len(space)))
    place = _own(space, belief) / space.prior_sd[:, None]
    return place @ belief.systematic @ place.T


def _owed_of(space: ParameterSpace, belief: Belief) -> dict[str, FloatArray]:
    """The errors of known causes in a belief, in z, shape (d,); 0 of what it does not know."""
    own = _own(space, belief)
    return {cause: own @ error / space.prior_sd for cause, error in belief.owed.items()}


def _own(space: ParameterSpace, belief: Belief) -> FloatArray:
    """1 where a parameter is one of a belief's, else 0, shape (d, b)."""
    return np.array([[name == other for other in belief.names] for name in space.names], dtype=np.float64)


def held_by(belief: Belief) -> dict[str, dict[str, float]]:
    """Settings of a system whose parameters are held at a belief's values, and how well these are known.

    What was fixed when the belief was made is held there, too.
    """
    numbers = zip(belief.names, belief.estimate.tolist(), belief.sd.tolist(), strict=True)
    found = {name: {"held": value, "held_sd": sd} for name, value, sd in numbers}
    return found | {name: {"held": value} for name, value in belief.fixed.items()}


def completed(belief: Belief, system: Described) -> Belief:
    """A belief over all parameters of a system: what it does not know has its prior."""
    space, whole = system.space, belief.systematic is not None
    systematic = systematic_of(space, belief) if whole else None
    gaussian = gaussian_of(space, belief)
    return belief_of(system, *gaussian, dict(belief.provenance), systematic, _owed_of(space, belief))


#: Version of the layout of belief files.
SCHEMA_VERSION = 1
#: An estimate may end on a bound, and rounding may leave it beyond by this share of the range.
_ROUNDING = 1e-9
#: Share of its variances by which rounding may leave a part of a covariance outside of it.
_PART = 1e-6

#: Comment at the top of belief files.
_HEADER = """\
# What is believed of the parameters of a system: an estimate, and how sure it is.
# `covariance` is of log(estimate) where scale is log, of the estimate where it is linear;
# `sd`, `lower` and `upper` (90 %) follow from it and are for people: reading ignores them.
# `systematic` is the part of `covariance` that comes from the model, which more logs do not narrow;
# `owed` has what of it one sd of each known cause makes.
# `model` has a hash of each part of the model, and `sets` says what a parameter sets in it: where they
# differ, the belief is refused. `fixed` are parameters that were taken as known.
"""


class _Entry(BaseModel):
    model_config = ConfigDict(extra="forbid")
    name: str
    unit: str = "-"
    scale: Literal["log", "linear"]
    sets: str | None = None
    estimate: FiniteFloat
    sd: float | None = None
    lower: float | None = None
    upper: float | None = None


class _File(BaseModel):
    model_config = ConfigDict(extra="forbid")
    schema_version: Literal[1]
    system: str
    model: dict[str, str] = {}
    parameters: Annotated[list[_Entry], Field(min_length=1)]
    covariance: list[list[FiniteFloat]]
    systematic: list[list[FiniteFloat]] | None = None
    owed: dict[str, list[FiniteFloat]] = {}
    fixed: dict[str, FiniteFloat] = {}
    provenance: dict[str, Any] = {}


def belief_text(belief: Belief) -> str:
    """The content of a belief file."""
    document = {
        "schema_version": SCHEMA_VERSION,
        "system": belief.system,
        "model": dict(belief.model),
        "parameters": [_entry(belief, i) for i in range(len(belief.names))],
        "covariance": belief.covariance.tolist(),
        **({} if belief.systematic is None else {"systematic": belief.systematic.tolist()}),
        **({"owed": {cause: error.tolist() for cause, error in belief.owed.items()}} if belief.owed else {}),
        "fixed": dict(belief.fixed),
        "provenance": belief.provenance,
    }
    return _HEADER + dumped(document)


def _entry(belief: Belief, i: int) -> dict[str, object]:
    lower, upper = belief.interval
    return {
        "name": belief.names[i],
        "unit": belief.units[i],
        "scale": "log" if belief.log[i] else "linear",
        "sets": belief.sets.get(belief.names[i]),
        "estimate": float(belief.estimate[i]),
        "sd": float(belief.sd[i]),
        "lower": float(lower[i]),
        "upper": float(upper[i]),
    }


def _read(path: Path, system: Described | None, belief_anyway: bool) -> Belief:
    """See `Belief.load`."""
    file = YamlFile(path)
    if "command" in file.own:
        raise ConfigError(f"{path}: a result, no belief; give the belief.yaml that `amhe identify` writes")
    content = validated(file, _File)
    names = [entry.name for entry in content.parameters]
    for i, name in enumerate(names):
        if names.count(name) > 1:
            file.problem(("parameters", i, "name"), f"parameter {name!r} is here twice")
    mistake = _covariance_mistake(content.covariance, len(names))
    if mistake:
        file.problem(("covariance",), mistake)
    elif content.systematic is not None and not _is_part(
        content.systematic, content.covariance, content.covariance
    ):
        file.problem(("systematic",), "systematic must be symmetric, positive and no more than covariance")
    elif not _are_parts(list(content.owed.values()), content.systematic or [], content.covariance):
        file.problem(("owed",), f"owed must have errors of {len(names)} numbers, a part of systematic")
    for i, entry in enumerate(content.parameters if not mistake else ()):
        sd = content.covariance[i][i] ** 0.5
        # the largest sd that means anything: of a logarithm, or beside the estimate
        most = 50.0 if entry.scale == "log" else 1e9 * max(1.0, abs(entry.estimate))
        if sd > most:
            what = f"log({entry.name})" if entry.scale == "log" else entry.name
            text = f"{what} has an sd of {sd:.3g}; at most {most:.3g} would be valid"
            file.problem(("covariance", i, i), text)
    file.raise_problems()
    belief = Belief(
        system=content.system,
        names=tuple(names),
        units=tuple(entry.unit for entry in content.parameters),
        log=tuple(entry.scale == "log" for entry in content.parameters),
        estimate=np.array([entry.estimate for entry in content.parameters]),
        covariance=np.array(content.covariance),
        provenance=content.provenance,
        model=content.model,
        sets={entry.name: entry.sets for entry in content.parameters if entry.sets},
        fixed=content.fixed,
        systematic=None if content.systematic is None else np.array(content.systematic),
        owed={cause: np.array(error) for cause, error in content.owed.items()},
    )
    if system is None:
        return belief
    for place, text in _problems(belief, system, belief_anyway):
        file.problem(place, text)
    file.raise_problems()
    return _suited(belief, system)


def belief_for(system: Described, given: Belief | str | Path, belief_anyway: bool = False) -> Belief:
    """A belief that a system can start from: one in memory, or that of a file.

    Args:
        given: The belief, or the path of its file.
        belief_anyway: Take a belief about another model too, and only warn of what has changed.

    Returns:
        The belief about the system's free parameters, given the values of those that are fixed.

    Raises:
        ConfigError: The belief does not suit the system.
    """
    if not isinstance(given, Belief):
        return _read(Path(given), system, belief_anyway)
    for _, text in _problems(given, system, belief_anyway):
        raise ConfigError(text)
    return _suited(given, system)


def _problems(belief: Belief, system: Described, belief_anyway: bool) -> Iterator[tuple[Place, str]]:
    """Why a belief cannot be a prior of a system, each with the place in its file."""
    for place, text in _changes(belief, system):
        if belief_anyway:
            logger.warning(f"{text}; it is used anyway")
        else:
            yield place, f"{text}; `belief_anyway=True` accepts it"
    space = {p.name: p for p in system.space.parameters}
    for i, (name, log, value) in enumerate(zip(belief.names, belief.log, belief.estimate, strict=True)):
        p = space.get(name)
        if p is None:
            continue
        if log != p.log:
            yield ("parameters", i, "scale"), f"the scale of {name} is {'log' if p.log else 'linear'}"
        elif not -_ROUNDING <= (value - p.lower) / (p.upper - p.lower) <= 1.0 + _ROUNDING:
            between = f"between {p.lower:g} and {p.upper:g} would be valid"
            yield ("parameters", i, "estimate"), f"{name} is {value:g}; {between}"


def _changes(belief: Belief, system: Described) -> Iterator[tuple[Place, str]]:
    """What of the system is not as it was when the belief was made."""
    changed = [part for part, value in belief.model.items() if system.parts.get(part, value) != value]
    if changed:
        yield ("model",), f"this belief is about another model: its {', '.join(changed)} differ"
    elif not belief.model and belief.system != system.name:
        yield ("system",), f"this belief is about {belief.system!r}, not about {system.name!r}"
    for i, name in enumerate(belief.names):
        now, then = system.sets.get(name), belief.sets.get(name)
        if now is None:
            yield ("parameters", i, "name"), one_of("parameter", name, system.sets)
        elif then not in (None, now):
            yield ("parameters", i, "sets"), f"{name} set {then} when this belief was made; now it sets {now}"


def _suited(belief: Belief, system: Described) -> Belief:
    """The belief about the parameters of a system that are free, given those that are fixed."""
    for name, value in belief.fixed.items():
        if name in system.sets and system.fixed.get(name) != value:
            now = f"fixed at {system.fixed[name]:g}" if name in system.fixed else "not fixed"
            logger.warning(f"this belief rests on {name} fixed at {value:g}; here it is {now} (`fix`)")
    suited = belief.without([name for name in belief.names if name not in system.sets]).given(system.fixed)
    return replace(suited, system=system.name, model=system.parts, sets=system.sets, fixed=system.fixed)


def _covariance_mistake(rows: list[list[float]], size: int) -> str | None:
    if len(rows) != size or any(len(row) != size for row in rows):
        return f"covariance must be {size} x {size}: a row and a column for each parameter"
    covariance = np.array(rows)
    if not np.allclose(covariance, covariance.T) or np.linalg.eigvalsh(covariance).min() <= 0.0:
        return "covariance must be symmetric and positive definite"
    return None


def _are_parts(
    errors: list[list[float]], systematic: list[list[float]], covariance: list[list[float]]
) -> bool:
    """Whether errors, each of one cause, are together a part of what is systematic in a covariance."""
    if (errors and not systematic) or any(len(error) != len(systematic) for error in errors):
        return False
    return not errors or _is_part((np.array(errors).T @ np.array(errors)).tolist(), systematic, covariance)


def _is_part(rows: list[list[float]], whole: list[list[float]], covariance: list[list[float]]) -> bool:
    """Whether the first is a part of the second, but for rounding in units of the sds of a covariance."""
    if len(rows) != len(covariance) or any(len(row) != len(rows) for row in rows):
        return False
    sd = np.sqrt(np.diagonal(covariance))
    with np.errstate(over="ignore"):  # what is infinite is no part
        part, rest = (np.array(matrix) / sd / sd[:, None] for matrix in (rows, np.subtract(whole, rows)))
    if not np.allclose(part, part.T) or (np.abs(part) > 1.0 + _PART).any():
        return False
    return min(np.linalg.eigvalsh(matrix).min() for matrix in (part, rest)) > -_PART
