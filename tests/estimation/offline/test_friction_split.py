"""Viscous and Coulomb friction that the excitation cannot split: no run claims to know either."""

from __future__ import annotations

import mujoco
import numpy as np

import amhe_cli as amhe

STEP, TRUTH = 0.005, np.array([0.02, 0.28, 0.15])
XML = f"""<mujoco><option timestep="{STEP}" integrator="implicitfast"/><worldbody><body>
  <joint name="drive" axis="0 0 1" armature="0.02" damping="0.2" frictionloss="0.2"/>
  <geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.02" mass="0.3" contype="0" conaffinity="0"/>
  </body></worldbody>
  <actuator><position name="drive" joint="drive" kp="100" kv="2"/></actuator></mujoco>"""


def drive() -> amhe.System:
    words = {"armature": "armature", "viscous": "damping", "coulomb": "friction_loss"}
    return amhe.System.from_model(
        mujoco.MjSpec.from_string(XML),
        parameters={
            name: {"scale": "log", "prior_sd": 0.7, "targets": [{"joint": "drive", "set": word}]}
            for name, word in words.items()
        },
        signals={
            "joints": {"joints": ["drive"], "noise": {"position": 0.003}},
            "command": {"actuators": ["drive"], "quantity": "position"},
        },
        settings={"identify": {"profile_points": 0, "rulers": {"gain": 0, "command_delay": 0}}},
    )


def run(system: amhe.System, turns: np.ndarray, seed: int) -> amhe.Log:
    """To and fro as the turns (n,) at every step say, two for there and back."""
    model = system.edits.apply(system.model, TRUTH)
    data, command = mujoco.MjData(model), np.abs(turns % 2.0 - 1.0) - 0.5
    data.qpos[0], position = command[0], np.empty(len(turns))
    for k, target in enumerate(command):
        position[k] = data.qpos[0]
        data.ctrl[0] = target
        mujoco.mj_step(model, data)
    time = np.arange(len(turns)) * STEP
    position += 0.003 * np.random.default_rng(seed).standard_normal(len(turns))
    return amhe.Log.from_arrays(
        {
            "joints": {"time": time, "position": position[:, None]},
            "command": {"time": time, "position": command[:, None]},
        },
        system,
    )


def test_runs_at_one_speed_know_neither_friction_and_never_contradict() -> None:
    system, time = drive(), np.arange(900) * STEP
    for seed, speed in enumerate((1.9, 2.1)):
        found = amhe.identify(system, [run(system, speed * time, seed)], seed=seed).parameters
        for name, true in zip(("viscous", "coulomb"), TRUTH[1:], strict=True):
            assert found[name].verdict in ("weak", "prior"), (name, seed)
            assert found[name].interval[0] < true < found[name].interval[1]
