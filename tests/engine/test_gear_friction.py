"""Friction of geared joints on every engine: energy, stick and slip, driving and driving back."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
import pytest

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.errors import ConfigError
from amhe_cli.engine.open import open_engine
from amhe_cli.engine.rollout import Engine
from amhe_cli.system.export.mjcf import identified_xml
from amhe_cli.system.parameters.gear_friction import GearFriction, beyond
from amhe_cli.system.system import System
from tests.engine.conftest import Open

STEP, MASS, GRAVITY, DRY = 0.001, 2.0, 10.0, 0.5
#: A hoist: a mass that a motor lifts. What the motor does not do, gravity does.
HOIST = f"""
<mujoco><option timestep="{STEP}" gravity="0 0 -{GRAVITY}"/>
  <worldbody><body name="load"><joint name="lift" type="slide" axis="0 0 1" frictionloss="{DRY}"/>
    <geom size=".1" mass="{MASS}"/></body></worldbody>
  <actuator><motor name="motor" joint="lift"/></actuator></mujoco>
"""
#: A load that falls and one that lies on its side, each on a joint with a motor, and their k_e.
TWO = f"""
<mujoco><option timestep="{STEP}" gravity="0 0 -{GRAVITY}"/><worldbody>
  <body name="a"><joint name="a" type="slide" axis="0 0 1" frictionloss=".1"/>
    <geom size=".1" mass="2"/></body>
  <body name="b" pos="1 0 0"><joint name="b" type="slide" axis="1 0 0" frictionloss=".4"/>
    <geom size=".1" mass="1"/></body></worldbody>
  <actuator><motor name="a" joint="a"/><motor name="b" joint="b"/></actuator></mujoco>
"""
GEARS = (("a", 0.3), ("b", 0.1))
WORDS = {
    "load_friction_motor": 0.1,
    "load_friction_external": 0.3,
    "stribeck_friction": 0.0,
    "stribeck_velocity": 0.2,
    "stribeck_exponent": 1.0,
    "stribeck_load_friction": 0.0,
    "load_friction_quadratic": 0.0,
}


def hoist(words: dict[str, float] = WORDS, xml: str = HOIST, joint: str = "lift") -> System:
    """The model with some numbers of its gear friction as parameters."""
    parameters: dict[str, Any] = {
        word: {
            "nominal": value,
            "bounds": [value - 5.0, value + 5.0]
            if word not in ("stribeck_velocity", "stribeck_exponent")
            else None,
            "targets": [{"joint": joint, "set": word}],
        }
        for word, value in words.items()
    }
    signals = {
        "q": {"joints": [joint], "noise": {"position": 0.001}},
        "u": {"actuators": ["motor"], "quantity": "effort"},
    }
    return System.from_model(
        mujoco.MjSpec.from_string(xml), parameters=parameters, signals=signals, warn=False
    )


def run(
    engine: Engine, system: System, forces: Sequence[float], speed: float = 0.0, steps: int = 200,
    **words: float | Sequence[float],
) -> FloatArray:  # fmt: skip
    """Speeds (n, steps) under n constant forces of the motor, with one number of the gear's for all or n."""
    n = len(forces)
    theta = np.stack([np.broadcast_to({**WORDS, **words}[name], n) for name in system.space.names], axis=1)
    inputs = np.repeat(np.array(forces)[:, None, None], steps, axis=1)
    start = np.zeros((n, 1)), np.full((n, 1), speed)
    return engine.rollout(theta, *start, inputs, np.full(n, steps)).qvel[..., 0]


@pytest.fixture(scope="module")
def lift(opened: Open) -> tuple[Engine, System]:
    system = hoist()
    return opened(system), system


def test_it_is_harder_to_drive_back_than_to_drive(lift: tuple[Engine, System]) -> None:
    """|k_e tau_e - k_m tau_m| is the same formula up and down; what it takes of the motor's force is not."""
    force = np.array([32.0, 15.0, 2.0])
    friction = DRY + 0.3 * MASS * GRAVITY + 0.1 * force
    surplus = force - MASS * GRAVITY
    moves = np.maximum(abs(surplus) - friction, 0.0) * np.sign(surplus)
    assert (moves == 0.0).tolist() == [False, True, False]
    expected = moves[:, None] / MASS * STEP * np.arange(1, 201)
    # friction that holds gives way by the compliance of MuJoCo's constraint
    np.testing.assert_allclose(run(*lift, force), expected, rtol=1e-3, atol=0.02)


