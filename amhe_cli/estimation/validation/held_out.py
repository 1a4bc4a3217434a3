"""Clips that were not fitted: do the values predict them, and better than those before?

They are rolled out twice. From their recorded first states, as a user would predict them, the noise of the
sensors is a floor under the cost. With their first states fitted, as those of fitted clips are, a right model
leaves noise.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import cycle

import numpy as np

from amhe_cli.core import rotations
from amhe_cli.core.arrays import AnyArray, FloatArray, to_host
from amhe_cli.core.each_log import averaged, values_on
from amhe_cli.core.log import Window
from amhe_cli.estimation.core.agreement import SURPRISE
from amhe_cli.estimation.core.information import gauss_newton_step, information
from amhe_cli.estimation.core.result import Against, Fit, HeldOut, SpanError
from amhe_cli.estimation.offline.clips import ClipPool, clip_name
from amhe_cli.estimation.offline.problem import FEWEST, Problem
from amhe_cli.estimation.offline.search import SETTLED
from amhe_cli.estimation.uncertainty.fit import FinalFit, scored
from amhe_cli.matching.cost import MatchingCost, measures
from amhe_cli.matching.windows import Observed

#: Most steps to the values that a held-out log has of its own.
OWN_STEPS = 8
#: Ends of the spans over which errors are averaged [s]; the clip's end is the last.
SPANS = (0.1, 0.25, 0.5)
#: These ends as shares of a clip that is shorter.
SHARES = (0.25, 0.5)
#: Residual sd of held-out clips over that of fitted ones from which a model does not carry over.
CARRIES = 1.5
#: Student's t that chance exceeds once in a thousand, by degrees of freedom.
FREEDOM = (2, 3, 4, 5, 6, 8, 10, 15, 30, 1000)
STUDENT = (22.3, 10.2, 7.2, 5.9, 5.2, 4.5, 4.1, 3.7, 3.4, 3.1)
#: Clips that are drawn: the best, a middling and the worst of those given.
SHOWN = 3


def with_own_values(fit: FinalFit, windows: Sequence[Window]) -> tuple[list[Window], list[str]]:
    """Held-out clips, their logs' own values fitted; and what these values are, in words.

    No fitted log has them: they are fitted as first states are, around the mean of the fitted logs' values,
    with the parameter's prior sd.

    Args:
        fit: The fitted logs.
        windows: The clips.
    """
    problem, space, z, logs, notes = fit.problem, fit.space, fit.z, {}, []
    model = problem.system.edits.space
    for log in {id(window.log): window.log for window in windows}.values():
        logs[id(log)] = log
        if not (groups := averaged(log, model, space)):
            continue
        cost = problem.cost([window for window in windows if window.log is log], fit.scale)
        first = problem.recorded(cost)
        along, away = np.zeros((len(z), len(groups))), np.zeros(len(groups))
        for column, members in enumerate(groups.values()):
            along[members, column] = 1.0  # all of them move their mean
        for _ in range(OWN_STEPS):
            at = space.clip(z + along @ away)
            slopes = problem.linearised(
                cost, at, first, fit.shape, problem.rng(5), straight=not problem.touches
            )
            matrix, score = information(slopes).summed(np.ones(len(cost.clips.windows)))
            step, hessian = gauss_newton_step(
                along.T @ matrix @ along, along.T @ score, np.eye(len(groups)), away
            )
            away = away + step
            if step @ hessian @ step < SETTLED**2:
                break
        places = space.theta_of(space.clip(np.stack((z + along @ away, z))))
        fitted, mean = (
            dict(zip(model.names, map(float, row), strict=True))
            for row in values_on(log, model, space, places)
        )
        logs[id(log)] = log.with_(
            known=dict(log.known) | {name: fitted[name] for name in groups},
            own={name: owner for name, owner in log.own.items() if name not in groups},
        )
        notes += [
            f"{log.source}: is held out and has its own {name}: predicted with {fitted[name]:.3g}, fitted to "
            f"it as its first states are; the mean of the fitted logs is {mean[name]:.3g}"
            for name in groups
        ]
    return [replace(window, log=logs[id(window.log)]) for window in windows], notes


def validate(fit: FinalFit, windows: Sequence[Window]) -> HeldOut | None:
    """Costs and errors on clips that were not fitted, from their recorded first states."""
    if not windows:
        return None
    cost = fit.problem.cost(windows)
    residuals = cost.residuals(np.stack((fit.z, np.zeros_like(fit.z))))
    costs = cost.costs_of(residuals)
    position, orientation = (cost.errors(residuals, quantity) for quantity in ("position", "orientation"))
    return HeldOut(
        clips=len(windows),
        cost=float(costs[0]),
        initial_cost=float(costs[1]),
        position_error_m=_mean(position[0]),
        initial_position_error_m=_mean(position[1]),
        orientation_error_rad=_mean(orientation[0]),
        initial_orientation_error_rad=_mean(orientation[1]),
        errors=tuple(_spans(cost, residuals.values)),
    )


def judge(fit: FinalFit, windows: Sequence[Window], held_out: HeldOut) -> tuple[HeldOut, tuple[Against, ...]]:
    """Score held-out clips as fitted ones are, and compare them with those, and with the values before.

    Returns:
        What was known of them with the costs and errors from fitted first states, and what speaks against
        every value.
    """
    problem = fit.problem
    cost = problem.cost(windows, fit.scale)
    first, nowhere = problem.first_of_others(fit.information, windows), np.zeros_like(fit.z)
    now = scored(problem, cost, fit.z, fit.shape, first)
    if problem.non_smooth:
        first = problem.first_states(now.information, nowhere).forgotten
    before = scored(problem, cost, nowhere, fit.shape, first)
    costs = [float(cost.as_declared(each.residuals)[0]) for each in (now, before)]
    against = []
    # residuals of wrong values repeat more: with a time of its own, each would count by another measure
    times = [max(pair) for pair in zip(now.times, before.times, strict=True)]
    rise, by_z = now.misfit(times) - before.misfit(times), now
    if worst := not rise.sum() <= 0.0:  # else, no information is needed: nothing is always allowed
        if not problem.touches:
            by_z = scored(problem, cost, fit.z, fit.shape, by_z=True)
        worst = worse(rise, by_z.information.matrix, fit.posterior.covariance, fit.z)
    if worst:
        text = (
            f"held-out clips fit worse than under the prior: with first states fitted, their cost goes from "
            f"{costs[1]:.3g} to {costs[0]:.3g}"
        )
        against.append(Against("worse", text))
    scale, fitted, misses = {}, {}, {}
    if alike := _fitted_clips(problem, windows):
        same, first = problem.cost(alike, fit.scale), problem.first_of_others(fit.information, alike)
        losses = scored(problem, same, fit.z, fit.shape, first).losses
        for observed, loss in zip(same.clips.observed, losses, strict=True):
            fitted[observed.channel.key] = _for_each_sample(loss, observed)
    for observed, loss in zip(cost.clips.observed, now.losses, strict=True):
        key, held = observed.channel.key, _for_each_sample(loss, observed)
        scale[key] = (
            fit.scale.get(key, 1.0) * float(np.sqrt(held.mean() / observed.width)) if held.size else np.nan
        )
        if key in fitted and (ratio := misses_more(held, fitted[key])) is not None:
            misses[key] = ratio
            text = f"the model misses {key} of held-out clips {ratio:.1f} times as much as of fitted ones"
            against.append(Against("held out", text))
    errors = held_out.errors
    if problem.system.match == "effort":  # there are no first states
        costs = [math.nan, math.nan]
    else:
        both = map(np.concatenate, zip(now.residuals.values, before.residuals.values, strict=True))
        errors = tuple(
            replace(recorded, identified_fitted=span.identified, initial_fitted=span.initial)
            for recorded, span in zip(errors, _spans(cost, tuple(both)), strict=True)
        )
    judged = replace(
        held_out,
        fitted_cost=costs[0],
        initial_fitted_cost=costs[1],
        noise_scale=scale,
        misses=misses,
        errors=errors,
    )
    return judged, tuple(against)


def _fitted_clips(problem: Problem, windows: Sequence[Window]) -> list[Window]:
    """Clips of the fitted parts, as long as the held-out ones, and about as many."""
    settings, longest = problem.settings.clips, max(window.duration for window in windows)
    pool = ClipPool(problem.system, problem.pool.parts, settings)
    clips = pool.cut(longest, settings.held_out_first_only)
    return clips[:: max(1, len(clips) // max(FEWEST, len(windows)))]


def _for_each_sample(loss: FloatArray, observed: Observed) -> FloatArray:
    """Mean loss of a sample of each clip (c,), those left out that diverged or hold none."""
    count = observed.mask.sum(axis=1)
    mean = loss / np.maximum(count, 1)
    return mean[np.isfinite(mean) & (count > 0)]


def worse(rise: FloatArray, information: FloatArray, covariance: FloatArray, moved: FloatArray) -> bool:
    """Whether clips fit worse than under the prior, by more than chance.

    Where the prior stands at the truth the estimate is worse by what its own sd costs, tr(M C) on average;
    this is allowed, for SURPRISE sd. So is the scatter over clips, or what noise makes of the values' move.

    Args:
        rise: Misfit now less that before of each clip, shape (c,), as of independent samples.
        information: Information of each clip on z, shape (c, d, d).
        covariance: Covariance of z by noise and prior alone, shape (d, d).
        moved: Distance between the values, shape (d,).
    """
    both = np.isfinite(rise)
    if (rise == np.inf).sum() > (rise == -np.inf).sum():
        return True  # more clips diverge
    if not both.any():
        return False
    allowed = SURPRISE**2 * float(np.einsum("cij,ji->", information[both], covariance))
    noise = 4.0 * float(np.einsum("i,cij,j->", moved, information[both], moved))
    scatter = both.sum() * float(rise[both].var(ddof=1)) if both.sum() > 1 else 0.0
    return float(rise[both].sum()) > allowed + SURPRISE * np.sqrt(max(noise, scatter))


def misses_more(held: FloatArray, fitted: FloatArray) -> float | None:
    """How many times as much held-out clips are missed as fitted ones; None where it is chance or little.

    Student's test on the logarithms, which scatter alike whatever the size: there are few clips.

    Args:
        held, fitted: Mean loss of a sample of each clip, shape (h,) and (f,).
    """
    freedom = held.size + fitted.size - 2
    if min(held.size, fitted.size) < 1 or freedom < 2:
        return None
    one, other = (np.log(np.maximum(losses, 1e-12)) for losses in (held, fitted))
    spread = (((one - one.mean()) ** 2).sum() + ((other - other.mean()) ** 2).sum()) / freedom
    difference = float(one.mean() - other.mean())
    chance = np.sqrt(spread * (1.0 / held.size + 1.0 / fitted.size))
    limit = float(np.interp(1.0 / freedom, 1.0 / np.array(FREEDOM[::-1]), STUDENT[::-1]))
    ratio = float(np.exp(0.5 * difference))
    return ratio if ratio > CARRIES and difference > limit * chance else None


def _spans(cost: MatchingCost, residuals: Sequence[AnyArray]) -> Iterator[SpanError]:
    """Error of each channel over all of the clips, then over spans of them.

    Args:
        cost: The cost on the clips.
        residuals: Residuals under the estimate and under the values before, each channel (2, c, s, k).
    """
    longest, dt = max(window.duration for window in cost.clips.windows), cost.system.dt
    ends = [end for end in SPANS if end < 0.9 * longest] or [share * longest for share in SHARES]
    spans = [(0.0, longest), *zip((0.0, *ends), (*ends, longest), strict=True)]
    if cost.system.match == "effort":  # each instant stands for itself
        spans = spans[:1]
    for observed, values in zip(cost.clips.observed, map(to_host, residuals), strict=True):
        time, channel = (observed.rows + 1) * dt, observed.channel
        for start, end in spans:
            inside = observed.mask & (time > start) & (time <= end + 0.5 * dt)
            for unit in dict.fromkeys(channel.units) if inside.any() else ():
                after, before = (float(_sizes(observed, part, unit)[inside].mean()) for part in values)
                yield SpanError(channel.key, unit, start, end, before, after)


def _sizes(observed: Observed, residuals: FloatArray, unit: str) -> FloatArray:
    """Error of each sample (c, s) from whitened residuals (c, s, k): of a pose a distance, else the mean.

    Of joints, those of this unit count: some turn, others slide.
    """
    units = observed.channel.units
    if any(measures(observed.channel, quantity) for quantity in ("position", "orientation")):
        return observed.noise * np.linalg.norm(residuals, axis=-1)
    if len(units) > 1:
        residuals = residuals[..., [i for i, one in enumerate(units) if one == unit]]
    return np.abs(observed.noise * residuals).mean(axis=-1)


def _mean(errors: FloatArray) -> float:
    return float(errors.mean()) if errors.size and not np.isnan(errors).all() else float("nan")


def fits(problem: Problem, z: FloatArray, windows: Sequence[Window], held_out: bool) -> tuple[Fit, ...]:
    """Best, middling and worst clip under z (d,), each channel a Fit."""
    cost = problem.cost(windows)
    order = np.argsort(cost.clip_costs(cost.residuals(z[None]))[0])
    picks = order[np.unique(np.linspace(0, len(order) - 1, SHOWN).round().astype(int))]
    chosen = [windows[i] for i in picks]
    cost = problem.cost(chosen)
    predicted = cost.predict(np.stack((np.zeros_like(z), z)))
    return tuple(
        fit_of(observed, values[:, i], window, i, held_out, [source.key for source in problem.system.inputs])
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
        units=observed.channel.units,
        columns=tuple(columns),
        time=(observed.rows[i, keep] + 1) * window.log.dt,
        measured=measured,
        initial=initial,
        identified=identified,
        noise=float(np.mean(observed.noise)),
        held_out=held_out,
        inputs=tuple(
            (f"{key} {name}", unit, values)
            for key, series in zip(inputs, driven, strict=True)
            for name, unit, values in zip(
                series.columns, cycle(window.log.units.get(key, ("",))), series.values[rows].T, strict=False
            )
        ),
    )


def _turn(zero: FloatArray, q: FloatArray) -> FloatArray:
    """Rotation vectors from `zero` to q, unwrapped along time so that no curve jumps by a turn."""
    vectors = rotations.difference(q, np.broadcast_to(zero, q.shape))
    for k in range(1, len(vectors)):
        angle = np.linalg.norm(vectors[k])
        if angle > 1e-9 and np.dot(vectors[k], vectors[k - 1]) < 0.0 and angle > 0.5 * np.pi:
            vectors[k] *= (angle - 2.0 * np.pi) / angle
    return vectors
