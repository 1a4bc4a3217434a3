"""The ledger: every doubt about an estimate is a covariance with a name, and their sum is the posterior's.

A term holds errors e_k of the estimate, one standard deviation long each, and independent of each other:

    Cov(z) = sum over terms, k of  e_k e_k'

Nothing else widens an interval. Verdicts, reasons, the budget and what `amhe pool` carries over from run to
run are all read from the terms. To add a source of doubt, name its kind in `KINDS` and `Kind`, write a
function that returns a `Term`, and add it to the list in `conclude._ledger`.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.parameters import ParameterSpace
from amhe_cli.core.statistics import Z90, root

#: Kinds of terms, in the order of the budget, and what each means to the user.
KINDS: Mapping[str, str] = {
    "noise": "noise of the logs, and scatter between their clips",
    "prior": "your priors",
    "repeats": "residuals that repeat, as errors of the model do",
    "parts": "parts of the logs that contradict each other",
    "assumed": "numbers of the model that are no parameters",
    "curvature": "a response that bends, or jitters, within the interval",
    "search": "a search that had not settled",
    "minimum": "a second minimum",
    "spread": "values that differ from log to log",
    "declared": "identify.model_error",
}

#: Share of a variance below which a budget leaves a term out.
LEAST = 0.005

Kind = Literal[
    "noise", "prior", "repeats", "parts", "assumed", "curvature", "search", "minimum", "spread", "declared"
]


@dataclass(frozen=True, slots=True)
class Source:
    """Where one error of a term comes from.

    Args:
        name: What it is, such as 'the gain of servo'.
        value: The value that is taken for it, with its unit, such as '4'; '' for none.
        amount, unit: Its standard deviation, such as 10 and '%'; 0 where it has none of its own.
        acts: Share of the steps in which it acts; None for what always does.
        parameter: The parameter whose prior it is; '' for none.
        doubted: The logs speak against it: it is no assumption that they leave open.
        apart: Of parts of the data, what separates their estimates, in z.
        of_load: It is of a body that is weighed, and another body has another error.
    """

    name: str
    value: str = ""
    amount: float = 0.0
    unit: str = ""
    acts: float | None = None
    parameter: str = ""
    doubted: bool = False
    apart: tuple[float, ...] = ()
    of_load: bool = False

    def __str__(self) -> str:
        return f"{self.name} ({self.value})" if self.value else self.name

    def times(self, factor: float = 1.0, sign: str = "") -> str:
        """A multiple of its standard deviation in words, such as '10 %'; '' where it has none."""
        return f"{factor * self.amount:{sign}.3g} {self.unit}".strip() if self.amount else ""


@dataclass(frozen=True, slots=True, eq=False)
class Term:
    """One kind of doubt.

    Args:
        kind: A key of `KINDS`.
        errors: Errors of the estimate in z, one sd long each, shape (d, k); independent of each other.
        sources: Where each error comes from; empty where they have no names of their own.
        shared: Whether another log would have the same error, so that more logs do not narrow it.
    """

    kind: Kind
    errors: FloatArray
    sources: tuple[Source, ...] = ()
    shared: bool = False

    @property
    def covariance(self) -> FloatArray:
        """Sum of e e', shape (d, d)."""
        return self.errors @ self.errors.T

    def of(self, i: int) -> list[tuple[float, Source]]:
        """Variance of one parameter by named source, the largest first."""
        variances = (self.errors[i] ** 2).tolist()
        return sorted(zip(variances, self.sources, strict=False), key=lambda pair: -pair[0])


def term_of(kind: Kind, covariance: FloatArray, *, shared: bool = False) -> Term:
    """A term of a covariance (d, d); what rounding made negative of it counts as zero."""
    return Term(kind, root(covariance), shared=shared)


@dataclass(frozen=True, eq=False)
class Ledger:
    """All terms of an estimate."""

    terms: tuple[Term, ...]

    @cached_property
    def covariance(self) -> FloatArray:
        """Posterior covariance of z: the sum of all terms, shape (d, d)."""
        return np.sum([term.covariance for term in self.terms], axis=0)

    @cached_property
    def shared(self) -> FloatArray:
        """The part that other logs would have as well, shape (d, d)."""
        zero = np.zeros_like(self.covariance)
        return np.sum([zero, *(term.covariance for term in self.terms if term.shared)], axis=0)

    @property
    def owed(self) -> dict[str, FloatArray]:
        """The errors of this part whose cause has a name, by it, shape (d,)."""
        shared = (zip(term.sources, term.errors.T, strict=False) for term in self.terms if term.shared)
        return {source.name: error for pairs in shared for source, error in pairs}

    @cached_property
    def sd(self) -> FloatArray:
        """Posterior sd of each z, in prior sd, shape (d,)."""
        return np.sqrt(self.covariance.diagonal())

    def mapped(self, slopes: FloatArray) -> Ledger:
        """The ledger of k numbers that are linear in the d of this one, by their slopes, shape (k, d)."""
        return Ledger(tuple(replace(term, errors=slopes @ term.errors) for term in self.terms))

    def variance(self, i: int, kinds: Sequence[str]) -> float:
        """Variance of one parameter that is due to some kinds of terms."""
        return float(sum((term.errors[i] ** 2).sum() for term in self.terms if term.kind in kinds))

    def budget(self, i: int) -> dict[str, float]:
        """Share of one parameter's variance by kind of term; kinds without any are left out."""
        total = float(self.covariance[i, i]) or 1.0  # of what is fixed nothing
        shares = {kind: self.variance(i, (kind,)) / total for kind in KINDS}
        return {kind: share for kind, share in shares.items() if share > 0.0}

    def given(
        self, i: int, own: Collection[str] = (), *, doubted: bool = False
    ) -> list[tuple[float, Source]]:
        """Variance of one parameter that is due to numbers somebody else gave, the largest first.

        These are the numbers of the model that are no parameters, and the priors of the other parameters.

        Args:
            i: The parameter.
            own: Names of parameters whose priors are its own, and no such numbers.
            doubted: Those that the logs speak against, in place of those that they leave open.
        """
        pairs = [pair for term in self.terms if term.kind == "assumed" for pair in term.of(i)]
        pairs += [
            (variance, source)
            for term in self.terms
            if term.kind == "prior"
            for variance, source in term.of(i)
            if source.parameter and source.parameter not in own
        ]
        some = ((v, s) for v, s in pairs if v > 0.0 and s.doubted == doubted)
        return sorted(some, key=lambda pair: -pair[0])


def size(space: ParameterSpace, i: int, dz: float) -> str:
    """A step in z in words: a percentage for log-scaled parameters, in the unit for linear ones."""
    p = space.parameters[i]
    if not p.log:
        return f"{dz * p.prior_sd:+.2g} {p.unit}".removesuffix(" -")
    percent = 100.0 * np.expm1(dz * p.prior_sd)
    return f"{percent:+.0f} %" if abs(percent) >= 1.0 else f"{percent:+.1g} %"


def interval(space: ParameterSpace, z: FloatArray, sd: float, i: int) -> tuple[float, float]:
    """90 % interval of a parameter whose z has this sd, within its bounds."""
    p = space.parameters[i]
    ends = []
    for side in (-1.0, 1.0):
        moved = np.array(z)
        moved[i] += side * Z90 * sd
        ends.append(float(np.clip(space.theta_of(moved)[i], p.lower, p.upper)))
    return ends[0], ends[1]
