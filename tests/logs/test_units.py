"""Units and wrapping encoders that a signal declares: read from a file, values come out in SI."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

import amhe_cli as amhe
from amhe_cli.init.folder import init_system

ARM = """<mujoco><compiler angle="radian"/><option timestep="0.01"/><worldbody>
  <body><joint name="pan" axis="0 0 1" armature="0.01" range="-3 3"/><geom size="0.1"/></body></worldbody>
  <actuator><position name="pan" joint="pan" kp="5" kv="1"/></actuator></mujoco>"""
TIMES = np.arange(0.0, 4.0, 0.01)
SWING = 2.5 * np.sin(2.0 * TIMES)


def recorded(folder: Path, angles: np.ndarray, commands: np.ndarray) -> Path:
    (folder / "arm.xml").write_text(ARM)
    rows = np.stack([TIMES, angles, commands], axis=1)
    header = "time,position_pan,command_position_pan"
    np.savetxt(folder / "log.csv", rows, delimiter=",", header=header, comments="", fmt="%.9f")
    return folder / "log.csv"


def test_init_declares_degrees_of_positions_and_commands(tmp_path: Path) -> None:
    log = recorded(tmp_path, np.rad2deg(SWING), np.rad2deg(SWING))
    notes = init_system(tmp_path / "arm.xml", [log], tmp_path / "system").sentences
    system = amhe.System.load(tmp_path / "system")
    read = amhe.read_log(log, system)
    np.testing.assert_allclose(read["joints.position"].values[:, 0], SWING, atol=1e-6)
    np.testing.assert_allclose(read["command.position"].values[:, 0], SWING, atol=1e-6)
    np.testing.assert_allclose(read["joints.velocity"].values[:, 0], 5.0 * np.cos(2.0 * TIMES), atol=0.05)
    assert any(
        "looks like degrees (pan); unit: deg in system.yaml converts a file; it is" in note for note in notes
    )


def test_init_declares_an_encoder_that_wraps_and_it_is_unwrapped(tmp_path: Path) -> None:
    turning = 2.0 * SWING
    log = recorded(tmp_path, np.mod(turning + np.pi, 2.0 * np.pi) - np.pi, turning)
    init_system(tmp_path / "arm.xml", [log], tmp_path / "system")
    read = amhe.read_log(log, amhe.System.load(tmp_path / "system"))
    np.testing.assert_allclose(read["joints.position"].values[:, 0], turning, atol=1e-6)
    np.testing.assert_allclose(read["joints.velocity"].values[:, 0], 10.0 * np.cos(2.0 * TIMES), atol=0.1)


def test_radians_stay_as_they_are(tmp_path: Path) -> None:
    log = recorded(tmp_path, SWING, SWING)
    init_system(tmp_path / "arm.xml", [log], tmp_path / "system")
    text = (tmp_path / "system" / "system.yaml").read_text()
    assert "unit: deg" not in text and "unit: {" not in text and "wraps" not in text


@pytest.mark.parametrize(
    ("keys", "error"),
    [
        ({"unit": "furlong"}, "no unit 'furlong'"),
        ({"unit": {"speed": "deg"}}, "no quantity 'speed'"),
        ({"hold": False}, "hold is for what drives the model"),
        ({"joints": None, "topic": "/x", "wraps": True}, "wraps is for joints"),
    ],
)
def test_units_that_do_not_exist_are_refused(keys: dict, error: str) -> None:
    signal = {"joints": ["pan"], "noise": {"position": 0.01}} | keys
    with pytest.raises(amhe.AmheError, match=error):
        amhe.System.from_model(
            mujoco.MjSpec.from_string(ARM),
            parameters={"a": {"targets": [{"joint": "pan", "set": "armature"}]}},
            signals={"joints": signal},
        )
