"""Checks of an estimate: do parts of the data, or other models of contact, lead to another one?

Noise makes parts of a log disagree by chance. A wrong model makes them disagree by more.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from amhe_cli.core.arrays import BoolArray
from amhe_cli.core.each_log import acting, owner_free
from amhe_cli.core.log import Window
from amhe_cli.core.parameters import ParameterSpace
from amhe_cli.core.statistics import among
from amhe_cli.estimation.core.information import channel_times, split
from amhe_cli.estimation.offline import search
from amhe_cli.estimation.offline.fits import clip_name
from amhe_cli.estimation.offline.posterior import (
    Disagreement,
    FinalFit,
    Finding,
    by_kind,
    disagreement,
    final_fit,
    posterior,
)
from amhe_cli.estimation.offline.problem import Problem
from amhe_cli.estimation.offline.runs import names_of
from amhe_cli.estimation.offline.search import SearchState
from amhe_cli.estimation.offline.verdicts import NOTED, SURPRISE, share, size
from amhe_cli.matching.cost import Residuals
from amhe_cli.system.system import System

logger = logging.getLogger(__name__)

#: A next step of this many sd is a search cut short, and of this many where it was stopped on its way.
UNSETTLED, MOVING = 2.0, 1.0
#: Last iterations that show whether the cost still falls.
STALLED = 3
#: Residuals of this many noise sd are a wrong model.
MISFIT = 3.0
#: Residuals of this many times the declared noise make every number the model's, unless they are noise:
#: their autocorrelation time is below so many samples.
MISSED, WHITE = 5.0, 2.0
HALVES = "the first and second half of the logs"
#: Logs from which halves that disagree do so again and again: no value drifts alike in all of them.
AGAIN = 3
#: Iterations that each half gets to find its own estimate, and the clips that it must have.
REFITS, FEWEST_CLIPS = 2, 3


def disagreements(
    problem: Problem, finding: Finding, fit: FinalFit, *, with_halves: bool
) -> dict[str, Disagreement]:
    """Estimates from one part of the data against another: under a right model they agree."""
    prior = problem.system.space.prior_precision
    kinds = [_kind(o.channel.key) for o in fit.slopes.cost.clips.observed]
    alone = by_kind(finding.z, fit.slopes, fit.weight, prior, kinds)
    names = list(alone)
    compared = {
        f"{one} and {other} data": disagreement(alone[one], alone[other])
        for i, one in enumerate(names)
        for other in names[i + 1 :]
    }
    if with_halves and (parts := _halves(problem, finding)) is not None:
        compared[HALVES] = parts
    logs = _later_logs(problem.clips)
    if _both(logs):
        earlier, later = (posterior(finding.z, fit.found, fit.weight * side, prior) for side in (~logs, logs))
        found = disagreement(later, earlier)
        on_both = _acting(problem, ~logs) & _acting(problem, logs)
        pair = list(names_of(dict.fromkeys(clip.log for clip in problem.clips)).values())
        key = " and ".join(pair) if len(pair) == 2 else "the earlier and the later logs"
        compared[key] = replace(found, value=found.value * on_both)
    return compared


def _acting(problem: Problem, side: BoolArray) -> BoolArray:
    """Which unknowns have an effect on some of the clips, shape (d,)."""
    space, model = problem.system.space, problem.system.edits.space
    logs = {id(clip.log): clip.log for clip, on in zip(problem.clips, side, strict=True) if on}
    return np.any([acting(log, model, space) for log in logs.values()], axis=0)


def _halves(problem: Problem, finding: Finding) -> Disagreement | None:
    """What the second half of the logs wants more than the first.

    Each half is searched by itself, from the recorded first states: where they differ much, the misfit of
    their compromise looks like noise, and would hide that they do. So would first states fitted to it.
    """
    late = np.array([w.start + 0.5 * w.length > 0.5 * (w.log.steps - 1) for w in problem.clips])
    if not _both(late):
        return None
    straight = finding.shape if isinstance(finding, SearchState) and finding.straight else None
    means, covariances = [], []
    for rows in (np.flatnonzero(late), np.flatnonzero(~late)):
        part = problem.part(rows)
        state = search.restart(part, finding.z, straight)
        for _ in range(REFITS):
            state = search.advance(part, state)
        found = final_fit(part, state).posterior
        means.append(state.z + found.step)
        covariances.append(found.data_covariance)
    logs = len({id(w.log) for w in problem.clips})
    share = 1.0 if logs >= AGAIN else 0.5
    return Disagreement(means[0] - means[1], covariances[0] + covariances[1], share)


def _both(side: BoolArray) -> bool:
    """Enough clips on either side to compare them."""
    return min(side.sum(), (~side).sum()) >= FEWEST_CLIPS


def _later_logs(clips: Sequence[Window]) -> BoolArray:
    """Which clips are of the second half of the logs; none where there is one log."""
    order = {log: i for i, log in enumerate(dict.fromkeys(id(w.log) for w in clips))}
    return np.array([2 * order[id(w.log)] >= len(order) > 1 for w in clips])


def report_unsettled(problem: Problem, finding: Finding, fit: FinalFit) -> None:
    """Warn of a search that stopped on its way; on a rough cost the steps never get short."""
    space = problem.system.space
    left = np.abs(fit.left) / fit.posterior.sd
    moving = isinstance(finding, SearchState) and not (finding.settled or problem.rough)
    costs = [i.cost for i in finding.record if i.method.endswith("polish")][-STALLED:]
    if len(costs) < STALLED:
        unsettled = moving or left.max() > UNSETTLED
    else:  # on the same clips: has the misfit fallen by more than one squared noise sd?
        independent = float(fit.slopes.cost.clips.counts.sum()) / max(fit.times)
        falls = (costs[0] / max(costs[-1], 1e-300) - 1.0) * independent > 1.0
        unsettled = falls and left.max() > (MOVING if moving else UNSETTLED)
    if unsettled:
        logger.warning(
            f"the search stopped before it settled ({space.names[int(left.argmax())]} was still moving): "
            f"give it more with `identify.iterations`"
        )


def report_misfit(system: System, fit: FinalFit) -> None:
    """Warn of channels that the model does not explain."""
    for key, (scale, white) in _misfits(fit).items():
        if scale > MISFIT:
            missing = f"something is missing in it ({', '.join(suspects(system, key))}), or "
            logger.warning(
                f"the model misses {key} by {scale:.1f} times its declared noise: {missing * (not white)}"
                f"the noise is declared too small"
            )


def unexplained(system: System, fit: FinalFit) -> tuple[str, ...]:
    """Channels that the model misses by so much that no value can be believed, and what to do.

    Residuals that are large but independent are noise, however little was declared.
    """
    found = []
    noise = {channel.key: channel.noise or 0.0 for channel in system.channels}
    for key, (scale, white) in sorted(_misfits(fit).items(), key=lambda item: -item[1][0]):
        if scale > MISSED and not white:
            quantity = key.rsplit(".", 1)[1]
            found.append(
                f"the model misses {key} by {scale:.0f} times its noise: free what it may lack "
                f"({', '.join(suspects(system, key))}); if it cannot be better, declare what it misses, "
                f"noise: {{{quantity}: {scale * noise[key]:.2g}}}"
            )
    return tuple(found)


def blamed(system: System, fit: FinalFit) -> dict[str, tuple[str, ...]]:
    """Where the model misses the logs: parameters that several joints share, and what to do about each."""
    missed = [(scale, key) for key, (scale, white) in _misfits(fit).items() if scale > MISFIT and not white]
    if not missed:
        return {}
    scale, key = max(missed)
    joints, named = shared_by_joints(system), [(name, owner_free(name)) for name in system.space.names]
    return {
        name: (
            f"it is one value of {joints[own]} joints, and the model misses {key} by {scale:.1f} times its "
            f"noise: give each joint its own",
        )
        for name, own in named
        if own in joints
    }


def left_out(fit: FinalFit) -> tuple[str, ...]:
    """Clips that `cost.trim` leaves out and that contradict the values: the others may agree on a wrong one.

    Such a clip is missed by MISSED times the noise that the others show, and not by noise of its own.
    """
    cost, found = fit.slopes.cost, []
    values = split(cost, fit.found.residual)
    losses = cost.losses(Residuals(tuple(v[None] for v in values), fit.slopes.completed[None]))
    for i in np.flatnonzero((fit.weight == 0.0) & fit.slopes.completed):
        times = channel_times(cost, fit.found.residual, np.arange(len(fit.weight)) == i)
        for observed, loss, time in zip(cost.clips.observed, losses, times, strict=True):
            count = max(int(observed.mask[i].sum()), 1) * observed.width
            missed = float(np.sqrt(loss[0, i] / count))
            if missed > MISSED and time >= WHITE:
                found.append((missed, observed.channel.key, clip_name(cost.clips.windows[i])))
    if not found:
        return ()
    missed, key, clip = max(found)
    others = len({clip for _, _, clip in found}) - 1
    more = f" (and so {others} more)" if others else ""
    return (
        f"the model misses {key} of {clip} by {missed:.0f} times the noise of other clips{more}, and "
        f"`cost.trim` leaves it out: if nothing else happened there, the others agree on wrong values",
    )


def _misfits(fit: FinalFit) -> dict[str, tuple[float, bool]]:
    """For each channel, residual sd over declared noise, and whether the residuals are white."""
    keys = [observed.channel.key for observed in fit.slopes.cost.clips.observed]
    return {key: (fit.scale.get(key, 1.0), time < WHITE) for key, time in zip(keys, fit.times, strict=True)}


def shared_by_joints(system: System) -> dict[str, int]:
    """Parameters that set a number of several joints -> of how many."""
    rows = {
        p.name: {c.row for c in cells if c.field.startswith("dof_")}
        for p, cells in system.edits.by_parameter()
    }
    return {name: len(each) for name, each in rows.items() if len(each) > 1}


def suspects(system: System, key: str) -> list[str]:
    """What a model that misses a channel may lack, the likeliest first, without what is a parameter."""
    set_by, shared = system.edits.by_parameter(), shared_by_joints(system)
    found = [f"values of their own for the joints that share {' and '.join(shared)}"] if shared else []
    reading = system.calibration.readings.get(key)
    if key.endswith(".effort") and not (reading and system.calibration.set_rows & set(reading.scale)):
        found.append("a scale of the column, if it holds currents or another unit")
    if not system.edits.late:
        found.append("a delay")
    if all(c.field != "actuator_gainprm" for _, cells in set_by for c in cells):
        found.append("a gain")
    return [*found, "play", "a contact"]


def report_drift(space: ParameterSpace, disagreements: Mapping[str, Disagreement]) -> None:
    """Warn where the logs' first and second half want different parameters."""
    if HALVES not in disagreements:
        return
    difference, sd = disagreements[HALVES].value, disagreements[HALVES].sd
    limit = among(int(np.count_nonzero(difference)), SURPRISE)  # one of 50 is beyond 3 sd in every 8th log
    for i in map(int, np.flatnonzero(np.abs(difference) > limit * sd)):
        if share(space, i, difference[i]) >= NOTED:
            logger.warning(
                f"{space.names[i]} drifts within the logs: their second half wants "
                f"{size(space, i, difference[i])} against the first ({abs(difference[i]) / sd[i]:.1f} sd): "
                f"one constant value does not describe them"
            )


def _kind(key: str) -> str:
    return key.rsplit(".", 1)[1].replace("_", " ")
