"""SPI's linearised search, as steps from state to state: it can be stopped and resumed to the bit."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from amhe_cli.core.arrays import BoolArray, FloatArray, namespace_of, to_host
from amhe_cli.core.errors import EstimationError
from amhe_cli.core.log import Window
from amhe_cli.core.settings import IdentifySettings
from amhe_cli.estimation.core.information import (
    Information,
    channel_times,
    clip_weights,
    fitted_noise_scale,
    gauss_newton_step,
    information,
    objective,
    of_residuals,
    remaining_noise_scale,
    step_within,
)
from amhe_cli.estimation.core.linearise import (
    WIDEST,
    FirstStates,
    Linearisation,
    bounded,
    changed,
    coordinates,
    diagonal,
    sampling_sd,
    within,
)
from amhe_cli.estimation.core.result import Iteration
from amhe_cli.estimation.offline.problem import Carried, Problem, spread_floor
from amhe_cli.matching.cost import Residuals, quadratic_prior

Stage = Literal["explore", "polish", "done"]

#: A step shorter than this, in posterior sd, has settled.
SETTLED = 0.3
#: Samples are straight where the mean square of their bend is below this share of that of the residuals: what
#: they miss of a straight line is less than what is left to explain.
STRAIGHT = 1.0
#: A step may leave the middle of the samples by this many of their sd.
REACH = 3.0
#: First iterations that only have to get near, where nothing touches.
ROUGHLY = 2
#: Clips that are enough for them.
FEW = 4
#: Multiples of the Gauss-Newton step that are tried, which on non-smooth costs is often too timid; 0 stays.
LINE = np.array([4.0, 2.0, 1.0, 0.5, 0.2, 0.0])
#: Multiples that are tried first where nothing touches.
WHOLE = np.array([1.0, 0.0])
#: Multiples that are tried there, too, where the cost falls otherwise than its slopes predict.
OTHERS = np.array([4.0, 2.0, 0.5, 0.2])
#: Share of the predicted fall by which the true one may differ from it.
AS_PREDICTED = 0.25
#: Before that the step is corrected by the same slopes, at most so often: in a valley that bends it goes on
#: along the valley (the chord method; one rollout a clip).
CORRECTED = 3
#: A quick search takes the same slopes so often, as long as the cost falls as they predict.
AGAIN = 8
#: It ends with a step of so many posterior sd in a valley that bends, along which the cost does not fall as
#: predicted: the square of a step, halved, is the most that it gains of log likelihood.
BENT = 2.4
#: Where none of these helps, damped steps are tried: the share of each curvature that is added to it
#: (Marquardt 1963).
DAMPED = np.array([0.1, 1.0, 10.0, 100.0])
#: Near its minimum a non-smooth cost cannot distinguish a good step from none: the longest that completes is
#: taken.
BLIND_LINE = np.array([1.0, 0.5, 0.2])


@dataclass(frozen=True, slots=True, eq=False)
class SearchState:
    """State of a linearised search between two iterations; a checkpoint holds just this.

    Args:
        stage: 'explore' re-draws random clips each iteration, 'polish' uses the same ones.
        number: Number of iterations done.
        z: Estimate, shape (d,).
        shape: Shape of the samples of z, (d, d).
        scale: Channel -> residual sd over declared noise sd.
        record: One entry an iteration.
        settled: The last step was short, and the samples no wider than the posterior.
        trail: Estimates after each step of polishing a non-smooth cost, shape (k, d).
        first: Posterior of the clips' first states; None: as recorded.
        straight: Nothing touches, and samples of this width hardly bend: short steps to one side do.
    """

    stage: Stage
    number: int
    z: FloatArray
    shape: FloatArray
    scale: Mapping[str, float] = field(default_factory=dict)
    record: tuple[Iteration, ...] = ()
    settled: bool = False
    trail: FloatArray = field(default_factory=lambda: np.empty((0, 0)))
    first: FirstStates | None = None
    straight: bool = False

    @property
    def done(self) -> bool:
        """Whether the search has finished."""
        return self.stage == "done"


def start(problem: Problem) -> SearchState:
    """State before the first iteration: at the prior's mean, sampling with half its sd.

    Random clips show other contacts each time, and more of long logs. Without either they are no use.
    """
    few = len(problem.clips) <= problem.clip_count and problem.settings.identify.first_state != "polish"
    stage = "polish" if few and not problem.touches else "explore"
    return SearchState(stage, 0, np.zeros(len(problem.system.space)), diagonal(WIDEST, problem.active))


def total(problem: Problem, state: SearchState) -> int:
    """Most iterations that the search may take; where contacts jitter, `last_step` takes the last one."""
    return max(problem.settings.identify.iterations - problem.non_smooth, 1)


def restart(
    problem: Problem,
    z: FloatArray,
    shape: FloatArray | None = None,
    first: FirstStates | None = None,
    scale: Mapping[str, float] | None = None,
) -> SearchState:
    """State that polishes from z (d,), for a part of a solved problem.

    Args:
        problem: The part.
        z: Where to start, shape (d,).
        shape: Shape of the samples of z (d, d) that proved to be straight; None: none did.
        first: What is known of the clips' first states; None: as recorded.
        scale: The noise that a search nearby has left: it begins with all clips, and with this noise.
    """
    if shape is not None:
        return SearchState("polish", ROUGHLY if scale else 0, z, shape, scale or {}, straight=True)
    return SearchState("polish", 0, z, diagonal(0.5 * WIDEST, problem.active), first=first)


def advance(problem: Problem, state: SearchState) -> SearchState:
    """One iteration: draw clips, linearise, step, and decide what comes next."""
    known = next((one for one in problem.newest if one.record is state.record), None)
    known = known if known is None or known.steps < AGAIN else None
    slopes = known.slopes if known else slopes_at(problem, state)
    info = information(slopes, steps=True)
    taken = gauss_newton(problem, state, slopes, info)
    after = stepped(problem, state, slopes, info, taken)
    if problem.quick:
        problem.newest[:] = _carried(problem, slopes, taken, after, known)
    return after


def _carried(
    problem: Problem, slopes: Linearisation, taken: LineStep, after: SearchState, before: Carried | None
) -> Iterator[Carried]:
    """Slopes of all clips, seen from the end of a step, if the cost fell as they predict: they hold there.

    `before`: how they were carried to where the step began.
    """
    if taken.left is None or not taken.predicted or after.first is None:
        return
    cost, noise = problem.cost(problem.clips, after.scale), slopes.cost.noise_scale
    keys = [observed.channel.key for observed in cost.clips.observed]
    quieter = of_residuals(cost, [noise.get(k, 1.0) / cost.noise_scale.get(k, 1.0) for k in keys])
    there = replace(
        slopes,
        cost=cost,
        residual=quieter * taken.left.flat[0],
        gain=quieter * slopes.gain,
        curves=slopes.curves * namespace_of(slopes.curves).asarray(quieter),
        lift=quieter * slopes.lift,
        bend=quieter**2 * slopes.bend,
        first=after.first,
        completed=slopes.completed & taken.left.completed[0],
        rollouts=0,
        diverged=0,
    )
    steps, way = (before.steps, before.way) if before else (0, 0.0)
    yield Carried(after.record, there, steps + 1, way + taken.moved)


def slopes_at(problem: Problem, state: SearchState) -> Linearisation:
    """How an iteration begins: draw clips, and linearise."""
    setting = problem.settings.identify
    exploring, few = state.stage == "explore", _few(problem, state)
    rng, unfitted = problem.rng(0, len(state.record)), exploring
    if problem.non_smooth:  # the last random clips show which errors of first states matter
        last = setting.iterations - setting.polish <= state.number + 1 < total(problem, state)
        unfitted = exploring and not last
    if exploring:
        windows = problem.drawn(rng, min(problem.clip_count, FEW) if few else problem.clip_count)
    else:
        windows = problem.clips[:: max(1, len(problem.clips) // FEW)] if few else problem.clips
    cost = problem.cost(windows, state.scale)
    fitted = setting.first_state == "always" or (setting.first_state == "polish" and not unfitted)
    first = state.first or FirstStates.recorded(len(windows), cost.nx * fitted)
    return problem.linearised(cost, state.z, first, state.shape, rng, straight=state.straight)


def _few(problem: Problem, state: SearchState) -> bool:
    """A search that begins is far away, and a few clips say where to go, if they know all that is sought."""
    far = state.number < ROUGHLY and problem.whole is None
    return far and not problem.touches and not any(part.log.own for part in problem.pool.parts)


def stepped(
    problem: Problem, state: SearchState, slopes: Linearisation, info: Information, taken: LineStep
) -> SearchState:
    """How an iteration ends: take a step, and decide what comes next."""
    setting, few = problem.settings.identify, _few(problem, state)
    exploring, windows = state.stage == "explore", slopes.cost.clips.windows
    if np.isinf(taken.cost) and state.record and np.isinf(state.record[-1].cost):
        raise EstimationError(
            "simulations of these clips diverge: check the logs' units and the order of their joints "
            "(`amhe inspect` shows what looks wrong), then the model's own values"
        )
    shape = _reshaped(problem, state, taken, information(slopes, straight=True), windows)
    number = state.number + 1
    trail = state.trail
    if problem.non_smooth and not exploring:
        trail = np.append(trail.reshape(-1, taken.z.size), taken.z[None], axis=0)
    same = not changed(sampling_sd(state.shape), sampling_sd(shape))
    bent = problem.quick and not (taken.predicted or problem.noise or problem.touches)
    still = (taken.moved < (problem.enough or SETTLED) and same) or (bent and taken.moved < BENT)
    # a step is short, too, while the misfit of an iteration before passes for noise
    quieter = any(sd < 0.8 * state.scale.get(key, 1.0) for key, sd in taken.scale.items() if state.scale)
    settled = still and not few and (problem.touches or not quieter or problem.noise is not None)
    stage = _next_stage(state, number, settled, setting, total(problem, state))
    first = None  # of random clips, and few, others are not known
    if not (exploring or few):  # these clips are the same next time
        first = problem.first_states(info, taken.z - state.z)
    elif problem.non_smooth and stage == "polish" and info.nuisance.shape[1]:
        first = problem.first_of_others(info, problem.clips)
    return replace(
        state,
        stage=stage,
        number=number,
        z=taken.z,
        trail=trail,
        settled=settled,
        shape=shape,
        scale=taken.scale,
        record=(*state.record, _entry(problem, state, taken, slopes)),
        first=first,
        straight=not (problem.touches or (taken.stuck if problem.quick else taken.far))
        and float(slopes.bend.mean()) < STRAIGHT * float((info.residual**2).mean()),
    )


def last_step(problem: Problem, state: SearchState, slopes: Linearisation, info: Information) -> SearchState:
    """The search of a non-smooth cost after a last step, from the linearisation that its result rests on.

    Each step is an estimate from its own samples, whose scatter averages out over the later ones.
    """
    before = replace(state, stage="polish")
    taken = gauss_newton(problem, before, slopes, info)
    trail = np.append(state.trail.reshape(-1, taken.z.size), taken.z[None], axis=0)
    z, record = trail[len(trail) // 3 :].mean(axis=0), (*state.record, _entry(problem, before, taken, slopes))
    return replace(state, number=state.number + 1, z=z, trail=trail, record=record)


@dataclass(frozen=True, slots=True, eq=False)
class LineStep:
    """A Gauss-Newton step that was tried and accepted.

    Args:
        z: The new estimate, shape (d,).
        moved: Length of the step, in posterior sd.
        far: The full step left the region that was sampled, and was shortened, or did not help.
        stuck: It did not help.
        predicted: The cost fell as the slopes predict, so that they hold where the step ends.
        cost: Cost at the new estimate, in units of the declared noise.
        rollouts, diverged: Number of rollouts, and how many of them diverged.
        scale: Channel -> residual sd over declared noise sd.
        left: Residuals of the one candidate where it ended, where nothing touches; None: it diverged.
    """

    z: FloatArray
    moved: float
    far: bool
    stuck: bool
    predicted: bool
    cost: float
    rollouts: int
    diverged: int
    scale: Mapping[str, float]
    left: Residuals | None


def gauss_newton(problem: Problem, state: SearchState, slopes: Linearisation, info: Information) -> LineStep:
    """Step towards the minimum of the linearised cost plus prior; the true cost decides how far."""
    cost, prior = slopes.cost, problem.system.space.prior_precision
    weight = clip_weights(slopes, info) * problem.coverage(cost.clips.windows)
    matrix, score = info.summed(weight)
    whole, hessian = gauss_newton_step(matrix, score, prior, state.z)
    step = step_within(state.z, whole, hessian, problem.system.space) * problem.active
    # slopes of a smooth cost are good beyond the samples: there, the true cost alone decides how far
    width = state.shape if problem.touches else diagonal(WIDEST, problem.active)
    reach = np.abs(coordinates(width, step[None])).max() / REACH
    times = channel_times(cost, info.residual, slopes.completed)

    def along(line: FloatArray, steps: FloatArray) -> _Tried:
        z = problem.system.space.clip(state.z + steps / max(1.0, reach))
        first = info.first(z - state.z)
        residuals = cost.residuals(z, first if first.shape[2] else None)
        values = objective(cost, residuals, first, times, weight)
        return _Tried(line, z, first, residuals, values + quadratic_prior(z, np.zeros_like(state.z), prior))

    blind = problem.non_smooth and state.stage == "polish"
    line = BLIND_LINE[:1] if blind else LINE if problem.touches else WHOLE
    tried = [along(line, line[:, None] * step)]
    if blind and np.isinf(tried[0].values[0]):
        tried.append(along(BLIND_LINE[1:], BLIND_LINE[1:, None] * step))
    held, stay = bool(problem.quick or reach <= 1.0), tried[0].values[-1]
    tested = step / max(1.0, reach) if problem.quick else step
    falls = float((2.0 * whole - tested) @ hessian @ tested)
    if not problem.touches:
        for _ in range(CORRECTED * (reach <= 1.0)):  # a valley that bends is left by a straight step
            if not np.isfinite(tried[-1].values[0]) or _as_predicted(stay - tried[-1].values[0], falls):
                break
            at, score = tried[-1].z[0], _score(slopes, info, weight, tried[-1])
            more, _ = gauss_newton_step(matrix, score, prior, at)
            more = step_within(at, more, hessian, problem.system.space) * problem.active
            tried.append(along(WHOLE[:1], (at + more - state.z)[None]))
    if not problem.touches and not any(_as_predicted(stay - trial.values[0], falls) for trial in tried):
        tried.append(along(OTHERS, OTHERS[:, None] * step))
        if min(trial.values.min() for trial in tried) == stay:
            tried.append(along(1.0 / DAMPED, _damped(hessian, whole, problem.active)))
    trial = min(tried, key=lambda trial: trial.values.min())
    best = int(np.argmax(np.isfinite(trial.values)) if blind else np.argmin(trial.values))
    moved = trial.z[best] - state.z if problem.touches else step
    length = float(np.sqrt(moved @ hessian @ moved))
    stuck = trial.line[best] == 0.0 and length > SETTLED
    if problem.touches or not np.isfinite(trial.values[best]):
        scale, left = fitted_noise_scale(slopes, info, cost.noise_scale), None
    else:  # nothing jitters, so that one rollout shows the misfit that is left after the step
        left, first = trial.residuals_of(best), trial.first[best]
        scale = remaining_noise_scale(cost, left.flat[0], first, weight > 0.0, cost.noise_scale)
    return LineStep(
        z=trial.z[best],
        moved=length,
        predicted=held and _as_predicted(stay - trial.values[best], falls),
        far=bool(reach > 1.0 or stuck),
        stuck=bool(stuck),
        cost=float(cost.as_declared(trial.residuals)[best]),
        rollouts=sum(each.residuals.completed.size for each in tried),
        diverged=sum(int((~each.residuals.completed).sum()) for each in tried),
        scale=scale,
        left=left,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Tried:
    """Multiples of a step (p,), where they lead, z (p, d) and first states (p, c, nx), and the costs (p,)."""

    line: FloatArray
    z: FloatArray
    first: FloatArray
    residuals: Residuals
    values: FloatArray

    def residuals_of(self, one: int) -> Residuals:
        """Those of one of them, on the host."""
        values = tuple(to_host(each[one : one + 1]) for each in self.residuals.values)
        return Residuals(values, self.residuals.completed[one : one + 1])


def _score(slopes: Linearisation, info: Information, weight: FloatArray, trial: _Tried) -> FloatArray:
    """Gradient (d,) of half the data's cost where the first of some steps led, by the slopes from before."""
    gz, gx = np.split(slopes.gain, [trial.z.shape[1]], axis=1)
    pull = weight[:, None, None] * (info.weight * to_host(trial.residuals.stacked[0]))[..., None]
    of_first = (gx @ pull)[..., 0] + weight[:, None] * trial.first[0]
    moved: FloatArray = np.einsum("cxd,cx->d", info.nuisance_gain, of_first)
    return moved + (gz @ pull)[..., 0].sum(axis=0)


