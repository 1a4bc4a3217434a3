"""Products of parameters that are known better, or worse, than each of their factors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.parameters import ParameterSpace
from amhe_cli.core.statistics import correlation
from amhe_cli.estimation.core.result import Combination
from amhe_cli.estimation.uncertainty.verdicts import TOGETHER

#: Smallest exponent of a combination: a smaller one rounds to 0.
EXPONENT = 0.05


def combinations(
    space: ParameterSpace, covariance: FloatArray, active: np.ndarray
) -> tuple[Combination, ...]:
    """Products of log-scaled parameters that are known much better, or worse, than each alone.

    For every strongly correlated pair, the eigenvectors of its covariance in log(theta): the sharp one is
    what the data determine, the blunt one what they leave open.
    """
    matrix = correlation(covariance)
    scale = np.outer(space.prior_sd, space.prior_sd)
    phi, prior = covariance * scale, space.prior_covariance * scale
    found = []
    for i in range(len(space)):
        for j in range(i + 1, len(space)):
            together = active[i] and active[j] and abs(matrix[i, j]) > TOGETHER
            if together and space.log[i] and space.log[j]:
                found += _pair(space, phi, prior, (i, j))
    return tuple(found)


def _pair(
    space: ParameterSpace, phi: FloatArray, prior: FloatArray, pair: tuple[int, int]
) -> list[Combination]:
    """Combinations of two parameters, from posterior and prior covariance of all in log(theta), (d, d)."""
    block = np.ix_(pair, pair)
    values, vectors = np.linalg.eigh(phi[block])
    result = []
    for value, vector in zip(values, vectors.T, strict=True):
        powers = vector / vector[np.argmax(np.abs(vector))]
        before = float(np.sqrt(powers @ prior[block] @ powers))
        sd = float(np.sqrt(value) * np.linalg.norm(powers))
        if np.abs(powers).min() >= EXPONENT:
            names = tuple(space.names[i] for i in pair)
            result.append(Combination(_product(names, powers), sd, 1.0 - sd / before, names))
    return result


def _product(names: Sequence[str], powers: FloatArray) -> str:
    """'mass * friction^0.9', 'gain / mass'."""
    factors = sorted(zip(map(float, powers), names, strict=True), reverse=True)
    text = _power(factors[0][1], factors[0][0])
    for power, name in factors[1:]:
        text += f" {'*' if power > 0.0 else '/'} {_power(name, abs(power))}"
    return text


def _power(name: str, power: float) -> str:
    return name if abs(power - 1.0) < 0.05 else f"{name}^{power:.1f}"
