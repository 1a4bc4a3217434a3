"""The cost of a match, on the processor and on a card."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from amhe_cli.core.arrays import namespace_of, to_host
from amhe_cli.core.log import Log, Window
from amhe_cli.core.settings import CostSettings
from amhe_cli.core.signals import Series
from amhe_cli.engine.open import open_engine
from amhe_cli.engine.rollout import Predicted
from amhe_cli.estimation.core.information import channel_times, information, objective
from amhe_cli.estimation.core.linearise import FirstStates, Linearisation, averaged, linearise
from amhe_cli.estimation.design.information import rescaled
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


def test_clips_whose_noise_was_another_are_those_that_are_laid_out_with_it():
    windows, z = [Window(toss(), 0, 100), Window(toss(seed=1), 30, 60)], np.array([[0.3, -0.2, 0.0, 0.4]])
    first, second = {"cube.position": 2.0, "cube.orientation": 0.5}, {"cube.position": 3.0}
    anew = MatchingCost(CUBE, windows, ENGINE, SETTINGS, second)
    again = cost(windows).scaled(first).scaled(second)
    np.testing.assert_allclose(again.residuals(z).flat, anew.residuals(z).flat, rtol=1e-12)
    np.testing.assert_allclose(again.as_declared(again.residuals(z)), cost(windows).costs(z), rtol=1e-12)


def test_a_known_noise_stays_whatever_residuals_show():
    """Its autocorrelation times count, and not those of residuals; of some of the clips, too."""
    scale, matching = {"cube.position": 2.0}, cost([Window(toss(), 0, 100), Window(toss(seed=1), 30, 60)])
    times = {o.channel.key: 3.0 + k for k, o in enumerate(matching.clips.observed)}
    known = matching.under(scale, times).of(np.array([1]))
    residual = known.residuals(np.zeros((1, 4))).flat[0]
    assert known.noise_scale == scale
    assert channel_times(known, residual, np.ones(1, dtype=bool)) == tuple(times.values())
    assert matching.times is None and matching.noise_scale == {}


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


def _there(value: Any) -> Any:
    """What a device computes with: its own arrays, and plain numbers."""
    if isinstance(value, (tuple, list)):
        return type(value)(map(_there, value))
    if isinstance(value, np.ndarray):
        raise TypeError("a numpy array on the device: wants asarray")
    return value.values if isinstance(value, DeviceArray) else value


class _Module:
    """numpy's functions for arrays of the device."""

    def __init__(self, module: Any = np) -> None:
        self._module = module

    def __getattr__(self, name: str) -> Any:
        if name == "linalg":
            return _Module(np.linalg)
        if name == "asarray":
            return DeviceArray
        function = getattr(self._module, name)
        return lambda *args, **named: DeviceArray(
            function(*map(_there, args), **{key: _there(value) for key, value in named.items()})
        )


class DeviceArray:
    """An array as of CuPy: no implicit conversion to numpy, no operation with numpy's arrays."""

    __array_ufunc__ = None

    def __init__(self, values: np.ndarray) -> None:
        self.values = values

    def __array__(self, *args: Any, **named: Any) -> np.ndarray:
        raise TypeError("implicit conversion to numpy")

    def __array_namespace__(self) -> _Module:
        return _Module()

    def get(self) -> np.ndarray:
        """To the host."""
        return self.values

    def __len__(self) -> int:
        return len(self.values)

    def __getitem__(self, key: Any) -> DeviceArray:
        return DeviceArray(self.values[key])

    def __getattr__(self, name: str) -> Any:
        if name == "shape":
            return self.values.shape
        method = getattr(self.values, name)
        return lambda *args, **named: DeviceArray(method(*map(_there, args), **named))


def _operator(name: str) -> Any:
    return lambda self, *other: DeviceArray(getattr(self.values, name)(*map(_there, other)))


for _name in ("add", "radd", "sub", "rsub", "mul", "rmul", "truediv", "rtruediv", "pow", "neg", "lt", "gt"):
    setattr(DeviceArray, f"__{_name}__", _operator(f"__{_name}__"))


class DeviceEngine:
    """An engine whose predictions lie on a device."""

    rollout, upon, precision = ENGINE.rollout, ENGINE.upon, ENGINE.precision
    device_bytes = ENGINE.device_bytes

    def predict(self, theta: Any, starts: Any, errors: Any, wanted: Any) -> Predicted:
        done = ENGINE.predict(theta, starts, errors, wanted)
        return Predicted(tuple(map(DeviceArray, done.values)), done.completed)


def both() -> list[MatchingCost]:
    """The same cost on the host and on the device."""
    windows = [Window(toss(), 0, 60), Window(toss(seed=1), 20, 80)]
    return [MatchingCost(CUBE, windows, engine, SETTINGS) for engine in (ENGINE, DeviceEngine())]


def test_the_device_of_these_tests_refuses_numpy() -> None:
    there: Any = DeviceArray(np.ones(3))
    for mixed in (lambda: there + np.ones(3), lambda: np.ones(3) * there, lambda: np.sqrt(there)):
        with pytest.raises(TypeError):
            mixed()
    assert namespace_of(np.ones(3)) is np
    assert to_host(there + 1.0).tolist() == [2.0, 2.0, 2.0]


def test_costs_are_the_same_and_are_numpys() -> None:
    z = np.array([[0.0] * 4, [-0.5, 0.3, 0.2, 0.0]])
    host, device = both()
    here, there = (
        (cost.costs_of(residuals), cost.errors(residuals, "orientation"))
        for cost, residuals in ((cost, cost.residuals(z)) for cost in (host, device))
    )
    for costs in zip(here, there, strict=True):
        assert all(isinstance(values, np.ndarray) for values in costs)
        np.testing.assert_array_equal(*costs)
    assert isinstance(device.residuals(z).stacked, DeviceArray)
    np.testing.assert_array_equal(device.residuals(z).flat, host.residuals(z).flat)


@pytest.mark.parametrize("mean", [False, True])
def test_linearisations_are_the_same_and_are_numpys(mean: bool) -> None:
    def slopes(cost: MatchingCost) -> Linearisation:
        first, rng, shape = FirstStates.recorded(2, cost.nx), np.random.default_rng(0), 0.05 * np.eye(4)
        found = linearise(cost, np.zeros(4), first, shape, 0, rng)
        return averaged(found, shape) if mean else found

    host, device = map(slopes, both())
    for field in ("residual", "lift", "gain", "bend", "completed"):
        np.testing.assert_array_equal(getattr(device, field), getattr(host, field))
    np.testing.assert_array_equal(to_host(device.curves), host.curves)
    np.testing.assert_array_equal(information(device).matrix, information(host).matrix)
    factor = {o.channel.key: 2.0 for o in host.cost.clips.observed}
    np.testing.assert_array_equal(to_host(rescaled(device, factor).curves), host.curves / 2.0)


def test_the_objective_of_a_search_is_the_same() -> None:
    z, first = np.zeros((3, 4)), np.random.default_rng(0).normal(size=(3, 2, 12))
    times, weight = (2.0,) * 4, np.array([1.0, 0.5])
    host, device = (
        objective(cost, cost.residuals(z, first), first, times[: len(cost.clips.observed)], weight)
        for cost in both()
    )
    np.testing.assert_array_equal(device, host)
