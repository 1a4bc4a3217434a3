"""Misfit beyond noise, clips that are left out, a search cut short."""

from __future__ import annotations

import logging
from collections.abc import Sequence

import numpy as np

from amhe_cli.core.errors import and_more
from amhe_cli.estimation.core.agreement import SURPRISE
from amhe_cli.estimation.core.information import channel_times, split
from amhe_cli.estimation.core.result import Against, Iteration
from amhe_cli.estimation.offline.clips import clip_name
from amhe_cli.estimation.offline.problem import Problem
from amhe_cli.estimation.offline.search import ROUGHLY, SearchState
from amhe_cli.estimation.uncertainty.fit import FinalFit
from amhe_cli.matching.cost import MatchingCost, Residuals
from amhe_cli.matching.windows import Observed
from amhe_cli.system.description.data import PART
from amhe_cli.system.description.targets import gain_cells
from amhe_cli.system.parameters.edits import Cells
from amhe_cli.system.system import System

logger = logging.getLogger(__name__)

#: A next step of this many sd is a search cut short.
UNSETTLED = 2.0
#: A next step of this many sd is one, too, where the search was stopped on its way.
MOVING = 1.0
#: Last iterations that show whether the cost still falls.
STALLED = 3
#: Residuals of this many noise sd are asked what they lack.
ASKED = 2.0
#: Residuals of this many times the declared noise make every number the model's, unless they are white.
MISSED = 5.0
#: Residuals whose autocorrelation time is below so many samples are white: they are noise.
WHITE = 2.0
#: Things that a warning lists; of more, it gives the number.
LISTED = 3
#: Share of what a channel measured above which what is missed is no noise of a sensor.
NOISY = 0.1


def still_moving(fit: FinalFit) -> str:
    """The parameter that was still moving when the search stopped on its way; '' where it had settled.

    On a non-smooth cost the steps never get short.
    """
    finding, space = fit.finding, fit.space
    left = np.abs(fit.left) / fit.posterior.sd
    moving = isinstance(finding, SearchState) and not (finding.settled or fit.problem.non_smooth)
    fell = _fell(finding.record, fit.slopes.cost, fit.times)
    if fell is None:
        unsettled = moving or left.max() > UNSETTLED
    else:  # on the same clips: has the misfit fallen by more than one squared noise sd?
        unsettled = fell > 1.0 and left.max() > (MOVING if moving else UNSETTLED)
    return space.names[int(left.argmax())] if unsettled else ""


def _fell(record: Sequence[Iteration], cost: MatchingCost, times: Sequence[float]) -> float | None:
    """By how many squared noise sd the misfit has fallen in the last iterations; None: these were too few."""
    costs = [i.cost for i in record if i.stage == "polish"][-STALLED:]
    if len(costs) < STALLED:
        return None
    independent = float(cost.clips.counts.sum()) / max(times)
    noise = costs[-1] if cost.times is None else np.mean(np.square([*cost.noise_scale.values()]))
    return float((costs[0] - costs[-1]) / max(noise, 1e-300) * independent)


def stalled(problem: Problem, state: SearchState) -> bool:
    """Whether the last steps of a search have gained nothing, long as they were.

    Of one that may end with a step of so many sd, they have gained no more than such a step would.
    """
    if state.first is None or state.number < ROUGHLY + STALLED or problem.system.match == "effort":
        return False  # it has not seen all clips so often; efforts take no time, and their slopes hold
    cost = problem.cost(problem.clips, state.scale)
    if cost.times is None:
        residuals = cost.residuals(state.z[None], state.first.mean[None] if cost.nx else None)
        times = channel_times(cost, residuals.flat[0], residuals.completed[0])
    else:  # of a known noise, which takes no rollouts
        times = tuple(cost.times.values())
    fell = _fell(state.record, cost, times)
    return fell is not None and fell <= max(1.0, problem.enough or 0.0) ** 2


def report_misfit(fit: FinalFit) -> None:
    """Warn of channels that the model does not explain."""
    for key, (scale, white) in misfits(fit).items():
        if scale > SURPRISE:
            wrong = "" if white else f"{_remedy(fit.problem.system, key)}; or "
            logger.warning(
                f"the model misses {key} by {scale:.1f} times its declared noise: {wrong}"
                f"the noise is declared too small"
            )


def unexplained(fit: FinalFit) -> tuple[Against, ...]:
    """Channels that the model misses by so much that no value can be believed, and what to do.

    Residuals that are large but independent are noise, however little was declared.
    """
    texts, system = [], fit.problem.system
    noise = {o.channel.key: float(np.mean(o.noise)) for o in fit.slopes.cost.clips.observed}
    moved = {each.channel.key: _scatter(each) for each in fit.slopes.cost.clips.observed}
    for key, (scale, white) in sorted(misfits(fit).items(), key=lambda item: -item[1][0]):
        if scale > MISSED and not white:
            text = f"the model misses {key} by {scale:.0f} times its noise: {_remedy(system, key)}"
            missed, (signal, quantity) = noise[key], key.partition(PART)[0].rsplit(".", 1)
            declared = f"`signals.{signal}.noise.{quantity}={missed:.2g}`"
            advice = f"; if it cannot be better, declare what it misses: {declared}"
            texts.append(Against("misfit", text + advice * (missed < NOISY * moved[key])))
    return tuple(texts)


