"""Systems as they are read: files, mistakes, identity and cost."""

from __future__ import annotations

import logging
import struct
import time
import zlib
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import pytest

from amhe_cli.core.bundled import bundled_root
from amhe_cli.core.errors import ConfigError
from amhe_cli.core.limits import limit
from amhe_cli.core.yaml_file import YamlFile, scalar
from amhe_cli.matching.readings import reading_of
from amhe_cli.system.description.folders import find_system
from amhe_cli.system.description.targets import WORDS
from amhe_cli.system.model.files import compiled, read_spec
from amhe_cli.system.system import System
from tests.conftest import MODELS
from tests.system.conftest import MODEL

Write = Callable[..., Path]

WRONG = """\
model: scene.xml
keyframe: hone
colour: red
parameters:
  friction:
    nominal: "0.5"
    bounds: [0.1, 1.5]
    targets:
      - {pair: slide, set: sliding_friction}
  mass:
    targets:
      - {body: boxx, set: mass}
      - {geom: floor, set: sliding_frction}
  damping:
    scale: logg
    targets: [{joint: hip, set: damping, mod: scale}]
  stray: {}
signals:
  hip:
    topic: /joint_states
    joints: [hipp]
    noise: {positon: 0.01}
  knee:
    topic: /joint_states
    joints: [keen]
  none:
    joints: [hip]
  both: {topic: /x, body: box, site: imu}
settings:
  clips: {lenght: [0.3, 2]}
"""


def problems(folder: Path, **overrides) -> list[str]:
    with pytest.raises(ConfigError) as error:
        System.load(folder, overrides)
    return [line.removeprefix(f"{folder / 'system.yaml'}:") for line in str(error.value).splitlines()]


def test_every_mistake_is_reported_with_its_place(written: Write) -> None:
    folder = written("")
    (folder / "system.yaml").write_text(WRONG)
    assert problems(folder) == [
        "2:11: no keyframe 'hone' (did you mean 'home'?); there is: home",
        "3:1: no key 'colour'; there is: boxes, keyframe, match, model, parameters, robot, settings, "
        "signals, unknowns",
        "6:14: nominal is '0.5'; a number (without quotes) would be valid",
        "12:9: no body 'boxx' (did you mean 'box'?); there is: arm, ball, box, hand, marker, table, world",
        "13:9: no target 'sliding_frction' (did you mean 'sliding_friction'?); there is: "
        + ", ".join(sorted(WORDS)),
        "15:12: scale is 'logg'; 'log' or 'linear' would be valid",
        "16:42: no key 'mod' (did you mean 'mode'?); there is: actuator, axis, body, carry_inertia, "
        "carry_limit, geom, joint, mode, pair, quantity, set, signal",
        "17:3: parameters.stray lacks the key 'targets'",
        "19:3: no quantity 'positon' (did you mean 'position'?); there is: angular_velocity, effort, "
        "enabled, force, linear_acceleration, linear_velocity, orientation, position, torque, value, "
        "velocity, voltage",
        "25:5: no joint 'keen' (did you mean 'knee'?); there is: box, hip, knee, socket",
        "26:3: signals.none lacks the key 'topic'",
        "28:3: a signal is one thing; keep one of: body, site",
        "30:11: no key 'lenght' (did you mean 'length'?); there is: count, held_out, held_out_first_only, "
        "held_out_least, held_out_length, length, still",
    ]


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("model: a\nmodel: b\n", "2:1: key 'model' is here twice; its first value is in line 1"),
        ("model: [\n", "2:1: not valid YAML"),
        ("model: !!bool foo\n", "1:8: not valid YAML: 'foo' is no bool"),
        ("model:\n  - !!timestamp foo\n", "2:5: not valid YAML: 'foo' is no timestamp"),
        ("- a\n", "1:1: this file must be a mapping"),
        ("", "1:1: this file lacks the key 'model'"),
        (
            "model: !!python/object/apply:os.system [ls]\n",
            "1:8: not valid YAML: could not determine a constructor",
        ),
        ("a: {b: 1, b: 2}\nc: 1\nc: 2\n", "1:11: key 'b' is here twice"),
    ],
)
def test_what_is_no_system_file_is_refused(text: str, line: str, tmp_path: Path) -> None:
    (tmp_path / "system.yaml").write_text(text)
    assert any(problem.startswith(line) for problem in problems(tmp_path))


