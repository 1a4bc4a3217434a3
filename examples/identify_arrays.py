"""Identify the damping and the mass of a pendulum from arrays: python examples/identify_arrays.py."""

import mujoco
import numpy as np

import amhe_cli as amhe

ROD = '<geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.02" mass="0.1"/>'
LOAD = '<body name="load" pos="0 0 -0.4"><geom type="sphere" size="0.05" mass="0.5"/></body>'
JOINT = '<joint name="hinge" axis="0 1 0" damping="0.03" stiffness="2"/>'
spec = mujoco.MjSpec.from_string(f"<mujoco><worldbody><body>{JOINT}{ROD}{LOAD}</body></worldbody></mujoco>")
model = spec.compile()
data = mujoco.MjData(model)
data.qpos[0] = 1.0
states = []
for _ in range(4000):  # 8 s of a swing, which a real encoder would measure
    mujoco.mj_step(model, data)
    states.append((data.time, data.qpos[0]))
time, angle = np.array(states[::5]).T
angle += np.random.default_rng(0).normal(0.0, 0.002, angle.size)

system = amhe.System.from_model(
    spec,
    parameters={
        "damping": {"nominal": 0.01, "targets": [{"joint": "hinge", "set": "damping"}]},
        "load": {"nominal": 0.4, "targets": [{"body": "load", "set": "mass"}]},
    },
    signals={"joints": {"joints": ["hinge"], "noise": {"position": 0.002}}},
)
log = amhe.Log.from_arrays({"joints": {"time": time, "position": angle}}, system)
print(amhe.identify(system, log, seed=0))
