"""A designed probe: what is done when, and how well the parameters will be known from it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.parameters import ParameterSpace
from amhe_cli.estimation.design.design import Accuracy, best_product


@dataclass(frozen=True, slots=True)
class Part:
    """A stretch of a probe.

    Args:
        name: A word.
        title: In words.
        start: Of the part [s].
        seconds: Its length [s].
    """

    name: str
    title: str
    start: float
    seconds: float


@dataclass(frozen=True, slots=True, eq=False)
class ProbePlan:
    """A probe before it is run.

    Args:
        parts: What is done, in order.
        expected: How well parameters will be known from it and the prior.
        plain: The same of equally long plain motion; None where that cannot be done.
        plain_title: What that is.
    """

    parts: tuple[Part, ...]
    expected: Accuracy
    plain: Accuracy | None
    plain_title: str

    @property
    def seconds(self) -> float:
        """How long it takes."""
        return self.parts[-1].start + self.parts[-1].seconds


def plan_record(plan: ProbePlan) -> dict[str, Any]:
    """A plan as plain values: the content of plan.json."""
    return {
        "sequence": [asdict(part) for part in plan.parts],
        "probe_seconds": plan.seconds,
        "plain_title": plan.plain_title,
        **known_record({"expected": plan.expected, "plain": plan.plain}),
    }


def known_record(accuracies: Mapping[str, Accuracy | None]) -> dict[str, Any]:
    """Prior and posterior sd of each parameter, and of the two that the first of them knows best together.

    A log-scaled parameter's sd is a share of its value.
    """
    known = {key: own for key, own in accuracies.items() if own is not None}
    space = next(iter(known.values())).space
    rows = [
        {"name": p.name, "unit": p.unit, "relative": p.log, "prior": p.nominal, "prior_sd": p.prior_sd}
        | {f"{key}_sd": float(own.sd[i]) for key, own in known.items()}
        for i, p in enumerate(space.parameters)
    ]
    powers = best_product(next(iter(known.values())))
    return {"parameters": rows, "together": None if powers is None else _together(space, known, powers)}


def _together(space: ParameterSpace, known: Mapping[str, Accuracy], powers: FloatArray) -> dict[str, Any]:
    sd = space.prior_sd * powers
    names = [space.names[i] for i in np.flatnonzero(powers)]
    sign = "*" if powers.sum() > 0.0 else "/"
    return {
        "name": f" {sign} ".join(names),
        "prior_sd": float(np.sqrt(sd @ space.prior_covariance @ sd)),
    } | {f"{key}_sd": own.sd_along(powers) for key, own in known.items()}


def parts_of(names: Sequence[tuple[str, str, float]]) -> tuple[Part, ...]:
    """Parts one after the other from (name, title, seconds)."""
    starts = np.cumsum([0.0, *(seconds for _, _, seconds in names)])
    return tuple(
        Part(name, title, float(start), seconds)
        for (name, title, seconds), start in zip(names, starts, strict=False)
    )
