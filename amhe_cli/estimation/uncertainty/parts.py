"""Do parts of the data want different values? Kinds of measurements, halves of the logs, and whole logs.

Noise makes parts disagree by chance, a wrong model by more. Each part gives an estimate of its own, with the
system's prior moved to the joint estimate, so that a part that says nothing agrees with all. Estimates are
compared by the formula of `core.agreement`. What chance does not explain is a random effect: parts scatter
about their mean, and so may whatever comes next. Of k parts that differ by d_ij beyond chance, the variance
is the sum over pairs of d_ij d_ij' / (k (k - 1)), where a part counts as far as it knows the difference, in
units of the joint posterior.
"""

from __future__ import annotations

import logging
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np

from amhe_cli.core.arrays import BoolArray, FloatArray, sealed
from amhe_cli.core.log import Log
from amhe_cli.estimation.core.agreement import beyond_chance, difference
from amhe_cli.estimation.core.information import Information, information
from amhe_cli.estimation.core.result import RunEstimate
from amhe_cli.estimation.offline import search
from amhe_cli.estimation.offline.problem import Problem
from amhe_cli.estimation.offline.search import SearchState
from amhe_cli.estimation.uncertainty.fit import LITTLE, FinalFit, Posterior, final_fit, posterior
from amhe_cli.estimation.uncertainty.ledger import Source, Term, size

logger = logging.getLogger(__name__)

#: Names of the halves.
HALVES = ("the first half of the logs", "the second half of the logs")
#: Iterations that each half gets to find its own estimate.
REFITS = 2
#: Clips that a part must have.
FEWEST_CLIPS = 3
#: From so many logs on, they are compared by halves and not each with each.
MANY = 10
#: What two parts know of a combination, as a share of what they know of the best known one, below which it is
#: rounding.
ROUNDING = 3e-5
#: Error of the estimate, in the sd of noise, from which a difference of the halves is reported as a drift.
DRIFTS = 0.5
#: Values that the report of a drift lists.
LISTED = 3

#: Parts of the data by their names, with what each says alone.
Parts = Mapping[str, Posterior]


def parts(fit: FinalFit, *, with_halves: bool, refitted: bool = True) -> Term:
    """Covariance between parts of the data beyond chance.

    Args:
        fit: The linearisation where the search ended.
        with_halves: Compare the halves of the logs, too.
        refitted: Each half has a search of its own, which takes some rollouts; else the linearisation speaks
            for it, too.
    """
    compared = [_kinds(fit), each_log(fit) or _later_logs(fit)]
    if with_halves:
        compared.append(_halves(fit, refitted))
    errors, sources = [], []
    for alone in compared:
        pairs = list(combinations(alone, 2))
        for one, other in pairs:
            apart, excess = _apart(alone[other], alone[one], fit, len(pairs))
            weight = _weight(alone, (one, other), excess, fit.posterior.covariance)
            if weight > 0.0:
                errors.append(weight * excess)
                sources.append(Source(f"{one} and {other}", apart=tuple(map(float, apart))))
    columns = np.array(errors).T if errors else np.zeros((len(fit.z), 0))
    return Term("parts", columns, tuple(sources))


def _apart(one: Posterior, other: Posterior, fit: FinalFit, pairs: int) -> tuple[FloatArray, FloatArray]:
    """Difference of two parts' estimates (d,), and what of it is no chance (d,).

    Parts cannot differ in what neither knows: there the estimate follows as the joint posterior says, so that
    a combination that other parts know stays as it is.
    """
    noise, pull, joint = (one.noise, other.noise), (one.pull, other.pull), fit.posterior.covariance
    apart, prior_error = one.step - other.step, sealed(np.linalg.inv(fit.posterior.prior))
    excess = beyond_chance(apart, difference(noise, pull, prior_error), pairs)
    # in units of the joint posterior, where no combination is small because it is well known
    lower = np.linalg.cholesky(joint)
    share = np.linalg.solve(lower, (np.eye(len(apart)) - 0.5 * (pull[0] + pull[1])) @ lower)
    follow = np.linalg.pinv(share, rcond=ROUNDING) @ share
    return apart, lower @ follow @ np.linalg.solve(lower, excess)


def _weight(alone: Parts, pair: tuple[str, str], excess: FloatArray, joint: FloatArray) -> float:
    """Weight of a pair in the scatter of k parts, sqrt(1 / k (k - 1)); a part counts as far as it knows.

    Args:
        alone: The parts.
        pair: Names of two of them.
        excess: Their difference beyond chance, shape (d,).
        joint: Covariance of the joint posterior, shape (d, d).
    """
    if not excess.any():
        return 0.0
    # in units of the joint posterior: in those of the prior, what is hardly known would outweigh all else
    shares, along = {}, np.linalg.solve(joint, excess)
    for name, part in alone.items():
        shares[name] = float(np.clip(1.0 - along @ part.pull @ excess / (along @ excess), 0.0, 1.0))
    count = max(sum(shares.values()), 2.0)
    both = shares[pair[0]] * shares[pair[1]]
    return float(np.sqrt(both / (count * (count - 1.0)))) if both > LITTLE**2 else 0.0


def _kinds(fit: FinalFit) -> Parts:
    """Posteriors from each kind of measurement alone, such as positions and velocities."""
    kinds = [o.channel.quantity.replace("_", " ") for o in fit.slopes.cost.clips.observed]
    if len(set(kinds)) < 2:
        return {}
    return {
        f"{kind} data": _alone(fit, information(fit.slopes, [k == kind for k in kinds]))
        for kind in dict.fromkeys(kinds)
    }


