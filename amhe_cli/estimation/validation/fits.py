"""Measured against predicted, and costs along the parameters, for figures."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from amhe_cli.core import rotations
from amhe_cli.core.arrays import BoolArray, FloatArray, IntArray, to_host
from amhe_cli.core.log import Window
from amhe_cli.core.parameters import ParameterSpace
from amhe_cli.estimation.core.result import Fit
from amhe_cli.estimation.offline.clips import clip_name
from amhe_cli.estimation.offline.problem import Problem
from amhe_cli.matching.cost import MatchingCost
from amhe_cli.matching.windows import Observed

#: Clips that are drawn: the best, a middling and the worst of those given.
SHOWN = 3


def fits(problem: Problem, z: FloatArray, windows: Sequence[Window], held_out: bool) -> tuple[Fit, ...]:
    """Best, middling and worst clip under z (d,), each channel a Fit."""
    cost = MatchingCost(problem.system, windows, problem.engine, problem.settings.cost)
    order = np.argsort(cost.clip_costs(cost.residuals(z[None]))[0])
    picks = order[np.unique(np.linspace(0, len(order) - 1, SHOWN).round().astype(int))]
    chosen = [windows[i] for i in picks]
    cost = MatchingCost(problem.system, chosen, problem.engine, problem.settings.cost)
    predicted = cost.predict(np.stack((np.zeros_like(z), z)))
    return tuple(
        fit_of(observed, values[:, i], window, i, held_out, [one.key for one in problem.system.inputs])
        for i, window in enumerate(chosen)
        for observed, values in zip(cost.clips.observed, map(to_host, predicted.values), strict=True)
        if observed.mask[i].any()
    )


def fit_of(
    observed: Observed,
    predicted: FloatArray,
    window: Window,
    i: int,
    held_out: bool,
    inputs: Sequence[str] = (),
) -> Fit:
    """Channel on clip i, its inputs, and its predictions before and after, shape (2, samples, columns)."""
    keep = observed.mask[i]
    rows = window.start + observed.rows[i, keep] + 1
    driven = [window.log[key] for key in inputs]
    measured, (initial, identified) = observed.measured[i, keep], predicted[:, keep]
    columns = window.log[observed.channel.series].columns
    columns = columns if observed.channel.part is None else columns[observed.channel.part :][:1]
    if observed.channel.kind == "rotation":
        zero = measured[0]
        measured, initial, identified = (_turn(zero, q) for q in (measured, initial, identified))
        columns = ("x", "y", "z")
    return Fit(
        clip=clip_name(window),
        channel=observed.channel.key,
        unit=observed.channel.unit,
        columns=tuple(columns),
        time=(observed.rows[i, keep] + 1) * window.log.dt,
        measured=measured,
        initial=initial,
        identified=identified,
        noise=float(np.mean(observed.noise)),
        held_out=held_out,
        inputs=tuple(
            (f"{key} {name}", values)
            for key, one in zip(inputs, driven, strict=True)
            for name, values in zip(one.columns, one.values[rows].T, strict=False)
        ),
    )


def profiles(
    space: ParameterSpace,
    costs_along: Callable[[IntArray, FloatArray], FloatArray],
    z: FloatArray,
    sd: FloatArray,
    active: BoolArray,
    points: int,
) -> dict[int, tuple[FloatArray, FloatArray]]:
    """Cost along each active parameter through the estimate, the others held.

    Args:
        costs_along: Costs (m, p) of m parameters, by their rows (m,), at values of z (m, p).
        sd: Posterior sd of z: the profile reaches 4 of them, at least 0.3 prior sd, to either side.
        points: Points of each profile.
    """
    columns = np.flatnonzero(active)
    if points < 3 or not columns.size:
        return {}
    reach = np.maximum(4.0 * sd, 0.3)[columns]
    lower, upper = (bound[columns] for bound in space.bounds)
    middle = z[columns]
    values = np.linspace(np.maximum(lower, middle - reach), np.minimum(upper, middle + reach), points, axis=1)
    costs = costs_along(columns, values)
    candidates = np.repeat(z[None], columns.size * points, axis=0).reshape(columns.size, points, -1)
    candidates[np.arange(columns.size), :, columns] = values
    theta = space.theta_of(candidates)
    return {int(i): (theta[row, :, i], costs[row]) for row, i in enumerate(columns)}


def _turn(zero: FloatArray, q: FloatArray) -> FloatArray:
    """Rotation vectors from `zero` to q, unwrapped along time so that no curve jumps by a turn."""
    vectors = rotations.difference(q, np.broadcast_to(zero, q.shape))
    for k in range(1, len(vectors)):
        angle = np.linalg.norm(vectors[k])
        if angle > 1e-9 and np.dot(vectors[k], vectors[k - 1]) < 0.0 and angle > 0.5 * np.pi:
            vectors[k] *= (angle - 2.0 * np.pi) / angle
    return vectors
