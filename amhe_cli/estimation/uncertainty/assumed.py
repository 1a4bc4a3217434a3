"""Sensitivity of estimates to numbers that a model takes for granted: contacts, solver, time step, others.

Each is a nuisance r ~ N(0, 1) beside z, and a row of one regression: with slopes by r, the log gives r a
posterior N(m, S), and the estimate moves by A r. It was found at r = 0 and stays there, so that its error is

    A (S + m m') A'

A number that the log itself determines costs nothing where it was right, and its whole error where it was
wrong. One that no log can determine costs what its data sheet leaves open. The symmetric root of S + m m'
says what each number adds.

Where contacts jitter, other contacts, another solver or a finer step are another draw of the jitter, of which
no regression says anything. There the move of the estimate counts beyond what a draw of jitter moves it, as
far as the log allows it: to where the misfit would have risen by SURPRISE squared.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from amhe_cli.core.arrays import FloatArray, IntArray, sealed
from amhe_cli.core.statistics import root
from amhe_cli.engine.open import contact_variants, finer_solver, finer_step
from amhe_cli.estimation.core.agreement import SURPRISE
from amhe_cli.estimation.core.information import (
    Information,
    gauss_newton_step,
    information,
    objective,
    of_jitter,
)
from amhe_cli.estimation.uncertainty.fit import FinalFit, posterior
from amhe_cli.estimation.uncertainty.ledger import Source, Term
from amhe_cli.matching.cost import MatchingCost, Residuals
from amhe_cli.matching.starts import differentiated
from amhe_cli.system.assumed import Acting, Assumed, acting, assumed_of, joined, with_assumed

logger = logging.getLogger(__name__)

#: Share of the misfit that a shorter time step must explain to be recommended.
EXPLAINS = 0.1
#: First change of numbers, in their sd; where contacts jitter, it is all of the sd.
SMALL = 0.05
#: Samples along the axes of a posterior, in its sd: ridges bend from 0.4 on, and seven digits want long ones.
ALONG = 0.2
#: Most turns of these, and the growth of a variance that calls for one more.
TURNS, GROWN = 4, 1.2
#: Error of the estimate, in its sd, below which a number has no say in it.
FELT = 0.03
#: The same where contacts jitter.
FELT_IN_JITTER = 0.3
#: Factor on the sd of a first velocity that was differentiated, where assumed values are judged.
BLIND = 10.0
#: Step of a number, in its sd, beyond which the slopes of one sd say little.
FAR = 1.0
#: Share of the misfit that one number explains from which another explains it as well.
AS_WELL = 0.5
#: Share of the largest variance below which a direction is rounding.
RANK = 1e-6
#: Pairs of samples over which a change is averaged where contacts jitter.
PAIRS = 4
#: States of the rollouts that are examined for what acts in them, about.
EXAMINED = 1000


def assumed(fit: FinalFit) -> tuple[Term, tuple[str, ...]]:
    """Error due to assumed values, and the settings of those that act and are taken as exact."""
    problem, values = fit.problem, _acting_values(fit)
    exact = [value.setting for value in values if value.sd == 0.0]
    if problem.settings.identify.assumed.time_step == 0.0:
        exact.append("time_step")
    changes = list(_changes(fit))
    values = [v for v in values if v.sd > 0.0]
    # of jitter no regression says anything: the whole move counts
    moves, known = (changes, []) if problem.non_smooth else ([], changes)
    term = _regressed(fit, known, values)
    errors = np.concatenate((*(change.error[:, None] for change in moves), term.errors), axis=1)
    sources = (*(change.source for change in moves), *term.sources)
    return replace(term, errors=errors, sources=sources), tuple(dict.fromkeys(exact))


def allowed(rise: float) -> float:
    """Share of a change of the model that raises the misfit by no more than SURPRISE squared.

    Misfit rises with the square of the change; where all of the change raises it by less, it is 1.
    """
    return SURPRISE / float(np.sqrt(max(rise, SURPRISE**2)))


# -- other contacts, another solver, a finer step ------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class _Change:
    """Effect of one standard deviation of a numerical choice.

    Args:
        source: The choice.
        z: The move of the estimate, shape (d,).
        slope: The change of the residuals besides the move, shape (c, R); 0 where a clip diverged.
        rise: By how much the misfit rises.
    """

    source: Source
    z: FloatArray
    slope: FloatArray
    rise: float = 0.0

    def times(self, factor: float, source: Source) -> _Change:
        """A multiple of it, with another name."""
        return _Change(source, factor * self.z, factor * self.slope, factor**2 * self.rise)

    @property
    def error(self) -> FloatArray:
        """The move, as far as the log allows it, shape (d,)."""
        return allowed(self.rise) * self.z


def _changed(fit: FinalFit, cost: MatchingCost) -> tuple[_Change, float]:
    """Effect of another engine on an estimate, and the share by which the misfit rises."""
    slopes = fit.slopes

    def after(cost: MatchingCost, step: FloatArray, first: FloatArray) -> tuple[Residuals, float]:
        """Residuals after a step (d,) of the estimate, first states (c, nx) moved along; and the misfit."""
        z = fit.space.clip((fit.z + step)[None])
        residuals = cost.residuals(z, first[None] if first.shape[1] else None)
        return residuals, float(objective(cost, residuals, first[None], fit.times, fit.weight)[0])

    there = cost.residuals(*_samples(fit))
    both = slopes.completed & there.completed.all(axis=0)
    info = information(replace(slopes, residual=there.flat.mean(axis=0), completed=both))
    pairs = (fit.information, fit.weight), (info, fit.weight * both)
    steps = [posterior(fit.z, *pair, fit.space.loose_precision).step for pair in pairs]
    firsts = [one.first(step[None])[0] for (one, _), step in zip(pairs, steps, strict=True)]
    (here, least), (there, most) = map(after, (slopes.cost, cost), steps, firsts)
    z = steps[1] - steps[0]
    if fit.problem.non_smooth:
        z = _beyond_jitter(fit, z)
    gz, gx = np.split(slopes.gain, [len(z)], axis=1)
    along = np.einsum("d,cdr->cr", z, gz) + np.einsum("cx,cxr->cr", firsts[1] - firsts[0], gx)
    done = here.completed[0] & there.completed[0]
    slope = np.where(done[:, None], there.flat[0] - here.flat[0] - along, 0.0)
    return _Change(Source(""), z, slope, most - least), (most - least) / max(least, 1e-300)


def _samples(fit: FinalFit) -> tuple[FloatArray, FloatArray | None]:
    """Places z (p, d) and first states (p, c, nx) at which a change is seen; where contacts jitter, some."""
    z, first = fit.z, fit.slopes.first
    w = np.zeros((1, z.size + first.shape.shape[2]))
    if fit.problem.non_smooth:
        w = fit.problem.rng(10).choice([-1.0, 1.0], (PAIRS, w.size))
        w = np.concatenate((w, -w))
    errors = first.mean + np.einsum("cij,pj->pci", first.shape, w[:, z.size :])
    return fit.space.clip(z + w[:, : z.size] @ fit.shape.T), errors if first.mean.shape[1] else None


def _beyond_jitter(fit: FinalFit, z: FloatArray) -> FloatArray:
    """What of the move (d,) of an estimate between means of some rollouts is no draw of their jitter.

    Jitter counts in the noise already. Of the move's square, in units of the covariance that it gives to the
    difference of such means, chance makes the rank (James and Stein 1961).
    """
    jitter = np.einsum("c,cij->ij", fit.weight, of_jitter(fit.slopes, fit.information))
    jitter = jitter * (1.0 / PAIRS + 1.0 / len(fit.slopes.pairs))
    covariance = fit.posterior.inverse @ jitter @ fit.posterior.inverse
    distance = float(z @ np.linalg.pinv(covariance, rcond=RANK, hermitian=True) @ z)
    chance = np.linalg.matrix_rank(covariance, tol=RANK * np.linalg.norm(covariance, 2), hermitian=True)
    return z * np.sqrt(max(1.0 - chance / max(distance, 1e-300), 0.0))


def _changes(fit: FinalFit) -> Iterator[_Change]:
    """Numerical choices of the model, each by one standard deviation."""
    problem, cost = fit.problem, fit.slopes.cost
    settings = problem.settings.identify.assumed
    if problem.system.match == "effort":
        return  # nothing is integrated, and nothing touches
    soft = settings.contacts and problem.touches
    variants = contact_variants(problem.engine, problem.system.unedited) if soft else {}
    softness = Source("the softness of contacts", amount=2.0**settings.contacts, unit="times")
    for engine in variants.values():  # a factor of two to either side: each has half of the variance
        yield _changed(fit, cost.upon(engine))[0].times(settings.contacts / np.sqrt(2.0), softness)
    option = problem.system.model.opt
    finer = finer_solver(problem.engine, problem.system.unedited) if settings.solver else None
    if finer is not None:
        source = Source("the solver", f"{option.iterations} iterations")
        yield _changed(fit, cost.upon(finer))[0].times(settings.solver, source)
    if settings.time_step:
        half_step, order = finer_step(problem.engine, problem.system.unedited)
        change, rise = _changed(fit, cost.at_half_steps(half_step))
        step = 1000.0 * option.timestep
        if rise < -EXPLAINS:
            logger.warning(
                f"the time step is too long: at {0.5 * step:g} ms the model explains {-100 * rise:.0f} % of "
                f"what it misses of the logs; run it at {0.5 * step:g} ms"
            )
        # to a step of zero: an error of order n falls to 2^-n of itself
        yield change.times(settings.time_step / (1.0 - 0.5**order), Source("the time step", f"{step:g} ms"))


# -- the regression ------------------------------------------------------------------------------------------


def _regressed(fit: FinalFit, changes: Sequence[_Change], values: Sequence[Assumed]) -> Term:
    """A (S + m m') A' of choices, whose slopes are known, and of numbers of the model."""
    if not changes and not values:
        return Term("assumed", np.zeros((len(fit.z), 0)), shared=True)
    nuisances = _Nuisances(fit, changes, values)
    nuisances = nuisances.only(nuisances.felt())
    if nuisances.values:
        nuisances = nuisances.followed()
        if np.abs(nuisances.posterior[1]).max() > FAR:
            # a step from a fit that they bias ends where the residuals are others
            nuisances = nuisances.moved()
    known, mean, moves = nuisances.posterior
    spread = known + np.outer(mean, mean)
    doubted = np.abs(mean) > SURPRISE * np.sqrt(known.diagonal())
    errors = moves @ root(spread)
    sd = fit.posterior.sd
    wrong = np.array([(np.abs(mean[k] * moves[:, k]) > sd).any() for k in range(len(mean))], dtype=bool)
    sources = [replace(source, doubted=bool(d)) for source, d in zip(nuisances.sources, doubted, strict=True)]
    of_values = np.arange(len(mean)) >= len(nuisances.changes)
    for text in _against(sources, known, mean, np.flatnonzero(doubted & wrong & of_values)):
        logger.warning(text)
    return Term("assumed", errors, tuple(sources), shared=True)


class _Nuisances:
    """Further unknowns r beside z, in units of their sd.

    Args:
        fit: The final linearisation.
        changes: Those of known slope.
        values: Numbers of the model.
        slopes: Slopes of the residuals by all of them, shape (c, K, R); None: not computed yet.
        at: Their values where `fit` was linearised, shape (K,); None: 0.
    """

    def __init__(
        self,
        fit: FinalFit,
        changes: Sequence[_Change],
        values: Sequence[Assumed],
        slopes: FloatArray | None = None,
        at: FloatArray | None = None,
    ) -> None:
        self.problem, self.fit = fit.problem, fit
        self.changes, self.values = list(changes), list(values)
        self._at = np.zeros(len(self.changes) + len(self.values)) if at is None else at
        # the errors of differentiated velocities have a common cause, and would pass for one of a number
        blind = np.array([differentiated(fit.problem.system, clip.log) for clip in fit.problem.clips])
        self._loose = np.where(blind, BLIND, 1.0)[:, : fit.slopes.first.mean.shape[1]]
        self.slopes = self._alone() if slopes is None else slopes
        self.posterior, self._found, self._step = self._posterior()

    @property
    def sources(self) -> list[Source]:
        """Their sources, in order."""
        rows = [change.source for change in self.changes]
        load = "center_of_mass"
        return rows + [
            Source(v.name, v.value, v.amount, v.unit, v.acts, of_load=v.setting == load) for v in self.values
        ]

    def felt(self) -> IntArray:
        """Those that move the estimate by a share of its sd; numbers that do not take no more rollouts."""
        known, mean, moves = self.posterior
        # a number that the log seems to determine may be one whose samples bent: its whole sd counts here
        size = np.sqrt(np.maximum(known.diagonal() + mean**2, 1.0))
        least = FELT_IN_JITTER if self.problem.non_smooth else FELT
        return np.flatnonzero((np.abs(moves * size) > least * self.fit.posterior.sd[:, None]).any(axis=0))

    def only(self, rows: IntArray) -> _Nuisances:
        """Some of them."""
        first = len(self.changes)
        changes = [self.changes[i] for i in rows if i < first]
        values = [self.values[i - first] for i in rows if i >= first]
        return _Nuisances(self.fit, changes, values, self.slopes[:, rows], self._at[rows])

    def followed(self) -> _Nuisances:
        """Slopes from samples along the ridges of the posterior: beside them the bend would be information.

        Two gains and the masses have a common factor of which no log knows anything, and of each of them
        alone a log may know a thousandth of what its data sheet leaves open. So samples follow the axes of
        their posterior, by a part of its width, and z and the first states follow them; again, until it
        gets no wider. Where contacts jitter, each number is moved by its sd.
        """
        found, first, whole = self, len(self.changes), np.eye(len(self.values))
        for _ in range(TURNS):
            known, _, moves = found.posterior
            gain = self._loose[..., None] * found._found.nuisance_gain
            turns = gain[..., : len(moves)] @ moves[:, first:] + gain[..., len(moves) + first :]
            steps = whole if self.problem.non_smooth else ALONG * axes(known[first:, first:])
            slopes = self._with_changes(self._sampled(moves[:, first:], turns, steps))
            found = _Nuisances(self.fit, self.changes, self.values, slopes, self._at)
            grown = found.posterior[0].diagonal() / known.diagonal()
            if self.problem.non_smooth or grown.max() < GROWN:
                break
        return found

    def moved(self) -> _Nuisances:
        """Linearised again where z, first states and all of them fit best, if they fit better there."""
        fit, first, d = self.fit, len(self.changes), len(self.fit.z)
        grows = np.array([*(False for _ in self.changes), *(value.grows for value in self.values)])
        at = np.where(grows, np.maximum(self.posterior[1], 0.0), self.posterior[1])
        z = self.problem.system.space.clip(fit.z + self._step[:d])
        step = np.concatenate((z - fit.z, at - self._at))
        means = fit.slopes.first.mean, self._loose * self._found.first(step[None])[0]
        places = np.stack((np.concatenate((fit.z, self._at[first:])), np.concatenate((z, at[first:]))))
        cost = self._cost
        there = cost.residuals(places, np.stack(means) if means[0].shape[1] else None)
        misfit = objective(cost, there, np.stack(means) / self._loose, fit.times, fit.weight)
        if not misfit[1] < misfit[0]:
            return self
        rest = np.einsum("k,ckr->cr", at[:first] - self._at[:first], self.slopes[:, :first])
        slopes = replace(
            fit.slopes,
            residual=there.flat[1] + rest,
            first=replace(fit.slopes.first, mean=means[1]),
            completed=fit.slopes.completed & there.completed[1],
        )
        best = replace(fit, slopes=slopes, finding=replace(fit.finding, z=z))
        return _Nuisances(best, self.changes, self.values, self.slopes, at).followed()

    def _alone(self) -> FloatArray:
        """Slopes from small samples, and alone; where contacts jitter, of one sd, else to one side.

        They show which numbers are felt, and along what their samples should lie.
        """
        moves = np.zeros((len(self.fit.z), len(self.values)))
        turns = np.zeros((*self.fit.slopes.first.mean.shape, len(self.values)))
        size, straight = 1.0 if self.problem.non_smooth else SMALL, not self.problem.touches
        return self._with_changes(self._sampled(moves, turns, size * np.eye(len(self.values)), straight))

    def _with_changes(self, slopes: FloatArray) -> FloatArray:
        return np.concatenate((*(change.slope[:, None] for change in self.changes), slopes), axis=1)

    def _sampled(
        self, moves: FloatArray, turns: FloatArray, steps: FloatArray, straight: bool = False
    ) -> FloatArray:
        """Slopes of the residuals (c, k, R) by the numbers of the model.

        Args:
            moves: Steps of z with a step of each, shape (d, k).
            turns: Steps of the first states with it, shape (c, nx, k).
            steps: The samples of one side, in the sd of each number, shape (k, k).
            straight: Take that side alone: half of the rollouts.
        """
        fit, k = self.fit, len(self.values)
        if not k:
            return np.zeros((len(fit.weight), 0, fit.slopes.residual.shape[1]))
        grows, at = np.array([value.grows for value in self.values]), self._at[len(self.changes) :]
        steps = steps if straight else np.concatenate((steps, -steps))
        steps = np.where(grows, np.maximum(steps, -at), steps)
        z = np.concatenate((fit.z + steps @ moves.T, at + steps), axis=1)
        first = fit.slopes.first.mean + np.einsum("pk,cxk->pcx", steps, turns)
        residuals = self._cost.residuals(z, first if first.shape[2] else None)
        middle, other = (0.0, fit.slopes.residual) if straight else (steps[k:], residuals.flat[k:])
        change = np.tensordot(np.linalg.inv(steps[:k] - middle), residuals.flat[:k] - other, 1).swapaxes(0, 1)
        gz, gx = np.split(fit.slopes.gain, [len(fit.z)], axis=1)
        return change - np.einsum("dk,cdr->ckr", moves, gz) - np.einsum("cxk,cxr->ckr", turns, gx)

    @cached_property
    def _cost(self) -> MatchingCost:
        """The cost with the numbers of the model as further unknowns."""
        system = with_assumed(self.problem.system, self.values)
        return self.fit.slopes.cost.upon(self.problem.engine.upon(system.model, system.edits), system)

    def _posterior(self) -> tuple[tuple[FloatArray, FloatArray, FloatArray], Information, FloatArray]:
        """Covariance S (K, K), mean m (K,), how z follows r, A (d, K); joint information; and the step."""
        slopes, d = self.fit.slopes, len(self.fit.z)
        gz, gx = np.split(slopes.gain, [d], axis=1)
        gain = np.concatenate((gz, self.slopes, self._loose[..., None] * gx), axis=1)
        first = replace(slopes.first, mean=slopes.first.mean / self._loose)
        found = information(replace(slopes, gain=gain, first=first))
        prior = np.eye(d + self.slopes.shape[1])
        prior[:d, :d] = self.problem.system.space.loose_precision
        away = np.concatenate((self.fit.z, self._at))
        step, precision = gauss_newton_step(*found.summed(self.fit.weight), prior, away)
        moves = -sealed(np.linalg.solve(precision[:d, :d], precision[:d, d:]))
        return (sealed(np.linalg.inv(precision)[d:, d:]), self._at + step[d:], moves), found, step


def axes(covariance: FloatArray) -> FloatArray:
    """The principal axes of a covariance (k, k), one a row, each as long as its sd."""
    values, vectors = np.linalg.eigh(covariance)
    return (vectors * np.sqrt(values)).T


def _against(
    sources: Sequence[Source], known: FloatArray, mean: FloatArray, wrong: IntArray
) -> Iterator[str]:
    """Sentences on assumed values that the logs contradict, and on rivals that explain as much.

    Args:
        sources: What the nuisances are.
        known, mean: Their covariance (K, K) and mean (K,).
        wrong: Which of them the logs speak against.
    """
    precision = np.linalg.inv(known)
    score, alone = precision @ mean, precision.diagonal()
    worth = score**2 / alone  # of the misfit, by each alone
    wanted = (score / np.maximum(alone - 1.0, 1e-9)).tolist()  # what the logs want, whatever the data sheet
    named: set[int] = set()
    for i in sorted(map(int, wrong), key=lambda i: -worth[i]):
        if i in named:
            continue
        others = [j for j in map(int, np.argsort(-worth)) if j != i and worth[j] > AS_WELL * worth[i]]
        named |= {i, *others}
        rivals = "".join(f", or {_in_words(sources[j], wanted[j])} of {sources[j]}" for j in others)
        whose, one = ("them", "one of them") if others else ("it", "it")
        yield (
            f"the logs speak against {sources[i]}: they want {_in_words(sources[i], wanted[i])} "
            f"({np.sqrt(worth[i]):.0f} sd){rivals}; measure {whose}, or make {one} a parameter; something "
            f"else that the model lacks, such as the zero of an encoder, may act alike"
        )


def _in_words(source: Source, wanted: float) -> str:
    """'+16 %', or '+1.6 times what was assumed' of what has no size of its own."""
    return source.times(wanted, "+") or f"{wanted:+.2g} times what was assumed"


def _acting_values(fit: FinalFit) -> list[Assumed]:
    """The assumed values that act in the rollouts at the estimate."""
    felt = {p.of_model for p, active in zip(fit.space.parameters, fit.problem.active, strict=True) if active}
    largest = {
        o.channel.key: np.abs(o.measured[o.mask]).max(initial=0.0) for o in fit.slopes.cost.clips.observed
    }
    return assumed_of(fit.problem.system, _acting(fit), felt, largest)


def _acting(fit: FinalFit) -> Acting:
    """Elements of the model that act in the rollouts at the estimate."""
    system, cost, found = fit.problem.system, fit.slopes.cost, []
    if system.match == "effort":
        return Acting.nothing(system.model)
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