def test_a_missing_or_broken_model_is_a_mistake_of_the_model_key(written: Write) -> None:
    folder = written("  p: {targets: [{body: box, set: mass}]}\n")
    (folder / "scene.xml").write_text("<mujoco><worldbody><geom/></worldbody></mujoco>")
    assert "1:8: MuJoCo cannot compile the model" in problems(folder)[0]
    (folder / "scene.xml").write_text("<mujoco><worldbod/></mujoco>")
    assert "1:8: MuJoCo cannot read 'scene.xml'" in problems(folder)[0]
    (folder / "scene.xml").unlink()
    assert "1:8: no file 'scene.xml' beside this one" in problems(folder)[0]


def test_numbers_and_words_are_what_people_mean() -> None:
    assert scalar("1e-3") == 0.001
    assert scalar("010") == 10
    assert scalar("on") == "on"
    assert scalar("yes") == "yes"
    assert scalar("[1, .5, true, null, ~]") == [1, 0.5, True, None, None]
    assert scalar("12:30") == "12:30"


def test_a_missing_file_and_a_binary_one_are_errors(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="No such file"):
        YamlFile(tmp_path / "no.yaml")
    (tmp_path / "b.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="not a text file"):
        YamlFile(tmp_path / "b.yaml")


def test_bundled_systems_are_found_by_name_and_folders_by_path(tmp_path: Path) -> None:
    assert find_system("pendulum") == bundled_root() / "models" / "pendulum"
    assert find_system(str(bundled_root() / "models" / "cube_toss")).name == "cube_toss"
    with pytest.raises(ConfigError, match=r"did you mean 'pendulum'\?\); there is: cube_toss, .*pendulum"):
        find_system("pendulun")
    with pytest.raises(ConfigError, match="amhe init"):
        find_system(str(tmp_path))


def test_joints_that_no_signal_measures_are_named_unless_a_keyframe_holds_them(
    written: Write, caplog
) -> None:
    target = "  p: {targets: [{body: box, set: mass}]}\n"
    with caplog.at_level(logging.WARNING):
        System.load(written(target))
        assert not caplog.records
        System.load(written(target, more=""))
    assert "no signal gives the state of joint box, knee, socket" in caplog.text


def test_overrides_reach_settings_parameters_and_signals(written: Write) -> None:
    folder = written("  p: {targets: [{body: box, set: mass}]}\n")
    overrides = {
        "clips": {"length": [0.1, 0.2]},
        "parameters": {"p": {"nominal": 3.0}},
        "signals": {"hip": {"topic": "/other"}},
    }
    system = System.load(folder, overrides)
    assert system.settings.clips.length == (0.1, 0.2)
    assert system.settings.clips.count == 24
    assert system.space.nominal[0] == 3.0
    assert system.signals[0].topic == "/other"


def test_wrong_overrides_are_named_as_settings(written: Write) -> None:
    folder = written("  p: {targets: [{body: box, set: mass}]}\n")
    assert problems(folder, clip={"length": 1})[0].startswith("no setting 'clip' (did you mean 'clips'?)")
    assert problems(folder, clips={"count": "many"}) == [
        "setting clips.count: count is 'many'; a number (without quotes) would be valid"
    ]
    assert problems(folder, parameters={"p": {"bounds": [3, 4]}})[0].startswith("setting parameters.p")
    assert problems(folder, parameters={"q": {"nominal": 1.0}}) == [
        "setting parameters.q: no parameter 'q'; there is: p"
    ]
    assert problems(folder, parameters={"p": {"nominl": 1.0}})[0].startswith(
        "setting parameters.p.nominl: no key 'nominl' (did you mean 'nominal'?)"
    )


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({"clips": {"length": [2, 0.3]}}, "length [2, 0.3] is the wrong way round; write the lower number"),
        ({"clips": {"held_out": float("nan")}}, "setting clips.held_out: "),
        ({"clips": {"still": float("inf")}}, "setting clips.still: "),
        ({"clips": {"held_out_length": float("inf")}}, "setting clips.held_out_length: "),
        ({"cost": {"huber": float("inf")}}, "setting cost.huber: "),
        ({"logs": {"max_gap": -1.0}}, "setting logs.max_gap: "),
        ({"identify": {"model_error": {"q": 0.1}}}, "setting identify.model_error.q: no parameter 'q'"),
        ({"mhe": {"systematic": {"q": 0.1}}}, "setting mhe.systematic.q: no parameter 'q'"),
        ({"mhe": {"prior_weight": {"q": 1.0}}}, "setting mhe.prior_weight.q: no parameter 'q'"),
        ({"parameters": 5}, "setting parameters: parameters is 5; a mapping of names would be valid"),
    ],
)
def test_settings_that_make_no_sense_are_one_line(written: Write, overrides: dict, message: str) -> None:
    folder = written("  p: {targets: [{body: box, set: mass}]}\n")
    (line,) = problems(folder, **overrides)
    assert message in line


