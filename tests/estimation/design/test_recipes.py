"""Excitation for robots: it stays in its leeway, and what breaks a bound in simulation is not chosen."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

import amhe_cli as amhe
from amhe_cli.core.errors import ConfigError
from amhe_cli.engine.bounds import Bounds, Broken
from amhe_cli.estimation.design.probe import ActuatorProbe, ProbeOptions, nothing_left
from amhe_cli.estimation.design.recipes import RECIPES, Leeway, driven_controls, leeway_of, recipes
from amhe_cli.logs import read_log
from amhe_cli.system.system import System

LEEWAY = Leeway(
    rest=np.array([0.0, 0.5, 0.0]),
    lower=np.array([-1.0, 0.0, -2.0]),
    upper=np.array([1.0, 0.6, 2.0]),
    speed=np.array([2.0, 1.0, np.inf]),
    fastest=np.array([2.0, 1.0, 3.0]),
    joints=np.array([0, 1, 2]),
)
TIMES = 0.01 * np.arange(800, dtype=np.float64)
ARM = """
<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.004" integrator="implicitfast"/>
  <worldbody>
    <body name="upper"><joint name="shoulder" axis="0 1 0" range="-1 1"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.03" mass="0.5"/>
      <body name="lower" pos="0 0 -0.3"><joint name="elbow" axis="0 1 0" range="-2.9 2.9"/>
        <geom name="forearm" type="capsule" fromto="0 0 -0.1 0 0 -0.2" size="0.02" mass="0.2"/></body></body>
    <body name="wall" pos="0.35 0 -0.4"><geom name="wall" type="box" size="0.1 0.1 0.5"/></body>
  </worldbody>
  <actuator>
    <position name="shoulder" joint="shoulder" kp="20" kv="1" forcerange="-8 8"/>
    <position name="elbow" joint="elbow" kp="10" kv="0.5"/>
  </actuator>
</mujoco>"""


def arm(model: str = ARM, more: Mapping[str, Any] | None = None, servos: str = "") -> System:
    """An arm beside a wall, whose logs are tables."""
    damping = {"targets": [{"joint": "*", "set": "damping"}], "nominal": 0.1}
    late = {"targets": [{"set": "command_delay"}], "nominal": 0.01, "bounds": [0.0, 0.05], "prior_sd": 0.005}
    signals: dict[str, Any] = {
        "joints": {
            "joints": ["shoulder", "elbow"],
            "columns": {"position": ["q1", "q2"]},
            "noise": {"position": 0.001},
        },
        "command": {
            "actuators": [f"shoulder{servos}", f"elbow{servos}"],
            "columns": {"position": ["c1", "c2"]},
        },
    }
    settings = {"probe": {"candidates": 1, "pairs": 1}, "clips": {"length": [0.4, 0.8]}}
    return amhe.System.from_model(
        mujoco.MjSpec.from_string(model),
        parameters={"damping": damping, "delay": late, **(more or {})},
        signals=signals,
        settings=settings,
        name="arm",
    )


@pytest.mark.parametrize("kind", RECIPES)
def test_a_recipe_stays_in_its_leeway_and_comes_home(kind: str) -> None:
    for one in recipes(kind, LEEWAY, 4, seed=0):
        commands = one.at(TIMES)
        assert (commands > LEEWAY.lower).all() and (commands < LEEWAY.upper).all()
        assert (np.abs(np.diff(commands, axis=0)) <= 0.8 * 0.01 * LEEWAY.speed + 1e-9).all()
        assert commands[0] == pytest.approx(LEEWAY.rest) and commands[-1] == pytest.approx(LEEWAY.rest)
        assert (np.ptp(commands, axis=0) > 0.05).all()


def test_a_joint_that_breaks_a_bound_moves_less_and_the_others_as_before() -> None:
    (one,) = recipes("chirp", LEEWAY, 1, seed=0)
    less = one.smaller(1)
    assert less is not None
    before, after = np.ptp(one.at(TIMES), axis=0), np.ptp(less.at(TIMES), axis=0)
    assert after[1] < 0.8 * before[1] and after[[0, 2]] == pytest.approx(before[[0, 2]])
    everything = one.smaller(None)
    assert everything is not None and (np.ptp(everything.at(TIMES), axis=0) < before).all()


@pytest.mark.parametrize("kind", RECIPES)
def test_who_asks_for_a_recipe_gets_it_within_the_speed_and_ending_at_home(kind: str) -> None:
    """A slow sine, with which the recipes are compared, may know more; it is never what is written."""
    probe = ActuatorProbe(ProbeOptions(seconds=3.0, recipe=kind, speed=2.0), arm())
    plan = probe.design(lambda _: None)
    written = probe.excitation()
    assert plan.parts[0].name == f"{kind} 1"
    step = float(written.times[1])
    assert np.abs(np.diff(written.targets, axis=0)).max() <= 0.8 * 2.0 * step + 1e-9
    assert written.targets[-1] == pytest.approx(0.0)


def test_a_home_outside_a_range_is_said_before_anything_is_tried() -> None:
    outside = ARM.replace('range="-1 1"', 'range="0.5 1.9"')
    with pytest.raises(
        ConfigError, match=r"shoulder = 0, is outside its range 0\.5 to 1\.9 rad: give a `key"
    ):
        ActuatorProbe(ProbeOptions(recipe="chirp"), arm(outside))


def test_a_probe_that_fails_says_how_often_and_what_helps() -> None:
    once = Broken("joint elbow reaches its limit", 1, "widen its range")
    text = nothing_left(Counter([once, *[Broken("a touches b")] * 3]))
    assert text.endswith(
        "bound: a touches b (3 times); joint elbow reaches its limit (once): widen its range"
    )


def test_an_unknown_recipe_is_refused() -> None:
    with pytest.raises(ConfigError, match="no recipe 'chrip' \\(did you mean 'chirp'\\?\\)"):
        recipes("chrip", LEEWAY, 1, 0)


def test_what_breaks_a_bound_is_named() -> None:
    system = arm()
    bounds = Bounds(system, (0, 1), np.array([3.0, 3.0]))
    still, calm = np.zeros((5, 2)), np.zeros((5, 2))

    def broken(qpos: Any = (0.0, 0.0), qvel: Any = (0.0, 0.0), inputs: Any = None) -> str | None:
        commands = np.asarray(qpos if inputs is None else inputs)
        found = bounds.broken(np.array([0.1, 0.01]), still + qpos, calm + qvel, still + commands)
        return None if found is None else found.text

    assert broken() is None
    assert broken(qvel=(0.0, -4.0)) == "joint elbow is faster than 3 rad/s"
    assert broken(inputs=(0.9, 0.0)) == "joint shoulder needs more force than its actuator has"
    touched = broken(qpos=(-0.8, 0.0))
    assert touched is not None and "geom 'wall'" in touched


def test_the_leeway_of_a_servo_is_also_its_joints() -> None:
    """The elbow has no ctrlrange: its joint's range counts."""
    leeway = leeway_of(arm(), driven_controls(arm()), speed=None)
    assert leeway.lower == pytest.approx([-1.0, -2.9]) and leeway.upper == pytest.approx([1.0, 2.9])
    assert leeway.fastest == pytest.approx(np.pi)


