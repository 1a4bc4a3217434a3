"""Servos as they are built: firmware, supply and motor, against a loop of another kind."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np
import pytest

from amhe_cli.core.errors import ConfigError
from amhe_cli.engine.inverse import forces_along
from amhe_cli.engine.open import open_engine
from amhe_cli.engine.rollout import Engine
from amhe_cli.system.export.mjcf import identified_xml
from amhe_cli.system.parameters.servos import Servos, with_servos
from amhe_cli.system.system import System
from tests.engine.conftest import Open

STEP, KP, LIMIT, STEPS = 0.002, 2.0, 0.8, 300
#: A load that a servo swings.
SWING = f"""
<mujoco><option timestep="{STEP}"/><worldbody><body>
    <joint name="hip" axis="0 1 0" damping="0.01" frictionloss="0.02" armature="0.005"/>
    <geom type="sphere" size=".02" pos="0 0 -.1" mass=".5"/></body></worldbody>
  <actuator><position name="servo" joint="hip" kp="{KP}" forcerange="-{LIMIT} {LIMIT}"/></actuator></mujoco>
"""
WORDS = {"punch": 0.06, "dead_band": 0.02, "supply_sag": 0.5, "back_emf": 0.05, "supply": 7.4}
COMMAND = 0.9 * np.sin(np.arange(STEPS) * STEP * 12.0)


def swing(words: Mapping[str, float] = WORDS, signals: tuple[str, ...] = (), xml: str = SWING) -> System:
    """The model with some numbers of its servo as parameters, and what the log says of it."""
    parameters = {
        word: {"nominal": value, "bounds": [1.0 if word == "supply" else -1.0, 9.0], "scale": "linear"}
        | {"targets": [{"actuator": "servo", "set": word}]}
        for word, value in words.items()
    }
    given: dict[str, Any] = {"q": {"joints": ["hip"], "noise": {"position": 0.001}}}
    for quantity in ("position", *signals):
        given[quantity] = {"actuators": ["servo"], "quantity": quantity}
    return System.from_model(mujoco.MjSpec.from_string(xml), parameters=parameters, signals=given, warn=False)


def rolled(
    system: System, *told: np.ndarray | float, theta: np.ndarray | None = None, engine: Engine | None = None
) -> np.ndarray:
    """Positions of candidates under COMMAND and what else the log says, shape (n, STEPS)."""
    theta = system.space.nominal[None] if theta is None else theta
    inputs = np.stack([COMMAND, *(np.broadcast_to(one, STEPS) for one in told)], axis=1)
    rest, n = np.zeros((len(theta), 1)), len(theta)
    engine = engine or open_engine(system, threads=1)
    done = engine.rollout(theta, rest, rest, np.repeat(inputs[None], n, 0), np.full(n, STEPS))
    assert done.completed.all()
    return done.qpos[..., 0]


def by_hand(volts: np.ndarray | float = 7.4, on: np.ndarray | float = 1.0, **words: float) -> np.ndarray:
    """The same motion, with the servo's torque as a force at the joint."""
    model = mujoco.MjModel.from_xml_string(SWING.replace("<position", "<motor").replace(f'kp="{KP}"', ""))
    model.actuator_forcelimited[:] = 0
    data, path, of = mujoco.MjData(model), [], dict.fromkeys(WORDS, 0.0) | words
    told = (np.broadcast_to(one, STEPS) for one in (volts, on))
    for command, supply, enabled in zip(COMMAND, *told, strict=True):
        error, speed = command - data.qpos[0], data.qvel[0]
        duty = min(max(KP * abs(error) / LIMIT, of["punch"]), 1.0) * (abs(error) > of["dead_band"])
        torque = LIMIT * np.sign(error) * duty * supply / 7.4 - of["back_emf"] * speed
        data.ctrl[0] = enabled * torque / (1.0 + of["supply_sag"] * duty**2)
        mujoco.mj_step(model, data)
        path.append(data.qpos[0])
    return np.array(path)


@pytest.mark.parametrize("words", [*({word: WORDS[word]} for word in list(WORDS)[:4]), WORDS])
def test_each_number_acts_as_its_equation_says(words: dict[str, float]) -> None:
    path = rolled(swing(words))[0]
    np.testing.assert_allclose(path, by_hand(**words), atol=1e-12)
    assert np.abs(path - by_hand()).max() > 5e-4


