"""Make examples/logs/arm.csv: an arm of three servos plays a chirp; its drives are not those of arm.xml.

    python examples/make_arm_log.py

Encoders have noise and are off by an offset, commands act late, and the simulation steps twice as finely
as arm.xml does. TRUTH has the names that `amhe init --actuators` gives the unknowns.
"""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np

JOINTS = ("yaw", "shoulder", "elbow")
TRUTH = {
    **{"yaw_damping": 0.7, "shoulder_damping": 0.55, "elbow_damping": 0.25},
    **{"yaw_friction_loss": 0.25, "shoulder_friction_loss": 0.3, "elbow_friction_loss": 0.1},
    **{"yaw_armature": 0.035, "shoulder_armature": 0.03, "elbow_armature": 0.012},
    **{"yaw_offset": 0.0, "shoulder_offset": 0.03, "elbow_offset": -0.04},
    "command_delay": 0.013,
}
SECONDS, HZ, FINER = 20.0, 100, 2
NOISE = 0.0005  # sd of the encoders [rad]
CENTRE, SIZE = np.array([0.0, -0.4, 0.6]), np.array([0.5, 0.35, 0.4])  # of the chirp [rad]


def main() -> None:
    """Simulate and write the log."""
    rng, folder = np.random.default_rng(5), Path(__file__).parent / "logs"
    model = mujoco.MjModel.from_xml_path(str(folder / "arm.xml"))
    for joint, dof in zip(JOINTS, range(model.nv), strict=True):
        model.dof_damping[dof] = TRUTH[f"{joint}_damping"]
        model.dof_frictionloss[dof] = TRUTH[f"{joint}_friction_loss"]
        model.dof_armature[dof] = TRUTH[f"{joint}_armature"]
    offset = np.array([TRUTH[f"{joint}_offset"] for joint in JOINTS])
    model.opt.timestep /= FINER
    data = mujoco.MjData(model)
    mujoco.mj_setConst(model, data)
    data.qpos[:] = CENTRE - offset
    per_row = round(1.0 / HZ / model.opt.timestep)
    late = round(TRUTH["command_delay"] / model.opt.timestep)
    times = np.arange(round(SECONDS * HZ)) / HZ
    commands = np.array([target(time) for time in times])
    rows = []
    for step in range(len(times) * per_row):
        if step % per_row == 0:
            rows.append(data.qpos + offset + rng.normal(0.0, NOISE, 3))
        data.ctrl[:] = commands[max(0, step - late) // per_row] - offset
        mujoco.mj_step(model, data)
    names = [f"{kind}_{joint}" for kind in ("position", "command_position") for joint in JOINTS]
    table = np.column_stack((times, rows, commands))
    path = folder / "arm.csv"
    formats = ["%.2f", *["%.5f"] * 6]
    np.savetxt(path, table, fmt=formats, delimiter=",", header=",".join(("time", *names)), comments="")
    print(f"{path}: {path.stat().st_size / 1000:.0f} kB")


def target(time: float) -> np.ndarray:
    """Position commands [rad]: a chirp from 0.1 to 5 Hz whose frequency grows exponentially."""
    slowest, growth = 0.1, np.log(5.0 / 0.1) / SECONDS
    phase = 2.0 * np.pi * slowest * np.expm1(growth * time) / growth + np.array([0.0, 2.0, 4.0])
    fade = min(1.0, time) * min(1.0, (SECONDS - time))
    return CENTRE + fade * SIZE / (1.0 + growth * time) * np.sin(phase)


if __name__ == "__main__":
    main()
