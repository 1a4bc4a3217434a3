"""What in a log contradicts the model or itself; backlash."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

import amhe_cli as amhe
from amhe_cli.core.errors import ConfigError
from amhe_cli.logs import LogWriter
from amhe_cli.system.model.gaps import add_gaps, gaps, set_gaps
from amhe_cli.system.system import System

XML = """
<mujoco>
  <option timestep="0.005"/>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" axis="0 1 0" range="-1.6 1.6" limited="true"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass=".4"/>
      <body name="lower" pos="0 0 -.3">
        <joint name="elbow" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass=".4"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="s" joint="shoulder" kp="5"/>
    <position name="e" joint="elbow" kp="5"/>
  </actuator>
</mujoco>
"""
TIMES = 0.01 * np.arange(600)
SIGNALS = {
    "joints": {"joints": ["shoulder", "elbow"], "noise": {"position": 0.001, "velocity": 0.05}},
    "command": {"actuators": ["s", "e"], "quantity": "position"},
}


@pytest.fixture(scope="module")
def arm() -> amhe.System:
    gain = {"targets": [{"joint": "elbow", "set": "damping"}], "nominal": 0.1}
    spec = mujoco.MjSpec.from_string(XML)
    return amhe.System.from_model(spec, name="arm", parameters={"damping": gain}, signals=SIGNALS)


def motion(velocity: bool = True) -> dict[str, dict[str, np.ndarray]]:
    """Two joints that follow their targets 30 ms later, with noise."""
    rng = np.random.default_rng(0)

    def target(t: np.ndarray) -> np.ndarray:
        return np.stack((np.sin(2.0 * t) + 0.3 * np.sin(5.0 * t), 0.8 * np.cos(3.1 * t) + 0.4), axis=1)

    joints = {"time": TIMES, "position": target(TIMES - 0.03) + rng.normal(0.0, 0.001, (TIMES.size, 2))}
    if velocity:
        joints["velocity"] = (target(TIMES) - target(TIMES - 0.06)) / 0.06 + rng.normal(0.0, 0.05, (600, 2))
    return {"joints": joints, "command": {"time": TIMES, "position": target(TIMES)}}


def said(arrays: dict, arm: amhe.System, caplog: pytest.LogCaptureFixture) -> str:
    caplog.clear()
    with caplog.at_level(logging.WARNING):
        amhe.Log.from_arrays(arrays, arm, name="run")
    return caplog.text


@pytest.mark.parametrize("velocity", [True, False])
def test_what_is_right_is_not_doubted(
    velocity: bool, arm: amhe.System, caplog: pytest.LogCaptureFixture
) -> None:
    assert said(motion(velocity), arm, caplog) == ""


@pytest.mark.parametrize(
    ("signal", "quantity", "factor", "text"),
    [
        (
            "joints",
            "position",
            180.0 / np.pi,
            "'joints': the position looks like degrees (shoulder, elbow); unit",
        ),
        ("joints", "velocity", 180.0 / np.pi, "'joints': the velocity looks like degrees per second (should"),
        (
            "joints",
            ("position", "velocity"),
            180.0 / np.pi,
            "'joints': position reaches 72.75 rad: looks like degrees (shoulder); unit: deg in system.yaml",
        ),
        ("joints", "velocity", 30.0 / np.pi, "'joints': the velocity looks like rpm (shoulder, elbow)"),
        ("command", "position", 180.0 / np.pi, "'command': the command looks like degrees (shoulder, elbow)"),
    ],
)
def test_units(
    signal: str, quantity: Any, factor: float, text: str, arm: amhe.System, caplog: pytest.LogCaptureFixture
) -> None:
    arrays = motion()
    for one in [quantity] if isinstance(quantity, str) else quantity:
        arrays[signal][one] = factor * arrays[signal][one]
    assert f"run: signal {text}" in said(arrays, arm, caplog)


@pytest.mark.parametrize(
    ("joint", "text"),
    [
        (lambda q, v: (q, v * [1.0, -1.0]), "the velocity has the other sign than the position (elbow)"),
        (lambda q, v: (q, v[:, ::-1]), "the velocity is that of elbow's position (shoulder)"),
        (lambda q, v: (q, np.stack((v[:, 0], q[:, 1]), 1)), "the velocity is not the derivative of the pos"),
        (lambda q, v: (np.round(q * 4096 / 2 / np.pi), v), "counts of an encoder (shoulder, elbow)"),
    ],
)  # fmt: skip
def test_what_contradicts_the_velocity(
    joint: Any, text: str, arm: amhe.System, caplog: pytest.LogCaptureFixture
) -> None:
    arrays = motion()
    of = arrays["joints"]
    of["position"], of["velocity"] = joint(of["position"], of["velocity"])
    assert text in said(arrays, arm, caplog)


def test_degrees_without_a_velocity_are_found_by_range(
    arm: amhe.System, caplog: pytest.LogCaptureFixture
) -> None:
    arrays = motion(velocity=False)
    arrays["joints"]["position"] = np.rad2deg(2.0 * arrays["joints"]["position"])
    (line,) = [line for line in said(arrays, arm, caplog).splitlines() if "position reaches" in line]
    assert "looks like degrees (shoulder, elbow); unit: deg" in line


@pytest.mark.parametrize(("base", "doubted"), [("<freejoint/>", False), ("", True)])
def test_a_wheel_of_a_base_that_drives_turns_for_long(
    base: str, doubted: bool, caplog: pytest.LogCaptureFixture
) -> None:
    """Without a velocity: of a joint that hangs on the world, more than 50 rad look like degrees."""
    spec = mujoco.MjSpec.from_string(
        f"""<mujoco><worldbody><body name="base">{base}<geom size=".1" mass="1"/><body name="wheel">
        <joint name="hub" axis="0 1 0"/><geom size=".1" mass="1"/></body></body></worldbody></mujoco>"""
    )
    damping = {"targets": [{"joint": "hub", "set": "damping"}], "nominal": 0.1}
    signals: dict[str, Any] = {"wheels": {"joints": ["hub"], "noise": {"position": 0.001}}}
    arrays = {"wheels": {"time": TIMES, "position": 25.0 * TIMES[:, None]}}
    if base:
        signals["pose"] = {"body": "base"}
        quaternion = np.tile([1.0, 0.0, 0.0, 0.0], (600, 1))
        arrays["pose"] = {"time": TIMES, "position": np.zeros((600, 3)), "orientation": quaternion}
    cart = amhe.System.from_model(spec, name="cart", parameters={"damping": damping}, signals=signals)
    assert ("looks like degrees" in said(arrays, cart, caplog)) == doubted


def test_commands_in_degrees_that_joints_hardly_follow_are_found_by_range(
    arm: amhe.System, caplog: pytest.LogCaptureFixture
) -> None:
    arrays = motion()
    fast = np.sin(np.outer(TIMES, [9.0, 7.0]))
    arrays["command"]["position"] = fast
    assert "degrees" not in said(arrays, arm, caplog)
    arrays["command"]["position"] = np.rad2deg(fast)
    assert "'command': the command looks like degrees (shoulder)" in said(arrays, arm, caplog)


def test_an_encoder_that_wraps(arm: amhe.System, caplog: pytest.LogCaptureFixture) -> None:
    arrays = motion(velocity=False)
    angle = 3.0 + arrays["joints"]["position"][:, 1]
    assert angle.min() < np.pi < angle.max()
    arrays["joints"]["position"][:, 1] = np.mod(angle + np.pi, 2.0 * np.pi) - np.pi
    text = said(arrays, arm, caplog)
    assert "'joints': position jumps by a turn: the encoder wraps (elbow); wraps: true in system.yaml" in text


def test_milliseconds(arm: amhe.System, caplog: pytest.LogCaptureFixture) -> None:
    arrays = motion()
    for signal in arrays.values():
        signal["time"] = 1000.0 * signal["time"]
    with pytest.raises(amhe.AmheError, match="rows for 600 samples: time must be in seconds"):
        amhe.Log.from_arrays(arrays, arm)
    for signal in arrays.values():
        signal["time"] = 0.1 * signal["time"]
    assert "'joints': a sample every 1 s: its times look like milliseconds" in said(arrays, arm, caplog)


def test_a_file_is_doubted_like_arrays(
    arm: amhe.System, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    joints, command = motion()["joints"], motion()["command"]
    degrees = np.rad2deg(joints["position"])
    with LogWriter(tmp_path / "run.mcap") as log:
        for i, time in enumerate(TIMES):
            stamp = 10**18 + round(1e9 * time)
            log.joint_state("/joints", stamp, ["shoulder", "elbow"], degrees[i], joints["velocity"][i])
            log.joint_state("/command", stamp, ["s", "e"], command["position"][i])
    with caplog.at_level(logging.WARNING):
        amhe.read_log(tmp_path / "run.mcap", arm)
    assert "run.mcap: signal 'joints': the position looks like degrees (shoulder, elbow)" in caplog.text


MODEL = """
<mujoco>
  {option}
  <worldbody>
    <geom name="floor" type="plane" size="5 5 1" friction="1 0.005 0.0001"/>
    <body name="box" pos="0 0 0.1">
      <freejoint/><geom name="box" type="box" size="0.1 0.1 0.1" friction="0.5 0.005 0.0001" {box}/>
    </body>
  </worldbody>
  {pair}
