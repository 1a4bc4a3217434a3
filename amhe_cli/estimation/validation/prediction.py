"""How far a prediction is off after a while: errors of each joint or pose at growing horizons.

A prediction starts from a recorded state and follows the recorded commands, as a user's would. Its error at a
horizon is the rms over the last tenth of it, so that one sample's noise does not decide.

Models are paired clip by clip, and a bootstrap over clips gives the interval of the ratio of their errors:
what is hard for all models does not count as noise.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from amhe_cli.core.arrays import BoolArray, FloatArray, to_host
from amhe_cli.core.log import Window
from amhe_cli.engine.rollout import Engine
from amhe_cli.estimation.core.result import AtHorizon, HorizonError, Identification
from amhe_cli.estimation.offline.clips import ClipPool
from amhe_cli.estimation.offline.problem import Problem
from amhe_cli.matching.cost import MatchingCost
from amhe_cli.matching.windows import Observed
from amhe_cli.system.model.elements import joint_of
from amhe_cli.system.system import System

#: Horizons [s]; the last one is the end of the logs.
HORIZONS = (0.1, 0.5, 2.0)
#: Starts of each horizon, at most.
STARTS = 20
#: Share of a horizon, at its end, that the error is taken over.
_LAST = 0.1
_LENGTHS = {"rad", "m"}


#: Resamples of the clips.
RESAMPLES = 2000
#: Ends of the interval [%].
ENDS = (2.5, 97.5)
#: The fewest clips that can tell two models apart.
FEWEST = 4
#: One over degrees of freedom, and by how much Student's 95 % interval is wider than a normal one.
STUDENT = (0.0, 1 / 20, 1 / 10, 1 / 5, 1 / 3), (1.0, 1.064, 1.137, 1.312, 1.624)
#: A diverged prediction counts as one that is off by so many times the usual error.
_DIVERGED = 100.0


@dataclass(frozen=True, slots=True, eq=False)
class ClipErrors:
    """Errors of one column of a channel, or of a pose, at one horizon.

    Args:
        channel, column, unit: What it is.
        errors: Of each candidate on each clip, shape (p, c); NaN where nothing was measured then, infinite
            where the rollout diverged.
        moved: How far the clip's measured values moved from its first sample, shape (c,).
    """

    channel: str
    column: str
    unit: str
    errors: FloatArray
    moved: FloatArray


def stretches(windows: Sequence[Window]) -> list[Window]:
    """Clips that lie side by side, as one window each."""
    joined: list[Window] = []
    for window in sorted(windows, key=lambda one: (id(one.log), one.start)):
        last = joined[-1] if joined else None
        if last is not None and last.log is window.log and window.start <= last.stop:
            joined[-1] = Window(last.log, last.start, max(last.stop, window.stop) - last.start)
        else:
            joined.append(window)
    return joined


def starts(system: System, windows: Sequence[Window], horizon: float) -> list[Window]:
    """At most `STARTS` windows of one length [s] within some clips; infinite: as long as they are."""
    parts = [part for part in stretches(windows) if not part.duration < horizon < np.inf]
    cut = ClipPool(system, parts, system.settings.clips).cut(horizon) if horizon < np.inf else parts
    return (
        [cut[i] for i in np.unique(np.linspace(0, len(cut) - 1, STARTS).round().astype(int))] if cut else []
    )


def horizon_errors(problem: Problem, windows: Sequence[Window], z: FloatArray) -> tuple[HorizonError, ...]:
    """Errors of an estimate z (d,) and of the prior's mean at each horizon, on clips that were not fitted."""
    rows = []
    places, longest = np.stack((np.zeros_like(z), z)), max(part.duration for part in stretches(windows))
    for horizon in (*(h for h in HORIZONS if h < longest), np.inf):
        if not (clips := starts(problem.system, windows, horizon)):
            continue
        for row in clip_errors(problem.cost(clips), places):
            initial, identified = (_rms(errors) for errors in row.errors)
            rows.append(
                HorizonError(
                    channel=row.channel,
                    column=row.column,
                    unit=row.unit,
                    horizon=min(horizon, max(clip.duration for clip in clips)),
                    to_end=horizon == np.inf,
                    clips=len(clips),
                    moved=_rms(row.moved),
                    initial=initial,
                    identified=identified,
                )
            )
    return tuple(rows)


def errors_of(system: System, windows: Sequence[Window], engine: Engine, z: FloatArray) -> list[ClipErrors]:
    """Errors of one candidate z (d,) of a system at the end of each window."""
    return list(clip_errors(MatchingCost(system, windows, engine, system.settings.cost), z[None]))


