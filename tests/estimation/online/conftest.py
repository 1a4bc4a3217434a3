"""A block that is pushed over a floor: mass and friction from its positions, in closed form."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from amhe_cli.core.log import Log
from amhe_cli.core.signals import Series
from amhe_cli.system.system import System

DT, NOISE = 0.005, 1e-3
#: x'' = (force - damping x') / mass: linear, so that every number has an analytic answer.
MODEL = """
<mujoco><option timestep="0.005" gravity="0 0 0"/>
  <worldbody><body name="cart"><joint name="x" type="slide" axis="1 0 0" damping="2"/>
    <geom type="box" size=".1 .1 .1" mass="1"/></body></worldbody>
  <actuator><motor name="push" joint="x"/></actuator></mujoco>
"""
SYSTEM = """
model: cart.xml
parameters:
  mass:
    {unit: kg, nominal: 1.5, bounds: [0.2, 8], prior_sd: 0.5, drift: 0.05, targets: [{body: cart, set: mass}]}
  damping: {nominal: 2.0, bounds: [0.2, 20], prior_sd: 0.5, drift: 0.05, targets: [{joint: x, set: damping}]}
signals:
  state: {topic: /joint_states, joints: [x], noise: {position: 0.001}}
  force: {topic: /force, actuators: [push], quantity: effort}
settings:
  mhe: {step: 0.03}
"""

#: Makes a log: (seconds, mass and damping over time, force over time) -> Log.
Drive = Callable[..., Log]


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("cart")
    (folder / "cart.xml").write_text(MODEL)
    (folder / "system.yaml").write_text(SYSTEM)
    return folder


@pytest.fixture(scope="session")
def cart(folder: Path) -> System:
    """Mass and damping may drift."""
    return System.load(folder)


@pytest.fixture(scope="session")
def constant(folder: Path) -> System:
    """They may not."""
    return System.load(folder, {"parameters": {"mass": {"drift": 0.0}, "damping": {"drift": 0.0}}})


def swing(time: np.ndarray) -> np.ndarray:
    """A force that tells mass and damping apart."""
    return 6.0 * np.sin(2.0 * np.pi * 1.3 * time) + 3.0 * np.sin(2.0 * np.pi * 0.4 * time)


@pytest.fixture(scope="session")
def drive() -> Drive:
    def make(
        seconds: float,
        mass: Callable[[float], float] = lambda t: 2.0,
        damping: Callable[[float], float] = lambda t: 3.0,
        force: Callable[[np.ndarray], np.ndarray] = swing,
        noise: float = NOISE,
        seed: int = 0,
    ) -> Log:
        steps = round(seconds / DT)
        time = DT * np.arange(steps + 1)
        pushed = force(time)
        x, v = np.zeros(steps + 1), np.zeros(steps + 1)
        for k in range(steps):  # the implicit damping of MuJoCo's Euler steps
            m, d = mass(time[k]), damping(time[k])
            v[k + 1] = (m * v[k] + DT * pushed[k]) / (m + DT * d)
            x[k + 1] = x[k] + DT * v[k + 1]
        rng = np.random.default_rng(seed)
        sampled = np.arange(steps + 1) % 2 == 0
        seen = x + noise * rng.standard_normal(x.size)
        ones = np.ones(steps + 1, dtype=bool)
        return Log(
            DT,
            {
                "state.position": Series(seen[:, None], ones, sampled, ("x",)),
                "state.velocity": Series(v[:, None], ones, sampled, ("x",)),
                "force.effort": Series(pushed[:, None], ones, ones, ("push",)),
            },
            "a made-up log",
        )

    return make