def _damped(hessian: FloatArray, step: FloatArray, active: BoolArray) -> FloatArray:
    """Gauss-Newton's step, damped by each of `DAMPED`, shape (p, d)."""
    down, curvature = hessian @ step, np.diag(np.diag(hessian))
    return np.array([np.linalg.solve(hessian + more * curvature, down) for more in DAMPED]) * active


def _as_predicted(fall: float, predicted: float) -> bool:
    """Whether the cost falls as the slopes predict; that of a settled search may differ."""
    return abs(fall - predicted) < AS_PREDICTED * max(predicted, SETTLED**2)


def _reshaped(
    problem: Problem, state: SearchState, taken: LineStep, straight: Information, windows: Sequence[Window]
) -> FloatArray:
    """Shape of the next samples: along the posterior, or wider where the step left the sampled region.

    The posterior is that of `straight` samples: wide ones bend, and would keep themselves wide.
    """
    floor = spread_floor(problem)
    if taken.far:
        return bounded(4.0 * state.shape @ state.shape.T, floor, problem.active, problem.alike)
    matrix = straight.matrix.sum(axis=0) * problem.coverage(windows)
    covariance = np.linalg.inv(matrix + problem.system.space.prior_precision)
    wide = 4.0 * within(covariance, problem.alike)
    if problem.touches:  # with a fading memory of the shape before
        wide += 0.36 * state.shape @ state.shape.T
    return bounded(wide, floor, problem.active, problem.alike)


def _next_stage(
    state: SearchState, number: int, settled: bool, setting: IdentifySettings, most: int
) -> Stage:
    if state.stage == "explore" and number < most:
        late = number >= setting.iterations - setting.polish
        return "polish" if (settled and number >= 3) or late else "explore"
    return "done" if settled or number >= most else "polish"


def _entry(problem: Problem, state: SearchState, taken: LineStep, slopes: Linearisation) -> Iteration:
    return Iteration(
        number=len(state.record) + 1,
        method=f"linearised, {state.stage}",
        stage=state.stage,
        cost=taken.cost,
        sigma=float(sampling_sd(state.shape)[problem.active].mean()) if problem.active.any() else 0.0,
        rollouts=slopes.rollouts + taken.rollouts,
        diverged=slopes.diverged + taken.diverged,
        theta=tuple(float(t) for t in problem.system.space.theta_of(taken.z)),
    )
