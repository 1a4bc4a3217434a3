"""Make examples/logs/arm_torque.csv and arm_torque.xml: joint torques of an arm that moves, and its model.

    python examples/make_arm_torque_log.py

The log has positions, velocities and torques of seven joints, as arms with torque sensors record them, and no
targets. The arm has what its model does not: a tool of 0.8 kg, friction, and sensors that are not at zero.
"""

from pathlib import Path

import mujoco
import numpy as np

from amhe_cli.engine.inverse import forces_along

HERE = Path(__file__).parent / "logs"
#: Each link: where its joint is on the one before, its roll there [deg], mass, centre, half lengths.
LINKS = (
    ((0, 0, 0.33), 0, 3.5, (0, -0.03, -0.08), (0.06, 0.06, 0.12)),
    ((0, 0, 0), -90, 3.2, (0, -0.08, 0.03), (0.06, 0.12, 0.06)),
    ((0, -0.32, 0), 90, 2.9, (0.04, 0.03, -0.06), (0.06, 0.06, 0.1)),
    ((0.08, 0, 0), 90, 2.7, (-0.04, 0.05, 0.03), (0.07, 0.1, 0.06)),
    ((-0.08, 0.38, 0), -90, 2.5, (0, 0.04, -0.11), (0.05, 0.05, 0.13)),
    ((0, 0, 0), 90, 1.5, (0.05, 0.01, 0), (0.07, 0.05, 0.05)),
    ((0.09, 0, 0), 90, 0.7, (0.01, 0.01, 0.08), (0.05, 0.05, 0.05)),
)
SECONDS, RATE = 15.0, 200.0
DRY = np.array([0.55, 0.7, 0.5, 0.6, 0.35, 0.25, 0.2])
VISCOUS = np.array([0.6, 0.8, 0.5, 0.7, 0.3, 0.2, 0.15])
OFFSET = np.array([0.3, -0.2, 0.25, 0.1, -0.1, 0.08, -0.05])
NOISE = np.array([0.25, 0.25, 0.2, 0.2, 0.1, 0.1, 0.06])


def arm() -> mujoco.MjSpec:
    """The arm as its maker models it: with servos, without friction."""
    spec = mujoco.MjSpec()
    spec.modelname, body = "arm_torque", spec.worldbody
    for i, (place, roll, mass, centre, half) in enumerate(LINKS, 1):
        turn = np.deg2rad(roll) / 2.0
        body = body.add_body(name=f"link{i}", pos=place, quat=[np.cos(turn), np.sin(turn), 0.0, 0.0])
        square = np.array(half) ** 2
        body.explicitinertial, body.mass, body.ipos = True, mass, np.array(centre)
        body.inertia = mass / 3.0 * (square.sum() - square)
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=half, pos=centre, contype=0, conaffinity=0)
        joint = body.add_joint(name=f"joint{i}", axis=[0, 0, 1], armature=0.1)
        servo = spec.add_actuator(name=f"servo{i}", trntype=mujoco.mjtTrn.mjTRN_JOINT, target=joint.name)
        servo.set_to_position(kp=4500.0, kv=450.0)
    return spec


def motion(t: np.ndarray, rng: np.random.Generator) -> list[np.ndarray]:
    """Positions, velocities and accelerations (T, 7): sums of sines of 0.1 to 0.8 Hz."""
    w = 2.0 * np.pi * np.array([0.1, 0.2, 0.35, 0.55, 0.8])[:, None, None]
    phase, size = rng.uniform(0, 2 * np.pi, (5, 1, 7)), rng.uniform(0.3, 1.0, (5, 1, 7)) * (w / w[0]) ** -0.9
    return [
        (0.6 * size * w**k * np.sin(w * t[:, None] + phase + k * np.pi / 2)).sum(axis=0) for k in range(3)
    ]


def main() -> None:
    """Write both files."""
    spec, rng = arm(), np.random.default_rng(6)
    spec.compile()
    (HERE / "arm_torque.xml").write_text(spec.to_xml())
    last = spec.body("link7")
    tool = last.add_body(name="tool", pos=[0.0, 0.0, 0.15])
    tool.explicitinertial, tool.mass, tool.ipos, tool.inertia = True, 0.8, [0.02, 0.0, 0.03], [0.002] * 3
    model = spec.compile()
    model.dof_armature, model.dof_damping = 0.0, VISCOUS  # the sensors are behind the gears
    t = np.arange(0.0, SECONDS, 1.0 / RATE)
    q, v, a = motion(t, rng)
    torque = forces_along(model, q, v, a).needed + DRY * np.sign(v) + OFFSET
    torque += NOISE * rng.standard_normal(q.shape)
    q = q + 1e-4 * rng.standard_normal(q.shape)
    late = motion(t - 0.005, np.random.default_rng(6))[1]  # a filter of the robot's own
    names = [f"{kind}{i}" for kind in ("q", "dq", "tau") for i in range(1, 8)]
    rows = np.column_stack((t, q, late, torque))
    formats = ["%.3f", *7 * ["%.5f"], *7 * ["%.4f"], *7 * ["%.3f"]]
    header = ",".join(["time", *names])
    np.savetxt(HERE / "arm_torque.csv", rows, fmt=formats, delimiter=",", header=header, comments="")


if __name__ == "__main__":
    main()