def test_it_sticks_and_slips_where_the_law_says(lift: tuple[Engine, System]) -> None:
    """A load holds itself if k_e is large, and the motor alone decides how hard it must pull to hold."""
    least = ((1.0 - 0.3) * MASS * GRAVITY - DRY) / (1.0 + 0.1)
    forces = (0.0, 0.0, least + 0.3, least - 1.0)
    held, slips, holds, yields = run(*lift, forces, load_friction_external=(1.01, 0.8, 0.3, 0.3))[:, -1]
    assert max(abs(held), abs(holds)) < 0.02
    assert slips < -0.2 and yields < -0.05


def test_quadratic_friction_acts_while_motor_and_load_pull_against_each_other(
    lift: tuple[Engine, System],
) -> None:
    words = {"load_friction_motor": 0.0, "load_friction_external": 0.0, "load_friction_quadratic": 0.01}
    against, together = run(*lift, (30.0, -30.0), **words)[:, -1]
    time = 200 * STEP
    assert against == pytest.approx((30.0 - MASS * GRAVITY - DRY - 0.01 * 600.0) / MASS * time, rel=1e-3)
    assert together == pytest.approx((-30.0 - MASS * GRAVITY + DRY) / MASS * time, rel=1e-3)


def test_a_free_stop_follows_stribecks_curve(opened: Open) -> None:
    """The speed of a coasting mass, and its energy: all of it is what friction has taken."""
    system = hoist(xml=HOIST.replace(f"0 0 -{GRAVITY}", "0 0 0"))
    words = {"stribeck_friction": 2.0, "stribeck_velocity": 0.15, "stribeck_exponent": 2.0}
    done = run(opened(system), system, (0.0,), speed=0.2, steps=300, **words)[0]
    v, x, fine, lost = 0.2, [], 20, 0.0
    for _ in range(300 * fine):
        held = DRY + 2.0 * np.exp(-((v / 0.15) ** 2))
        lost += held * v * STEP / fine
        v = max(v - held / MASS * STEP / fine, 0.0)
        x.append(v)
    np.testing.assert_allclose(done, x[fine - 1 :: fine], atol=0.006)
    assert lost == pytest.approx(0.5 * MASS * 0.2**2, rel=0.01)
    held = DRY + 2.0 * np.exp(-((done / 0.15) ** 2))
    assert np.sum(held * np.abs(done)) * STEP == pytest.approx(0.5 * MASS * 0.2**2, rel=0.02)


def test_rollouts_depend_neither_on_company_nor_on_earlier_calls(opened: Open) -> None:
    system, rng = hoist(), np.random.default_rng(2)
    theta = np.tile(system.space.nominal, (11, 1))
    theta[:, 0] = rng.uniform(0.0, 0.5, 11)
    lengths = rng.integers(5, 60, 11)
    states = theta, np.zeros((11, 1)), rng.normal(size=(11, 1))
    call: tuple[Any, ...] = *states, rng.normal(20, 9, (11, 60, 1)), lengths
    engine = opened(system)
    whole = engine.rollout(*call)
    for rows in (np.arange(11)[::-1], np.array([4]), np.arange(3)):
        some = engine.rollout(*(part[rows] for part in call))
        for i, row in enumerate(rows):
            np.testing.assert_array_equal(some.qpos[i, : lengths[row]], whole.qpos[row, : lengths[row]])
    assert whole.completed.all()


def test_engines_agree(opened: Open) -> None:
    """With the engine of one thread, to rounding."""
    system, rng = hoist(), np.random.default_rng(3)
    theta = np.tile(system.space.nominal, (5, 1))
    theta[:, :3] = rng.uniform(0.0, 0.4, (5, 3))
    call = theta, np.zeros((5, 1)), rng.normal(size=(5, 1)), rng.normal(20, 9, (5, 50, 1)), np.full(5, 50)
    engine = opened(system)
    one = open_engine(system, threads=1).rollout(*call)
    np.testing.assert_allclose(engine.rollout(*call).qpos, one.qpos, atol=max(1e-12, 100 * engine.precision))