@pytest.mark.medium
def test_a_probe_writes_what_a_robot_can_play_and_its_log_is_read(tmp_path: Path) -> None:
    servos = ARM.replace('" joint="', ' servo" joint="')
    system, folder = arm(servos, servos=" servo"), tmp_path / "excitation"
    record = amhe.probe(
        system, recipe="chirp", seconds=4.0, speed=2.0, rate=50.0, threads=1, excitation=folder,
        log=tmp_path / "log.csv",
    )  # fmt: skip
    assert record["sequence"][0]["name"] == "chirp 1"
    for row in record["parameters"]:
        assert row["expected_sd"] < row["prior_sd"] and "achieved_sd" in row
    with np.load(folder / "excitation.npz") as played:
        times, targets = played["times"], played["targets"]
        assert played["joints"].tolist() == ["shoulder", "elbow"]
        assert played["actuators"].tolist() == ["shoulder servo", "elbow servo"]
    assert times[1] == pytest.approx(0.02) and targets.shape == (200, 2)
    assert np.abs(np.diff(targets, axis=0)).max() <= 2.0 * 0.02
    lines = (folder / "excitation.csv").read_text().splitlines()
    assert lines[0] == "time [s],c1,c2" and len(lines) == 201
    assert {path.suffix for path in folder.iterdir()} == {".csv", ".npz", ".mcap"}
    log = read_log(tmp_path / "log.csv", system)
    assert log.duration == pytest.approx(4.0, abs=0.05)
    model = system.model
    assert np.abs(log["joints.position"].values).max() < np.abs(model.jnt_range).max()


def test_commands_act_late_in_the_rehearsal_where_they_do_in_the_model() -> None:
    """Under a delay of 40 ms the joints follow ten steps of 4 ms later."""
    probe = ActuatorProbe(ProbeOptions(seconds=2.0, recipe="steps"), arm())
    (one,) = probe._motions[1:]
    prompt, late = probe._played(probe._model, one, np.array([[0.1, 0.0], [0.1, 0.04]]), 2)
    assert isinstance(prompt, amhe.Log) and isinstance(late, amhe.Log)
    first, second = (log["joints.position"].values for log in (prompt, late))
    np.testing.assert_allclose(second[10:], first[:-10], atol=0.006)
    np.testing.assert_array_equal(prompt["command.position"].values, late["command.position"].values)


@pytest.mark.medium
def test_what_no_measurement_depends_on_is_expected_to_stay_as_unknown() -> None:
    """The zero of an encoder about an upright axis: commands are in its frame, and gravity hides it."""
    upright = ARM.replace('axis="0 1 0"', 'axis="0 0 1"')
    zero = {"signal": "joints", "set": "bias", "quantity": "position", "joint": "shoulder"}
    offset = {"nominal": 0.0, "bounds": [-0.3, 0.3], "scale": "linear", "prior_sd": 0.05, "targets": [zero]}
    system = arm(upright, {"offset": offset})
    for row in amhe.probe(system, recipe="chirp", seconds=4.0, speed=1.0, threads=1)["parameters"]:
        narrowed = [row["expected_sd"] / row["prior_sd"], row["achieved_sd"] / row["prior_sd"]]
        assert narrowed == pytest.approx([1.0, 1.0]) if row["name"] == "offset" else max(narrowed) < 0.5
