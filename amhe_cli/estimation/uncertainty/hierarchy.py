"""Values of the logs' own around a common mean: one level, y_i ~ N(mean, spread^2), in phi.

The search knows the values y_i of a parameter as independent unknowns with the parameter's prior. Here that
prior is taken out of the posterior again, and the common mean put in its place (Gelman et al., *Bayesian
Data Analysis*, section 5.4): for a given spread everything is Gaussian, and the spread, whose posterior is
not, is integrated on a grid. Each error in the ledger moves the values and their mean as the estimate follows
it; what mean and spread leave open is a term of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from amhe_cli.core.arrays import BoolArray, FloatArray
from amhe_cli.core.parameters import Parameter, ParameterSpace
from amhe_cli.estimation.core.result import OwnSpread
from amhe_cli.estimation.uncertainty.ledger import Ledger, term_of

#: Spreads that are tried, in prior sd; their prior is half a normal distribution with the parameter's prior
#: sd: logs are not expected to differ by more than the value itself was uncertain before.
SPREADS = np.geomspace(1e-3, 4.0, 161)


@dataclass(frozen=True, slots=True, eq=False)
class CommonMean:
    """Values of one parameter with their common mean.

    Args:
        mean: Mean and covariance of the unknowns with the common mean as the last, shape (k + 1,) and
            (k + 1, k + 1), in z.
        follows: How it follows a change of the unknowns under the independent priors, shape (k + 1, k).
        spread: Quantiles 5, 50 and 95 % of the spread, in z.
        variance: Mean of the spread's square.
    """

    mean: FloatArray
    covariance: FloatArray
    follows: FloatArray
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
    pull = np.concatenate((precision, np.zeros((1, len(z)))))
    score = pull @ z
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
        np.einsum("g,gij->ij", weight, covariances) @ pull,
        np.exp(np.interp((0.05, 0.5, 0.95), below, np.log(SPREADS))),
        float(weight @ SPREADS**2),
    )


@dataclass(frozen=True, slots=True, eq=False)
class WithMeans:
    """Lines of a report: the unknowns of a search, and before values of the logs' own their common mean.

    Args:
        space: The lines.
        z: Estimate, shape (k,).
        ledger: All terms of its error.
        rows: The unknowns that each line is; of a common mean, its values.
        next_log: Variance by which the value of another log differs from the line, in z, shape (k,).
        spreads: How far values lie from their mean.
    """

    space: ParameterSpace
    z: FloatArray
    ledger: Ledger
    rows: tuple[tuple[int, ...], ...]
    next_log: FloatArray
    spreads: tuple[OwnSpread, ...] = ()

    def of(self, values: FloatArray | BoolArray) -> FloatArray:
        """Numbers of the unknowns (d,) for the lines (k,), that of a common mean being a mean."""
        return np.array([np.mean(values[list(rows)], axis=0) for rows in self.rows]).reshape(
            -1, *values.shape[1:]
        )

    @property
    def means(self) -> dict[str, tuple[str, ...]]:
        """The common means -> names of their values."""
        return {spread.name: spread.values for spread in self.spreads}


def with_common_means(
    space: ParameterSpace, model: ParameterSpace, z: FloatArray, ledger: Ledger
) -> WithMeans:
    """The estimate with the common mean of each parameter that logs have as their own.

    Args:
        space: Unknowns of the search.
        model: Parameters of the model, with their prior.
        z: Estimate of the unknowns, shape (d,).
        ledger: All terms of its error.
    """
    lines = WithMeans(space, z, ledger, tuple((i,) for i in range(len(space))), np.zeros(len(space)))
    for parameter in model.parameters:
        members = [
            i for i, p in enumerate(lines.space.parameters) if p.owner and p.of_model == parameter.name
        ]
        if members:
            lines = _with_mean(lines, parameter, members)
    return lines


def _with_mean(lines: WithMeans, parameter: Parameter, members: list[int]) -> WithMeans:
    """The lines with one parameter's common mean before its values."""
    space, group = lines.space, grouped(lines.z, lines.ledger.covariance, members)
    at, names = members[0], tuple(space.names[i] for i in members)
    order = [*range(at), len(space), *range(at, len(space))]
    follows, terms = group.follows[order], []
    for term in lines.ledger.terms:
        sources = [replace(s, apart=tuple(follows @ s.apart)) if s.apart else s for s in term.sources]
        # the independent priors of the values are no more
        kept = [k for k, s in enumerate(sources) if s.parameter not in names] if sources else slice(None)
        errors = follows @ term.errors[:, kept]
        terms.append(
            replace(term, errors=errors, sources=tuple(s for s in sources if s.parameter not in names))
        )
    left = group.covariance[np.ix_(order, order)] - np.sum([term.covariance for term in terms], axis=0)
    low, middle, high = (float(s * parameter.prior_sd) for s in group.spread)
    return WithMeans(
        ParameterSpace(tuple(parameter if i == len(space) else space.parameters[i] for i in order)),
        group.mean[order],
        Ledger((*terms, term_of("spread", left))),
        (*lines.rows[:at], tuple(lines.rows[i][0] for i in members), *lines.rows[at:]),
        np.insert(lines.next_log, at, group.variance),
        (*lines.spreads, OwnSpread(parameter.name, names, middle, low, high, parameter.log)),
    )