def test_a_wrong_pair_in_the_file_has_its_place(written: Write) -> None:
    folder = written(
        "  p: {targets: [{body: box, set: mass}]}\n", more="settings: {clips: {length: [2, 1]}}\n"
    )
    assert problems(folder)[0].startswith("2:20: length [2, 1] is the wrong way round")


def test_a_key_given_twice_does_not_hide_other_mistakes(written: Write) -> None:
    folder = written("  p:\n    nominal: 1\n    nominal: 2\n    targets: [{body: bix, set: mass}]\n")
    first, second = problems(folder)
    assert first.startswith("6:5: key 'nominal' is here twice; its first value is in line 5")
    assert "no body 'bix'" in second


def test_a_wrong_only_signal_does_not_hide_wrong_names(written: Write) -> None:
    parameters = (
        "  p: {targets: [{body: bix, set: mass}]}\n"
        "  delay: {nominal: 0.01, bounds: [0, 0.1], targets: [{set: command_delay}]}\n"
    )
    first, second = problems(written(parameters, signals="signals: {hip: {topic: /j, joints: 3}}\n"))
    assert "no body 'bix'" in first
    assert second.endswith("joints is 3; a list or a mapping of names would be valid")


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ("clips: {length: 2}", "length is 2; [shortest, longest] would be valid"),
        ("clips: {length: [2]}", "length is [2]; [shortest, longest] would be valid"),
        ("clips: {length: [1, 2, 3]}", "length is [1, 2, 3]; [shortest, longest] would be valid"),
        ("clips: {length: [-1, 2]}", "length[0] is -1; a number above 0 would be valid"),
        ("clips: {count: 2.5}", "count is 2.5; a whole number would be valid"),
        ("clips: {held_out: .nan}", "held_out is nan; a finite number would be valid"),
        ("clips: {held_out: 1}", "held_out is 1; a number below 1 would be valid"),
        ("logs: {align: maybe}", "align is 'maybe'; true or false would be valid"),
        ("clips: 3", "clips is 3; a mapping of keys to values would be valid"),
    ],
)
def test_what_would_be_valid_is_reported_in_plain_words(written: Write, more: str, message: str) -> None:
    folder = written("  p: {targets: [{body: box, set: mass}]}\n", more=f"settings: {{{more}}}\n")
    assert problems(folder)[0].endswith(message)


