"""How much a log reveals about the parameters: Fisher information by the matching cost."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from amhe_cli.core.arrays import FloatArray, namespace_of
from amhe_cli.core.log import Log, Window
from amhe_cli.engine.rollout import Engine
from amhe_cli.estimation.core.information import (
    Information,
    fitted_noise_scale,
    gauss_newton_step,
    information,
    step_within,
)
from amhe_cli.estimation.core.linearise import FirstStates, Linearisation, sampling_width
from amhe_cli.estimation.offline.clips import ClipPool, whole
from amhe_cli.estimation.offline.problem import Problem
from amhe_cli.system.system import System

#: Gauss-Newton steps from the belief to a log's own estimate: at most so many with first states as recorded,
#: and so many with fitted ones, until a step is this small [sd].
FAR, NEAR, SETTLED = 5, 3, 1.0


def clips_of(system: System, log: Log) -> list[Window]:
    """Clips of a log side by side, as `amhe identify` cuts them; none where nothing moves."""
    clips = system.settings.clips
    return ClipPool(system, [whole(log)], clips).cut(0.5 * sum(clips.length))


def problem_of(system: System, windows: Sequence[Window], engine: Engine) -> Problem:
    """The problem of identifying windows of logs."""
    pool = ClipPool(system, windows, system.settings.clips)
    return Problem(system, pool, engine, seed=0, only=tuple(windows))


def information_at(
    problem: Problem, z: FloatArray, rng: np.random.Generator, *, recorded: bool = False
) -> Information:
    """Information of each of c windows at z (d,); its `matrix` has shape (c, d, d).

    Errors of first states are fitted along, as in the last iterations of `amhe identify`: taken as recorded,
    they would pass for noise of the motion. The noise's scale is that of the residuals, with their
    autocorrelation; the samples are as wide as the jitter of contacts needs.

    Args:
        problem: The windows, and rollouts of the system's model.
        z: Where the predictions are linearised, shape (d,).
        rng: Source of the samples.
        recorded: Take first states as recorded, unless the system's settings always fit them; for a robot
            this needs a fifteenth of the rollouts.
    """
    setting, cost = problem.settings.identify, problem.cost(problem.clips)
    as_recorded = recorded and setting.first_state == "polish"
    first = FirstStates.recorded(len(problem.clips), 0) if as_recorded else problem.recorded(cost)
    shape = np.diag(sampling_width(problem.system.space, setting.step) * problem.active)
    # of a few seconds, what is freed of jitter would say less than a log of the usual length will
    found = problem.linearised(cost, z, first, shape, rng, raw=True)
    return information(rescaled(found, fitted_noise_scale(found, information(found), {})))


def rescaled(found: Linearisation, scale: Mapping[str, float]) -> Linearisation:
    """A linearisation in units of another noise: the declared sd times a factor for each channel's key."""
    cost = found.cost
    sizes = [o.mask.shape[1] * o.width for o in cost.clips.observed]
    factor = np.repeat([scale[o.channel.key] for o in cost.clips.observed], sizes)
    return replace(
        found,
        residual=found.residual / factor,
        lift=found.lift / factor,
        gain=found.gain / factor,
        curves=found.curves / namespace_of(found.curves).asarray(factor),
        bend=found.bend / factor**2,
    )


def information_where_it_points(problem: Problem, rng: np.random.Generator) -> FloatArray:
    """Information (d, d) of all windows together, near the windows' own estimate.

    Information depends on the parameters, and the belief may be far from the truth. So a few Gauss-Newton
    steps lead from the belief to an estimate. The first steps take first states as recorded, which is
    cheaper; the last ones fit them, because errors of first states mislead where the data hardly show a
    parameter. The information is that at the point before the last step.
    """
    space = problem.system.space
    z = np.zeros(len(space))
    for recorded, most in ((True, FAR), (False, NEAR)):
        for _ in range(most):
            found = information_at(problem, z, rng, recorded=recorded)
            matrix, score = found.matrix.sum(axis=0), found.score.sum(axis=0)
            whole, hessian = gauss_newton_step(matrix, score, space.prior_precision, z)
            step = step_within(z, whole, hessian, space)
            z = space.clip(z + step)
            if step @ hessian @ step < SETTLED**2:
                break
    return found.matrix.sum(axis=0)