</mujoco>
"""
OF_HIP = "signals: {b: {topic: /b, body: box, noise: {position: 0.01}}}\n"


@pytest.fixture
def warnings_of(written: Callable[..., Path], caplog) -> Callable[..., str]:
    """What is warned of one target."""

    def load(target: str, keys: str = "", box: str = "", pair: str = "", option: str = "") -> str:
        model = MODEL.format(box=box, pair=pair, option=option)
        text = f"  p: {{targets: [{target}]{keys}}}\n"
        System.load(written(text, signals=OF_HIP, model=model, more=""))
        return caplog.text

    return load


PAIR = '<contact><pair name="slide" geom1="box" geom2="floor" condim="{}"/></contact>'
FRICTION = "{geom: box, set: sliding_friction}"


BOTH = f"{FRICTION}, {{geom: floor, set: sliding_friction}}"
PRIORITY = 'priority="1"'
#: Of the same body, with a friction of its own: no doubt about the floor's.
LID = '/><geom name="lid" type="sphere" size="0.01"'
ABOVE = ", nominal: 2, bounds: [1.5, 3]"
TORSION = "{pair: slide, set: torsional_friction}"


@pytest.mark.parametrize(
    ("target", "how", "text"),
    [
        (FRICTION, {}, "below 1 it changes nothing against geom 'floor'"),
        (BOTH, {"keys": ", nominal: 0.5"}, None),
        (BOTH, {"keys": ", nominal: 0.5", "box": LID}, None),
        (FRICTION, {"box": PRIORITY}, None),
        ("{geom: floor, set: sliding_friction}", {"box": PRIORITY}, "whose higher priority decides"),
        (FRICTION, {"keys": ABOVE}, None),
        (FRICTION, {"box": 'contype="0" conaffinity="0"', "pair": PAIR.format(3)}, "target the pair"),
        (TORSION, {"pair": PAIR.format(3)}, "'slide' has condim 3; torsional friction acts from condim 4"),
        ("{geom: box, set: rolling_friction}", {}, "rolling friction acts from condim 6"),
        (TORSION, {"pair": PAIR.format(4)}, None),
        (
            "{geom: box, set: contact_time_constant}",
            {"keys": ", bounds: [0.001, 0.1]"},
            "below two time steps, 0.004 s, acts as 0.004 s",
        ),
    ],
)
def test_a_target_that_does_nothing_is_warned_of(warnings_of, target: str, how: dict, text: str) -> None:
    said = warnings_of(target, **how)
    assert said == "" if text is None else text in said


SPARSE = '<option jacobian="sparse" {}/>'


@pytest.mark.parametrize(
    ("version", "option", "warned"),
    [
        ("4.0.0", SPARSE.format(""), True),
        ("4.0.0", "", False),
        ("4.0.0", SPARSE.format('solver="CG"'), False),
        ("4.0.1", SPARSE.format(""), False),
    ],
)
def test_the_sparse_newton_solver_of_mujoco_4_0_0_is_warned_of(
    warnings_of, monkeypatch, version: str, option: str, warned: bool
) -> None:
    monkeypatch.setattr("mujoco.__version__", version)
    text = warnings_of(FRICTION, ABOVE, option=option)
    assert ('<option jacobian="dense"/>' in text) == warned
    assert warned or text == ""


def test_a_nominal_that_is_far_from_the_models_own_number(warnings_of) -> None:
    """A friction of 0.005 that is given as a factor, too, is 200 times too small; a value near it is none."""
    torsional = ", ".join(
        f"{{geom: {geom}, set: torsional_friction, mode: scale}}" for geom in ("box", "floor")
    )
    solid = 'condim="4"'
    assert "starts at" not in warnings_of(torsional, ", nominal: 0.5", box=solid)
    assert "starts at 2.5e-05, where the model's own number is 0.005" in warnings_of(
        torsional, ", nominal: 0.005, bounds: [0.001, 0.01]", box=solid
    )


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


def test_a_factor_on_a_joint_that_has_none_is_said_to_do_nothing(caplog: pytest.LogCaptureFixture) -> None:
    spec = mujoco.MjSpec.from_string(
        """<mujoco><worldbody><body><joint name="dry" frictionloss="0.1"/><geom size="0.1"/>
        <body><joint name="free"/><geom size="0.1"/></body></body></worldbody></mujoco>"""
    )
    factor = {"prior_sd": 0.5, "targets": [{"joint": "*", "set": "friction_loss", "mode": "scale"}]}
    System.from_model(spec, parameters={"p": factor}, signals={"joints": {"joints": ["dry", "free"]}})
    assert "'p': a factor leaves at 0 what free has none of: give a nominal of its own" in caplog.text