def test_an_unknown_robot_is_refused_and_the_known_ones_are_named(written: Write) -> None:
    robots = {path.parent.name for path in (MODELS.parent / "amhe_cli" / "robots").glob("*/settings.py")}
    known = " or ".join(f"'{name}'" for name in sorted(robots))
    mine = "settings: {spot: {kp: 3}, control: {}}\n"  # that nobody checks them is no second mistake
    folder = written("  p: {targets: [{body: box, set: mass}]}\n", more="robot: spot\n" + mine)
    (problem,) = problems(folder)
    assert problem.endswith(f"robot is 'spot'; {known} would be valid")


@pytest.mark.parametrize(
    ("parameters", "signals", "message"),
    [
        ("  {}\n", "signals: {}\n", "parameters is empty; at least 1 of them would be valid"),
        ("  p: {targets: []}\n", "signals: {}\n", "targets is empty; at least 1 of them would be valid"),
        (
            "  p: {targets: [{body: box, set: mass}]}\n",
            "signals: {hip: {topic: /j, joints: [hip], noise: 0.1}}\n",
            "noise is 0.1; a mapping such as {position: 0.002} would be valid",
        ),
        (
            "  p: {targets: [{body: box, set: mass}]}\n",
            "signals: {hip: {topic: /j, joints: [hip], noise: {position: 0.1}, compare: [velocity]}}\n",
            "velocity cannot be compared without its noise; add it to noise: {...}",
        ),
        (
            "  p: {targets: [{body: box, set: mass}]}\n",
            "signals: {hip: {topic: /j, joints: [hip], noise: {position: 0.1}, slope: {position: 0.1}}}\n",
            "position is no velocity, and has no slope of its own",
        ),
        (
            "  p: {bounds: 3, targets: [{body: box, set: mass}]}\n",
            "signals: {}\n",
            "bounds is 3; [lower, upper] would be valid",
        ),
    ],
)
def test_empty_groups_and_wrong_shapes(written: Write, parameters: str, signals: str, message: str) -> None:
    assert any(line.endswith(message) for line in problems(written(parameters, signals=signals)))


MASS = "  p: {targets: [{body: box, set: mass}]}\n"
HIP = "{topic: /j, joints: [hip, knee], noise: {position: 0.01, effort: 0.1}"


def load(written: Write, signal: str, target: str = "", more: str = "") -> System:
    parameters = f"  p: {{targets: [{target}], bounds: [-1, 1]}}\n" if target else MASS
    return System.load(written(parameters, signals=f"signals:\n  s: {signal}\n{more}"), warn=False)


def test_numbers_are_those_of_the_file_until_a_parameter_sets_them(written: Write) -> None:
    system = load(
        written,
        HIP + ", bias: {effort: [0.3, 0.4]}, scale: {effort: 2}}",
        "{signal: s, set: bias, quantity: effort, joint: knee}",
    )
    assert system.space.nominal[0] == 0.4  # the file's own
    assert system.space.parameters[0].unit == "N m"
    reading = system.calibration.readings["s.effort"]
    numbers = system.edits.numbers(np.array([[0.4], [0.7]]))
    np.testing.assert_array_equal(numbers[:, list(reading.bias)], [[0.3, 0.4], [0.3, 0.7]])
    np.testing.assert_array_equal(numbers[:, list(reading.scale)], 2.0)
    assert "s.position" not in system.calibration.readings


def test_each_joint_may_have_a_torque_constant_of_its_own(written: Write) -> None:
    knee = "  p: {targets: [{signal: s, set: scale, quantity: effort, joint: knee}]}\n"
    system = System.load(written(knee, signals=f"signals:\n  s: {HIP}}}\n"), warn=False)
    reading = system.calibration.readings["s.effort"]
    numbers = system.edits.numbers(np.array([[0.5]]))
    np.testing.assert_array_equal(numbers[:, list(reading.scale)], [[1.0, 0.5]])
    (channel,) = (c for c in system.channels if c.key == "s.effort")
    shown = reading_of(channel, reading, numbers, np.array([[[3.0, 4.0]]]))
    np.testing.assert_array_equal(shown, [[[3.0, 2.0]]])