def _alone(fit: FinalFit, info: Information | None = None, side: BoolArray | float = 1.0) -> Posterior:
    """Posterior from a part of the linearisation; the prior's mean is the joint estimate."""
    return posterior(np.zeros_like(fit.z), info or fit.information, fit.weight * side, fit.posterior.prior)


def each_log(fit: FinalFit) -> dict[str, Posterior]:
    """Posterior from each log alone, by its name; none of a single log, or of many."""
    clips = fit.problem.clips
    sides = {
        log: np.array([clip.log is log for clip in clips]) for log in dict.fromkeys(c.log for c in clips)
    }
    sides = {log: side for log, side in sides.items() if side.sum() >= FEWEST_CLIPS}
    if not 2 <= len(sides) < MANY:
        return {}
    names = names_of(sides)
    return {names[log]: _alone(fit, side=side) for log, side in sides.items()}


def _later_logs(fit: FinalFit) -> Parts:
    """The earlier and the later half of many logs."""
    logs = [clip.log for clip in fit.problem.clips]
    order = {log: i for i, log in enumerate(dict.fromkeys(logs))}
    late = np.array([2 * order[log] >= len(order) > 1 for log in logs])
    if min(late.sum(), (~late).sum()) < FEWEST_CLIPS:
        return {}
    return {"the earlier logs": _alone(fit, side=~late), "the later logs": _alone(fit, side=late)}


def _halves(joint: FinalFit, refitted: bool) -> Parts:
    """The first and the second half of each log's fitted clips, by a joint fit, or a search of its own.

    Where halves differ much, the misfit of their compromise looks like noise, and would hide that they do. So
    would first states fitted to it: each is searched from the recorded ones.
    """
    problem, finding = joint.problem, joint.finding
    late = _second_half(problem)
    if min(late.sum(), (~late).sum()) < FEWEST_CLIPS:
        return {}
    if not refitted:
        return {name: _alone(joint, side=side) for name, side in zip(HALVES, (~late, late), strict=True)}
    straight = finding.shape if isinstance(finding, SearchState) and finding.straight else None
    halves = {}
    for name, rows in zip(HALVES, (np.flatnonzero(~late), np.flatnonzero(late)), strict=True):
        part, recorded = problem.part(rows), joint.slopes.first.of(rows).forgotten
        state = search.restart(part, finding.z, straight, recorded if part.non_smooth else None)
        for _ in range(REFITS - part.non_smooth):  # whose fit is a step of the search, too
            state = search.advance(part, state)
        fit = final_fit(part, state)
        away = fit.z - finding.z  # a search that has settled ends with a step of the fit
        alone = posterior(away, fit.information, fit.weight, fit.posterior.prior)
        halves[name] = replace(alone, step=away + alone.step)
    return halves


def _second_half(problem: Problem) -> BoolArray:
    """Mask of the clips in the second half of their log's."""
    late = np.zeros(len(problem.clips), dtype=bool)
    for log in dict.fromkeys(clip.log for clip in problem.clips):
        rows = np.array([i for i, clip in enumerate(problem.clips) if clip.log is log])
        starts = np.array([problem.clips[i].start for i in rows])
        late[rows[np.argsort(starts, kind="stable")[(len(rows) + 1) // 2 :]]] = True
    return late


def report_drift(fit: FinalFit, term: Term) -> None:
    """Warn of values that the halves of the logs want otherwise by more than noise leaves open."""
    for k, source in enumerate(term.sources):
        if source.name == " and ".join(HALVES):
            sizes = np.abs(term.errors[:, k]) / fit.posterior.sd
            drifting = [i for i in map(int, np.argsort(-sizes)) if sizes[i] > DRIFTS]
            wants = ", ".join(
                f"{fit.space.names[i]} {size(fit.space, i, source.apart[i])}" for i in drifting[:LISTED]
            )
            if wants:
                logger.warning(
                    f"values drift within the logs: their second half wants {wants} against the first: one "
                    f"constant value does not describe them"
                )


def estimates(fit: FinalFit) -> tuple[RunEstimate, ...]:
    """Value and sd of each parameter from each log alone, without those that it hardly knows."""
    runs, space = [], fit.space
    for name, part in each_log(fit).items():
        # from the system's own prior, as if the log were alone
        step = part.step - part.pull @ fit.z
        values = space.theta_of(space.clip(fit.z + step))
        sd = part.sd * space.prior_sd * np.where(space.log, values, 1.0)
        lines = zip(space.names, values.tolist(), sd.tolist(), part.informed, strict=True)
        runs.append(RunEstimate(name, {name: (value, s) for name, value, s, informed in lines if informed}))
    return tuple(runs)


def names_of(logs: Collection[Log]) -> dict[Log, str]:
    """Names of the logs' files, with what leads to them where some are alike."""
    short: Sequence[str] = [Path(log.source).name for log in logs]
    unique = len(set(short)) == len(short)
    numbered = [name if unique else log.source for name, log in zip(short, logs, strict=True)]
    if len(set(numbered)) < len(numbered):
        numbered = [f"{name} #{i + 1}" for i, name in enumerate(short)]
    return dict(zip(logs, numbered, strict=True))
