"""Bayesian D-optimal design: how well data would determine the parameters, and the plan of a probe.

How much data reveal depends on the true parameters, which nobody knows. So the expectation over a few
draws of the prior is maximised,

    mean over draws of log det(P + M),

where P is the prior's precision and M the information of the excitation (Chaloner and Verdinelli 1995).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.parameters import ParameterSpace


def ensemble(space: ParameterSpace, pairs: int, rng: np.random.Generator) -> FloatArray:
    """Draws of z that stand for its prior, shape (1 + 2 pairs, d): the mean, and pairs one sd to either side.

    With random signs as coordinates the draws have the prior's spread, and none is extreme: a box that no
    robot can push would reveal nothing.
    """
    d = len(space)
    signs = rng.choice([-1.0, 1.0], size=(pairs, d))
    steps = signs @ np.linalg.cholesky(space.prior_covariance).T
    return space.clip(np.concatenate((np.zeros((1, d)), steps, -steps)).astype(np.float64))


def criterion(information: FloatArray, prior: FloatArray) -> float:
    """Mean log det(P + M) over draws, from information (draws, d, d) and the prior's precision (d, d)."""
    return float(np.linalg.slogdet(prior + information)[1].mean())


@dataclass(frozen=True, slots=True, eq=False)
class Accuracy:
    """How well parameters are, or would be, known.

    Args:
        space: The parameters.
        covariance: Posterior covariance of phi, which is log(theta) where log-scaled, shape (d, d).
    """

    space: ParameterSpace
    covariance: FloatArray

    @property
    def sd(self) -> FloatArray:
        """Posterior sd of phi, shape (d,); a share of the parameter where log-scaled."""
        return np.sqrt(np.diag(self.covariance))


def accuracy(space: ParameterSpace, information: FloatArray) -> Accuracy:
    """Accuracy from the prior and the information of data on z (draws, d, d), averaged over the draws."""
    covariance = np.linalg.inv(space.prior_precision + information).mean(axis=0)
    return Accuracy(space, covariance * np.outer(space.prior_sd, space.prior_sd))


@dataclass(frozen=True, slots=True)
class Part:
    """A stretch of a probe.

    Args:
        name: Short name of the motion.
        title: Description of the motion.
        start: Start of the part [s].
        seconds: Length of the part [s].
    """

    name: str
    title: str
    start: float
    seconds: float


@dataclass(frozen=True, slots=True, eq=False)
class ProbePlan:
    """A probe before it is run.

    Args:
        parts: The motions, in order.
        expected: How well the parameters will be known from the probe and the prior.
        plain: How well they would be known from equally long plain motion; None where that is impossible.
        plain_title: Description of the plain motion.
        tried: Each motion that was tried, and the geometric mean of the sds it would leave over the prior's.
    """

    parts: tuple[Part, ...]
    expected: Accuracy
    plain: Accuracy | None
    plain_title: str
    tried: tuple[tuple[str, float], ...] = ()

    @property
    def seconds(self) -> float:
        """Length of the whole probe [s]."""
        return self.parts[-1].start + self.parts[-1].seconds


def parts_of(motions: Sequence[tuple[str, str, float]]) -> tuple[Part, ...]:
    """Parts one after the other, from name, title and seconds of each."""
    starts = np.cumsum([0.0, *(seconds for _, _, seconds in motions)])
    return tuple(
        Part(name, title, float(start), seconds)
        for (name, title, seconds), start in zip(motions, starts, strict=False)
    )


def plan_record(plan: ProbePlan) -> dict[str, Any]:
    """A plan as plain values: the content of plan.json."""
    return {
        "sequence": [asdict(part) for part in plan.parts],
        "probe_seconds": plan.seconds,
        "plain_title": plan.plain_title,
        "tried": [{"name": name, "sd_over_prior": sd} for name, sd in plan.tried],
        **known_record({"expected": plan.expected, "plain": plan.plain}),
    }


def known_record(accuracies: Mapping[str, Accuracy | None]) -> dict[str, Any]:
    """Prior and posterior sd of each parameter; that of a log-scaled one is a share of its value."""
    known = {key: own for key, own in accuracies.items() if own is not None}
    rows = [
        {"name": p.name, "unit": p.unit, "relative": p.log, "prior": p.nominal, "prior_sd": p.prior_sd}
        | {f"{key}_sd": float(own.sd[i]) for key, own in known.items()}
        for i, p in enumerate(next(iter(known.values())).space.parameters)
    ]
    return {"parameters": rows}