def test_the_zero_of_an_encoder_moves_stops_and_springs_along(written: Write) -> None:
    plain, moved = load(written, HIP + "}").model, load(written, HIP + ", bias: {position: [0.2, 0]}}").model
    hip = int(plain.joint("hip").qposadr[0])
    assert moved.qpos0[hip] - plain.qpos0[hip] == pytest.approx(0.2)
    assert moved.qpos_spring[hip] - plain.qpos_spring[hip] == pytest.approx(0.2)
    np.testing.assert_allclose(
        moved.jnt_range[plain.joint("hip").id] - plain.jnt_range[plain.joint("hip").id], 0.2
    )
    knee = int(plain.joint("knee").qposadr[0])
    assert moved.qpos0[knee] == plain.qpos0[knee]


@pytest.mark.parametrize(
    ("signal", "text"),
    [
        (HIP + ", bias: {effort: [1, 2, 3]}}", "bias of effort has 3 numbers; it needs 2"),
        (HIP + ", bias: {force: 1}}", "no quantity with a bias 'force'"),
        (HIP + ", scale: 0}", "scale is 0; a number above 0"),
        (HIP + ", frame: [0, 0, 0, 0, 0, 0]}", "frame of a body or site"),
        (HIP + ", frame: [0, 0, 0]}", "frame is [0, 0, 0]; world, body, or [x, y, z, roll, pitch, yaw]"),
        (HIP + ", frame: body}", "frame: body is for force_on"),
        (HIP + ", band: -1}", "band is -1; a number above 0"),
        (HIP + ", smooth: 0.1}", "smooth is for what drives the model"),
        (HIP + ", at: grip}", "at is for force_on"),
        (HIP + ", reaction: true}", "reaction is for forces and torques"),
        (HIP + ", active: 3}", "active is 3; times such as [[0.5, 3.0]], or a signal and its value"),
        (HIP + ", active: [[0, 1], [4, 1]]}", "active: a stretch from 4 to 1 s ends before it begins"),
        (HIP + ", active: {on: 1}}", "active: no signal that is only read 'on'"),
        (
            "{topic: /m, mocap: marker, scale: 2}",
            "scale is for what is compared with the model, and for force_on",
        ),
        ("{topic: /m, mocap: marker, band: 2}", "band is for numbers that are compared"),
        ("{topic: /f, force_on: box, at: s}", "the signal 's' must be only read, with quantity: position"),
        (
            "{topic: /i, site: imu, noise: {position: 1, force: 1}, frame: [0, 0, 0, 0, 0, 1]}",
            "in the world and in the site's own axes: split it in two",
        ),
    ],
)
def test_what_makes_no_sense_is_refused(written: Write, signal: str, text: str) -> None:
    with pytest.raises(ConfigError) as raised:
        load(written, signal)
    (line,) = str(raised.value).splitlines()
    assert text in line and "system.yaml:" in line, line


def test_a_declared_zero_of_an_encoder_is_no_parameter_that_is_held(written: Write) -> None:
    system = load(
        written,
        HIP + ", bias: {position: 0.03}}",
        more="  c: {topic: /c, actuators: [hip_servo], quantity: position}\n",
    )
    assert list(system.edits.considered()) == []