def _scatter(observed: Observed) -> float:
    """Sd of what one channel measured [SI]."""
    values = observed.measured[observed.mask]
    return float(np.sqrt(values.var(axis=0).mean()))


def blamed(fit: FinalFit) -> dict[str, tuple[str, ...]]:
    """Where the model misses the logs: parameters that several joints share, and what to do about each."""
    missed = [(scale, key) for key, (scale, white) in misfits(fit).items() if scale > SURPRISE and not white]
    if not missed:
        return {}
    scale, key = max(missed)
    joints = shared_by_joints(fit.problem.system)
    return {
        p.name: (
            f"it is one value of {joints[p.of_model]} joints, and the model misses {key} by {scale:.1f} "
            f"times its noise: give each joint its own",
        )
        for p in fit.space.parameters
        if p.of_model in joints
    }


def left_out(fit: FinalFit) -> tuple[Against, ...]:
    """Clips that `cost.trim` leaves out and that contradict the values: the others may agree on a wrong one.

    Such a clip is missed by MISSED times the noise that the others show, and not by noise of its own.
    """
    cost, misses = fit.slopes.cost, []
    values = split(cost, fit.information.residual)
    losses = cost.losses(Residuals(tuple(v[None] for v in values), fit.slopes.completed[None]))
    for i in np.flatnonzero((fit.weight == 0.0) & fit.slopes.completed):
        times = channel_times(cost, fit.information.residual, np.arange(len(fit.weight)) == i)
        for observed, loss, time in zip(cost.clips.observed, losses, times, strict=True):
            count = max(int(observed.mask[i].sum()), 1) * observed.width
            missed = float(np.sqrt(loss[0, i] / count))
            if missed > MISSED and time >= WHITE:
                misses.append((missed, observed.channel.key, clip_name(cost.clips.windows[i])))
    if not misses:
        return ()
    missed, key, clip = max(misses)
    others = len({clip for _, _, clip in misses}) - 1
    more = f" (and so {others} more)" if others else ""
    text = (
        f"the model misses {key} of {clip} by {missed:.0f} times the noise of other clips{more}, and "
        f"`cost.trim` leaves it out: if nothing else happened there, the others agree on wrong values"
    )
    return (Against("left out", text),)


def misfits(fit: FinalFit) -> dict[str, tuple[float, bool]]:
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


def _remedy(system: System, key: str) -> str:
    """Advice on a channel that the model misses; causes that nothing tested are not named."""
    held = held_fixed(system, key)
    if not held:
        return "free what it may lack"
    return f"free what it may have wrong; now fixed are {and_more(held, LISTED)}"


def held_fixed(system: System, key: str) -> list[str]:
    """Fixed numbers that may be wrong where a system misses a channel, in the order to look at them."""
    key = key.partition(PART)[0]
    held, reading = _of_drives(system), system.calibration.readings.get(key)
    if key.endswith(".effort") and not (reading and system.edits.calibrated & set(reading.scale)):
        held.insert(0, f"the scale of {key}, read as forces and torques")
    held += [f"{name} at {value:.4g}" for name, value in system.fixed.items()]
    held += [f"{name} as one value of {count} joints" for name, count in shared_by_joints(system).items()]
    return [*held, *(["the commands' delay"] if system.edits.prompt else [])]


def _of_drives(system: System) -> list[str]:
    """Gains, force limits and filters that no parameter sets; of actuators of the file that act."""
    model, held = system.unedited, []
    taken = {(cells.field, cells.row) for _, each in system.edits.by_parameter() for cells in each}
    names = {row: model.actuator(row).name for row in range(model.nactuator)}
    acts = model.actuator_gainprm.any(axis=1)
    rows = [row for row, name in names.items() if acts[row] and name and not name.startswith("amhe/")]
    limited, filtered = (np.flatnonzero(x) for x in (model.actuator_forcelimited, model.actuator_dyntype))
    for what, cells in (
        ("gain", [cell for row in rows for cell in gain_cells(model, row)[:1]]),
        ("force limit", [Cells("actuator_forcerange", row) for row in rows if row in limited]),
        ("filter", [Cells("actuator_dynprm", row) for row in rows if row in filtered]),
    ):
        free = [names[cell.row] for cell in cells if (cell.field, cell.row) not in taken]
        if free:
            held.append(f"the {what} of {free[0] if len(free) == 1 else f'{len(free)} actuators'}")
    return held
