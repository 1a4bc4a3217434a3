"""Backlash: a gap between a joint and its drive."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

from amhe_cli.core.errors import ConfigError
from amhe_cli.system.model.gaps import add_gaps, gaps, set_gaps
from amhe_cli.system.system import System

ARM = """
<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.002" integrator="implicitfast"/>
  <default><joint damping="0.3" frictionloss="0.1"/></default>
  <worldbody>
    <body name="upper" pos="0.1 0 1"><joint name="shoulder" axis="0 1 0" armature="0.02" range="-2 2"/>
      <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="0.5"/>
      <body name="lower" pos="0.3 0 0"><joint name="elbow" axis="0 1 0" pos="0 0.01 0"/>
        <geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.02" mass="0.2"/>
        <body name="hand" pos="0.2 0 0"><joint name="roll" axis="1 0 0"/><joint name="pitch" axis="0 1 0"/>
          <geom size="0.02" mass="0.1"/></body></body></body>
  </worldbody>
  <actuator>
    <position name="shoulder" joint="shoulder" kp="50" kv="1" inheritrange="1"/>
    <position name="elbow" joint="elbow" kp="30" kv="1"/>
  </actuator>
  <keyframe><key name="out" qpos="0.1 0.2 0.3 0.4"/></keyframe>