def clip_errors(cost: MatchingCost, z: FloatArray) -> Iterator[ClipErrors]:
    """Errors of candidates z (p, d) at each clip's end: poses and joints, or all channels if none is one."""
    residuals = cost.residuals(z)
    placed = [_LENGTHS.issuperset(one.channel.units) for one in cost.clips.observed]
    lengths = np.array([window.length for window in cost.clips.windows])
    for observed, values, shown in zip(cost.clips.observed, residuals.values, placed, strict=True):
        if not shown and any(placed):
            continue
        late = observed.mask & (observed.rows + 1 >= (1.0 - _LAST) * lengths[:, None])
        away = observed.noise * to_host(values)
        moved = observed.measured - observed.measured[:, :1]
        for name, unit, columns in _columns(cost, observed):
            size = np.linalg.norm(away[..., columns], axis=-1)
            errors = np.array([_rms_of(one, late) for one in size])
            errors = np.where(residuals.completed, errors, np.inf)
            turned = observed.channel.kind == "rotation"
            travelled = (
                np.full(len(lengths), np.nan)
                if turned
                else _rms_of(np.linalg.norm(moved[..., columns], axis=-1), late)
            )
            yield ClipErrors(observed.channel.key, name, unit, errors, travelled)


def _columns(cost: MatchingCost, observed: Observed) -> Iterator[tuple[str, str, list[int]]]:
    """Name, unit and residuals of each joint; of a pose all together."""
    channel, width = observed.channel, observed.width
    if channel.kind == "rotation" or channel.part is not None or (channel.unit == "m" and width == 3):
        yield "", channel.unit, list(range(width))
        return
    names = cost.clips.windows[0].log[channel.series].columns
    units = [channel.units[i % len(channel.units)] for i in range(len(names))]
    if channel.source != "qpos":
        for i, name in enumerate(names):
            yield (str(name) if width > 1 else ""), units[i], [i]
        return
    for i in np.argsort(channel.columns[: len(names)], kind="stable").tolist():  # the model's order of joints
        yield joint_of(cost.system.model, channel.columns[i]) or str(names[i]), units[i], [i]


def _rms_of(size: FloatArray, inside: BoolArray) -> FloatArray:
    """Rms over the samples of each clip that are inside, (c,); NaN where none is."""
    count = inside.sum(axis=1)
    total = np.where(inside, size**2, 0.0).sum(axis=1)
    return np.where(count > 0, np.sqrt(total / np.maximum(count, 1)), np.nan)


def _rms(values: FloatArray) -> float:
    measured = values[~np.isnan(values)]
    return float(np.sqrt(np.mean(measured**2))) if measured.size else float("nan")


@dataclass(frozen=True, slots=True, eq=False)
class Compared:
    """Comparison of the errors of several models.

    Args:
        names: Names of the models.
        found: What was identified of each.
        horizons: Their errors at each horizon.
        best: Index of the model that predicts best.
        verdicts: What the logs say of it against each other model, in words.
    """

    names: tuple[str, ...]
    found: tuple[Identification, ...]
    horizons: tuple[AtHorizon, ...]
    best: int
    verdicts: tuple[str, ...]


def at_horizon(
    horizon: float, to_end: bool, of_systems: Sequence[Sequence[ClipErrors]], rng: np.random.Generator
) -> AtHorizon:
    """Compare the errors of each system, those of the joints and poses that all of them predict.

    Args:
        horizon, to_end: See `AtHorizon`.
        of_systems: Errors of each system on the same clips; the first candidate's count.
        rng: Generator of the resamples.
    """
    by_name = [{(one.channel, one.column, one.unit): one.errors[0] for one in each} for each in of_systems]
    common = [key for key in by_name[0] if all(key in each for each in by_name)]
    errors = np.array([[each[key] for key in common] for each in by_name])
    errors = errors.reshape(len(of_systems), len(common), -1 if common else 0)  # (m, k, c)
    measured = ~np.isnan(errors).any(axis=(0, 1))
    errors = errors[:, :, measured]
    finite = np.isfinite(errors)
    total = np.sum(np.where(finite, errors, 0.0) ** 2, axis=(0, 2), keepdims=True)
    usual = np.sqrt(total / np.maximum(finite.sum(axis=(0, 2), keepdims=True), 1))
    squares = np.minimum(errors / np.maximum(usual, 1e-300), _DIVERGED) ** 2
    squares = squares.sum(axis=1) / max(len(common), 1)  # (m, c)
    clips = squares.shape[1]
    picks = rng.integers(0, max(clips, 1), (RESAMPLES, clips))
    with np.errstate(invalid="ignore"):  # without clips all is NaN
        means = squares[:, picks].sum(axis=-1) / clips  # (m, resamples)
        ratios = np.sqrt(means[:, None] / means[None])
        whole = squares.sum(axis=1) / clips
        rms = np.sqrt((errors**2).sum(axis=-1) / clips)  # (m, k)
    ends = np.percentile(ratios, ENDS, axis=-1)
    if clips < FEWEST:
        ends[:] = np.nan
    else:  # a bootstrap over few clips is too narrow, as a normal interval is against Student's
        wider = np.sqrt(clips / (clips - 1.0)) * np.interp(1.0 / (clips - 1.0), *STUDENT)
        centre = np.sqrt(whole[:, None] / whole[None])
        ends = centre * (ends / centre) ** wider
    return AtHorizon(
        horizon=horizon,
        to_end=to_end,
        clips=clips,
        errors={(column or channel, unit): rms[:, i] for i, (channel, column, unit) in enumerate(common)},
        ratios=np.sqrt(whole[:, None] / whole[None]),
        lower=ends[0],
        upper=ends[1],
    )


