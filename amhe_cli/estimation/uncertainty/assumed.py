"""Sensitivity of estimates to numbers that a model takes for granted: contacts, solver, time step, others.

Each is a nuisance r ~ N(0, 1) beside z, and a row of one regression: with slopes by r, the log gives r a
posterior N(m, S), and the estimate moves by A r. It was found at r = 0 and stays there, so that its error is

    A (S + m m') A'

A number that the log itself determines costs nothing where it was right, and its whole error where it was
wrong. One that no log can determine costs what its data sheet leaves open. The symmetric root of S + m m'
says what each number adds.

Where contacts jitter, so do the slopes by r: what z and first states cannot take over of their jitter would
be information on r. The even response to the samples shows how much it is, and this much is taken out of each
direction of r: what is not resolved beyond it is left open by the log, and its whole sd counts.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from amhe_cli.core.arrays import FloatArray, IntArray, sealed, to_host
from amhe_cli.core.statistics import root
from amhe_cli.engine.open import contact_variants, finer_solver, finer_step
from amhe_cli.estimation.core.agreement import SURPRISE
from amhe_cli.estimation.core.information import (
    Information,
    information,
    objective,
)
from amhe_cli.estimation.core.linearise import orthogonal_directions
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
RANK = 1e-12
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
    values = [v for v in values if v.sd > 0.0]
    return _regressed(fit, list(_changes(fit)), values), tuple(dict.fromkeys(exact))


# -- other contacts, another solver, a finer step ------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class _Change:
    """Effect of one standard deviation of a numerical choice.

    Args:
        source: The choice.
        slope: The change of the residuals besides the move of the estimate, shape (c, R); 0 where a clip
            diverged.
        error: Sd of its jitter, in that of the mean of a pair of samples.
    """

    source: Source
    slope: FloatArray
    error: float = 0.0

    def times(self, factor: float, source: Source) -> _Change:
        """A multiple of it, with another name."""
        return _Change(source, factor * self.slope, factor * self.error)


def _changed(fit: FinalFit, cost: MatchingCost, *, fitted: bool = False) -> tuple[_Change, float]:
    """Effect of another engine, and the share by which the misfit rises: in jitter, 0 unless `fitted`."""
    slopes = fit.slopes

    def after(cost: MatchingCost, step: FloatArray, first: FloatArray) -> tuple[Residuals, float]:
        """Residuals after a step (d,) of the estimate, first states (c, nx) moved along; and the misfit."""
        z = fit.space.clip((fit.z + step)[None])
        residuals = cost.residuals(z, first[None] if first.shape[1] else None)
        return residuals, float(objective(cost, residuals, first[None], fit.times, fit.weight)[0])

    there = cost.residuals(*_samples(fit))
    both, mean = slopes.completed & there.completed.all(axis=0), there.flat.mean(axis=0)
    error = float(np.sqrt(1.0 / PAIRS + 1.0 / len(slopes.pairs)))
    jumps = _Change(Source(""), np.where(both[:, None], mean - slopes.residual, 0.0), error)
    if fit.problem.non_smooth and not fitted:
        return jumps, 0.0
    info = information(replace(slopes, residual=mean, completed=both))
    pairs = (fit.information, fit.weight), (info, fit.weight * both)
    steps = [posterior(fit.z, *pair, fit.space.loose_precision).step for pair in pairs]
    firsts = [one.first(step[None])[0] for (one, _), step in zip(pairs, steps, strict=True)]
    (here, least), (there, most) = map(after, (slopes.cost, cost), steps, firsts)
    share = (most - least) / max(least, 1e-300)
    if fit.problem.non_smooth:
        return jumps, share
    z = steps[1] - steps[0]
    gz, gx = np.split(slopes.gain, [len(z)], axis=1)
    along = np.einsum("d,cdr->cr", z, gz) + np.einsum("cx,cxr->cr", firsts[1] - firsts[0], gx)
    done = here.completed[0] & there.completed[0]
    slope = np.where(done[:, None], there.flat[0] - here.flat[0] - along, 0.0)
    return _Change(Source(""), slope), share


def _samples(fit: FinalFit) -> tuple[FloatArray, FloatArray | None]:
    """Places z (p, d) and first states (p, c, nx) at which a change is seen; where contacts jitter, some."""
    z, first = fit.z, fit.slopes.first
    w = np.zeros((1, z.size + first.shape.shape[2]))
    if fit.problem.non_smooth:
        w = fit.problem.rng(10).choice([-1.0, 1.0], (PAIRS, w.size))
        w = np.concatenate((w, -w))
    errors = first.mean + np.einsum("cij,pj->pci", first.shape, w[:, z.size :])
    return fit.space.clip(z + w[:, : z.size] @ fit.shape.T), errors if first.mean.shape[1] else None


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
        change, rise = _changed(fit, cost.at_half_steps(half_step), fitted=True)
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


class _Slopes(NamedTuple):
    """Slopes by K nuisances.

    Args:
        by: Slopes of the residuals, shape (c, K, R).
        error: Sd of the jitter of each, in that of the mean of a pair of samples, shape (K,).
        even: Even response to each of h pairs of samples, shape (h, c, R).
    """

    by: FloatArray
    error: FloatArray
    even: FloatArray


class _Nuisances:
    """Further unknowns r beside z, in units of their sd.

    Args:
        fit: The final linearisation.
        changes: Those of known slope.
        values: Numbers of the model.
        slopes: Slopes by all of them; None: not computed yet.
        at: Their values where `fit` was linearised, shape (K,); None: 0.
    """

    def __init__(
        self,
        fit: FinalFit,
        changes: Sequence[_Change],
        values: Sequence[Assumed],
        slopes: _Slopes | None = None,
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
        slopes = self.slopes._replace(by=self.slopes.by[:, rows], error=self.slopes.error[rows])
        return _Nuisances(self.fit, changes, values, slopes, self._at[rows])

    def followed(self) -> _Nuisances:
        """Slopes from samples along the ridges of the posterior: beside them the bend would be information.

        Two gains and the masses have a common factor of which no log knows anything, and of each of them
        alone a log may know a thousandth of what its data sheet leaves open. So samples follow the axes of
        their posterior, by a part of its width, and z and the first states follow them; again, until it
        gets no wider. Where contacts jitter, all are moved at once, and once, by all of its width.
        """
        found, first = self, len(self.changes)
        for _ in range(TURNS):
            known, _, moves = found.posterior
            gain = self._loose[..., None] * found._found.nuisance_gain
            turns = gain[..., : len(moves)] @ moves[:, first:] + gain[..., len(moves) + first :]
            width = axes(known[first:, first:])
            steps = self._together @ width if self.problem.non_smooth else ALONG * width
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
        rest = np.einsum("k,ckr->cr", at[:first] - self._at[:first], self.slopes.by[:, :first])
        slopes = replace(
            fit.slopes,
            residual=there.flat[1] + rest,
            first=replace(fit.slopes.first, mean=means[1]),
            completed=fit.slopes.completed & there.completed[1],
        )
        best = replace(fit, slopes=slopes, finding=replace(fit.finding, z=z))
        return _Nuisances(best, self.changes, self.values, self.slopes, at).followed()

    def _alone(self) -> _Slopes:
        """Slopes from small samples, and alone; where contacts jitter, of one sd, else to one side.

        They show which numbers are felt, and along what their samples should lie.
        """
        moves = np.zeros((len(self.fit.z), len(self.values)))
        turns = np.zeros((*self.fit.slopes.first.mean.shape, len(self.values)))
        together = self.problem.non_smooth and self.values
        steps = self._together if together else SMALL * np.eye(len(self.values))
        return self._with_changes(self._sampled(moves, turns, steps, not self.problem.touches))

    @property
    def _together(self) -> FloatArray:
        """Steps of all numbers at once: every pair of samples shows every slope."""
        return orthogonal_directions(len(self.values), len(self.values), self.problem.rng(14))

    def _with_changes(self, slopes: _Slopes) -> _Slopes:
        by = (*(change.slope[:, None] for change in self.changes), slopes.by)
        error = (*(change.error for change in self.changes), *slopes.error)
        return slopes._replace(by=np.concatenate(by, axis=1), error=np.array(error))

    def _sampled(
        self, moves: FloatArray, turns: FloatArray, steps: FloatArray, straight: bool = False
    ) -> _Slopes:
        """Slopes by the numbers of the model.

        Args:
            moves: Steps of z with a step of each, shape (d, k).
            turns: Steps of the first states with it, shape (c, nx, k).
            steps: The samples of one side, in the sd of each number, shape (k, k).
            straight: Take that side alone: half of the rollouts.
        """
        fit, k = self.fit, len(self.values)
        if not k:
            shape = fit.slopes.residual.shape
            return _Slopes(np.zeros((shape[0], 0, shape[1])), np.zeros(0), to_host(fit.slopes.curves))
        grows, at = np.array([value.grows for value in self.values]), self._at[len(self.changes) :]
        steps = steps if straight else np.concatenate((steps, -steps))
        steps = np.where(grows, np.maximum(steps, -at), steps)
        z = np.concatenate((fit.z + steps @ moves.T, at + steps), axis=1)
        first = fit.slopes.first.mean + np.einsum("pk,cxk->pcx", steps, turns)
        residuals = self._cost.residuals(z, first if first.shape[2] else None).flat
        minus, other = (0.0 * steps, fit.slopes.residual) if straight else (steps[k:], residuals[k:])
        odd = np.linalg.inv(steps[:k] - minus)
        change = np.tensordot(odd, residuals[:k] - other, 1)
        even = residuals[:0]
        if self.problem.non_smooth:  # the middle of a pair of what only grows is not where `fit` is
            even = 0.5 * (residuals[:k] + other) - fit.slopes.residual
            even -= np.tensordot(0.5 * (steps[:k] + minus), change, 1)
        gz, gx = np.split(fit.slopes.gain, [len(fit.z)], axis=1)
        change = change.swapaxes(0, 1) - np.einsum("dk,cdr->ckr", moves, gz)
        by = change - np.einsum("cxk,cxr->ckr", turns, gx)
        return _Slopes(by, 2.0 * np.linalg.norm(odd, axis=1), even)

    @cached_property
    def _cost(self) -> MatchingCost:
        """The cost with the numbers of the model as further unknowns."""
        system = with_assumed(self.problem.system, self.values)
        return self.fit.slopes.cost.upon(self.problem.engine.upon(system.model, system.edits), system)

    def _posterior(self) -> tuple[tuple[FloatArray, FloatArray, FloatArray], Information, FloatArray]:
        """Covariance S (K, K), mean m (K,), how z follows r, A (d, K); joint information; and the step."""
        found = self._information(self.slopes.by)
        moves, own, pull, step = self._given(found)
        weight = np.eye(len(own))
        if self.problem.non_smooth:
            # the score errs by more than its slopes say, whose share of jitter is no slope
            own, noise = self._resolved(own), self._noise(found, moves)
            weight = own @ np.linalg.pinv(noise, rcond=RANK, hermitian=True)
        known = sealed(np.linalg.inv(weight @ own + np.eye(len(own))))
        further = -known @ (weight @ pull + self._at)
        step = np.concatenate((step + moves @ further, further))
        return (known, self._at + further, moves), found, step

    def _information(self, columns: FloatArray) -> Information:
        """Information on z and on nuisances with these slopes (c, k, R), first states fitted along."""
        slopes, even = self.fit.slopes, self.slopes.even
        gz, gx = np.split(slopes.gain, [len(self.fit.z)], axis=1)
        gain = np.concatenate((gz, columns, self._loose[..., None] * gx), axis=1)
        first = replace(slopes.first, mean=slopes.first.mean / self._loose)
        curves = np.concatenate((even, -even))  # about none, and not about their mean
        return information(replace(slopes, gain=gain, first=first, curves=curves))

    def _given(self, found: Information) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """With z fitted: how it follows r, (d, K); information on r and score, (K, K) and (K,); step of z."""
        prior, d = self.problem.system.space.loose_precision, len(self.fit.z)
        matrix, score = found.summed(self.fit.weight)
        score[:d] += prior @ self.fit.z
        solved = np.linalg.solve(matrix[:d, :d] + prior, np.concatenate((matrix[:d, d:], score[:d, None]), 1))
        moves, step = sealed(-solved[:, :-1]), sealed(-solved[:, -1])
        return moves, matrix[d:, d:] + matrix[d:, :d] @ moves, score[d:] + moves.T @ score[:d], step

    def _resolved(self, own: FloatArray) -> FloatArray:
        """Information on r (K, K) less what jitter of its slopes adds: of an eigenvalue what exceeds it.

        It is the largest that the even responses have, of as many pairs, with z and first states fitted as in
        `own`: these take over nearly all of a slope, and of its jitter hardly any.
        """
        even, error = self.slopes.even, self.slopes.error
        count = len(even)
        about = (even - even.mean(axis=0)) * np.sqrt(count / (count - 1.0)) if count > 1 else even
        jitter = np.linalg.eigvalsh(self._given(self._information(about.swapaxes(0, 1)))[1])[-1]
        values, vectors = np.linalg.eigh(own / np.outer(error, error))
        part = error[:, None] * vectors * np.sqrt(np.maximum(values - jitter, 0.0))
        resolved: FloatArray = part @ part.T
        return resolved

    def _noise(self, found: Information, moves: FloatArray) -> FloatArray:
        """Covariance of the score of r with z fitted, (K, K); jitter counts by what it does to scores."""
        noise, d = np.einsum("c,cij->ij", self.fit.weight, found.scatter), len(moves)
        noise[:d, :d] += self.problem.system.space.loose_precision
        with_z = np.concatenate((moves, np.eye(moves.shape[1])))
        covariance: FloatArray = with_z.T @ noise @ with_z
        return covariance


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