</mujoco>
"""


def with_gaps(**widths: float) -> tuple[mujoco.MjSpec, mujoco.MjModel]:
    spec = mujoco.MjSpec.from_string(ARM)
    add_gaps(spec, widths)
    return spec, mujoco.MjModel.from_xml_string(spec.to_xml())  # as `init` writes it


def test_drives_take_armature_friction_and_actuators_along() -> None:
    _, model = with_gaps(shoulder=0.02, elbow=0.01)
    own = {name: int(model.joint(name).dofadr[0]) for name in ("shoulder", "shoulder_drive", "elbow_drive")}
    assert model.dof_armature[own["shoulder_drive"]] == 0.02 and not model.dof_armature[own["shoulder"]]
    assert model.dof_armature[own["elbow_drive"]] > 0.0  # the model has none, and a rotor needs inertia
    for field, value in (("dof_damping", 0.3), ("dof_frictionloss", 0.1)):
        assert getattr(model, field)[list(own.values())] == pytest.approx([0.0, value, value])
    driven = [model.joint(int(row)).name for row in model.actuator_trnid[:, 0]]
    assert driven == ["shoulder_drive", "elbow_drive"]
    np.testing.assert_allclose(model.actuator_ctrlrange[0], [-2.0, 2.0])  # inherited from the joint's range
    np.testing.assert_allclose(np.ptp(model.tendon_range, axis=1), [0.02, 0.01])


def test_a_keyframe_puts_each_drive_beside_its_link() -> None:
    _, model = with_gaps(shoulder=0.02, elbow=0.01)
    held = {model.joint(row).name: model.key_qpos[0, model.jnt_qposadr[row]] for row in range(model.njnt)}
    links = {"shoulder": 0.1, "elbow": 0.2, "roll": 0.3, "pitch": 0.4}
    assert held == links | {"shoulder_drive": 0.1, "elbow_drive": 0.2}


def test_drive_and_link_move_freely_within_the_gap_and_no_further() -> None:
    _, model = with_gaps(elbow=0.03)
    model.dof_armature[model.joint("elbow_drive").dofadr] = 0.01
    data = mujoco.MjData(model)
    away = np.empty(3000)
    for step in range(away.size):
        data.ctrl[1] = -1.6 * np.sin(0.002 * np.pi * step)  # from level to above the vertical and back
        mujoco.mj_step(model, data)
        away[step] = data.joint("elbow_drive").qpos[0] - data.joint("elbow").qpos[0]
    assert np.abs(away).max() == pytest.approx(0.015, rel=0.2)  # an impact dents a stop
    assert np.percentile(np.abs(away), 80.0) == pytest.approx(0.015, rel=0.02)


@pytest.mark.parametrize("seen", ["elbow", "elbow_drive"])
def test_what_is_not_measured_starts_at_the_stop_that_carries_the_load(seen: str) -> None:
    _, model = with_gaps(elbow=0.03)
    qpos, qvel = np.zeros((2, model.nq)), np.zeros((2, model.nv))
    at = int(model.joint(seen).qposadr[0])
    qpos[:, at], qvel[:, model.joint(seen).dofadr[0]] = [0.0, -np.pi / 2.0], 0.7  # level, upright
    qpos[1, model.joint("shoulder").qposadr[0]] = 0.0
    set_gaps(model, qpos, qvel, {at})
    drive, link = (qpos[:, model.joint(name).qposadr[0]] for name in ("elbow_drive", "elbow"))
    # gravity turns the level link towards +; its drive holds it from below
    assert drive[0] - link[0] == pytest.approx(-0.015)
    assert abs(drive[1] - link[1]) <= 0.015 + 1e-12
    np.testing.assert_allclose(qvel[:, model.joint("elbow_drive").dofadr[0]], 0.7)
    assert gaps(model)[0].tendon == 0


def test_an_elastic_drive_bends_by_its_torque_and_rings_at_its_frequency() -> None:
    spec = mujoco.MjSpec.from_string(ARM)
    add_gaps(spec, {"elbow": 50.0}, elastic=True)
    model = mujoco.MjModel.from_xml_string(spec.to_xml())
    (spring,) = gaps(model)
    drive, link = (int(model.jnt_dofadr[row]) for row in (spring.drive, spring.link))
    model.dof_frictionloss[:], model.dof_damping[:], model.dof_armature[drive] = (
        0.0,
        0.0,
        1e6,
    )  # a locked rotor
    data, others = mujoco.MjData(model), [d for d in range(model.nv) if d not in (drive, link)]
    model.dof_armature[others] = 1e6
    mujoco.mj_forward(model, data)
    torque, inertia = float(data.qfrc_bias[link]), float(model.dof_M0[link])
    qpos, qvel = np.zeros((1, model.nq)), np.zeros((1, model.nv))
    set_gaps(model, qpos, qvel, {int(model.jnt_qposadr[spring.link])})
    assert qpos[0, model.jnt_qposadr[spring.drive]] == pytest.approx(torque / 50.0)
    angles = np.empty(2000)
    for step in range(angles.size):
        mujoco.mj_step(model, data)
        angles[step] = data.qpos[model.jnt_qposadr[spring.link]]
    ringing = angles - angles[-500:].mean()
    crossings = np.flatnonzero(np.diff(np.sign(ringing[:600])))
    period = 2.0 * model.opt.timestep * np.diff(crossings).mean()
    assert 2.0 * np.pi / period == pytest.approx(np.sqrt(50.0 / inertia), rel=0.03)
    assert angles[-500:].mean() == pytest.approx(-torque / 50.0, rel=0.05)


def test_a_joint_that_shares_its_body_is_refused() -> None:
    with pytest.raises(ConfigError, match="'pitch' shares its body with roll"):
        with_gaps(pitch=0.01)


def test_the_zero_of_an_encoder_moves_drive_and_link(tmp_path: Path) -> None:
    spec, _ = with_gaps(elbow=0.03)
    offset = {"signal": "joints", "set": "bias", "joint": "elbow", "quantity": "position"}
    gap = {"nominal": 0.02, "targets": [{"joint": "elbow", "set": "backlash"}]}
    system = System.from_model(
        spec,
        parameters={"zero": {"bounds": [-0.3, 0.3], "targets": [offset]}, "gap": gap},
        signals={"joints": {"joints": ["elbow"], "noise": {"position": 0.01}}},
        keyframe="out",
    )
    assert system.sets["gap"] == "tendon_range[1] of elbow_backlash; tendon_range[0] of elbow_backlash"
    model = system.edits.apply(system.model, np.array([0.1, 0.05]))
    moved = [model.qpos0[model.joint(name).qposadr[0]] for name in ("elbow", "elbow_drive", "shoulder")]
    np.testing.assert_allclose(moved, [0.1, 0.1, 0.0])
    np.testing.assert_allclose(model.tendon_range[0], [-0.025, 0.025])
    assert ("qpos0", int(model.joint("elbow").qposadr[0])) in system.edits.taken
    assert not list(system.edits.considered())


def test_a_joint_without_a_gap_is_refused_with_what_to_do() -> None:
    target = {"joint": "elbow", "set": "backlash"}
    with pytest.raises(ConfigError, match="no gap in the model; `amhe init --backlash elbow` writes one"):
        System.from_model(
            mujoco.MjSpec.from_string(ARM),
            parameters={"gap": {"nominal": 0.02, "targets": [target]}},
            signals={"joints": {"joints": ["elbow"], "noise": {"position": 0.01}}},
        )