def test_the_supply_and_the_enabling_come_from_the_log() -> None:
    """Torque off is no gap: the load falls, without back-EMF."""
    on = (np.arange(STEPS) < 150).astype(float)
    system = swing({"supply": 7.4, "back_emf": 0.05}, ("voltage", "enabled"))
    np.testing.assert_allclose(
        rolled(system, 5.9, on)[0], by_hand(volts=5.9, on=on, back_emf=0.05), atol=1e-12
    )
    assert [driving.delayed for driving in system.inputs] == [True, False, False]


def test_engines_agree(opened: Open) -> None:
    """With the loop by hand, in company and alone; and with one thread, beside friction of gears."""
    on, volts = (np.arange(STEPS) < 200).astype(float), 7.0 + 0.5 * np.sin(np.arange(STEPS) / 20.0)
    geared = SWING.replace(
        "</mujoco>",
        '<custom><numeric name="gear_friction/hip" data="0.1 0.3 0.05 0.2 1 0 0 0"/></custom></mujoco>',
    )
    for xml in (SWING, geared):
        system = swing(WORDS, ("voltage", "enabled"), xml)
        engine, theta = opened(system), np.tile(system.space.nominal, (3, 1))
        theta[1, :4], theta[2, 0] = 0.0, 0.2
        paths = rolled(system, volts, on, theta=theta, engine=engine)
        expected = rolled(system, volts, on, theta=theta)
        if xml is SWING:
            expected[:2] = by_hand(volts=volts, on=on, **WORDS), by_hand(volts=volts, on=on)
        np.testing.assert_allclose(paths, expected, atol=max(1e-12, 1e3 * engine.precision))
        alone = rolled(system, volts, on, theta=theta[2:], engine=engine)
        np.testing.assert_array_equal(alone[0], paths[2])


def test_without_any_of_it_a_servo_is_mujocos() -> None:
    """Candidates differ from each other only where they are told to, whatever their company."""
    system = swing({"punch": 0.0, "back_emf": 0.0})
    theta = np.array([[0.0, 0.0], [0.1, 0.0], [0.0, 0.05]])
    paths = rolled(system, theta=theta)
    np.testing.assert_allclose(paths[0], by_hand(), atol=1e-12)
    np.testing.assert_array_equal(paths[1:2], rolled(system, theta=theta[1:2]))


def test_forces_along_a_motion_have_it() -> None:
    system = swing({"punch": 0.1})
    model = system.edits.apply(system.model, np.array([0.1]))
    still, command = np.zeros((2, 1)), np.array([[0.01], [0.3]])
    given = forces_along(model, still, still, still, command, system.input_spec).given
    np.testing.assert_allclose(given[:, 0], [0.1 * LIMIT, 0.3 * KP])


def test_a_servo_of_no_gain_is_one_whose_torque_is_off() -> None:
    """`known: {torque: 0, back_emf: 0}` of a drop: what looks for causes meets such a model."""
    system = swing({"punch": 0.06})
    model = system.edits.apply(system.model, system.space.nominal)
    model.actuator_gainprm[0, 0] = model.actuator_biasprm[0, 1] = 0.0
    free, drive = with_servos(model, np.full((1, 1), 0.3), np.ones((1, 1)), np.ones((1, 1)), np.zeros((1, 0)))
    drive(0)
    data = mujoco.MjData(free)
    data.qpos[0], data.qvel[0], data.ctrl[0] = 0.3, 1.0, 1.0
    mujoco.mj_forward(free, data)
    assert data.actuator_force[0] == 0.0


def test_an_exported_model_has_the_numbers() -> None:
    model = mujoco.MjModel.from_xml_string(identified_xml(swing(), np.array(list(WORDS.values()))))
    np.testing.assert_allclose(model.numeric_data, list(WORDS.values()))
    found = Servos.of(model)
    assert found is not None and model.nu == 1
    assert "servos" in swing(xml=SWING.replace(
        "</mujoco>", '<custom><numeric name="servo/servo" data=".1 0 0 0 0"/></custom></mujoco>'
    )).parts  # fmt: skip


@pytest.mark.medium
def test_mistakes_are_named() -> None:
    with pytest.raises(ConfigError, match="'servo' is no position servo of a joint"):
        swing(xml=SWING.replace("<position", "<motor").replace(f'kp="{KP}"', ""))
    with pytest.raises(ConfigError, match="'servo' needs a forcerange"):
        swing(xml=SWING.replace(f'forcerange="-{LIMIT} {LIMIT}"', ""))
    with pytest.raises(ConfigError, match="nothing says at which"):
        open_engine(swing({"punch": 0.1}, ("voltage",)))
