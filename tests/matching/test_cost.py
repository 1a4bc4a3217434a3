"""The one cost: zero at the truth, blind to quaternion signs, robust, +inf where the simulation diverged."""

import numpy as np
import pytest

from amhe_cli.core.log import Log, Window
from amhe_cli.core.settings import CostSettings
from amhe_cli.core.signals import Series
from amhe_cli.engine.open import open_engine
from amhe_cli.matching.cost import MatchingCost, quadratic_prior
from amhe_cli.system.system import System

CUBE = System.load("cube_toss")
ENGINE = open_engine(CUBE)
SETTINGS = CostSettings(trim=0.0)


def toss(flip: bool = False, seed: int = 0, steps: int = 150) -> Log:
    """A cube that falls and slides under the nominal parameters, without noise."""
    rng = np.random.default_rng(seed)
    qpos = np.concatenate(([0.0, 0.0, 0.12], rng.normal(size=4)))
    qpos[3:] /= np.linalg.norm(qpos[3:])
    qvel = np.concatenate(([0.8, -0.3, -0.5], rng.normal(0.0, 3.0, 3)))
    done = ENGINE.rollout(
        CUBE.space.nominal[None], qpos[None], qvel[None], np.zeros((1, steps, 0)), np.array([steps])
    )
    qpos = np.vstack((qpos, done.qpos[0]))
    qvel = np.vstack((qvel, done.qvel[0]))
    if flip:
        qpos[::2, 3:] *= -1.0
    yes = np.ones(steps + 1, dtype=bool)

    def series(values, names):
        return Series(values, yes, yes, tuple(names))

    return Log(
        CUBE.model.opt.timestep,
        {
            "cube.position": series(qpos[:, :3], "xyz"),
            "cube.orientation": series(qpos[:, 3:], "wxyz"),
            "cube.linear_velocity": series(qvel[:, :3], "xyz"),
            "cube.angular_velocity": series(qvel[:, 3:], "xyz"),
        },
        "toss",
    )


def cost(windows, engine=ENGINE, settings=SETTINGS) -> MatchingCost:
    return MatchingCost(CUBE, windows, engine, settings)


def test_no_misfit_at_the_truth_from_any_instant():
    log = toss()
    matching = cost([Window(log, 0, 100), Window(log, 30, 60), Window(log, 0, 150)])
    assert matching.costs(np.zeros((1, 4))) == pytest.approx(0.0, abs=1e-12)


def test_misfit_away_from_it():
    costs = cost([Window(toss(), 0, 150)]).costs(
        np.array([[0.0] * 4, [-1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0]])
    )
    assert costs[0] < 1e-12
    assert (costs[1:] > 1.0).all()


def test_a_log_may_flip_quaternion_signs():
    z = np.array([[-0.5, 0.3, 0.2, 0.0]])
    plain, flipped = (cost([Window(toss(flip), 0, 150)]).costs(z) for flip in (False, True))
    assert plain == pytest.approx(flipped, rel=1e-9)


def test_costs_do_not_depend_on_the_company():
    log = toss()
    z = np.array([[-0.5, 0.3, 0.2, 0.0], [0.5, 0.0, 0.0, 0.0]])
    together = cost([Window(log, 0, 50), Window(log, 20, 120)])
    alone = cost([Window(log, 20, 120)])
    np.testing.assert_array_equal(
        together.clip_costs(together.residuals(z))[:, 1], alone.clip_costs(alone.residuals(z))[:, 0]
    )


def test_residuals_of_whole_rollouts_are_those_of_a_prediction():
    log = toss()
    matching, z = cost([Window(log, 0, 50), Window(log, 20, 120)]), np.array([-0.5, 0.3, 0.2, 0.0])
    (done,) = matching.rolled_out(z, None)
    found, expected = matching.residuals_of(done), matching.residuals(z[None])
    np.testing.assert_array_equal(found.flat, expected.flat)
    np.testing.assert_array_equal(found.completed, expected.completed)


def test_first_state_errors_move_the_rollout():
    matching = cost([Window(toss(), 0, 80)])
    zero = matching.residuals(np.zeros((1, 4)), np.zeros((1, 1, matching.nx))).flat
    moved = matching.residuals(np.zeros((1, 4)), np.full((1, 1, matching.nx), 0.5)).flat
    assert matching.nx == 12
    assert np.abs(zero).max() < 1e-6 < np.abs(moved).max()


class Diverging:
    """An engine whose second clip never completes under the first candidate."""

    rollout, upon, precision = ENGINE.rollout, ENGINE.upon, ENGINE.precision
    device_bytes = ENGINE.device_bytes

    def predict(self, theta, starts, errors, wanted):
        predicted = ENGINE.predict(theta, starts, errors, wanted)
        predicted.completed[0, 1] = False
        return predicted


def test_a_diverged_candidate_costs_infinity_even_where_the_worst_clip_is_trimmed():
    log = toss()
    windows = [Window(log, 0, 50), Window(log, 20, 50), Window(log, 40, 50), Window(log, 60, 50)]
    matching = cost(windows, Diverging(), CostSettings(trim=0.5))
    costs = matching.costs(np.zeros((2, 4)))
    assert np.isinf(costs[0])
    assert np.isfinite(costs[1])


def test_errors_are_distances_and_angles():
    log = toss()
    shifted = dict(log.series)
    far = np.array(shifted["cube.position"].values)
    far[1:] += [0.003, 0.0, 0.004]
    old = shifted["cube.position"]
    shifted["cube.position"] = Series(far, old.valid, old.sampled, old.columns)
    matching = cost([Window(Log(log.dt, shifted, "far"), 0, 100)])
    residuals = matching.residuals(np.zeros((1, 4)))
    assert matching.errors(residuals, "position")[0, 0] == pytest.approx(0.005, abs=1e-9)
    assert matching.errors(residuals, "orientation")[0, 0] == pytest.approx(0.0, abs=1e-9)


def test_the_arrival_cost_is_the_quadratic_form():
    precision = np.array([[2.0, 0.5], [0.5, 1.0]])
    values = quadratic_prior(np.array([[1.0, 2.0], [0.0, 0.0]]), np.array([0.0, 0.0]), precision)
    assert values == pytest.approx([2.0 + 4.0 + 2.0, 0.0])
