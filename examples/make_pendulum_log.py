"""Make examples/logs/pendulum.mcap: a simulated servo swings a load, with sensor noise and known truth.

    python examples/make_pendulum_log.py

The simulated pendulum steps four times finer than the model that identifies it, so that the example is
not a model matched with itself.
"""

from __future__ import annotations

import json
from pathlib import Path

import mujoco
import numpy as np

from amhe_cli.logs import LogWriter
from amhe_cli.system.system import System

TRUTH = {"load_mass": 0.55, "damping": 0.03, "friction_loss": 0.035, "armature": 0.006}
SECONDS, STATE_HZ, COMMAND_HZ = 15.0, 100, 50
POSITION_NOISE, VELOCITY_NOISE = 0.002, 0.05  # sd [rad], [rad/s]: a 12-bit encoder and its difference
START_NS = 1_700_000_000_000_000_000
FINER = 4


def main() -> None:
    """Simulate and write the log."""
    rng = np.random.default_rng(7)
    system = System.load("pendulum")
    model = system.edits.apply(system.model, np.array([TRUTH[name] for name in system.space.names]))
    model.opt.timestep /= FINER
    data = mujoco.MjData(model)
    path = Path(__file__).parent / "logs" / "pendulum.mcap"
    path.parent.mkdir(exist_ok=True)
    about = {"system": "pendulum", "truth": json.dumps(TRUTH), "seed": "7"}
    steps = round(SECONDS / model.opt.timestep)
    per_state, per_command = (round(1.0 / hz / model.opt.timestep) for hz in (STATE_HZ, COMMAND_HZ))
    target = excitation(rng)
    with LogWriter(path, about) as log:
        for step in range(steps + 1):
            stamp = START_NS + round(step * model.opt.timestep * 1e9)
            if step % per_command == 0:
                data.ctrl[0] = target(step * model.opt.timestep)
                log.joint_state("/joint_commands", stamp, ["hinge"], position=data.ctrl)
            if step % per_state == 0:
                position = data.qpos + rng.normal(0.0, POSITION_NOISE)
                velocity = data.qvel + rng.normal(0.0, VELOCITY_NOISE)
                log.joint_state("/joint_states", stamp, ["hinge"], position, velocity)
            mujoco.mj_step(model, data)
    print(f"{path}: {path.stat().st_size / 1000:.0f} kB")


def excitation(rng: np.random.Generator):
    """A position command [rad] over time [s]: a multisine from slow (friction) to fast (inertia)."""
    hertz = np.geomspace(0.15, 2.5, 6)
    phase = rng.uniform(0.0, 2.0 * np.pi, 6)
    size = 0.9 / np.sqrt(hertz / hertz[0]) / 2.0
    return lambda t: float((size * (np.sin(2.0 * np.pi * hertz * t + phase) - np.sin(phase))).sum())


if __name__ == "__main__":
    main()