@pytest.mark.parametrize(
    ("target", "text"),
    [
        ("{signal: t, set: bias}", "no signal 't'; there is: s"),
        ("{signal: s, set: bias}", "say which quantity: one of position, velocity, effort"),
        ("{signal: s, set: bias, quantity: effort, joint: hop}", "no joint, actuator or axis of this signal"),
        ("{signal: s, set: band}", "give the signal a band of its own, such as band: 100"),
        ("{signal: s, set: frame, axis: yaw}", "frame of a body or site"),
        ("{signal: s, set: frame}", "needs axis: one of x, y, z, roll, pitch, yaw"),
        ("{signal: s, set: mass}", "target 'mass' needs body: NAME, not signal"),
        ("{joint: hip, set: bias}", "target 'bias' needs signal: NAME, not joint"),
    ],
)
def test_a_target_that_makes_no_sense_is_refused(written: Write, target: str, text: str) -> None:
    with pytest.raises(ConfigError) as raised:
        load(written, HIP + "}", target)
    (line,) = str(raised.value).splitlines()
    assert text in line and "system.yaml:" in line, line


PARAMETERS = {
    "mass": {"prior_sd": 0.1, "targets": [{"body": "box", "set": "mass"}]},
    "damping": {"nominal": 0.2, "targets": [{"joint": "[hk]*", "set": "damping"}]},
    "scale": {"targets": [{"geom": "box", "set": "sliding_friction", "mode": "scale"}]},
    "delay": {"nominal": 0.01, "bounds": [0.0, 0.05], "targets": [{"set": "command_delay"}]},
}
SIGNALS = {"hip": {"joints": ["hip"], "noise": {"position": 0.01}}, "command": {"actuators": ["hip_servo"]}}


def made(xml: str = MODEL, **changes: object) -> System:
    arguments = {"parameters": PARAMETERS, "signals": SIGNALS, "name": "one"} | changes
    return System.from_model(mujoco.MjSpec.from_string(xml), warn=False, **arguments)  # pyright: ignore


def changed(other: System) -> list[str]:
    own = made()
    assert own.parts.keys() == other.parts.keys()
    return [part for part in own.parts if own.parts[part] != other.parts[part]]


@pytest.mark.parametrize(
    ("old", "new", "parts"),
    [
        ('damping="0.3"', 'damping="0.4"', ["joints"]),
        ('mass="1"/>', 'mass="1.1"/>', ["bodies"]),
        ('kp="20"', 'kp="21"', ["actuators"]),
        ('gear="3"', 'gear="-3"', ["actuators"]),
        ('friction="1 0.005 0.0001"', 'friction="0.9 0.005 0.0001"', ["geoms"]),
        ('solref="0.02 1"', 'solref="0.03 1"', ["contact pairs"]),
        ("<worldbody>", '<option timestep="0.001"/><worldbody>', ["options"]),
    ],
)
def test_a_changed_model_is_known_by_its_part(old: str, new: str, parts: list[str]) -> None:
    assert old in MODEL
    assert changed(made(MODEL.replace(old, new, 1))) == parts


def test_what_does_not_act_makes_no_other_model() -> None:
    assert changed(made(name="two")) == []
    assert changed(made(parameters={k: PARAMETERS[k] for k in ("damping", "scale")})) == []
    nominal = PARAMETERS["damping"] | {"nominal": 0.5}
    assert changed(made(parameters=PARAMETERS | {"damping": nominal})) == []
    assert changed(made().fixing({"mass": 2.5, "scale": 0.7})) == []
    visual = '<geom type="sphere" size="0.3" mass="0" contype="0" conaffinity="0"/>'
    seen = MODEL.replace('<body name="box" pos="0 0 0.1">', f'<body name="box" pos="0 0 0.1">{visual}')
    assert changed(made(seen)) == []


def test_the_same_model_has_the_same_parts_in_another_folder(tmp_path: Path) -> None:
    for name in ("here", "there"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "model.xml").write_text(MODEL)
        (tmp_path / name / "system.yaml").write_text(
            "model: model.xml\nparameters: {mass: {targets: [{body: box, set: mass}]}}\n"
            "signals: {hip: {topic: /j, joints: [hip], noise: {position: 0.01}}}\n"
        )
    here, there = (System.load(tmp_path / name, warn=False) for name in ("here", "there"))
    assert here.parts == there.parts == made().parts


