"""A pendulum that is simulated in memory: the estimator's tests need no log files."""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np
import pytest

from amhe_cli.core.log import Log
from amhe_cli.core.signals import Series
from amhe_cli.system.description.folders import find_system
from amhe_cli.system.system import System

TRUTH = np.array([0.55, 0.03, 0.035, 0.006])
NOISE = (0.002, 0.05)
#: Few samples and clips: these tests are about rightness, not about the last digit.
CHEAP = {"clips": {"count": 6, "length": [0.4, 0.8]}, "identify": {"iterations": 8, "cmaes_iterations": 30}}


@pytest.fixture(scope="session")
def pendulum() -> System:
    return System.load("pendulum", CHEAP)


@pytest.fixture(scope="session")
def delayed(tmp_path_factory: pytest.TempPathFactory) -> System:
    """The pendulum with an unknown command delay, whose prior's mean is a multiple of the time step."""
    folder, source = tmp_path_factory.mktemp("delayed"), find_system("pendulum")
    (folder / "scene.xml").write_text((source / "scene.xml").read_text())
    text = (source / "system.yaml").read_text()
    delay = (
        "  delay:\n    unit: s\n    nominal: 0.02\n    bounds: [0.0, 0.06]\n    scale: linear\n"
        "    prior_sd: 0.01\n    targets:\n      - {set: command_delay}\n"
    )
    (folder / "system.yaml").write_text(text.replace("\nsignals:", delay + "\nsignals:", 1))
    return System.load(folder, CHEAP)


@pytest.fixture(scope="session")
def swing(pendulum: System) -> Callable[..., Log]:
    """Simulate the pendulum under a held multisine command; states are sampled at 100 Hz."""

    def simulate(
        seconds: float,
        seed: int = 0,
        theta: np.ndarray = TRUTH,
        noise: float = 1.0,
        later: np.ndarray | None = None,
        size: float = 0.3,
    ) -> Log:
        rng = np.random.default_rng(seed)
        model = pendulum.edits.apply(pendulum.model, theta)
        switched = pendulum.edits.apply(pendulum.model, theta if later is None else later)
        data = mujoco.MjData(model)
        dt = model.opt.timestep
        steps = round(seconds / dt)
        hertz, phase = rng.uniform(0.2, 2.5, 6), rng.uniform(0.0, 6.28, 6)
        states = np.empty((steps + 1, 3))
        for step in range(steps + 1):
            held = np.floor(step * dt / 0.02 + 1e-9) * 0.02
            data.ctrl[0] = size * np.sin(2.0 * np.pi * hertz * held + phase).sum()
            states[step] = data.qpos[0], data.qvel[0], data.ctrl[0]
            mujoco.mj_step(model if 2 * step < steps else switched, data)
        states[:, :2] += noise * rng.normal(0.0, NOISE, (steps + 1, 2))
        return as_trajectory(states, dt)

    return simulate


def as_trajectory(states: np.ndarray, dt: float, every: int = 5) -> Log:
    """Columns position, velocity, command (T, 3); states count as measured on every fifth row."""
    sampled = np.zeros(len(states), dtype=bool)
    sampled[::every] = True
    valid = np.ones(len(states), dtype=bool)
    valid[np.flatnonzero(sampled)[-1] + 1 :] = False
    rows = np.arange(len(states))

    def between(column: int) -> np.ndarray:
        return np.interp(rows, rows[sampled], states[sampled, column])[:, None]

    return Log(
        dt,
        {
            "joints.position": Series(between(0), valid, sampled, ("hinge",)),
            "joints.velocity": Series(between(1), valid, sampled, ("hinge",)),
            "command.position": Series(states[:, 2:], np.ones_like(valid), sampled, ("servo",)),
        },
        "swing",
    )