def best_of(horizons: Sequence[AtHorizon]) -> int:
    """The system whose errors are smallest, in the mean of their logarithms over the horizons."""
    scored = [at for at in horizons if at.clips]
    telling = [at for at in scored if at.clips >= FEWEST] or scored or list(horizons)
    return int(np.mean([np.log(at.ratios).mean(axis=1) for at in telling], axis=0).argmin())


def simplest_of(horizons: Sequence[AtHorizon], sizes: Sequence[int]) -> int:
    """The smallest model that is within one standard error of the best.

    The standard error is that of the paired difference, in the mean over the horizons, from the interval of
    the bootstrap.

    Args:
        horizons: Errors at each horizon.
        sizes: Number of parameters of each model.
    """
    best, telling = best_of(horizons), [one for one in horizons if one.clips >= FEWEST]
    within = np.zeros(len(sizes), dtype=bool)
    within[best] = True
    if telling:
        worse = np.mean([np.log(one.ratios[:, best]) for one in telling], axis=0)
        width = np.mean([np.log(one.upper[:, best] / one.lower[:, best]) for one in telling], axis=0)
        within |= worse <= width / (2.0 * 1.96)
    return min(map(int, np.flatnonzero(within)), key=lambda i: (sizes[i], i != best))


def improves(horizons: Sequence[AtHorizon], one: int, other: int) -> bool:
    """Whether a system predicts better than another by more than chance, and nowhere worse.

    It is one test over the horizons together, since each more would be one more chance to err.
    The mean of the logarithms of its ratios, each with weight 1 / sd^2, must be below 0 by as many sd as an
    interval is wide. The horizons look at the same clips: their errors are taken to go up and down together.
    """
    telling = [at for at in horizons if at.clips >= FEWEST and np.isfinite(at.upper[one, other])]
    if not telling or any(at.better(other, one) for at in horizons):
        return False
    ratio, upper = np.log([(at.ratios[one, other], at.upper[one, other]) for at in telling]).T
    width = np.maximum(upper - ratio, 1e-12)
    return bool((upper / width**2).sum() < 0.0)


def verdict(horizons: Sequence[AtHorizon], names: Sequence[str], best: int, other: int) -> str:
    """Comparison of the best system with another one, in words."""
    one, two = names[best], names[other]
    wins = [at for at in horizons if at.better(best, other)]
    losses = [at for at in horizons if at.better(other, best)]

    def times(some: Sequence[AtHorizon]) -> str:
        return _listed([f"{at.horizon:.3g} s" for at in some])

    def smaller(some: Sequence[AtHorizon], i: int, j: int) -> str:
        sizes = _listed([f"{100.0 * (1.0 - at.ratios[i, j]):.0f} % after {at.horizon:.3g} s" for at in some])
        return f"{names[i]} predicts better than {names[j]}: its error is smaller by {sizes}"

    if improves(horizons, best, other):
        return smaller(wins or [at for at in horizons if at.clips >= FEWEST], best, other)
    if wins:
        but = f"and worse after {times(losses)}" if losses else "but not over all horizons together"
        return f"{one} predicts better than {two} after {times(wins)}, {but}"
    if losses:
        return smaller(losses, other, best)
    if all(at.clips < FEWEST for at in horizons):
        return f"the logs cannot decide between {one} and {two}: fewer than {FEWEST} clips were held out"
    return f"the logs cannot decide between {one} and {two}: their errors differ by no more than chance"


def _listed(parts: Sequence[str]) -> str:
    return parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} and {parts[-1]}"
