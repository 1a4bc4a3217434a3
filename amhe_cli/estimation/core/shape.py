"""The shape in which candidates are sampled: along the valleys of the posterior, not along the axes.

A shape is a matrix S, (d, d); samples are z + S w with w of unit variance. Where parameters are known only
together (mass and friction of a pushed box) their posterior is a thin ridge. Samples drawn along the axes
leave it by hundreds of its widths, and the bend of the residuals there would count as information along it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from amhe_cli.core.arrays import BoolArray, FloatArray, IntArray
from amhe_cli.core.parameters import ParameterSpace

#: Widest sampling sd along any direction, in prior sd.
WIDEST = 0.5


def sampling_width(space: ParameterSpace, share: float) -> FloatArray:
    """Sampling sd of z, shape (d,): a share of each parameter, or of a linear one's prior sd."""
    return np.minimum(space.in_z(share), WIDEST)


def diagonal(sd: float, active: BoolArray) -> FloatArray:
    """The same sd for every active parameter, shape (d, d)."""
    return np.diag(np.where(active, sd, 0.0))


def adapted(
    covariance: FloatArray,
    before: FloatArray,
    floor: FloatArray,
    active: BoolArray,
    alike: Sequence[IntArray] | None = None,
) -> FloatArray:
    """Shape of two posterior sd, with a fading memory of the one before.

    Args:
        covariance: Posterior covariance of z, shape (d, d).
        before: The shape before; its directions fade by 0.6 a time.
        floor: Smallest sampling sd of each parameter, shape (d,).
        active: Parameters that are sampled at all, shape (d,).
        alike: Groups of parameters of which no sample mixes two; None: one group.
    """
    return bounded(4.0 * within(covariance, alike) + 0.36 * before @ before.T, floor, active, alike)


def bounded(
    covariance: FloatArray, floor: FloatArray, active: BoolArray, alike: Sequence[IntArray] | None = None
) -> FloatArray:
    """Shape of a sampling covariance, no direction thinner than the floor or wider than WIDEST.

    Args:
        covariance: Sampling covariance of z, shape (d, d); what it says across groups is ignored.
        floor, active, alike: See `adapted`.
    """
    shape = np.zeros_like(covariance)
    for group in alike or [np.arange(len(covariance))]:
        rows = group[active[group]]
        scale = floor[rows]
        block = covariance[np.ix_(rows, rows)] / np.outer(scale, scale)
        values, vectors = np.linalg.eigh(block)
        part = (
            scale[:, None] * vectors * np.sqrt(np.maximum(values, 1.0))
        )  # in units of the floor, which is 1
        shape[np.ix_(rows, rows)] = part * np.minimum(1.0, WIDEST / np.linalg.norm(part, axis=0))
    return shape


def within(covariance: FloatArray, alike: Sequence[IntArray] | None) -> FloatArray:
    """Covariance (d, d) of each group of parameters, given all others: no sample leaves a common valley."""
    if alike is None or len(alike) == 1:
        return covariance
    precision, part = np.linalg.inv(covariance), np.zeros_like(covariance)
    for rows in alike:
        part[np.ix_(rows, rows)] = np.linalg.inv(precision[np.ix_(rows, rows)])
    return part


def coordinates(shape: FloatArray, steps: FloatArray) -> FloatArray:
    """The w of steps S w, shape (n, d); 0 along directions that are not sampled."""
    return steps @ np.linalg.pinv(shape, rcond=1e-9).T


def changed(before: FloatArray, after: FloatArray) -> bool:
    """Whether any sampling sd (d,) has changed by more than a quarter."""
    return bool((np.abs(after - before) > 0.25 * after).any())


def sampling_sd(shape: FloatArray) -> FloatArray:
    """Sampling sd of each parameter, shape (d,)."""
    return np.sqrt((shape**2).sum(axis=1))