def test_what_a_parameter_sets_is_in_words() -> None:
    assert made().sets == {
        "mass": "body_mass of box with its inertia",
        "damping": "dof_damping of hip, knee",
        "scale": "scale geom_friction[0] of box",
        "delay": "command_delay",
    }


def test_a_fixed_parameter_is_in_the_model_and_not_in_theta() -> None:
    whole = made()
    system = whole.fixing({"damping": 0.7, "delay": 0.02})
    assert system.space.names == ("mass", "scale") and system.fixed == {"damping": 0.7, "delay": 0.02}
    full = whole.edits.apply(whole.model, np.array([3.0, 0.7, 0.5, 0.02]))
    free = system.edits.apply(system.model, np.array([3.0, 0.5]))
    for field in ("body_mass", "body_inertia", "dof_damping", "geom_friction", "dof_M0"):
        np.testing.assert_array_equal(getattr(free, field), getattr(full, field))
    late = [[0.02, 0, 0, 0, 0, 0]]
    np.testing.assert_array_equal(system.edits.delays(np.ones((2, 2))), late * 2)
    assert system.model.dof_damping[6] == 0.7
    np.testing.assert_array_equal(
        system.edits.upon(whole.model).delays(np.ones((1, 2))), [[0.02, 0, 0, 0, 0, 0]]
    )


def test_a_prior_without_width_fixes_a_parameter() -> None:
    known = PARAMETERS | {"damping": PARAMETERS["damping"] | {"prior_sd": 0}}
    system = made(parameters=known)
    assert system.fixed == {"damping": 0.2} and "damping" not in system.space.names
    assert system.model.dof_damping[6] == 0.2
    with pytest.raises(ConfigError, match="every parameter has the prior_sd 0"):
        made(parameters={"damping": known["damping"]})


def test_only_fixes_all_others_at_their_nominal_values() -> None:
    system = made().fixing({"mass": 1.5}, only=["dam*", "scale"])
    assert system.space.names == ("damping", "scale") and system.fixed == {"mass": 1.5, "delay": 0.01}


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"fix": {"mas": 1.0}}, "`fix`: no parameter 'mas' (did you mean 'mass'?)"),
        ({"fix": {"mass": 99.0}}, "`fix`: mass cannot be 99.0; between 0.2 and 20 would be valid"),
        ({"only": ["dampin"]}, "`only`: no parameter 'dampin' (did you mean 'damping'?)"),
        ({"only": "mass"}, "`only`: give a list of names"),
        ({"only": ["mass"], "fix": {"mass": 2.0}}, "`only`: mass is fixed too"),
        ({"fix": {"mass": 2.0, "damping": 0.2, "scale": 1.0, "delay": 0.01}}, "every parameter is fixed"),
    ],
)
def test_a_wrong_name_or_value_is_refused(arguments: dict, said: str) -> None:
    with pytest.raises(ConfigError) as error:
        made().fixing(**arguments)
    assert said in str(error.value) and "\n" not in str(error.value)


