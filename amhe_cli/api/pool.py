"""Results of several runs as one belief."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from amhe_cli.api.export import system_of
from amhe_cli.core.belief import Belief, belief_for, belief_of, gaussian_of, systematic_of
from amhe_cli.core.errors import ConfigError, EstimationError
from amhe_cli.estimation.core.agreement import Agreement, agreement, pairs, pooled
from amhe_cli.system.provenance import now, versions
from amhe_cli.system.system import System

#: Beliefs contradict each other where noise explains their differences less often than this.
CHANCE = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class Pooled:
    """Several beliefs as one.

    Args:
        belief: What they say together.
        sources: Names of the beliefs.
        beliefs: The beliefs, about the same parameters.
        agreement: How far they differ.
        differences: Parameter, the two sources that differ most in it, and by how many sd; worst first.
    """

    belief: Belief
    sources: tuple[str, ...]
    beliefs: tuple[Belief, ...]
    agreement: Agreement
    differences: tuple[tuple[str, str, str, float], ...]


def pool(
    beliefs: Sequence[Belief | str | Path],
    *,
    system: System | str | Path | None = None,
    belief_anyway: bool = False,
) -> Pooled:
    """Pool beliefs of independent runs, if they agree.

    Args:
        beliefs: Beliefs, or paths of belief.yaml files; from runs of the same system, each with the system's
            own prior and logs of its own.
        system: The system, its name or folder; None: the one that the first belief names, if it comes with
            amhe.
        belief_anyway: Take a belief about another model too, and only warn of what has changed.

    Raises:
        ConfigError: There are fewer than two beliefs, two were made of the same log, or one does not suit the
            system.
        EstimationError: The beliefs contradict each other: the parameter and the pair that differ most.
    """
    if isinstance(beliefs, str | Path | Belief) or len(beliefs) < 2:
        raise ConfigError("`beliefs`: give two or more")
    read = [one if isinstance(one, Belief) else Belief.load(one) for one in beliefs]
    names = tuple(f"belief {i + 1}" if isinstance(one, Belief) else str(one) for i, one in enumerate(beliefs))
    _refuse_shared(names, read)
    opened = system_of(read[0], names[0], system)
    known = [belief_for(opened, one, belief_anyway) for one in read]
    space = opened.space
    means, covariances = (
        np.array(each) for each in zip(*(gaussian_of(space, one) for one in known), strict=True)
    )
    systematic = np.array([systematic_of(space, one) for one in known])
    found = agreement(means, covariances, space.prior_precision)
    differences = tuple(pairs(names, found, space.names))
    if found.chance < CHANCE:
        name, one, other, sd = differences[0]
        raise EstimationError(
            f"these beliefs contradict each other: {name} differs by {sd:.1f} sd between {one} and {other} "
            f"(chi-square of all: {found.chi_square:.3g} of {found.freedom}); identify from all logs "
            f"together, where runs that differ widen the intervals"
        )
    z, covariance, shared = pooled(
        means, covariances, systematic, np.zeros(len(space)), space.prior_precision, space.bounds
    )
    origin: dict[str, object] = {"created": now(), "pooled": list(names), "versions": versions()}
    origin |= {key: read[0].provenance[key] for key in ("system_folder",) if key in read[0].provenance}
    origin["logs"] = {log: digest for one in read for log, digest in one.logs.items()}
    belief = belief_of(opened, z, covariance, origin, shared if shared.any() else None)
    return Pooled(belief, names, tuple(known), found, differences)


def _refuse_shared(names: Sequence[str], beliefs: Sequence[Belief]) -> None:
    """Refuse beliefs of the same log, whose information would count twice."""
    seen: dict[str, str] = {}
    for name, belief in zip(names, beliefs, strict=True):
        for log, digest in belief.logs.items():
            if digest in seen:
                raise ConfigError(
                    f"`beliefs`: {seen[digest]} and {name} were both made of {log}: pool other runs"
                )
        seen |= dict.fromkeys(belief.logs.values(), name)
