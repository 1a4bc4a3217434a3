"""What a careful person expects of `identify` on carts and a pendulum: exact models, small noise.

Parts of the data that say nothing contradict nothing, parts that know different combinations agree, and the
order in which things are given never matters. Whatever one log says counts, and only once.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
import pytest

import amhe_cli as amhe

#: What a model lacks is not looked for here.
pytestmark = pytest.mark.usefixtures("unexplained")
#: Noise of positions [m or rad] and velocities [m/s or rad/s].
NOISE = {"position": 0.001, "velocity": 0.02}
#: The models are exact, to their time step; nothing is held out unless a test says so.
EXACT = {"identify": {"assumed": 0}}
STEP = 0.005
#: Cart, true mass [kg] and true gain of the motor of unknown gain.
MASS, GAIN = 2.0, 1.5

CART = f"""<mujoco><option timestep="{STEP}" gravity="0 0 0"/><worldbody>
<body name="cart"><joint name="slide" type="slide" axis="1 0 0"/><geom size="0.1" mass="{MASS}"/></body>
</worldbody><actuator><motor name="measured" joint="slide"/><motor name="loose" joint="slide"/></actuator>
</mujoco>"""
TWO_CARTS = f"""<mujoco><option timestep="{STEP}" gravity="0 0 0"/><worldbody>
<body name="one"><joint name="left" type="slide" axis="1 0 0"/>
<geom size="0.1" mass="2"/></body>
<body name="two" pos="0 9 0"><joint name="right" type="slide" axis="1 0 0"/>
<geom size="0.1" mass="3"/></body>
</worldbody><actuator><motor name="left" joint="left"/>
<motor name="right" joint="right"/></actuator></mujoco>"""
PENDULUM = f"""<mujoco><option timestep="{STEP}"/><worldbody>
<body><joint name="hinge" axis="0 1 0" damping="0.05" armature="0.002"/>
<geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.02" mass="0.1"/>
<body name="load" pos="0 0 -0.4"><geom size="0.05" mass="0.5"/></body></body>
</worldbody><actuator><motor name="motor" joint="hinge"/></actuator></mujoco>"""

MASS_OF_CART = {"nominal": 1.3, "bounds": [0.1, 20], "targets": [{"body": "cart", "set": "mass"}]}
GAIN_OF_LOOSE = {"nominal": 1.0, "targets": [{"actuator": "loose", "set": "gain"}]}

Push = Callable[[float], Sequence[float]]


def system_of(xml: str, parameters: Mapping[str, Any], **clips: Any) -> amhe.System:
    """A system whose joints are measured and whose motors are commanded, with some settings of its clips."""
    spec = mujoco.MjSpec.from_string(xml)
    signals = {
        "joints": {"joints": [joint.name for joint in spec.joints], "noise": NOISE},
        "command": {"actuators": [motor.name for motor in spec.actuators], "quantity": "effort"},
    }
    settings = {**EXACT, "clips": {"length": [0.5, 1.5], "held_out": 0.0, **clips}}
    return amhe.System.from_model(spec, parameters=parameters, signals=signals, settings=settings)


def multisine(seed: int, size: float) -> Callable[[float], float]:
    """A push [N or N m] of many frequencies."""
    rng = np.random.default_rng(seed)
    hertz, phase = np.geomspace(0.3, 2.0, 5), rng.uniform(0.0, 2.0 * np.pi, 5)
    return lambda t: float(size * np.sin(2.0 * np.pi * hertz * t + phase).sum())


def arrays(
    xml: str,
    push: Push,
    seconds: float,
    seed: int = 0,
    *,
    change: Callable[[mujoco.MjModel, float], None] | None = None,
    speed: float = 0.0,
) -> dict[str, dict[str, np.ndarray]]:
    """A noisy log of a model, at 100 Hz, as arrays.

    Args:
        xml: The model.
        push: Commands of all motors over time.
        seconds: Length of the log.
        seed: Of the noise.
        change: Changes the model before each step.
        speed: Speed of all joints at the start.
    """
    model, rng = mujoco.MjModel.from_xml_string(xml), np.random.default_rng([7, seed])
    data = mujoco.MjData(model)
    data.qvel[:] = speed
    rows = []
    for k in range(round(seconds / STEP) + 1):
        if k % 2 == 0:
            data.ctrl[:] = push(k * STEP)
        rows.append(np.concatenate(([k * STEP], data.qpos, data.qvel, data.ctrl)))
        if change is not None:
            change(model, k * STEP)
        mujoco.mj_step(model, data)
    time, position, velocity, command = np.split(np.array(rows)[::2], np.cumsum([1, model.nq, model.nv]), 1)
    position += NOISE["position"] * rng.standard_normal(position.shape)
    velocity += NOISE["velocity"] * rng.standard_normal(velocity.shape)
    return {
        "joints": {"time": time[:, 0], "position": position, "velocity": velocity},
        "command": {"time": time[:, 0], "effort": command},
    }


def part(of: Mapping[str, Mapping[str, np.ndarray]], begin: float, end: float) -> dict[str, Any]:
    """What arrays hold between two times [s]."""
    return {
        signal: {k: v[(series["time"] >= begin) & (series["time"] <= end)] for k, v in series.items()}
        for signal, series in of.items()
    }


def without_velocity(of: Mapping[str, Mapping[str, np.ndarray]]) -> dict[str, Any]:
    """The same arrays from encoders alone."""
    return {**of, "joints": {k: v for k, v in of["joints"].items() if k != "velocity"}}


def moved(of: Mapping[str, Mapping[str, np.ndarray]], seconds: float) -> dict[str, Any]:
    """The same arrays at another time."""
    return {signal: {**series, "time": series["time"] + seconds} for signal, series in of.items()}


def said(result: amhe.Result, name: str) -> str:
    """All that a result says of one parameter."""
    about = [text for text in result.warnings if name in text]
    reasons = [reason.text for reason in result.parameters[name].reasons]
    return "; ".join((*about, *reasons))


def alike(one: amhe.Result, other: amhe.Result, names: Mapping[str, str] | None = None) -> None:
    """Check that two results say the same of all parameters, up to what a search and its samples leave."""
    for name, first in one.parameters.items():
        second = other.parameters[(names or {}).get(name, name)]
        assert second.estimate == pytest.approx(first.estimate, abs=0.1 * first.sd), name
        assert second.sd == pytest.approx(first.sd, rel=0.1), name
        assert second.verdict == first.verdict, name


# -- parts that say nothing --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def cart() -> amhe.System:
    return system_of(CART, {"cart_mass": MASS_OF_CART})


@pytest.fixture(scope="module")
def throughout(cart: amhe.System) -> amhe.Result:
    """The cart is pushed for 24 s."""
    push = multisine(1, 1.0)
    return amhe.identify(cart, amhe.Log.from_arrays(arrays(CART, lambda t: (push(t), 0.0), 24.0), cart))


@pytest.fixture(scope="module")
def late() -> dict[str, dict[str, np.ndarray]]:
    """The cart rolls freely at first, and is pushed only after 12 of 24 s."""
    push = multisine(1, 1.0)
    return arrays(CART, lambda t: (push(t) * (t >= 12.0), 0.0), 24.0, speed=0.3)


def check_late(result: amhe.Result, throughout: amhe.Result) -> None:
    mass, reference = result.parameters["cart_mass"], throughout.parameters["cart_mass"]
    assert mass.estimate == pytest.approx(MASS, abs=4.0 * reference.sd)
    assert mass.sd < 2.5 * reference.sd, "half of the data, and no more doubt than that"
    assert mass.verdict == "identified" and not said(result, "cart_mass")


@pytest.mark.medium
def test_a_cart_that_is_pushed_all_the_time_is_weighed(throughout: amhe.Result) -> None:
    mass = throughout.parameters["cart_mass"]
    assert mass.verdict == "identified" and mass.sd < 0.003
    assert mass.estimate == pytest.approx(MASS, abs=4.0 * mass.sd)


@pytest.mark.medium
def test_a_half_that_says_nothing_contradicts_nothing(cart, late, throughout) -> None:
    check_late(amhe.identify(cart, amhe.Log.from_arrays(late, cart)), throughout)


@pytest.mark.medium
def test_nor_does_it_where_the_prior_is_four_sd_off(late, throughout) -> None:
    prior = {**MASS_OF_CART, "prior_sd": 0.25, "nominal": MASS * np.exp(-1.0)}
    system = system_of(CART, {"cart_mass": prior})
    check_late(amhe.identify(system, amhe.Log.from_arrays(late, system)), throughout)


@pytest.mark.medium
def test_a_silent_part_may_be_a_log_of_its_own(cart, late, throughout) -> None:
    logs = [amhe.Log.from_arrays(part(late, *span), cart) for span in ((0.0, 12.0), (12.0, 24.0))]
    check_late(amhe.identify(cart, logs), throughout)


@pytest.mark.medium
def test_joints_that_move_one_after_the_other_contradict_nothing() -> None:
    masses = {name: {"nominal": 1.5, "targets": [{"body": name, "set": "mass"}]} for name in ("one", "two")}
    system, push = system_of(TWO_CARTS, masses), multisine(2, 1.0)
    after = arrays(TWO_CARTS, lambda t: (push(t) * (t < 8.0), push(t) * (t >= 8.0)), 16.0, speed=0.2)
    result = amhe.identify(system, amhe.Log.from_arrays(after, system))
    for name, truth in (("one", 2.0), ("two", 3.0)):
        mass = result.parameters[name]
        assert mass.verdict == "identified" and not said(result, name)
        assert mass.estimate == pytest.approx(truth, abs=4.0 * mass.sd) and mass.sd < 0.01


# -- parts that say something else -------------------------------------------------------------------------


def heavier(after: float) -> Callable[[mujoco.MjModel, float], None]:
    """The cart is 40 % heavier from some time on."""

    def change(model: mujoco.MjModel, t: float) -> None:
        if t >= after and model.body_mass[1] == MASS:
            model.body_mass[1], model.body_inertia[1] = 1.4 * MASS, 1.4 * model.body_inertia[1]
            mujoco.mj_setConst(model, mujoco.MjData(model))

    return change


@pytest.mark.medium
def test_a_load_that_changes_in_mid_log_is_found(cart) -> None:
    push = multisine(1, 1.0)
    log = arrays(CART, lambda t: (push(t), 0.0), 24.0, change=heavier(12.0))
    result = amhe.identify(cart, amhe.Log.from_arrays(log, cart))
    mass = result.parameters["cart_mass"]
    assert mass.sd > 0.2 and mass.verdict != "identified" and said(result, "cart_mass")


@pytest.mark.medium
def test_halves_are_halves_of_what_is_fitted() -> None:
    """Seven clips are fitted of this log; of its own halves the second would have too few for a check."""
    system, push = system_of(CART, {"cart_mass": MASS_OF_CART}, held_out=0.25), multisine(1, 1.0)
    log = arrays(CART, lambda t: (push(t), 0.0), 9.6, change=heavier(3.6))
    result = amhe.identify(system, amhe.Log.from_arrays(log, system))
    assert result.parameters["cart_mass"].sd > 0.2 and said(result, "cart_mass")


# -- parts that know different combinations ----------------------------------------------------------------


@pytest.fixture(scope="module")
def motors() -> amhe.System:
    return system_of(CART, {"cart_mass": MASS_OF_CART, "gain": GAIN_OF_LOOSE})


def by_loose_motor(system: amhe.System, seed: int = 0) -> amhe.Log:
    """Says what gain / mass is, and neither of the two."""
    push = multisine(3, 1.0)
    return amhe.Log.from_arrays(
        arrays(CART.replace('name="loose"', f'name="loose" gear="{GAIN}"'), lambda t: (0.0, push(t)), 6.0),
        system,
        name="loose",
    )


def by_measured_motor(system: amhe.System, strength: float = 1.0, seed: int = 1) -> amhe.Log:
    """Says what the mass is, and nothing of the loose motor; the motor may be weaker than was measured."""
    push = multisine(4, 1.0)
    weaker = CART.replace('name="measured"', f'name="measured" gear="{strength}"')
    return amhe.Log.from_arrays(
        arrays(weaker, lambda t: (push(t), 0.0), 6.0, seed), system, name=f"measured {seed}"
    )


def sd_of_ratio(result: amhe.Result) -> float:
    """Sd of log(gain / mass)."""
    rows = [list(result.parameters).index(name) for name in ("gain", "cart_mass")]
    covariance = np.array(result.belief.covariance)[np.ix_(rows, rows)]  # of the logarithms
    return float(np.sqrt(np.array([1.0, -1.0]) @ covariance @ [1.0, -1.0]))


@pytest.mark.medium
def test_a_motor_of_unknown_gain_and_a_measured_one_agree(motors) -> None:
    logs = [by_loose_motor(motors), by_measured_motor(motors)]
    result = amhe.identify(motors, logs)
    mass = result.parameters["cart_mass"]
    assert mass.verdict == "identified" and mass.sd < 0.004 and "disagree" not in " ".join(result.warnings)
    for name, truth in (("cart_mass", MASS), ("gain", GAIN)):
        found = result.parameters[name]
        assert found.verdict == "identified" and not said(result, name)
        assert found.estimate == pytest.approx(truth, abs=4.0 * found.sd)
    assert sd_of_ratio(result) < 0.002


@pytest.mark.medium
def test_a_ridge_is_as_narrow_as_its_product_is_known(motors) -> None:
    result = amhe.identify(motors, by_loose_motor(motors))
    assert sd_of_ratio(result) < 0.002
    assert {p.verdict for p in result.parameters.values()} <= {"weak", "prior"}


@pytest.mark.medium
def test_a_contradicted_factor_leaves_the_product_alone(motors) -> None:
    """On the second day the measured motor is a fifth weaker: the mass is in doubt, gain / mass is not."""
    loose = by_loose_motor(motors)
    agreeing = [loose, by_measured_motor(motors, 1.0, 1), by_measured_motor(motors, 1.0, 2)]
    doubtful = [loose, by_measured_motor(motors, 1.0, 1), by_measured_motor(motors, 0.8, 2)]
    sure, unsure = amhe.identify(motors, agreeing), amhe.identify(motors, doubtful)
    assert sure.parameters["cart_mass"].verdict == "identified"
    assert unsure.parameters["cart_mass"].sd > 0.1 and said(unsure, "cart_mass")
    # what residuals repeat is of no one combination; the contradiction itself widens the mass alone
    mass = unsure.parameters["cart_mass"]
    assert sd_of_ratio(sure) < 0.002 and sd_of_ratio(unsure) < 0.33 * mass.sd / mass.estimate


# -- order, names, and how data are cut --------------------------------------------------------------------

PARAMETERS = {
    "load": {"nominal": 0.4, "targets": [{"body": "load", "set": "mass"}]},
    "damping": {"nominal": 0.02, "targets": [{"joint": "hinge", "set": "damping"}]},
}


@pytest.fixture(scope="module")
def pendulum() -> amhe.System:
    return system_of(PENDULUM, PARAMETERS)


@pytest.fixture(scope="module")
def swings() -> list[dict[str, dict[str, np.ndarray]]]:
    """Two logs of a pendulum."""
    pushes = [multisine(seed, 0.5) for seed in (5, 6)]
    return [arrays(PENDULUM, lambda t, p=p: (p(t),), 6.0, seed) for seed, p in enumerate(pushes)]


@pytest.fixture(scope="module")
def swung(pendulum, swings) -> amhe.Result:
    """What the first of them says."""
    return amhe.identify(pendulum, amhe.Log.from_arrays(swings[0], pendulum))


@pytest.mark.medium
@pytest.mark.parametrize("velocities", [True, False], ids=["alike", "one without velocities"])
def test_the_order_of_logs_never_matters(pendulum, swings, velocities: bool) -> None:
    second = swings[1] if velocities else without_velocity(swings[1])
    logs = [
        amhe.Log.from_arrays(one, pendulum, name=name)
        for name, one in (("first", swings[0]), ("second", second))
    ]
    one, other = amhe.identify(pendulum, logs), amhe.identify(pendulum, logs[::-1])
    for name, first in one.parameters.items():
        assert other.parameters[name].estimate == pytest.approx(first.estimate, rel=1e-9)
        assert other.parameters[name].sd == pytest.approx(first.sd, rel=1e-9)
        assert first.verdict == "identified" and not said(one, name)
    truth = {"load": 0.5, "damping": 0.05}
    for name, value in truth.items():
        assert one.parameters[name].estimate == pytest.approx(value, abs=4.0 * one.parameters[name].sd)


@pytest.mark.medium
def test_a_log_without_velocities_adds_what_its_positions_say(pendulum, swings, swung) -> None:
    logs = [amhe.Log.from_arrays(a, pendulum) for a in (swings[0], without_velocity(swings[1]))]
    both = amhe.identify(pendulum, logs)
    for name, alone in swung.parameters.items():
        assert both.parameters[name].sd < 0.95 * alone.sd


@pytest.mark.medium
def test_the_order_of_parameters_never_matters(swings, swung) -> None:
    system = system_of(PENDULUM, dict(reversed(PARAMETERS.items())))
    alike(swung, amhe.identify(system, amhe.Log.from_arrays(swings[0], system)))


@pytest.mark.medium
def test_a_parameter_may_be_renamed(swings, swung) -> None:
    names = {"load": "zulu", "damping": "alpha"}
    system = system_of(PENDULUM, {names[name]: entry for name, entry in PARAMETERS.items()})
    result = amhe.identify(system, amhe.Log.from_arrays(swings[0], system))
    for name, first in swung.parameters.items():
        assert result.parameters[names[name]].estimate == first.estimate
        assert result.parameters[names[name]].sd == first.sd


@pytest.mark.medium
def test_one_log_may_be_given_as_two(pendulum, swings, swung) -> None:
    logs = [amhe.Log.from_arrays(part(swings[0], *span), pendulum) for span in ((0.0, 3.0), (3.0, 6.0))]
    alike(swung, amhe.identify(pendulum, logs))


@pytest.mark.medium
def test_the_order_of_clips_never_matters(pendulum, swings) -> None:
    """Pieces of a log as long as a clip, once in the order of their times and once the other way round."""
    pieces = [part(swings[0], t, t + 1.0) for t in range(6)]
    turned = [moved(piece, 5.0 - 2.0 * t) for t, piece in enumerate(pieces)]
    one, other = (
        amhe.identify(
            pendulum, [amhe.Log.from_arrays(piece, pendulum, name=f"{i}") for i, piece in enumerate(given)]
        )
        for given in (pieces, turned)
    )
    alike(one, other)