def test_the_order_of_the_numbers_in_the_file_means_nothing() -> None:
    """Joint a is driven back by its load, joint b is not loaded, and all joints of the model have gears."""
    numbers = {name: f'<numeric name="gear_friction/{name}" data="0 {k} 0 .2 1 0 0 0"/>' for name, k in GEARS}
    found = []
    for order in ("ab", "ba"):
        written = "".join(numbers[name] for name in order)
        system = System.from_model(
            mujoco.MjSpec.from_string(TWO.replace("</mujoco>", f"<custom>{written}</custom></mujoco>")),
            parameters={"m": {"targets": [{"body": "a", "set": "mass"}]}},
            signals={
                "q": {"joints": ["a", "b"], "noise": {"position": 0.001}},
                "u": {"actuators": ["a", "b"]},
            },
            warn=False,
        )
        theta, steps = system.space.nominal[None], 100
        inputs = np.tile([10.0, 1.0], (1, steps, 1))
        engine = open_engine(system, threads=1)
        found.append(engine.rollout(theta, np.zeros((1, 2)), np.ones((1, 2)), inputs, np.array([steps])).qvel)
    np.testing.assert_array_equal(*found)
    assert abs(found[0][0, -1]).max() > 0.01, "something moves"


def test_contacts_load_the_gear_and_friction_itself_does_not() -> None:
    model = hoist().model
    gear = GearFriction.of(model)
    assert gear is not None
    bound = gear.law(model.numeric_data[gear.at][None], np.full((1, 1), DRY))
    speed, holds = np.zeros((1, 1)), np.full((1, 1), 6.5)

    def law(constraint: np.ndarray, speed: np.ndarray, holds: np.ndarray) -> np.ndarray:
        external = beyond(constraint, holds) - 20.0
        return bound(np.zeros((1, 1)), external, speed)

    assert law(np.array([[6.5]]), speed, holds).item() == pytest.approx(DRY + 0.3 * 20.0)
    assert law(np.array([[16.5]]), speed, holds).item() == pytest.approx(DRY + 0.3 * 10.0)


def test_without_gear_friction_rollouts_are_those_of_mujoco() -> None:
    """A joint that has the numbers, all zero, costs and changes nothing; one k = 0 among others does not."""
    system = hoist({"load_friction_motor": 0.0})
    one = open_engine(system, threads=1).rollout(
        np.zeros((1, 1)), np.zeros((1, 1)), np.ones((1, 1)), np.full((1, 80, 1), 24.0), np.array([80])
    )
    model = mujoco.MjModel.from_xml_string(HOIST)
    data = mujoco.MjData(model)
    data.qvel[:], data.ctrl[:] = 1.0, 24.0
    for k in range(80):
        mujoco.mj_step(model, data)
        assert one.qpos[0, k, 0] == data.qpos[0]


def test_the_numbers_are_part_of_the_model() -> None:
    """An exported model has them, and a system of that model starts from them."""
    system = hoist({"load_friction": 0.1, "stribeck_velocity": 0.2})
    text = identified_xml(system, np.array([0.25, 0.4]))
    again = hoist({"load_friction_motor": 0.1}, xml=text)
    gear = GearFriction.of(mujoco.MjModel.from_xml_string(text))
    assert gear is not None
    np.testing.assert_allclose(
        mujoco.MjModel.from_xml_string(text).numeric_data, [0.25, 0.25, 0, 0.4, 1, 0, 0, 0]
    )
    assert again.parts["gear friction"] != system.parts.get("gear friction")
    unit = {p.name: p.unit for p in system.space.parameters}
    assert unit == {"load_friction": "-", "stribeck_velocity": "m/s"}


@pytest.mark.medium
def test_mistakes_are_named() -> None:
    ball = HOIST.replace('type="slide" axis="0 0 1"', 'type="ball"').replace(
        '<motor name="motor" joint="lift"/>', ""
    )
    with pytest.raises(ConfigError, match="only hinges and slides"):
        System.from_model(
            mujoco.MjSpec.from_string(ball),
            parameters={"k": {"bounds": [-1, 1], "targets": [{"joint": "lift", "set": "load_friction"}]}},
            signals={"q": {"body": "load", "noise": {"orientation": 0.01}}},
        )
    short = HOIST.replace(
        "</mujoco>", '<custom><numeric name="gear_friction/lift" data="1 2"/></custom></mujoco>'
    )
    with pytest.raises(ConfigError, match="needs 8 numbers: load_friction_motor, "):
        hoist({"load_friction": 0.1}, xml=short)
