"""Where an estimate would move if what the model takes as exact were otherwise.

The residuals of a changed model, with the slopes of the model itself, give the estimate that it would have
led to. A change that the log contradicts, even with another estimate and other first states, counts only as
far as the log allows it: to where the misfit would have risen by SURPRISE squared.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from amhe_cli.core.arrays import FloatArray, sealed
from amhe_cli.core.each_log import owner_free
from amhe_cli.engine.open import contact_variants, finer_solver, finer_step
from amhe_cli.estimation.core.information import Information, gauss_newton_step, information, objective
from amhe_cli.estimation.offline.posterior import FinalFit, posterior
from amhe_cli.estimation.offline.problem import Problem
from amhe_cli.estimation.offline.verdicts import RESTS, SURPRISE, Shift
from amhe_cli.estimation.offline.widening import beyond_chance
from amhe_cli.matching.cost import MatchingCost, Residuals
from amhe_cli.matching.starts import differentiated
from amhe_cli.system.rulers import Acting, Ruler, acting, joined, rulers_of, with_rulers

logger = logging.getLogger(__name__)

#: Share of the misfit that a shorter time step must explain to be recommended.
EXPLAINS = 0.1
#: First change of a ruler, in its sd; where contacts jitter, it is all of the sd.
SMALL = 0.05
#: Factor on the sd of a first velocity that was differentiated, where rulers are judged.
BLIND = 10.0
#: Share of the misfit that one ruler explains from which another explains it as well.
AS_WELL = 0.5
#: Weight of a ruler in a combination from which it is named.
JOINED = 0.4
#: States of the rollouts that are examined for what acts in them, about.
EXAMINED = 1000


def shifts_of(problem: Problem, fit: FinalFit) -> tuple[list[Shift], tuple[str, ...]]:
    """Where the estimate would move under other contacts, a finer simulation, and other rulers.

    The second value has the names of the rulers that act and that the settings take as exact.
    """
    about, rulers = _Neighbourhood(fit, problem.system.space.loose_precision), _acting_rulers(problem, fit)
    open_ones = [ruler for ruler in rulers if ruler.sd > 0.0]
    exact = [ruler.name.partition(" along ")[0] for ruler in rulers if ruler.sd == 0.0]
    if problem.settings.identify.rulers.time_step == 0.0:
        exact.append("the time step")
    found = [*_contacts(problem, about), *_solver(problem, about), *_rulers(problem, about, open_ones)]
    return found, tuple(dict.fromkeys(exact))


def allowed(rise: float) -> float:
    """Share of a change of the model that raises the misfit by no more than SURPRISE squared.

    Misfit rises with the square of the change; where all of the change raises it by less, it is 1.
    """
    return SURPRISE / float(np.sqrt(max(rise, SURPRISE**2)))


@dataclass(frozen=True, slots=True, eq=False)
class _Move:
    """Where a change of the model moves the estimate.

    Args:
        z: The move, shape (d,).
        share: Share of the change that the log allows.
        rise: Rise of the misfit under all of the change, as a share of it.
        slope: What the change does to the residuals besides the move, shape (c, R); 0 where a clip diverged.
    """

    z: FloatArray
    share: float
    rise: float
    slope: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class _Neighbourhood:
    """The estimate, and the estimates that changed residuals lead to.

    Args:
        fit: The estimate.
        prior: Information of the prior that is no knowledge of the model, shape (d, d).
    """

    fit: FinalFit
    prior: FloatArray

    def residuals(self, cost: MatchingCost, step: FloatArray, first: FloatArray) -> Residuals:
        """Residuals after a step (d,) of the estimate, first states (c, nx) moved along."""
        z = cost.system.space.clip((self.fit.z + step)[None])
        return cost.residuals(z, first[None] if first.shape[1] else None)

    def misfit(self, cost: MatchingCost, residuals: Residuals, first: FloatArray) -> float:
        """Weighted squared residuals, and first-state errors (c, nx)."""
        return float(objective(cost, residuals, first[None], self.fit.times, self.fit.weight)[0])

    def moved(self, cost: MatchingCost) -> _Move:
        """Move of the estimate under the engine of `cost`, as far as the log allows it."""
        fit, slopes = self.fit, self.fit.slopes
        changed = self.residuals(cost, np.zeros_like(fit.z), slopes.first.mean)
        both = slopes.completed & changed.completed[0]
        residual = slopes.residual + changed.flat[0] - slopes.centre
        found = information(replace(slopes, residual=residual, completed=both))
        kept = (fit.found, fit.weight), (found, fit.weight * both)
        steps = [posterior(fit.z, *each, self.prior).step for each in kept]
        firsts = [one.first(step[None])[0] for one, step in zip((fit.found, found), steps, strict=True)]
        costs = slopes.cost, cost
        here, there = (self.residuals(*each) for each in zip(costs, steps, firsts, strict=True))
        least, most = (self.misfit(*each) for each in zip(costs, (here, there), firsts, strict=True))
        share, z = allowed(most - least), steps[1] - steps[0]
        gz, gx = np.split(slopes.gain, [len(z)], axis=1)
        along = np.einsum("d,cdr->cr", z, gz) + np.einsum("cx,cxr->cr", firsts[1] - firsts[0], gx)
        done = here.completed[0] & there.completed[0]
        slope = np.where(done[:, None], there.flat[0] - here.flat[0] - along, 0.0)
        return _Move(share * z, share, (most - least) / least, slope)

    def still(self) -> _Move:
        """The move under no change."""
        return _Move(np.zeros_like(self.fit.z), 1.0, 0.0, np.zeros_like(self.fit.slopes.residual))

    def beyond_sd(self, move: FloatArray) -> FloatArray:
        """The move (d,), or none where it stays within the sd of every parameter."""
        return move if (np.abs(move) > self.fit.posterior.sd).any() else np.zeros_like(move)


def _contacts(problem: Problem, about: _Neighbourhood) -> Iterator[Shift]:
    """Other contacts. Half of the move beyond chance counts as an sd: none of them is known to be right."""
    for name, engine in contact_variants(problem.engine, problem.system.unedited).items():
        move = about.moved(about.fit.slopes.cost.upon(engine))
        label = name if move.share == 1.0 else f"{name}, as far as the log allows it,"
        spread = 0.5 * beyond_chance(about.fit.posterior.covariance, move.z)
        yield Shift(f"{label} would move it by {{}}", move.z, spread)


def _solver(problem: Problem, about: _Neighbourhood) -> Iterator[Shift]:
    """A solver that goes on for longer."""
    option = problem.system.model.opt
    if (engine := finer_solver(problem.engine, problem.system.unedited)) is not None:
        move = about.moved(about.fit.slopes.cost.upon(engine))
        text = (
            f"it depends on the solver's {option.iterations} iterations: with more it would move by {{}}; "
            f"give the model more, and a smaller tolerance"
        )
        yield Shift(text, move.z, about.beyond_sd(move.z))


def _rulers(problem: Problem, about: _Neighbourhood, rulers: Sequence[Ruler]) -> Iterator[Shift]:
    """Numbers that the model takes as exact, each with what a data sheet is worth as its prior.

    As nuisances r ~ N(0, 1) beside z they have slopes, a posterior N(m, S) and a gain A: the estimate moves
    by A r. It was found at r = 0 and stays there, so that A (S + m m') A' is what they add to its covariance.
    The first of them is the way to a time step of zero: the world has no step, and a log that another program
    simulated may have the model's, which the settings can say. Of the others, each eigenvector of what
    S + m m' has besides is a shift: of rulers that the log knows only together, one.
    """
    half, order = finer_step(problem.engine, problem.system.unedited)
    # to a step of zero: an error of order n falls to 2^-n of itself
    way = problem.settings.identify.rulers.time_step / (1.0 - 0.5**order)
    halved = about.moved(about.fit.slopes.cost.at_half_steps(half)) if way else about.still()
    nuisances = _Nuisances(problem, about, rulers, way * halved.slope)
    found = nuisances.joint(nuisances.slopes(None))
    # samples that leave the ridge along which z follows a ruler would bend, and pass for information
    found = nuisances.joint(nuisances.slopes(found))
    known, mean, moves = nuisances.posterior(found)
    spread = known + np.outer(mean, mean)
    # where contacts jitter, a finer step is another draw of the jitter, of which the log says nothing
    towards = way * halved.z if problem.rough else moves @ spread[0] / np.sqrt(spread[0, 0])
    assumed = not problem.rough and abs(mean[0]) <= SURPRISE * np.sqrt(known[0, 0])
    if way:
        yield _step(problem, halved, about.beyond_sd(towards), assumed)
    surprising = np.abs(mean) > SURPRISE * np.sqrt(known.diagonal())
    wrong = [i for i in range(1, len(mean)) if surprising[i] and about.beyond_sd(mean[i] * moves[:, i]).any()]
    for text in _against(rulers, known, mean, [i - 1 for i in wrong]):
        logger.warning(text)
    moves, left = moves[:, 1:], _without_first(spread)
    values, vectors = np.linalg.eigh(left)
    for value, vector in zip(values, vectors.T, strict=True):
        move = np.sqrt(max(value, 0.0)) * (moves @ vector)
        together = [i for i in np.argsort(-np.abs(vector)) if abs(vector[i]) > JOINED]
        yield Shift(_rests([rulers[i] for i in together]), move, about.beyond_sd(move), assumed=True)


def _against(
    rulers: Sequence[Ruler], known: FloatArray, mean: FloatArray, wrong: Sequence[int]
) -> Iterator[str]:
    """What the logs speak against, and by how much it alone would be wrong, with what explains them as well.

    Args:
        rulers: The rulers.
        known, mean: Covariance (K, K) and mean (K,) of the step and the rulers.
        wrong: Which of the rulers the logs speak against.
    """
    precision = np.linalg.inv(known)
    score, own = (precision @ mean)[1:], precision.diagonal()[1:]
    worth = score**2 / own  # of the misfit, by each alone
    wanted = (score / np.maximum(own - 1.0, 1e-9)).tolist()  # what the logs want, whatever the data sheet
    named: set[int] = set()
    for i in sorted(wrong, key=lambda i: -worth[i]):
        if i in named:
            continue
        others = [j for j in np.argsort(-worth) if j != i and worth[j] > AS_WELL * worth[i]]
        named |= {i, *others}
        rivals = "".join(f", or {_times(wanted[j], rulers[j].change)} of {rulers[j].name}" for j in others)
        whose, one = ("them", "one of them") if others else ("it", "it")
        yield (
            f"the logs speak against {rulers[i].name}: they want {_times(wanted[i], rulers[i].change)} "
            f"({np.sqrt(worth[i]):.0f} sd){rivals}; measure {whose}, or make {one} a parameter; "
            f"something else that the model lacks, such as the zero of an encoder, may act alike"
        )


def _times(factor: float, change: str) -> str:
    """'+16%' is 1.6 times '10%'."""
    digits = re.match(r"[\d.]+", change)
    assert digits is not None, "a change begins with its size"
    return f"{factor * float(digits[0]):+.2g}{change[digits.end() :]}"


def _step(problem: Problem, halved: _Move, spread: FloatArray, assumed: bool) -> Shift:
    """The shift on the way to a step of zero, and a warning where half the step lowers the misfit."""
    step = 1000.0 * problem.system.model.opt.timestep
    half = f"{0.5 * step:g} ms"
    if halved.rise < -EXPLAINS:
        logger.warning(
            f"the time step is too long: at {half} the model explains {-halved.rise:.0%} of what it misses "
            f"of the logs; run it at {half}"
        )
    if assumed:
        text = f"{RESTS} the time step of {step:g} ms: a finer one leaves {{}} open"
        return Shift(text, spread, spread, assumed=True)
    text = f"it depends on the time step: at {half} it would move by {{}}; run the model at {half}"
    return Shift(text, halved.z, spread)


def _without_first(spread: FloatArray) -> FloatArray:
    """What a covariance (K, K) has besides the first unknown and all that goes with it, (K - 1, K - 1)."""
    return spread[1:, 1:] - np.outer(spread[1:, 0], spread[0, 1:]) / spread[0, 0]


class _Nuisances:
    """Further unknowns r beside z, in units of their sd: the time step, of known slope (c, R), and rulers."""

    def __init__(
        self, problem: Problem, about: _Neighbourhood, rulers: Sequence[Ruler], step: FloatArray
    ) -> None:
        self._fit, self._d, self._step = about.fit, len(about.fit.z), step[:, None]
        self._rulers, self._count = len(rulers), 1 + len(rulers)
        # the errors of these velocities have a common cause, and would pass for one of a ruler
        logs = {id(clip.log): clip.log for clip in problem.clips}.values()
        blind = np.any([differentiated(problem.system, log) for log in logs], axis=0)
        self._loose = np.where(blind, BLIND, 1.0)
        self._loose = self._loose[: about.fit.slopes.first.mean.shape[1]]
        system = with_rulers(problem.system, rulers)
        self._cost = about.fit.slopes.cost.upon(problem.engine.upon(system.model, system.edits), system)
        self._rough = problem.rough
        self._prior = np.eye(self._d + self._count)
        self._prior[: self._d, : self._d] = about.prior

    def slopes(self, follow: Information | None) -> FloatArray:
        """Slopes of the residuals by r, shape (c, K, R).

        Args:
            follow: Samples of r are accompanied by what z and the first states do along with it, according
                to this information on z and r; None: they are small, and alone.
        """
        fit, d, k = self._fit, self._d, self._rulers
        if not k:
            return self._step
        moves, turns = np.zeros((d, k)), np.zeros((*fit.slopes.first.mean.shape, k))
        if follow is not None:
            moves = self.posterior(follow)[2][:, 1:]
            gain = self._loose[:, None] * follow.nuisance_gain
            turns = gain[..., :d] @ moves + gain[..., d + 1 :]
        size = 1.0 if follow is not None or self._rough else SMALL
        steps = size * np.concatenate((np.eye(k), -np.eye(k)))
        z = np.concatenate((fit.z + steps @ moves.T, steps), axis=1)
        first = fit.slopes.first.mean + np.einsum("pk,cxk->pcx", steps, turns)
        residuals = self._cost.residuals(z, first if first.shape[2] else None)
        change = np.einsum("pk,pcr->ckr", steps, residuals.flat) / (2.0 * size**2)
        gz, gx = np.split(fit.slopes.gain, [d], axis=1)
        own = change - np.einsum("dk,cdr->ckr", moves, gz) - np.einsum("cxk,cxr->ckr", turns, gx)
        return np.concatenate((self._step, own), axis=1)

    def joint(self, slopes: FloatArray) -> Information:
        """Information of the clips on z and r together, from the slopes by r (c, K, R)."""
        own, d = self._fit.slopes, self._d
        gz, gx = np.split(own.gain, [d], axis=1)
        gain = np.concatenate((gz, slopes, self._loose[:, None] * gx), axis=1)
        first = replace(own.first, mean=own.first.mean / self._loose)
        return information(replace(own, gain=gain, first=first))

    def posterior(self, found: Information) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Covariance (K, K) and mean (K,) of r, and how z follows r (d, K)."""
        d, weight = self._d, self._fit.weight
        matrix = np.einsum("c,cij->ij", weight, found.matrix)
        score = np.einsum("c,ci->i", weight, found.score)
        away = np.concatenate((self._fit.z, np.zeros(self._count)))
        step, precision = gauss_newton_step(matrix, score, self._prior, away)
        moves = -sealed(np.linalg.solve(precision[:d, :d], precision[:d, d:]))
        return sealed(np.linalg.inv(precision)[d:, d:]), step[d:], moves


def _rests(rulers: Sequence[Ruler]) -> str:
    """'it rests on the force limit of servo3 (0.5), which acts in 12 % of the steps: ...'."""
    parts = []
    for ruler in rulers:
        acts = "" if ruler.acts is None else f", which acts in {100.0 * ruler.acts:.2g} % of the steps"
        parts.append(f"{ruler.name}{acts}")
    known = " and ".join(dict.fromkeys(ruler.change for ruler in rulers))
    return f"{RESTS} {', and '.join(parts)}: known to {known}, that leaves {{}} open"


def _acting(problem: Problem, fit: FinalFit) -> Acting:
    """What acts in the rollouts at the estimate."""
    system, cost, found = problem.system, fit.slopes.cost, []
    most = max(1, EXAMINED // len(cost.clips.windows))  # of each clip
    for done in cost.rolled_out(fit.z, fit.slopes.first.mean if fit.slopes.first.mean.size else None):
        inside = np.arange(done.inputs.shape[1] - 1) < (done.lengths * done.rollouts.completed)[:, None] - 1
        clips, rows = np.nonzero(inside)
        some = np.arange(0, len(rows), max(1, len(rows) // (most * len(done.lengths))))
        clips, rows = clips[some], rows[some]
        # row k of the states is the instant k + 1, when input k + 1 begins to act
        qpos, qvel = done.rollouts.qpos[clips, rows], done.rollouts.qvel[clips, rows]
        model = system.edits.apply(system.model, done.theta)
        found.append(acting(model, system.input_spec, qpos, qvel, done.inputs[clips, rows + 1]))
    return joined(found)


def _acting_rulers(problem: Problem, fit: FinalFit) -> list[Ruler]:
    """The rulers that act in the rollouts at the estimate."""
    names = problem.system.space.names
    felt = {owner_free(name) for name, active in zip(names, problem.active, strict=True) if active}
    largest = {
        o.channel.key: np.abs(o.measured[o.mask]).max(initial=0.0) for o in fit.slopes.cost.clips.observed
    }
    return rulers_of(problem.system, _acting(problem, fit), felt, largest)
