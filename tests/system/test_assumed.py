"""The numbers that a model takes for granted: which they are, what they are worth, how they are written."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from amhe_cli.core.errors import ConfigError
from amhe_cli.core.settings import AssumedSettings
from amhe_cli.system.assumed import Acting, Assumed, acting, assumed_of, with_assumed
from amhe_cli.system.system import System

ARM = """
<mujoco><compiler angle="radian"/><option timestep="0.005" gravity="0 0 -10"/><worldbody>
<body name="pedestal"><geom size="0.1" mass="50" contype="0" conaffinity="0"/></body>
<body name="upper"><joint name="shoulder" axis="0 1 0" damping="0.5" armature="0.01" frictionloss="0.1"/>
  <geom size="0.05" mass="2"/>
  <body name="fore" pos="0 0 -0.4">
    <joint name="elbow" axis="0 1 0" damping="0.5" armature="0.02" stiffness="3" range="-1 1" limited="true"/>
    <geom size="0.05" mass="1"/>
    <body name="load" pos="0 0 -0.3"><geom size="0.02" mass="0.5"/></body>
  </body>
</body></worldbody>
<actuator><position name="a" joint="shoulder" kp="60" kv="2" forcerange="-5 5"/>
<position name="b" joint="elbow" kp="60" kv="2" ctrlrange="-0.5 0.5" ctrllimited="true"/></actuator></mujoco>
"""


def arm(*free: dict[str, Any], xml: str = ARM, **assumed: float) -> System:
    """The arm with parameters of these targets."""
    linear = {"nominal": 0.5, "prior_sd": 0.5, "scale": "linear", "bounds": [0.01, 5.0]}
    return System.from_model(
        mujoco.MjSpec.from_string(xml),
        parameters={f"p{i}": linear | {"targets": [target]} for i, target in enumerate(free)},
        signals={
            "joints": {"joints": ["shoulder", "elbow"], "noise": {"position": 0.001}},
            "command": {"actuators": ["a", "b"], "quantity": "position"},
        },
        settings={"identify": {"assumed": assumed}},
        warn=False,
    )


def hit(**rows: list[bool]) -> Acting:
    """Two states in which both servos push; `rows` says what is at a limit in the first of them."""
    both = {name: np.zeros((2, 8), dtype=bool) for name in ("force", "ctrl", "joint_force", "joint")}
    for name, row in rows.items():
        both[name][0, : len(row)] = row
    return Acting(driving=np.ones((2, 2), dtype=bool), **both)


def derived(system: System, acts: Acting | None = None, felt: tuple[str, ...] = ()) -> dict[str, Assumed]:
    return {value.name: value for value in assumed_of(system, acts or hit(), felt, {})}


BALL = '<freejoint/><geom size="0.1" mass="1"/>'
LOAD = {"body": "load", "set": "mass"}


def test_each_number_that_no_parameter_sets_is_derived_and_equal_ones_are_one() -> None:
    found = derived(arm(LOAD))
    assert {name: (value.value, value.sd) for name, value in found.items()} == {
        "the gain of a, b": ("60", 0.1),
        "the velocity gain of a, b": ("2", 0.1),
        "the damping of shoulder, elbow": ("0.5", 0.3),
        "the armature of shoulder": ("0.01", 0.2),
        "the armature of elbow": ("0.02", 0.2),
        "the dry friction of shoulder": ("0.1", 0.3),
        "the stiffness of elbow": ("3", 0.1),
        "the masses of the links": ("3 kg", 0.1),
        "the place of fore on upper": ("0.4 m", 0.01),
        "the place of load on fore": ("0.3 m", 0.01),
        "the base's tilt about x": ("level", 0.01),
        "the base's tilt about y": ("level", 0.01),
        "commands that act at once": ("", 0.005),
    }


def test_what_a_parameter_sets_is_not_assumed() -> None:
    targets = [
        {"joint": "shoulder", "set": "damping"},
        {"actuator": "a", "set": "gain"},
        {"body": "upper", "set": "mass"},
        {"set": "command_delay"},
    ]
    found = derived(arm(*targets))
    assert "the damping of elbow" in found and "the gain of b" in found
    assert found["the masses of the links"].value == "1.5 kg"
    assert "commands that act at once" not in found


def test_many_equal_ones_are_named_by_three() -> None:
    body = '<body><joint name="{0}" type="slide" damping="1"/><geom size="0.1" mass="1"/></body>'
    bodies = "".join(body.format(f"j{i}") for i in range(5))
    xml = ARM.replace("</worldbody>", f"{bodies}</worldbody>")
    assert "the damping of j0, j1, j2 and 2 more" in derived(arm(LOAD, xml=xml))


def test_limits_count_where_they_act_with_their_share_of_the_steps() -> None:
    acts = hit(force=[True, False], ctrl=[False, True], joint=[False, True], joint_force=[True, False])
    xml = ARM.replace('armature="0.01"', 'armature="0.01" actuatorfrcrange="-4 4"')
    found = derived(arm(LOAD, xml=xml), acts)
    limits = {name: value for name, value in found.items() if value.acts is not None}
    assert {name: (value.value, value.sd, value.acts) for name, value in limits.items()} == {
        "the force limit of a": ("5", 0.2, 0.5),
        "the control limit of b": ("0.5", 0.2, 0.5),
        "the force limit of shoulder": ("4", 0.2, 0.5),
        "the range of joint elbow": ("", 0.02, 0.5),
    }


@pytest.mark.parametrize(
    ("targets", "assumed"),
    [
        ([{"carry_limit": True}], True),  # of one factor: nothing says how exact their ratio is
        ([{"carry_limit": True}, {}], False),  # a gain beside it is their ratio
        ([{"carry_limit": True}, {"set": "force_limit"}], False),
        ([{}], True),
    ],
)
def test_a_limit_that_only_follows_a_gain_is_assumed(targets: list[dict[str, Any]], assumed: bool) -> None:
    scales = [{"actuator": "a", "set": "gain", "mode": "scale"} | target for target in targets]
    found = derived(arm(*scales), hit(force=[True, False]))
    assert ("the force limit of a" in found) == assumed and "the gain of a" not in found


def test_what_is_at_a_limit_is_seen_in_states() -> None:
    model = mujoco.MjModel.from_xml_string(ARM)
    spec, qvel = int(mujoco.mjtState.mjSTATE_CTRL), np.zeros((3, 2))
    qpos = np.array([[0.0, 0.0], [0.0, 1.0], [0.0, 0.0]])
    inputs = np.array([[1.0, 0.0], [0.01, 0.6], [0.0, 0.0]])
    found = acting(model, spec, qpos, qvel, inputs)
    np.testing.assert_array_equal(found.force, [[True, False], [False, False], [False, False]])
    np.testing.assert_array_equal(found.ctrl, [[False, False], [False, True], [False, False]])
    np.testing.assert_array_equal(found.joint, [[False, False], [False, True], [False, False]])
    np.testing.assert_array_equal(found.driving, [[True, False], [True, True], [False, False]])


def test_the_centre_of_mass_of_what_is_weighed_is_assumed_where_the_logs_feel_the_mass() -> None:
    system = arm(LOAD)
    found = derived(system, felt=("p0",))
    centres = [name for name in found if "centre of mass" in name]
    assert centres == [f"the centre of mass of load along {axis}" for axis in "xyz"]
    assert {found[name].sd for name in centres} == {0.01}
    assert not [name for name in derived(system) if "centre of mass" in name]


@pytest.mark.parametrize(
    ("xml", "tilts"),
    [
        (ARM, 2),
        (ARM.replace('gravity="0 0 -10"', 'gravity="0 0 0"'), 0),
        (ARM.replace("<worldbody>", f"<worldbody><body>{BALL}</body>"), 2),
        (ARM.replace('<body name="upper">', f'<body>{BALL}<body name="upper">')
         .replace("</worldbody>", "</body></worldbody>"), 0),
    ],
    ids=["fixed", "weightless", "a free body beside it", "floating"],
)  # fmt: skip
def test_a_fixed_base_may_tilt(xml: str, tilts: int) -> None:
    assert sum("tilt" in name for name in derived(arm(LOAD, xml=xml))) == tilts


def test_one_sd_of_each_is_written_into_the_model() -> None:
    system = arm(LOAD)
    found = derived(system, hit(force=[True, False]), ("p0",))
    wider = with_assumed(system, list(found.values()))
    at = dict(zip(wider.space.names, range(len(wider.space)), strict=True))

    def one(name: str, z: float = -1.0) -> mujoco.MjModel:
        moved = np.zeros(len(wider.space))
        moved[at[name]] = z
        return wider.edits.apply(wider.model, wider.space.theta_of(moved))

    assert one("the damping of shoulder, elbow").dof_damping == pytest.approx(0.5 * 0.7)
    assert one("the damping of shoulder, elbow", 1.0).dof_damping == pytest.approx(0.5 / 0.7)
    assert one("the armature of elbow").dof_armature == pytest.approx([0.01, 0.02 * 0.8])
    assert one("the force limit of a").actuator_forcerange[0] == pytest.approx([-4.0, 4.0])
    gains = one("the gain of a, b")
    assert gains.actuator_gainprm[:, 0] == pytest.approx(54.0)
    assert gains.actuator_biasprm[:, 1] == pytest.approx(-54.0)
    assert one("the velocity gain of a, b").actuator_biasprm[:, 2] == pytest.approx(-1.8)
    masses = one("the masses of the links")
    assert masses.body_mass[2:] == pytest.approx([1.8, 0.9, 0.5]), "not of what a parameter weighs"
    assert masses.body_inertia[2] == pytest.approx(0.9 * wider.model.body_inertia[2])
    assert one("the place of fore on upper").body_pos[3] == pytest.approx([0.0, 0.0, -0.4 * 0.99])
    assert one("the centre of mass of load along x", 1.0).body_ipos[4] == pytest.approx([0.01, 0.0, 0.0])


@pytest.mark.parametrize(("axis", "torque"), [("x", 0.0), ("y", 1.0)])
def test_a_tilt_turns_the_base_by_its_angle(axis: str, torque: float) -> None:
    """About y, gravity pulls the hanging arm as if its shoulder were turned by 0.01."""
    system = arm(LOAD)
    wider = with_assumed(system, [derived(system)[f"the base's tilt about {axis}"]])
    model = wider.edits.apply(wider.model, wider.space.theta_of(np.array([0.0, 1.0])))
    data, turned = mujoco.MjData(model), mujoco.MjData(wider.model)
    turned.qpos[0] = 0.01
    mujoco.mj_forward(model, data)
    mujoco.mj_forward(wider.model, turned)
    assert data.qfrc_bias == pytest.approx(torque * turned.qfrc_bias, abs=1e-4 * abs(turned.qfrc_bias[0]))


# -- settings ------------------------------------------------------------------------------------------------


def test_zero_says_that_all_is_exact() -> None:
    exact = System.load("pendulum", {"identify": {"assumed": 0}}).settings.identify.assumed
    assert set(exact.model_dump().values()) == {0.0}
    assert exact.model_dump().keys() == AssumedSettings().model_dump().keys()
    assert {value.sd for value in derived(arm(LOAD, **exact.model_dump())).values()} == {0.0}


@pytest.mark.parametrize(
    ("given", "text"),
    [({"assumed": 1}, "assumed"), ({"assumed": False}, "assumed"), ({"assumed": {"gian": 0.1}}, "gain")],
)
def test_other_settings_are_refused_in_words(given: dict[str, Any], text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        System.load("pendulum", {"identify": given})


def test_a_zero_that_no_parameter_sets_is_no_parameter() -> None:
    edits = System.load(Path(__file__).parents[2] / "examples" / "systems" / "xl330").edits
    assert any(not edit.columns for edit in edits._edits), "a declared zero of the encoder"
    assert edits.taken and not list(edits.considered())


def test_what_is_held_at_a_measured_value_is_assumed_and_what_is_held_as_it_is_stays_so() -> None:
    measured = {
        "motor_gain": {"held": 0.98, "held_sd": 0.02}, "command_latency": {"held": 0.001, "held_sd": 0.002},
        "trunk_load": {"held": 0.3, "held_sd": 0.1},
    }  # fmt: skip
    system = System.load("go1_push", {"parameters": measured}, warn=False)
    found = assumed_of(system, Acting.nothing(system.model), system.space.names, {})
    held = {value.name.partition(",")[0]: value for value in found if value.setting == "held"}
    assert set(held) == set(measured), "each once, though the gain is set in two places"
    assert held["motor_gain"].mode == "scale"
    assert held["motor_gain"].sd == pytest.approx(0.02 / 0.98)
    assert (held["command_latency"].mode, held["command_latency"].sd) == ("add", 0.002)
    assert (held["trunk_load"].mode, held["trunk_load"].sd) == ("add", 0.1)
    wider = with_assumed(system, list(held.values()))
    theta = wider.space.theta_of(np.array([[0.0, 0.0, 0.0, -2.0, -2.0, -2.0]]))
    assert (wider.edits.delays(theta) >= 0.0).all(), "nothing acts before it was commanded"
