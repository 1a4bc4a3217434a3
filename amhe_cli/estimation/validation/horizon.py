"""How far a prediction is off after a while: errors of each joint or pose at growing horizons.

A prediction starts from a recorded state and follows the recorded commands, as a user's would. Its error at a
horizon is the rms over the last tenth of it, so that one sample's noise does not decide.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from amhe_cli.core.arrays import BoolArray, FloatArray, to_host
from amhe_cli.core.log import Window
from amhe_cli.engine.rollout import Engine
from amhe_cli.estimation.core.result import HorizonError
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
_LENGTHS = ("rad", "m", "rad or m")


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
    found = []
    places, longest = np.stack((np.zeros_like(z), z)), max(part.duration for part in stretches(windows))
    for horizon in (*(h for h in HORIZONS if h < longest), np.inf):
        if not (clips := starts(problem.system, windows, horizon)):
            continue
        for one in clip_errors(problem.cost(clips), places):
            initial, identified = (_rms(errors) for errors in one.errors)
            found.append(
                HorizonError(
                    channel=one.channel,
                    column=one.column,
                    unit=one.unit,
                    horizon=min(horizon, max(clip.duration for clip in clips)),
                    to_end=horizon == np.inf,
                    clips=len(clips),
                    moved=_rms(one.moved),
                    initial=initial,
                    identified=identified,
                )
            )
    return tuple(found)


def errors_of(system: System, windows: Sequence[Window], engine: Engine, z: FloatArray) -> list[ClipErrors]:
    """Errors of one candidate z (d,) of a system at the end of each window."""
    return list(clip_errors(MatchingCost(system, windows, engine, system.settings.cost), z[None]))


def clip_errors(cost: MatchingCost, z: FloatArray) -> Iterator[ClipErrors]:
    """Errors of candidates z (p, d) at each clip's end: poses and joints, or all channels if none is one."""
    residuals = cost.residuals(z)
    placed = [one.channel.unit in _LENGTHS for one in cost.clips.observed]
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
            own = (
                np.full(len(lengths), np.nan)
                if turned
                else _rms_of(np.linalg.norm(moved[..., columns], axis=-1), late)
            )
            yield ClipErrors(observed.channel.key, name, unit, errors, own)


def _columns(cost: MatchingCost, observed: Observed) -> Iterator[tuple[str, str, list[int]]]:
    """Name, unit and residuals of each joint; of a pose all together."""
    channel, width = observed.channel, observed.width
    if channel.kind == "rotation" or (channel.unit == "m" and width == 3):
        yield "", channel.unit, list(range(width))
        return
    names = cost.clips.windows[0].log[channel.key].columns
    if channel.source != "qpos":
        for i, name in enumerate(names):
            yield (str(name) if width > 1 else ""), channel.unit, [i]
        return
    for i in np.argsort(channel.columns[: len(names)], kind="stable").tolist():  # the model's order of joints
        joint, unit = joint_of(cost.system.model, channel.columns[i])
        yield joint or str(names[i]), unit, [i]


def _rms_of(size: FloatArray, inside: BoolArray) -> FloatArray:
    """Rms over the samples of each clip that are inside, (c,); NaN where none is."""
    count = inside.sum(axis=1)
    total = np.where(inside, size**2, 0.0).sum(axis=1)
    return np.where(count > 0, np.sqrt(total / np.maximum(count, 1)), np.nan)


def _rms(values: FloatArray) -> float:
    known = values[~np.isnan(values)]
    return float(np.sqrt(np.mean(known**2))) if known.size else float("nan")
