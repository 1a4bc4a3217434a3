"""What stretches of a log tell about the parameters: Fisher information by the matching cost."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from amhe_cli.core.arrays import FloatArray, namespace_of
from amhe_cli.core.log import Window
from amhe_cli.engine.rollout import Engine
from amhe_cli.estimation.core.information import (
    Information,
    fitted_noise_scale,
    gauss_newton_step,
    information,
)
from amhe_cli.estimation.core.linearise import FirstStates, Linearisation, linearise
from amhe_cli.estimation.core.shape import sampling_width
from amhe_cli.matching.cost import MatchingCost
from amhe_cli.system.system import System

#: Gauss-Newton steps from the belief to where a log points, first states as recorded, then fitted: at most so
#: many, until one is this small [sd].
FAR, NEAR, SETTLED = 5, 3, 1.0


def information_at(
    system: System,
    windows: Sequence[Window],
    engine: Engine,
    z: FloatArray,
    rng: np.random.Generator,
    *,
    recorded: bool = False,
) -> Information:
    """Information of each window on z (d,): `matrix` has shape (c, d, d).

    First states are fitted along, as `amhe identify` does in the end: where they are taken as recorded, what
    their errors do to a surge counts as noise of the surge. The noise is what the residuals then show, their
    autocorrelation included; the samples are as wide as the jitter of contacts asks for.

    Args:
        recorded: Take first states as recorded all the same where the system's settings do not always fit
            them: for a robot a fifteenth of the rollouts.
    """
    setting = system.settings.identify
    cost = MatchingCost(system, windows, engine, system.settings.cost)
    fitted = setting.first_state == "always" or (setting.first_state == "polish" and not recorded)
    first = FirstStates.recorded(len(windows), cost.nx if fitted else 0)
    shape = np.diag(sampling_width(system.space, setting.step))
    found = linearise(cost, z, first, shape, 0, rng)
    return information(rescaled(found, fitted_noise_scale(found, information(found), {})))


def rescaled(found: Linearisation, scale: Mapping[str, float]) -> Linearisation:
    """A linearisation in units of another noise: its declared sd times a factor for each channel."""
    cost = found.cost
    sizes = [o.mask.shape[1] * o.width for o in cost.clips.observed]
    factor = np.repeat([scale[o.channel.key] for o in cost.clips.observed], sizes)
    return replace(
        found,
        residual=found.residual / factor,
        centre=found.centre / factor,
        gain=found.gain / factor,
        curves=found.curves / namespace_of(found.curves).asarray(factor),
        bend=found.bend / factor**2,
    )


def information_where_it_points(
    system: System, windows: Sequence[Window], engine: Engine, rng: np.random.Generator
) -> FloatArray:
    """Information (d, d) of all windows together, at the estimate that a few steps from the belief reach.

    What a log tells is to be asked where its truth is; a belief may be far from it. The first steps take
    first states as recorded, which is cheaper; the last ones fit them, or a push without surges, whose mass
    hardly shows, is led astray by them. It is that of the place from which the last step sets out.
    """
    space = system.space
    z = np.zeros(len(space))
    for recorded, most in ((True, FAR), (False, NEAR)):
        for _ in range(most):
            found = information_at(system, windows, engine, z, rng, recorded=recorded)
            matrix, score = found.matrix.sum(axis=0), found.score.sum(axis=0)
            step, hessian = gauss_newton_step(matrix, score, space.prior_precision, z)
            z = space.clip(z + step)
            if step @ hessian @ step < SETTLED**2:
                break
    return found.matrix.sum(axis=0)