def png(path: Path, width: int, height: int) -> Path:
    """A black picture, a byte for each eight pixels before it is packed."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head, rows = struct.pack(">IIBBBBB", width, height, 1, 0, 0, 0, 0), bytes((1 + (width + 7) // 8) * height)
    parts = (b"IHDR", head), (b"IDAT", zlib.compress(rows, 1)), (b"IEND", b"")
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(chunk(kind, data) for kind, data in parts))
    return path


def refused(path: Path, inner: str) -> str:
    path.write_text(f"<mujoco>{inner}<worldbody><geom size='.1'/></worldbody></mujoco>")
    begun = time.process_time()
    with pytest.raises(ConfigError) as error:
        read_spec(path)
    assert time.process_time() - begun < 5.0
    assert "\n" not in str(error.value)
    return str(error.value)


TEXTURE = "<asset><texture name='a' type='2d' file='a.png'/></asset>"


@pytest.mark.parametrize(
    "inner",
    [
        TEXTURE,
        "<asset><texture name='a' type='cube' fileright='a.png'/></asset>",
        "<compiler texturedir='in'/><asset><texture name='a' type='2d' file='b.png'/></asset>",
        "<asset><hfield name='h' file='a.png' size='1 1 1 1'/></asset>",
    ],
)
def test_an_image_that_unfolds_to_too_much(inner: str, tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    for name in ("a.png", "in/b.png"):
        png(tmp_path / name, 8000, 8000)
    assert "64000000 pixels of its images are beyond the limit model_numbers" in refused(
        tmp_path / "m.xml", inner
    )


def test_usual_images_are_read(tmp_path: Path) -> None:
    png(tmp_path / "a.png", 64, 64)
    (tmp_path / "m.xml").write_text(f"<mujoco>{TEXTURE}<worldbody><geom size='.1'/></worldbody></mujoco>")
    assert compiled(read_spec(tmp_path / "m.xml")).ntex == 1


@pytest.mark.parametrize(
    ("inner", "name"),
    [
        ("<option iterations='1000000000' tolerance='0'/>", "model_iterations"),
        ("<option iterations='10000' ls_iterations='1e4'/>", "model_iterations"),
        ("<option noslip_iterations='2000000'/>", "model_iterations"),
        ("<keyframe>" + "<key/>" * 90_000 + "</keyframe>", "model_elements"),
        ("<worldbody>" + "<body><geom size='.1'/></body>" * 3_000 + "</worldbody>", "model_elements"),
        ("<custom><numeric name='n' size='1000000000'/></custom>", "model_numbers"),
        ("<size nuser_geom='900000'/>" + "<worldbody><geom size='.1'/></worldbody>" * 50, "model_numbers"),
        (
            "<asset>" + "<hfield name='h' nrow='4000' ncol='4000' size='1 1 1 1'/>" * 4 + "</asset>",
            "model_numbers",
        ),
        ("<asset><mesh name='a' builtin='supersphere' params='100000 1 1'/></asset>", "model_numbers"),
        ("<sensor><user dim='100000000'/></sensor>", "model_numbers"),
        ("<!--" + "x" * 2**21 + "-->", "model_mib"),
    ],
)
def test_a_number_that_asks_for_too_much(inner: str, name: str, tmp_path: Path) -> None:
    with limit(model_mib=1 if name == "model_mib" else 64):
        assert f"beyond the limit {name} = " in refused(tmp_path / "m.xml", inner)


def test_models_that_are_attached_count_each_time(tmp_path: Path) -> None:
    geoms = "<geom size='.1'/>" * 100
    (tmp_path / "c.xml").write_text(f"<mujoco><worldbody><body name='x'>{geoms}</body></worldbody></mujoco>")
    attach = "".join(f"<attach model='c' body='x' prefix='{i}'/>" for i in range(20))
    middle = (
        f"<asset><model name='c' file='c.xml'/></asset><worldbody><body name='x'>{attach}</body></worldbody>"
    )
    (tmp_path / "b.xml").write_text(f"<mujoco>{middle}</mujoco>")
    attach = attach.replace("'c'", "'b'")
    whole = f"<asset><model name='b' file='b.xml'/></asset><worldbody><body>{attach}</body></worldbody>"
    assert "beyond the limit model_elements" in refused(tmp_path / "m.xml", whole)
    assert len(read_spec(tmp_path / "b.xml").geoms) == 2000


def test_what_only_mujoco_reads_is_refused(tmp_path: Path) -> None:
    """Its parser takes attributes twice and entities that are none; the look before would be blind."""
    text = refused(tmp_path / "m.xml", "<option timestep='0.01'timestep='0.02'/>")
    assert "no well-formed XML" in text and "line 1" in text
