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

    A share k on the linear scale, such as friction's of a load, is in them as 1 + k. For every strongly
    correlated pair, the eigenvectors of its covariance in logarithms: the sharp one is what the data
    determine, the blunt one what they leave open.
    """
    matrix = correlation(covariance)
    shares = [p.unit == "-" and -1.0 < p.lower < 0.0 and not p.log for p in space.parameters]
    relative = space.prior_sd / np.where(shares, 1.0 + space.nominal, 1.0)
    scale, factors = np.outer(relative, relative), space.log | shares
    names = [f"(1 + {name})" if share else name for name, share in zip(space.names, shares, strict=True)]
    phi, prior = covariance * scale, space.prior_covariance * scale
    found = []
    for i in range(len(space)):
        for j in range(i + 1, len(space)):
            together = active[i] and active[j] and abs(matrix[i, j]) > TOGETHER
            if together and factors[i] and factors[j]:
                found += _pair(space.names, names, phi, prior, (i, j))
    return tuple(found)


def _pair(
    names: Sequence[str], factors: Sequence[str], phi: FloatArray, prior: FloatArray, pair: tuple[int, int]
) -> list[Combination]:
    """Combinations of two parameters, from posterior and prior covariance of all logarithms, (d, d)."""
    block = np.ix_(pair, pair)
    values, vectors = np.linalg.eigh(phi[block])
    result = []
    for value, vector in zip(values, vectors.T, strict=True):
        powers = vector / vector[np.argmax(np.abs(vector))]
        before = float(np.sqrt(powers @ prior[block] @ powers))
        sd = float(np.sqrt(value) * np.linalg.norm(powers))
        if np.abs(powers).min() >= EXPONENT:
            text = _product([factors[i] for i in pair], powers)
            result.append(Combination(text, sd, 1.0 - sd / before, tuple(names[i] for i in pair)))
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
