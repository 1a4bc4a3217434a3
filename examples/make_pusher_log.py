"""Make examples/logs/pusher.mcap: a tool with a measured pose pushes a box, and shows the force at its wrist.

    python examples/make_pusher_log.py

The simulation steps four times finer than the models that identify the box (`pusher`, with the pose as the
input, and `pushed_box`, with the force). Poses are noisy, and the force passes a filter.
"""

from __future__ import annotations

import json
from pathlib import Path

import mujoco
import numpy as np

from amhe_cli.core import rotations
from amhe_cli.logs import LogWriter
from amhe_cli.system.system import System

TRUTH = {"box_mass": 1.4, "floor_friction": 0.4}
SECONDS, POSE_HZ, FORCE_HZ, BAND = 10.0, 100, 200, 25.0
POSITION_NOISE, ANGLE_NOISE, FORCE_NOISE = 0.0003, 0.002, 0.05  # sd [m], [rad], [N]
START_NS = 1_700_000_000_000_000_000
FINER = 4


def main() -> None:
    """Simulate and write the log."""
    rng = np.random.default_rng(11)
    system = System.load("pusher")
    model = system.edits.apply(system.model, np.array([TRUTH[name] for name in system.space.names]))
    model.opt.timestep /= FINER
    data, dt = mujoco.MjData(model), model.opt.timestep
    data.qpos[7:10] = data.mocap_pos[0] = tool(0.0)
    path = Path(__file__).parent / "logs" / "pusher.mcap"
    about = {"system": "pusher", "truth": json.dumps(TRUTH), "seed": "11"}
    wrist = model.sensor_adr[model.sensor("amhe/wrist/force").id]
    share, shown = 1.0 - np.exp(-2.0 * np.pi * BAND * dt), np.zeros(3)
    per_pose, per_force = (round(1.0 / hz / dt) for hz in (POSE_HZ, FORCE_HZ))
    with LogWriter(path, about) as log:
        for step in range(round(SECONDS / dt) + 1):
            stamp = START_NS + round(step * dt * 1e9)
            data.mocap_pos[0] = tool(step * dt)
            mujoco.mj_step(model, data)
            shown += share * (data.sensordata[wrist : wrist + 3] - shown)
            if step % per_pose == 0:
                for topic, body in (("/tool", "pusher"), ("/box", "box")):
                    position = data.body(body).xpos + rng.normal(0.0, POSITION_NOISE, 3)
                    turn = rotations.exp(rng.normal(0.0, ANGLE_NOISE, 3))
                    log.pose(topic, stamp, position, rotations.multiply(data.body(body).xquat, turn))
            if step % per_force == 0:
                log.wrench("/wrench", stamp, shown + rng.normal(0.0, FORCE_NOISE, 3), np.zeros(3))
    print(f"{path}: {path.stat().st_size / 1000:.0f} kB")


def tool(time: float) -> np.ndarray:
    """Position of the tool [m] at a time [s]: it pushes, rests, and pushes on."""
    push, phase = divmod(max(time - 0.3, 0.0), 1.0)
    p = min(phase / 0.6, 1.0)
    way = push + 10.0 * p**3 - 15.0 * p**4 + 6.0 * p**5  # with the least jerk
    return np.array([-0.103 + 0.07 * way, 0.012 * np.sin(0.9 * time), 0.06])


if __name__ == "__main__":
    main()
