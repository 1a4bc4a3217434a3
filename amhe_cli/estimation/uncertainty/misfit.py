"""What the model does not explain: misfit beyond noise, clips that are left out, a search cut short."""

from __future__ import annotations

import logging

import numpy as np

from amhe_cli.core.each_log import owner_free
from amhe_cli.estimation.core.information import channel_times, split
from amhe_cli.estimation.offline.clips import clip_name
from amhe_cli.estimation.offline.problem import Problem
from amhe_cli.estimation.offline.search import SearchState
from amhe_cli.estimation.uncertainty.fit import FinalFit, Finding
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


def report_unsettled(problem: Problem, finding: Finding, fit: FinalFit) -> None:
    """Warn of a search that stopped on its way; on a rough cost the steps never get short."""
    space = problem.system.space
    left = np.abs(fit.left) / fit.posterior.sd
    moving = isinstance(finding, SearchState) and not (finding.settled or problem.rough)
    costs = [i.cost for i in finding.record if i.stage == "polish"][-STALLED:]
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
