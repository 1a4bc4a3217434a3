"""Predictions that lie on a device stay there: what reduces them mixes them with no numpy array."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from amhe_cli.core.arrays import namespace_of, to_host
from amhe_cli.core.log import Window
from amhe_cli.engine.rollout import Predicted
from amhe_cli.estimation.core.information import information, objective
from amhe_cli.estimation.core.linearise import FirstStates, Linearisation, linearise
from amhe_cli.estimation.design.information import rescaled
from amhe_cli.matching.cost import MatchingCost
from tests.matching.test_cost import CUBE, ENGINE, SETTINGS, toss


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


@pytest.mark.parametrize("averaged", [False, True])
def test_linearisations_are_the_same_and_are_numpys(averaged: bool) -> None:
    def slopes(cost: MatchingCost) -> Linearisation:
        first, rng = FirstStates.recorded(2, cost.nx), np.random.default_rng(0)
        return linearise(cost, np.zeros(4), first, 0.05 * np.eye(4), 0, rng, averaged=averaged)

    host, device = map(slopes, both())
    for field in ("residual", "centre", "gain", "bend", "completed"):
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
