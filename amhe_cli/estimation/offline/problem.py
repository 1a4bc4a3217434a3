"""An identification problem: the system, the clips of its logs, and an engine to roll them out."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from amhe_cli.core.arrays import BoolArray, FloatArray, IntArray, sealed, to_host
from amhe_cli.core.log import Window
from amhe_cli.core.settings import Settings
from amhe_cli.engine.auto import AutoEngine
from amhe_cli.engine.open import open_engine
from amhe_cli.engine.rollout import Engine, cut
from amhe_cli.engine.states import nearest, touching
from amhe_cli.estimation.core.information import ROUNDING, Information, marginalised
from amhe_cli.estimation.core.linearise import (
    WIDEST,
    FirstStates,
    Linearisation,
    Sparsity,
    alike,
    averaged,
    diagonal,
    linearise,
    sampling_width,
)
from amhe_cli.estimation.core.result import Iteration
from amhe_cli.estimation.offline.clips import ClipPool, evenly, of_each_kind, places
from amhe_cli.matching.cost import MatchingCost, Residuals
from amhe_cli.matching.starts import first_index
from amhe_cli.system.parameters.contacts import geom_name, needed_contacts
from amhe_cli.system.parameters.inertia import inertia_of
from amhe_cli.system.system import System

#: A parameter whose step of half a prior sd moves no measurement by this many noise sd is out of reach.
OUT_OF_REACH = 1e-2
#: Share of the usual step where efforts are matched, whose slopes do not jitter.
SHORTEST = 1e-2
#: Relative rounding of an engine that does not decide it: contacts amplify its rounding beyond that.
COARSE = 1e-12
#: Random clips drawn even from a log too short for them side by side.
FEWEST = 8
#: Even over odd response to small steps from which a model is non-smooth.
NON_SMOOTH = 0.02
#: Clips of each kind of log that show what the errors of a first state move.
FEW = 2
#: From this many times as many clips as can be fitted, those are chosen that tell most.
WORTH = 2
#: At most this many times as many clips are looked at for that.
LOOKED_AT = 3
#: Smallest sampling sd of a first state along any direction of a non-smooth model, in its recorded sd:
#: slopes from narrower samples are jitter, and would count as knowledge of the first state.
NARROWEST = 0.7
#: Information on an error of a first state, in that of its record, below which it does not matter behind
#: contacts: its sd would be less by a tenth, and the estimate moves by a tenth of an interval at most.
FELT = 0.2
#: Instants of the rollouts at which a missing contact is looked for.
_LOOKS = 400
#: A gap below this is a touch [m].
_TOUCH = 0.005


@dataclass(frozen=True, slots=True)
class KnownNoise:
    """What is taken for noise: channel -> factor on its declared sd, and autocorrelation time in samples."""

    scale: Mapping[str, float]
    times: Mapping[str, float]


@dataclass(frozen=True, slots=True, eq=False)
class Carried:
    """Slopes of all clips, seen from where a later step ended.

    Args:
        record: The record of the search until there.
        slopes: They take no more rollouts.
        steps: Number of steps since they were sampled.
        way: Length of these steps, in posterior sd.
    """

    record: Sequence[Iteration]
    slopes: Linearisation
    steps: int
    way: float


#: Whether a search may end with its state, a `SearchState`, after an iteration.
Ends = Callable[["Problem", Any], bool]


@dataclass(frozen=True, eq=False)
class Problem:
    """An identification problem.

    Args:
        system: Model, parameters with their prior, signals.
        pool: Source of clips to fit.
        engine: Engine of the rollouts.
        seed: Seed of every random draw.
        only: Fit these clips alone, a part of the problem.
        beside: All usable clips, where `only` stands for them.
        whole: The problem of which this is a part: what moves what is the same.
        threads: Number of CPU threads, for what a coarse engine cannot decide.
        share: How often what the logs say counts: 0.5 where the prior has a half of it already.
        enough: A search may end with a step of so many posterior sd; None: when it has settled.
        ends: Whether its search may end with a state, beside.
        noise: What is taken for noise; None: what residuals show.
        like: A problem of the same unknowns under other priors; on the same clips it knows what moves what.
        quick: Its search takes slopes again as long as the cost falls as they predict.
    """

    system: System
    pool: ClipPool
    engine: Engine
    seed: int
    only: tuple[Window, ...] = ()
    beside: tuple[Window, ...] = ()
    whole: Problem | None = None
    threads: int = 1
    share: float = 1.0
    enough: float | None = None
    ends: Ends | None = None
    noise: KnownNoise | None = None
    like: Problem | None = None
    quick: bool = False

    @property
    def rough(self) -> bool:
        """Whether its search only shows where to go, or what else explains the logs."""
        return self.enough is not None or self.noise is not None

    def part(self, clips: IntArray) -> Problem:
        """The same problem on some of its clips."""
        return replace(self, only=tuple(self.clips[i] for i in clips), whole=self)

    @property
    def settings(self) -> Settings:
        """The system's settings."""
        return self.system.settings

    def cost(self, windows: Sequence[Window], scale: Mapping[str, float] | None = None) -> MatchingCost:
        """Matching cost on some clips, with the noise that the data have shown; the last clips are kept."""
        key, kept = tuple(windows), self._laid_out
        if key not in kept:
            kept.clear()
            kept[key] = MatchingCost(self.system, windows, self.engine, self.settings.cost)
        if self.noise is not None:
            return kept[key].under(self.noise.scale, self.noise.times)
        return kept[key].scaled(scale) if scale else kept[key]

    @cached_property
    def newest(self) -> list[Carried]:
        """Slopes that hold where the last step of a quick search ended, one or none."""
        return []

    @cached_property
    def _laid_out(self) -> dict[tuple[Window, ...], MatchingCost]:
        return {}

    def rng(self, *place: int) -> np.random.Generator:
        """A generator of its own for each place of the search: nothing to store, the same on resuming."""
        return np.random.default_rng([self.seed, *place])

    @cached_property
    def usable(self) -> Sequence[Window]:
        """Every usable clip; cut only once, since the pool counts what it drops."""
        low, high = self.settings.clips.length
        return self.only or self.pool.cut(0.5 * (low + high))

    @cached_property
    def clips(self) -> tuple[Window, ...]:
        """The fitted logs cut into clips, each instant used once; where there are many, some of them.

        Those that show more are taken more often, but behind contacts, where slopes far from the estimate say
        nothing of it.
        """
        if self.only:
            return self.only
        most = self.settings.clips.most
        if len(self.usable) < WORTH * most or self.touches:
            return tuple(evenly(self.usable, most))
        clips = evenly(self.usable, LOOKED_AT * most)
        return tuple(clips[i] for i in by_leverage(self._information(clips), most))

    def _information(self, clips: Sequence[Window]) -> FloatArray:
        """Information (c, d, d) of clips at the prior's mean, in turns that need no more memory than one."""
        z = np.zeros(len(self.system.space))
        shape, matrices = diagonal(WIDEST, self.active), []
        for rows in cut(len(clips), -(-len(clips) // self.settings.clips.count)):
            cost = self.cost([clips[i] for i in rows])
            first = self.recorded(cost)
            slopes = self.linearised(cost, z, first, shape, self.rng(7), straight=True)
            gz, gx = np.split(slopes.gain, [z.size], axis=1)
            weight = np.repeat(slopes.completed.astype(np.float64)[:, None], gz.shape[2], axis=1)
            matrices.append(marginalised(slopes.residual, gz, gx, weight, first.mean).matrix)
        return np.concatenate(matrices)

    def drawn(self, rng: np.random.Generator, count: int) -> Sequence[Window]:
        """Random clips; those side by side where hardly any place of the logs holds one."""
        return self.pool.draw(rng, count) or evenly(self.clips, count)

    @property
    def thinned(self) -> int:
        """Usable clips that are left out because there are many."""
        return len(self.beside or self.usable) - len(self.clips)

    @cached_property
    def clip_count(self) -> int:
        """Random clips of one iteration: no more than the logs hold side by side, but some."""
        return min(self.settings.clips.count, max(FEWEST, len(self.clips)))

    def coverage(self, windows: Sequence[Window]) -> float:
        """Time in all fitted clips over time in these: how often each clip's information counts.

        What was left out of a long log has not shaped the estimate, and narrows no interval.
        """
        return self.share * sum(w.duration for w in self.clips) / sum(w.duration for w in windows)

    @cached_property
    def linearisation(self) -> int:
        """Rollouts of one linearisation of all clips, its first states included."""
        setting, d = self.settings.identify, len(self.system.space)
        fitted = setting.first_state != "never"
        unknowns = d + fitted * first_index(self.system).size
        if self.sparsity is not None:
            unknowns = self.sparsity.unknowns(fitted)
        return (2 * max(unknowns, setting.samples // 2) + 1) * len(self.clips)

    def linearised(
        self,
        cost: MatchingCost,
        z: FloatArray,
        first: FirstStates,
        shape: FloatArray,
        rng: np.random.Generator,
        *,
        straight: bool = False,
        raw: bool = False,
    ) -> Linearisation:
        """Slopes of a cost about z (d,) and first-state errors, from samples of a shape (d, d).

        They are `averaged` where the model is not smooth, unless they are to stay `raw`.

        Efforts along a motion never jitter: the shortest steps give their slopes exactly, where wider ones
        would bend along the valleys of numbers that only together are known well.
        """
        if self.system.match == "effort":
            straight, shape = True, SHORTEST * shape
        samples = self.settings.identify.samples
        found = linearise(cost, z, first, shape, samples, rng, straight=straight, sparsity=self.sparsity)
        return averaged(found, shape) if self.non_smooth and not raw else found

    def recorded(self, cost: MatchingCost) -> FirstStates:
        """First states of a cost's clips as recorded; without errors where the settings fit none."""
        fitted = self.settings.identify.first_state != "never"
        return FirstStates.recorded(len(cost.clips.windows), cost.nx * fitted)

    def first_states(self, info: Information, dz: FloatArray) -> FirstStates:
        """Posterior of the clips' first states after a step of z (d,)."""
        sparsity = self.sparsity if info.nuisance.shape[1] else None  # recorded first states have no errors
        groups = None if sparsity is None else alike(np.concatenate(list(sparsity.first.values()), axis=1))
        narrowest, least = (NARROWEST, FELT) if self.non_smooth else (self.finest, ROUNDING)
        return info.first_states(dz, narrowest, groups, least)

    def first_of_others(self, info: Information, clips: Sequence[Window]) -> FirstStates:
        """Recorded first states of clips; behind contacts along the directions that matter on others."""
        count, nx = len(clips), info.nuisance.shape[1]
        return info.first_of_others(count, FELT) if self.non_smooth else FirstStates.recorded(count, nx)

    @property
    def finest(self) -> float:
        """Smallest sampling sd on a smooth cost, as a share of what is sampled.

        The cube root of the engine's rounding balances the rounding of a central difference against its third
        order. Samples of first states have the same floor as those of parameters: among wider ones the third
        order of these would pass for slopes, and make them narrower still.
        """
        return max(1e-4, self.engine.precision ** (1 / 3))

    @cached_property
    def _some_clips(self) -> Sequence[Window]:
        """Clips that show what moves what: some from everywhere, and some of each kind of log."""
        clips = self.beside or self.usable
        return list(dict.fromkeys([*evenly(clips, 8), *of_each_kind(clips, FEW)]))

    @property
    def _like(self) -> Problem | None:
        """The problem like this one, if it has been looked at on the same clips about the same values."""
        if (like := self.like) is None or "_moved" not in like.__dict__:
            return None
        one, other = self.system.space, like.system.space
        same = one.names == other.names and np.array_equal(one.nominal, other.nominal)
        return like if same and places(self._some_clips) == places(like._some_clips) else None

    @cached_property
    def _moved(self) -> tuple[dict[str, BoolArray], BoolArray]:
        """Columns of each channel that a step of half a prior sd moves, (d, k), and steps that diverge, (d,).

        What moves all in some of the clips is not looked at in the others, and the other side is tried of
        those alone that the first side leaves without an effect.
        What does not move all is looked at away from the prior's mean, too: a joint does not feel a mass
        whose centre lies on its axis, until the centre moves. What has the prior that it has in a problem
        like this one moves what it moves there.
        """
        d, cost = len(self.system.space), self.cost(self._some_clips)
        # cards that open between two of these calls would compute the later ones
        if self.engine.precision > COARSE or isinstance(self.engine, AutoEngine):
            cost = cost.upon(open_engine(self.system, threads=self.threads))
        moved = {o.channel.key: np.zeros((d, o.width), dtype=bool) for o in cost.clips.observed}
        diverged, left = np.zeros(d, dtype=bool), np.arange(d)
        if (like := self._like) is not None:
            moved, diverged = (
                {key: np.array(columns) for key, columns in like._moved[0].items()},
                np.array(like._moved[1]),
            )
            left = np.flatnonzero(like.system.space.prior_sd != self.system.space.prior_sd)
        fresh = left
        for columns in moved.values():
            columns[fresh] = False
        diverged[fresh] = False
        every = np.arange(len(self._some_clips))
        few = every[:: -(-len(every) // FEW)]
        for side, clips, enough in (
            (0.5, few, np.all),
            (0.5, np.setdiff1d(every, few), np.any),
            (-0.5, every, np.any),
        ):
            if left.size and clips.size:
                some, steps = cost.of(clips), side * np.concatenate((np.zeros((1, d)), np.eye(d)[left]))
                residuals = some.residuals(self.system.space.clip(steps))
                for key, columns in _moved_columns(some, residuals).items():
                    moved[key][left] |= columns
                diverged[left] |= ~residuals.completed[1:].all(axis=1)
            felt = enough(np.concatenate([columns[left] for columns in moved.values()], axis=1), axis=1)
            left = left[~(felt | diverged[left])]
        some = ~np.all([columns[fresh].all(axis=1) for columns in moved.values()], axis=0)
        gaps = fresh[np.broadcast_to(some, fresh.shape)]
        if gaps.size and not (self.touches or diverged.any()):
            place = self.rng(12).uniform(-1.0, 1.0, d)
            steps = np.concatenate((np.zeros((1, d)), 0.5 * np.eye(d)[gaps]))
            residuals = cost.residuals(self.system.space.clip(place + steps))
            if residuals.completed.all():
                for key, columns in _moved_columns(cost, residuals).items():
                    moved[key][gaps] |= columns
        return moved, diverged

    @cached_property
    def active(self) -> BoolArray:
        """Mask of the parameters that these logs depend on at all, shape (d,)."""
        if self.whole is not None:
            return self.whole.active
        moved, diverged = self._moved  # a step that diverges had an effect
        return np.any([columns.any(axis=1) for columns in moved.values()], axis=0) | diverged

    @cached_property
    def sparsity(self) -> Sparsity | None:
        """Sparsity pattern of the Jacobian; None: it is dense, as where something touches."""
        if self.whole is not None:
            return self.whole.sparsity
        moved, diverged = self._moved
        if self.touches or diverged.any():
            return None
        cost = self.cost(of_each_kind(self.usable, FEW))
        z = np.zeros((cost.nx + 1, len(self.system.space)))
        errors = np.concatenate((np.zeros((1, cost.nx)), np.eye(cost.nx)))
        first = np.repeat(errors[:, None], len(cost.clips.windows), axis=1)
        residuals = cost.residuals(z, first)
        sparsity = Sparsity(moved, _moved_columns(cost, residuals))
        unknowns = len(self.system.space) + cost.nx
        return sparsity if residuals.completed.all() and sparsity.unknowns(True) < unknowns else None

    @property
    def alike(self) -> list[IntArray] | None:
        """The parameters that move the same measurements; None: all do."""
        return None if self.sparsity is None else self.sparsity.alike

    @cached_property
    def non_smooth(self) -> bool:
        """Whether residuals jitter under steps of half a percent, as behind chaotic contact.

        A response bends for other reasons, too: without anything that touches, no model is non-smooth.
        """
        if self.whole is not None or not self.touches:
            return self.whole is not None and self.whole.non_smooth
        d = len(self.system.space)
        steps = np.diag(self.system.space.in_z(0.005) * self.active)
        middle = self._off_grid
        candidates = self.system.space.clip(middle + np.concatenate((np.zeros((1, d)), steps, -steps)))
        cost = self.cost(self._some_clips)
        centre, plus, minus = np.split(cost.residuals(candidates).flat, [1, d + 1])
        odd = ((plus - minus) ** 2).sum(axis=(0, 2))  # (c,)
        even = ((plus + minus - 2.0 * centre) ** 2).sum(axis=(0, 2))
        return bool(np.median(even) > NON_SMOOTH * np.median(odd))

    @property
    def _off_grid(self) -> FloatArray:
        """The prior's mean with a command delay in the middle of a time step, shape (d,).

        A command acts from one step on: where a delay is a multiple of the step, slopes by it have a kink.
        """
        space, late, dt = self.system.space, self.system.edits.late, self.system.dt
        theta = np.array(space.nominal)
        for column, parameter in enumerate(space.parameters):
            if parameter.of_model in late:  # a log may have its own
                theta[column] = (np.floor(theta[column] / dt + 1e-6) + 0.5) * dt
        return space.z_of(theta)

    @cached_property
    def idle(self) -> dict[str, str]:
        """Why these logs do not depend on a parameter, for each that is not active."""
        idle = np.flatnonzero(~self.active)
        if not idle.size:
            return {}
        cost = self.cost(self._some_clips)
        ends = np.zeros((2, idle.size, self.active.size))
        ends[:, np.arange(idle.size), idle] = np.array(self.system.space.bounds)[:, idle]
        at_ends = cost.residuals(np.concatenate((np.zeros((1, self.active.size)), *ends)))
        felt = np.any([columns.any(axis=1) for columns in _moved_columns(cost, at_ends).values()], axis=0)
        felt = (felt | ~at_ends.completed[1:].all(axis=1)).reshape(2, -1).any(axis=0)
        forwards = self.system.match != "effort"
        qpos, inputs = self._states(cost, np.zeros(len(self.system.space))) if forwards else ([], [])
        rows = np.linspace(0, len(qpos) - 1, min(len(qpos), _LOOKS)).astype(int)
        cells = {parameter.name: own for parameter, own in self.system.edits.by_parameter()}
        model, reasons = self.system.model, {}
        for column, far in zip(idle, felt, strict=True):
            parameter = self.system.space.parameters[column]
            name = parameter.name
            reasons[name] = "no measurement in these logs depends on it"
            if far and not inertia_of(name):
                reasons[name] += (
                    " near its nominal value, but at its bounds one does: give a nominal value of the right "
                    "size, or a wider prior"
                )
            if forwards and (pairs := needed_contacts(model, cells.get(parameter.of_model, ()))):
                gap, pair = nearest(model, qpos[rows], inputs[rows], self.system.input_spec, pairs)
                if gap > _TOUCH:
                    one, other = (geom_name(model, geom) for geom in pair)
                    reasons[name] = (
                        f"nothing touches: {one} and {other} come no nearer than {gap:.2g} m in these logs "
                        "(check the frames of their poses)"
                    )
        return reasons

    @cached_property
    def touches(self) -> bool:
        """Whether anything touches, or reaches a limit of its range, in rollouts at the prior's mean."""
        if self.whole is not None:
            return self.whole.touches
        if self.system.match == "effort":
            return False  # nothing is rolled out
        if self._like is not None:
            return self._like.touches
        return touching(self.system.model, self._states(self.cost(self._some_clips), self._off_grid)[0])

    def _states(self, cost: MatchingCost, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Positions (n, nq) and inputs (n, nu) at every step of the clips' rollouts under z (d,)."""
        qpos, inputs = [], []
        for rolled in cost.rolled_out(z, None):
            inside = np.arange(rolled.inputs.shape[1]) < rolled.lengths[:, None]
            qpos.append(rolled.rollouts.qpos[inside])
            inputs.append(rolled.inputs[inside])
        return np.concatenate(qpos), np.concatenate(inputs)


def by_leverage(information: FloatArray, most: int) -> IntArray:
    """At most so many of c clips, a clip the more often the larger its share of all information is.

    Its share is its leverage tr(M_c (P + sum M)^-1) (Drineas, Mahoney and Muthukrishnan 2006): a clip that
    many others repeat has little, one that alone knows something has much. Clips are taken at equal steps
    of the summed leverage: evenly where all are alike.

    Args:
        information: Information of each clip on z, whose prior is N(0, I), shape (c, d, d).
        most: The number.
    """
    covariance = sealed(np.linalg.inv(information.sum(axis=0) + np.eye(information.shape[1])))
    total = np.cumsum(np.einsum("cij,ji->c", information, covariance))
    return np.unique(np.searchsorted(total, (np.arange(most) + 0.5) / most * total[-1]))


def spread_floor(problem: Problem) -> FloatArray:
    """Smallest sampling sd of z, shape (d,): a share of the parameter, or of a linear one's prior sd.

    On non-smooth costs small steps measure the jitter of contacts, not the slope of the residuals; on smooth
    ones they are exact, and large steps are not.
    """
    share = problem.settings.identify.step if problem.non_smooth else problem.finest
    return sampling_width(problem.system.space, share)


def _moved_columns(cost: MatchingCost, residuals: Residuals) -> dict[str, BoolArray]:
    """Mask of the columns of each channel that all candidates but the first move, shape (p - 1, k)."""
    moved: dict[str, BoolArray] = {}
    for observed, lent in zip(cost.clips.observed, residuals.values, strict=True):
        values = to_host(lent)
        moved[observed.channel.key] = np.abs(values[1:] - values[0]).max(axis=(1, 2)) > OUT_OF_REACH
    return moved
