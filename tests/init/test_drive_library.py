"""The library of drives, and `init` with a drive of it."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

import amhe_cli as amhe
from amhe_cli.cli.main import run
from amhe_cli.core.belief import belief_of
from amhe_cli.core.errors import ConfigError
from amhe_cli.init.drive_library import LibraryDrive, drive, library
from amhe_cli.system.export.randomisation import randomisation
from amhe_cli.system.export.trainings import MJLAB_TOOL

ARM = """<mujoco><worldbody>
  <body name="upper"><joint name="shoulder" axis="0 1 0"/>
    <geom type="sphere" size=".03" pos="0 0 -.2" mass=".5"/>
    <body name="lower" pos="0 0 -.2"><joint name="elbow" axis="0 1 0"/>
      <geom type="sphere" size=".03" pos="0 0 -.2" mass=".2"/></body></body></worldbody>
  <actuator><position name="shoulder" joint="shoulder" kp="5"/>
    <position name="elbow" joint="elbow" kp="5" forcerange="-1 1"/></actuator></mujoco>"""


@pytest.mark.parametrize("one", library().values(), ids=list(library()))
def test_every_drive_has_a_source_and_numbers_that_a_drive_can_have(one: LibraryDrive) -> None:
    assert one.title and one.source and 0.05 <= one.torque_sd <= 1.0
    servo = one.servo(gain_p=1.0 if one.gains else None)
    numbers = [one.gear, one.volts, one.no_load_speed, servo.kp, servo.kv, servo.limit, servo.armature]
    assert all(number is None or 0.0 < number < 1000.0 for number in numbers)
    assert (one.gains == "counts") == (one.duty_per_count is not None)
    assert (one.armature is None) == (one.armature_sd is None)
    if one.no_load_speed is not None and one.stall_torque is not None:
        assert servo.kv and servo.limit  # at no load the back-EMF takes all of full duty
        assert servo.kv * one.no_load_speed == pytest.approx(servo.limit / (one.max_duty or 1.0))


def test_counts_become_newton_metres() -> None:
    xl330 = drive("dynamixel:xl330-m288").servo(volts=7.4, gain_p=100)
    assert xl330.kp == pytest.approx(100 * 4096 / (2 * np.pi) / (256 * 885) * 7.4 * 0.52 / 5.0, rel=1e-3)
    at_12 = drive("feetech:sts3215", volts=12.0)
    assert at_12.name == "feetech:sts3215-12v"
    soft, stiff = (at_12.servo(12.0, gain).kp for gain in (16, 32))
    assert soft and stiff == pytest.approx(2.0 * soft)
    assert drive("robstride:03").servo(gain_p=40.0).kp == 40.0
    with pytest.raises(ConfigError, match="no public measurement"):
        drive("feetech:sts3250").servo(gain_p=16)
    with pytest.raises(ConfigError, match="did you mean|there is"):
        drive("feetech:sts3216")


def theta_of(system: amhe.System, **values: float) -> np.ndarray:
    return np.array([values.get(p.name, p.nominal) for p in system.space.parameters])


def made(tmp_path: Path, *options: str, gains: str = "", extra: tuple[str, ...] = ()) -> amhe.System:
    times = np.arange(0.0, 2.0, 0.01)
    columns = {"time": times}
    for joint in ("shoulder", "elbow"):
        columns |= {f"pos_{joint}": np.sin(times), f"cmd_pos_{joint}": np.sin(times)}
    columns |= {name: np.full(times.size, 16.0) for name in (*([gains] if gains else []), *extra)}
    table = np.column_stack(list(columns.values()))
    np.savetxt(tmp_path / "arm.csv", table, delimiter=",", header=",".join(columns), comments="")
    (tmp_path / "arm.xml").write_text(ARM)
    paths = [str(tmp_path / name) for name in ("arm.xml", "arm.csv")]
    assert run(["init", *paths, "-o", str(tmp_path / "arm"), "--force", "-q", *options]) == 0
    return amhe.System.load(tmp_path / "arm")


def test_an_export_has_the_back_emf_and_says_what_is_lost(tmp_path: Path) -> None:
    system = made(tmp_path, "--drive", "elbow=feetech:sts3215", "--gain-p", "16")
    servo = drive("feetech:sts3215").servo(gain_p=16)
    size = len(system.space)
    text = randomisation(system, belief_of(system, np.zeros(size), 1e-6 * np.eye(size)), MJLAB_TOOL)
    (elbow,) = (line for line in text.splitlines() if 'target_names_expr=("elbow",)' in line)
    numbers = {key: float(value) for key, value in re.findall(r"(\w+)=([\d.]+)", elbow)}
    assert numbers["stiffness"] == pytest.approx(servo.kp, rel=1e-2)
    assert numbers["damping"] == pytest.approx(servo.kv, rel=1e-2)
    assert "# firmware of servos: punch" in text


@pytest.mark.parametrize("gains", ["", "P_Coefficient"])
def test_a_drive_takes_the_place_of_the_guesses(gains: str, tmp_path: Path, capsys) -> None:
    given = () if gains else ("--gain-p", "16")
    options = ("--actuators", "--drive", "elbow=feetech:sts3215", "--volts", "7.4", *given)
    system = made(tmp_path, *options, gains=gains)
    servo = drive("feetech:sts3215").servo(7.4, 16)
    prior = {p.name: (p.nominal, p.prior_sd) for p in system.space.parameters}
    assert prior["elbow_gain"] == pytest.approx((servo.kp, 0.1), rel=5e-3)
    assert prior["elbow_torque_scale"] == (1.0, 0.15)
    assert prior["elbow_back_emf"] == pytest.approx((servo.kv, 0.15), rel=5e-3)
    assert prior["elbow_punch"] == (0.016, 0.02) and prior["elbow_supply_sag"] == (0.1, 0.15)
    assert system.model.actuator("elbow").forcerange == pytest.approx([-servo.limit, servo.limit], rel=1e-3)
    at_08 = system.edits.apply(system.model, theta_of(system, elbow_torque_scale=0.8))
    for field in ("forcerange", "gainprm"):  # one torque per volt is in all that the servo gives
        scaled, own = (getattr(model.actuator("elbow"), field) for model in (at_08, system.model))
        assert scaled == pytest.approx(0.8 * own)
    assert prior["elbow_armature"] == pytest.approx((0.024, 0.3))
    assert prior["shoulder_armature"][1] == 1.0  # a guess, as before
    assert "shoulder_torque_scale" not in prior
    said = capsys.readouterr().out
    assert ("the drives' gain is 16, by the log's column P_Coefficient" in said) == bool(gains)


def test_a_log_has_the_supply_of_a_drive_and_says_whether_it_is_on(tmp_path: Path) -> None:
    columns = ("elbow_voltage", "elbow_torque_enable")
    system = made(tmp_path, "--actuators", "--drive", "elbow=feetech:sts3215", extra=columns)
    assert [driving.key for driving in system.inputs][1:] == [
        "elbow_voltage.voltage",
        "elbow_enabled.enabled",
    ]
    assert system.fixed["elbow_supply"] == 7.4
    assert "elbow_supply_sag" not in system.space.names  # the voltage has sagged already


def test_mistakes_are_one_line(tmp_path: Path, capsys) -> None:
    made(tmp_path)
    paths = [str(tmp_path / name) for name in ("arm.xml", "arm.csv")]
    for options, text in (
        (("--drive", "wrist=feetech:sts3215"), "no driven joint 'wrist'"),
        (("--drive", "elbow=feetech:x"), "no drive 'feetech:x'"),
        (("--volts", "12"), "--volts and --gain-p belong to --drive"),
    ):
        assert run(["init", *paths, "-o", str(tmp_path / "other"), *options]) == 2
        assert text in capsys.readouterr().err


def test_the_command_lists_them(capsys) -> None:
    assert run(["drives"]) == 0
    out = capsys.readouterr().out
    assert all(name in out for name in library())
    assert run(["drives", "dynamixel:mx-64", "--volts", "15", "--gain-p", "8", "--json"]) == 0
    (one,) = json.loads(capsys.readouterr().out)["drives"]
    assert one["servo"]["kp"] == pytest.approx(8 * 0.158 * 15 * 6.0 / 12.0)
    assert run(["drives", "feetech", "--volts", "12"]) == 2
