"""Values of the logs' own around a common mean: one level, y_i ~ N(mean, spread^2), in phi.

The search knows the values y_i of a parameter as independent unknowns with the parameter's prior. Here that
prior is taken out of the posterior again, and the common mean put in its place (Gelman et al., *Bayesian
Data Analysis*, section 5.4): for a given spread everything is Gaussian, and the spread, whose posterior is
not, is integrated on a grid.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.parameters import Parameter, ParameterSpace
from amhe_cli.core.statistics import Z90, correlation, part_of
from amhe_cli.estimation.core.result import Identification, Iteration, OwnSpread, ParameterResult, Reason
from amhe_cli.estimation.uncertainty.verdicts import DETERMINED, NOTHING

#: Spreads that are tried, in prior sd; their prior is half a normal distribution with the parameter's prior
#: sd: logs are not expected to differ by more than the value itself was uncertain before.
SPREADS = np.geomspace(1e-3, 4.0, 161)


@dataclass(frozen=True, slots=True, eq=False)
class CommonMean:
    """Values of one parameter with their common mean.

    Args:
        mean: Mean and covariance of the unknowns with the common mean as the last, shape (k + 1,) and
            (k + 1, k + 1), in z.
        spread: Quantiles 5, 50 and 95 % of the spread, in z.
        variance: Mean of the spread's square.
    """

    mean: FloatArray
    covariance: FloatArray
    spread: FloatArray
    variance: float


def grouped(z: FloatArray, covariance: FloatArray, members: Sequence[int]) -> CommonMean:
    """Replace the independent prior of some unknowns, N(0, 1) each, by a common mean and a spread.

    Args:
        z, covariance: Posterior under the independent priors, shape (k,) and (k, k).
        members: Columns of the values.
    """
    rows = list(members)
    precision = np.linalg.inv(covariance)
    score = np.append(precision @ z, 0.0)
    precision[rows, rows] -= 1.0
    values, vectors = np.linalg.eigh(precision)
    likelihood = np.zeros((len(z) + 1, len(z) + 1))
    likelihood[:-1, :-1] = (vectors * np.maximum(values, 0.0)) @ vectors.T
    centre = len(z)
    likelihood[centre, centre] = 1.0  # the prior of the mean
    weights, means, covariances = [], [], []
    for spread in SPREADS:
        total = likelihood.copy()
        total[rows, rows] += spread**-2
        total[rows, centre] -= spread**-2
        total[centre, rows] -= spread**-2
        total[centre, centre] += len(rows) * spread**-2
        inverse = np.linalg.inv(total)
        middle = inverse @ score
        log_det = np.linalg.slogdet(total)[1]
        log_prior = -0.5 * spread**2 + np.log(spread)  # the grid is even in log(spread)
        weights.append(0.5 * (score @ middle - log_det) - len(rows) * np.log(spread) + log_prior)
        means.append(middle)
        covariances.append(inverse)
    weight = np.exp(np.array(weights) - max(weights))
    weight /= weight.sum()
    average = weight @ np.array(means)
    scatter = np.array(means) - average
    whole = np.einsum("g,gij->ij", weight, covariances) + np.einsum("g,gi,gj->ij", weight, scatter, scatter)
    below = np.cumsum(weight) - 0.5 * weight
    return CommonMean(
        average,
        whole,
        np.exp(np.interp((0.05, 0.5, 0.95), below, np.log(SPREADS))),
        float(weight @ SPREADS**2),
    )


def with_common_means(found: Identification, model: ParameterSpace, space: ParameterSpace) -> Identification:
    """The identification with the common mean and spread of each parameter that logs have as their own.

    In its belief the spread adds to the common mean's covariance: that is what is known of the next log.

    Args:
        found: Result of the search, whose lines are the unknowns of `space`.
        model: Parameters of the model, with their prior.
        space: Unknowns of the search.
    """
    variances = {}
    for parameter in model.parameters:
        members = [i for i, p in enumerate(space.parameters) if p.owner and p.of_model == parameter.name]
        if members:
            found, space, variances[parameter.name] = _with_mean(found, space, parameter, members)
    between = np.diag([variances.get(name, 0.0) for name in found.belief.names])
    return replace(found, belief=replace(found.belief, covariance=found.belief.covariance + between))


def _with_mean(
    found: Identification, space: ParameterSpace, parameter: Parameter, members: list[int]
) -> tuple[Identification, ParameterSpace, float]:
    """The identification with one parameter's common mean as a line before its values.

    Returns:
        It, its unknowns, and the variance of phi between the values.
    """
    z, covariance = space.gaussian_of(found.belief)
    group, at = grouped(z, covariance, members), min(members)
    order = [*range(at), len(space), *range(at, len(space))]
    z, covariance = group.mean[order], group.covariance[np.ix_(order, order)]
    lines = [parameter if i == len(space) else space.parameters[i] for i in order]
    wider = ParameterSpace(tuple(lines))
    average = np.zeros((1, len(space)))
    average[0, members] = 1.0 / len(members)  # the mean errs by the mean of what its values err by
    rows = np.concatenate((np.eye(len(space)), average))[order]
    systematic = part_of(covariance, rows @ space.systematic_of(found.belief) @ rows.T)
    scale = np.outer(wider.prior_sd, wider.prior_sd)
    belief = replace(
        found.belief,
        names=wider.names,
        units=tuple(p.unit for p in lines),
        log=tuple(p.log for p in lines),
        estimate=wider.theta_of(z),
        covariance=covariance * scale,
        systematic=systematic * scale,
    )
    results = [
        _mean_line(parameter, found.parameters, members) if i == len(space) else found.parameters[i]
        for i in order
    ]
    moved = [at, *(order.index(i) for i in members)]
    for row in moved:
        results[row] = _updated(
            results[row], wider.parameters[row], z[row], float(covariance[row, row]) ** 0.5
        )
    low, middle, high = (float(s * parameter.prior_sd) for s in group.spread)
    spread = OwnSpread(
        parameter.name, tuple(space.names[i] for i in members), middle, low, high, parameter.log
    )
    widened = replace(
        found,
        parameters=tuple(results),
        belief=belief,
        correlations=correlation(covariance),
        iterations=tuple(_iteration(one, order, members, len(space)) for one in found.iterations),
        spreads=(*found.spreads, spread),
    )
    return widened, wider, group.variance * parameter.prior_sd**2


def _mean_line(
    parameter: Parameter, lines: Sequence[ParameterResult], members: Sequence[int]
) -> ParameterResult:
    """The line of a common mean; its numbers follow."""
    values = [lines[i] for i in members]
    wrong = next((p for p in values if p.verdict == "model-sensitive"), None)
    conditional = next((p for p in values if p.given), None)
    first = wrong or conditional
    text = f"the common mean of {len(values)} values"
    reasons = (Reason("together", tuple(p.name for p in values), 1.0, text),)
    if first is not None:
        reasons = (*(replace(r, text=f"{first.name}: {r.text}") for r in first.reasons[:1]), *reasons)
    return replace(
        values[0],
        name=parameter.name,
        verdict="" if wrong is None else wrong.verdict,
        reasons=reasons,
        budget={},
        doubled_prior=float("nan"),
        given="" if conditional is None else conditional.given,
        profile=None,
    )


def _updated(line: ParameterResult, p: Parameter, z: float, sd: float) -> ParameterResult:
    """A line with another posterior of its z."""
    alone = ParameterSpace((p,))
    estimate, *ends = (float(alone.theta_of(np.array([z + k * Z90 * sd]))[0]) for k in (0.0, -1.0, 1.0))
    strength = "identified" if 1.0 - sd >= DETERMINED else "weak" if 1.0 - sd >= NOTHING else "prior"
    if strength == "identified" and line.given:
        strength = "conditional"  # what the values rest on, their mean rests on
    verdict = line.verdict or strength
    return replace(
        line,
        estimate=float(np.clip(estimate, p.lower, p.upper)),
        sd=sd * p.prior_sd * (estimate if p.log else 1.0),
        lower=float(np.clip(ends[0], p.lower, p.upper)),
        upper=float(np.clip(ends[1], p.lower, p.upper)),
        shrinkage=1.0 - sd,
        verdict=verdict,
        given=line.given if verdict == "conditional" else "",
    )


def _iteration(one: Iteration, order: Sequence[int], members: Sequence[int], new: int) -> Iteration:
    """The record of an iteration with the values' mean in place of the common one."""
    mean = float(np.mean([one.theta[i] for i in members]))
    return replace(one, theta=tuple(mean if i == new else one.theta[i] for i in order))
