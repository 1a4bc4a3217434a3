"""Does every run say the same? Each log's estimate alone, and the pairs that disagree beyond chance.

A value that is another one in each run, such as friction that depends on the day, is a random effect: its
spread between runs widens the interval, which then holds the value of any run.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from itertools import combinations
from pathlib import Path

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.each_log import acting
from amhe_cli.core.log import Log
from amhe_cli.core.parameters import ParameterSpace
from amhe_cli.estimation.offline.posterior import Disagreement, FinalFit, Posterior, disagreement, posterior
from amhe_cli.estimation.offline.problem import Problem
from amhe_cli.estimation.offline.result import RunEstimate

#: Clips that a run needs to stand alone, and runs from which they are many parts of one data set.
FEWEST_CLIPS, MANY = 3, 10
#: Probability that some pair of runs that agree is named, for each of the parameters.
CHANCE = 0.01


def each_run(problem: Problem, z: FloatArray, fit: FinalFit) -> dict[Log, Posterior]:
    """What each log says alone, from the linearisation of all; none for a single log, or for many.

    Args:
        problem: The problem.
        z: Where its clips were linearised, shape (d,).
        fit: The linearisation.
    """
    sides = {log: np.array([clip.log is log for clip in problem.clips]) for log in _logs(problem)}
    sides = {log: side for log, side in sides.items() if side.sum() >= FEWEST_CLIPS}
    if not 2 <= len(sides) < MANY:
        return {}
    prior = problem.system.space.prior_precision
    return {log: posterior(z, fit.found, fit.weight * side, prior) for log, side in sides.items()}


def runs_that_differ(problem: Problem, alone: Mapping[Log, Posterior]) -> dict[str, Disagreement]:
    """Of three runs or more, the pair that differs most in each parameter where that is no chance."""
    found: dict[str, Disagreement] = {}
    pairs = list(combinations(alone, 2))
    if len(alone) < 3:  # the checks compare two of them as a pair
        return found
    space, model = problem.system.space, problem.system.edits.space
    names = names_of(alone)
    differences = [disagreement(alone[other], alone[one]) for one, other in pairs]
    both = np.array([acting(one, model, space) & acting(other, model, space) for one, other in pairs])
    sizes = np.abs([difference.value for difference in differences]) * both
    sizes = sizes / np.maximum([difference.sd for difference in differences], 1e-300)  # (pairs, d)
    for column, worst in enumerate(sizes.argmax(axis=0)):
        if len(pairs) * math.erfc(sizes[worst, column] / math.sqrt(2.0)) > CHANCE:
            continue
        one, other = pairs[worst]
        key, difference = f"{names[one]} and {names[other]}", differences[worst]
        value = found[key].value if key in found else np.zeros(len(space))
        own = np.arange(len(space)) == column
        found[key] = Disagreement(value + difference.value * own, difference.covariance)
    return found


def spread_between(alone: Mapping[Log, Posterior], named: Mapping[str, Disagreement]) -> FloatArray:
    """Sd of z from run to run of the parameters for which a pair is named, 0 of others; shape (d,).

    The random effect of DerSimonian and Laird (1986, "Meta-analysis in clinical trials", equation 8): by as
    much do the runs' estimates scatter about their weighted mean beyond their noise.
    """
    runs = list(alone.values())
    values = np.array([run.step for run in runs])  # (k, d)
    # a run weighs by the inverse of its variance, and not at all where it knows nothing
    weight = np.array([run.knows / np.maximum(run.data_covariance.diagonal(), 1e-300) for run in runs])
    total = np.maximum(weight.sum(axis=0), 1e-300)
    scatter = (weight * (values - (weight * values).sum(axis=0) / total) ** 2).sum(axis=0)
    expected = np.maximum((weight > 0.0).sum(axis=0) - 1, 0)
    worth = np.maximum(total - (weight**2).sum(axis=0) / total, 1e-300)
    differ = np.any([one.value != 0.0 for one in named.values()], axis=0)
    return np.sqrt(np.maximum(scatter - expected, 0.0) / worth) * differ


def estimates(
    space: ParameterSpace, z: FloatArray, alone: Mapping[Log, Posterior]
) -> tuple[RunEstimate, ...]:
    """Value and sd of each parameter from each run alone, without those that the run hardly knows."""
    names, found = names_of(alone), []
    for log, one in alone.items():
        values = space.theta_of(space.clip(z + one.step))
        sd = one.sd * space.prior_sd * np.where(space.log, values, 1.0)
        known = zip(space.names, values.tolist(), sd.tolist(), one.knows, strict=True)
        found.append(RunEstimate(names[log], {name: (value, s) for name, value, s, knows in known if knows}))
    return tuple(found)


def _logs(problem: Problem) -> list[Log]:
    return list(dict.fromkeys(clip.log for clip in problem.clips))


def names_of(logs: Collection[Log]) -> dict[Log, str]:
    """Names of the logs' files, with what leads to them where some are alike."""
    short = [Path(log.source).name for log in logs]
    unique = len(set(short)) == len(short)
    numbered = [name if unique else log.source for name, log in zip(short, logs, strict=True)]
    if len(set(numbered)) < len(numbered):
        numbered = [f"{name} #{i + 1}" for i, name in enumerate(short)]
    return dict(zip(logs, numbered, strict=True))
