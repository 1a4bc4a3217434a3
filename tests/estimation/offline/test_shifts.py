"""Where an estimate moves if what the model takes as exact were otherwise, and what of that counts."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
import pytest

from amhe_cli.core.arrays import sealed
from amhe_cli.core.each_log import searched
from amhe_cli.core.log import Log
from amhe_cli.core.settings import RulerSettings
from amhe_cli.engine.open import open_engine
from amhe_cli.estimation.offline import search
from amhe_cli.estimation.offline.clips import ClipPool, whole
from amhe_cli.estimation.offline.identification import IdentifyOptions, identify
from amhe_cli.estimation.offline.posterior import final_fit
from amhe_cli.estimation.offline.problem import Problem
from amhe_cli.estimation.offline.result import Identification, ParameterResult
from amhe_cli.estimation.offline.shifts import _against, shifts_of
from amhe_cli.estimation.offline.verdicts import Shift
from amhe_cli.system.description.load import find_system
from amhe_cli.system.rulers import Ruler
from amhe_cli.system.system import System
from tests.estimation.offline.conftest import CHEAP, NOISE, TRUTH, as_trajectory

Change = Callable[[mujoco.MjModel], None]


def unchanged(model: mujoco.MjModel) -> None:
    """The plant is the model."""


def strong_servo(model: mujoco.MjModel) -> None:
    """The servo's torque constant is 12 % larger than its data sheet says."""
    model.actuator_gainprm[:, 0] *= 1.12
    model.actuator_biasprm[:, 1] *= 1.12


def weak_limit(model: mujoco.MjModel) -> None:
    """The servo gives 20 % less torque than its data sheet says."""
    model.actuator_forcerange[:] *= 0.8


def finer(model: mujoco.MjModel) -> None:
    """The world takes finer steps than the model."""
    model.opt.timestep *= 0.25


def pendulum(limit: float, free: bool = False, step: float = 0.002, **rulers: float) -> System:
    """The bundled pendulum, with a limit of its servo's torque [N m], which may be free, and rulers."""
    spec = mujoco.MjSpec.from_file(str(find_system("pendulum") / "scene.xml"))
    spec.actuators[0].forcerange = [-limit, limit]
    spec.option.timestep = step
    bundled = System.load("pendulum")
    settings = {
        **CHEAP,
        "identify": {
            **CHEAP["identify"],
            "rulers": {"gain": 0, "center_of_mass": 0, "mass": 0, "command_delay": 0, **rulers},
        },
    }
    names = ("load_mass", "damping", "friction_loss", "armature")
    targets = ({"body": "load", "set": "mass"}, *({"joint": "hinge", "set": n} for n in names[1:]))
    return System.from_model(
        spec,
        parameters={
            p.name: {"nominal": p.nominal, "prior_sd": p.prior_sd, "targets": [target]}
            for p, target in zip(bundled.space.parameters, targets, strict=True)
        }
        | ({"limit": {"targets": [{"actuator": "servo", "set": "force_limit"}]}} if free else {}),
        signals={
            "joints": {"joints": ["hinge"], "noise": {"position": NOISE[0], "velocity": NOISE[1]}},
            "command": {"actuators": ["servo"], "quantity": "position"},
        },
        settings=settings,
    )


def swing(system: System, change: Change, seconds: float = 4.0, reach: float = 0.35) -> Log:
    """A log of the plant that `change` makes of the model, at TRUTH; states are sampled at 100 Hz."""
    model = system.edits.apply(system.model, TRUTH)
    change(model)
    data, rng = mujoco.MjData(model), np.random.default_rng(3)
    steps, substeps = round(seconds / system.dt), round(system.dt / model.opt.timestep)
    hertz, phase = rng.uniform(0.2, 2.5, 6), rng.uniform(0.0, 6.28, 6)
    states = np.empty((steps + 1, 3))
    for step in range(steps + 1):
        held = np.floor(step * system.dt / 0.02 + 1e-9) * 0.02
        data.ctrl[0] = reach * np.sin(2.0 * np.pi * hertz * held + phase).sum()
        states[step] = data.qpos[0], data.qvel[0], data.ctrl[0]
        for _ in range(substeps):
            mujoco.mj_step(model, data)
    states[:, :2] += rng.normal(0.0, NOISE, (steps + 1, 2))
    return as_trajectory(states, system.dt, every=round(0.01 / system.dt))


def shifts(system: System, log: Log, at: np.ndarray = TRUTH) -> list[Shift]:
    """The shifts at the truth, which moves the estimate by its step to the minimum."""
    problem = Problem(system, ClipPool(system, [whole(log)], system.settings.clips), open_engine(system), 0)
    state = search.restart(problem, system.space.z_of(at))
    return shifts_of(problem, final_fit(problem, state))[0]


def about(found: list[Shift], word: str) -> Shift:
    (one,) = (shift for shift in found if word in shift.text)
    return one


def of(result: Identification, name: str) -> ParameterResult:
    return next(p for p in result.parameters if p.name == name)


def held(result: Identification) -> bool:
    return all(p.lower <= true <= p.upper for p, true in zip(result.parameters, TRUTH, strict=True))


def test_only_rulers_that_act_move_anything() -> None:
    system = pendulum(50.0, gain=0.1, center_of_mass=0.01)
    names = [shift.text for shift in shifts(system, swing(system, unchanged)) if shift.assumed]
    assert len(names) == 5, "the time step, one gain, and three coordinates of a centre of mass"
    assert any("the gain of servo (4)" in name for name in names)
    assert any("the centre of mass of load along z" in name for name in names)
    assert not any("limit" in name for name in names), "it reaches neither of its two"


@pytest.mark.parametrize(
    ("more", "exact"),
    [
        (
            {},
            (
                "the gain of servo (4)",
                "the centre of mass of load",
                "the masses of the links (0.05 kg)",
                "commands that act at once",
            ),
        ),
        ({"gain": 0.1, "command_delay": 0.005, "mass": 0.1}, ("the centre of mass of load",)),
        (
            {"gain": 0.1, "center_of_mass": 0.01, "command_delay": 0.005, "mass": 0.1, "time_step": 0.0},
            ("the time step",),
        ),
    ],
)
def test_rulers_that_are_taken_as_exact_are_listed_where_they_act(
    more: dict[str, Any], exact: tuple[str, ...]
) -> None:
    system = pendulum(50.0, **more)
    assert identify(system, [swing(system, unchanged, 2.0)], None, IdentifyOptions()).exact == exact


def test_a_limit_that_acts_is_named_with_its_value_and_share() -> None:
    system = pendulum(limit=1.1)
    shift = about(shifts(system, swing(system, unchanged)), "limit")
    assert "the force limit of servo (1.1), which acts in" in shift.text and "% of the steps" in shift.text
    assert shift.assumed


def test_rulers_of_logs_with_known_values_move_what_is_searched() -> None:
    system = pendulum(1.1)
    log = swing(system, unchanged).with_(known={"damping": TRUTH[1]})
    fewer = replace(system, space=searched(system.space, [log]))
    problem = Problem(fewer, ClipPool(fewer, [whole(log)], system.settings.clips), open_engine(system), 0)
    state = search.restart(problem, fewer.space.z_of(np.delete(TRUTH, 1)))
    shift = about(shifts_of(problem, final_fit(problem, state))[0], "limit")
    assert shift.z.shape == (3,) and shift.z[0] > 0.0


def test_what_a_parameter_sets_is_no_ruler() -> None:
    free = pendulum(1.1, free=True)
    problem = Problem(
        free,
        ClipPool(free, [whole(swing(pendulum(1.1), unchanged))], free.settings.clips),
        open_engine(free),
        0,
    )
    state = search.restart(problem, free.space.z_of(np.append(TRUTH, 1.1)))
    (step,) = (shift for shift in shifts_of(problem, final_fit(problem, state))[0] if shift.assumed)
    assert "time step" in step.text


@pytest.mark.parametrize(
    ("limit", "more", "change", "word"),
    [
        (50.0, {"gain": 0.1}, strong_servo, "the gain of servo (4)"),
        (1.1, {}, weak_limit, "the force limit of servo (1.1)"),
    ],
)
def test_a_wrong_ruler_is_named_and_the_interval_holds(
    limit: float, more: dict[str, Any], change: Change, word: str
) -> None:
    system = pendulum(limit, **more)
    wrong = identify(system, [swing(system, change)], None, IdentifyOptions())
    assert held(wrong)
    assert any(word in reason for p in wrong.parameters for reason in p.reasons)


def test_a_world_of_finer_steps_is_held_and_the_step_is_recommended(caplog: pytest.LogCaptureFixture) -> None:
    system = pendulum(50.0, step=0.0025)
    wrong = identify(system, [swing(system, finer)], None, IdentifyOptions())
    assert held(wrong)
    assert "the time step is too long: at 1.25 ms the model explains" in caplog.text
    caplog.clear()
    shifts(system, swing(system, unchanged))
    assert "time step" not in caplog.text


def test_commands_that_act_late_are_found_and_the_interval_holds(caplog: pytest.LogCaptureFixture) -> None:
    system = pendulum(50.0, command_delay=0.005)
    prompt = swing(system, unchanged)
    exact = about(shifts(system, prompt), "commands that act at once")
    assert np.abs(exact.z).max() < 0.05, "the log knows when they act"
    assert "speak against" not in caplog.text
    acted = prompt["command.position"]
    early = replace(acted, values=np.roll(acted.values, -3, axis=0))  # logged 6 ms before they act
    late = replace(prompt, series={**prompt.series, "command.position": early})
    found = identify(system, [late], None, IdentifyOptions())
    assert held(found)
    (text,) = (line for line in caplog.messages if "speak against commands that act at once" in line)
    assert re.search(r"want \+[5-9](\.\d)? ms", text)


@pytest.mark.parametrize(("late", "blamed"), [(0, False), (2, True)])  # 4 ms are two steps
def test_what_a_finer_step_explains_is_no_delay(
    late: int, blamed: bool, caplog: pytest.LogCaptureFixture
) -> None:
    system = pendulum(50.0, command_delay=0.005)
    log = swing(system, finer)
    acted = log["command.position"]
    early = replace(acted, values=np.roll(acted.values, -late, axis=0))
    log = replace(log, series={**log.series, "command.position": early})
    identify(system.fixing({"load_mass": TRUTH[0]}), [log], None, IdentifyOptions())
    assert ("speak against commands that act at once" in caplog.text) == blamed


def test_the_step_widens_nothing_where_the_log_shows_that_the_plant_has_it_too() -> None:
    system = pendulum(50.0, step=0.005)
    of_model, of_world = (
        about(shifts(system, swing(system, plant)), "time step") for plant in (unchanged, finer)
    )
    assert not of_model.spread.any()
    assert np.abs(of_world.spread).max() > np.abs(of_world.z).max(), "the way to a step of zero is longer"


def test_a_step_that_is_taken_as_exact_adds_nothing() -> None:
    assumed, exact = (pendulum(50.0, step=0.005, time_step=share) for share in (1.0, 0.0))
    log = swing(assumed, finer)
    assert about(shifts(assumed, log), "time step").spread.any()
    assert not [shift for shift in shifts(exact, log) if "time step" in shift.text]


def test_an_exact_ruler_that_is_assumed_leaves_an_estimate_identified() -> None:
    system = pendulum(50.0, gain=0.1)
    twin = identify(system, [swing(system, unchanged)], None, IdentifyOptions())
    mass = of(twin, "load_mass")
    assert held(twin) and mass.verdict == "identified"
    assert mass.sd / mass.estimate == pytest.approx(0.1, abs=0.04), "no log of positions knows torques better"
    assert "it rests on the gain of servo (4): known to 10%" in mass.reasons[0]


def test_a_limit_as_a_parameter_is_found() -> None:
    system = pendulum(1.1, free=True)
    log = swing(pendulum(1.1), weak_limit)
    limit = of(identify(system, [log], None, IdentifyOptions()), "limit")
    assert limit.estimate == pytest.approx(0.88, rel=0.05)
    assert limit.lower < 0.88 < limit.upper


#: A cart on a servo, whose load stands on a force sensor.
CART = """
<mujoco><option timestep="0.005"/><worldbody>
<body><joint name="slide" type="slide" axis="1 0 0" damping="5" frictionloss="2"/><geom size="0.1" mass="2"/>
<body name="load" pos="0 0 0.2"><site name="wrist"/><geom size="0.05" mass="1"/></body></body></worldbody>
<actuator><position name="servo" joint="slide" kp="400" kv="20"/></actuator></mujoco>
"""


def weighed(**wrist: Any) -> tuple[System, Log]:
    """The cart with an unknown load, and a log of a sensor that shows 0.4 N too much along z."""
    free = {"load": {"targets": [{"body": "load", "set": "mass"}], "nominal": 1.0, "prior_sd": 0.7}}
    if wrist.pop("free", False):
        targets = [{"signal": "wrist", "set": "bias", "axis": axis} for axis in "xyz"]
        free["bias"] = {
            "targets": targets,
            "nominal": 0.0,
            "prior_sd": 0.5,
            "scale": "linear",
            "bounds": [-9, 9],
        }
    system = System.from_model(
        mujoco.MjSpec.from_string(CART),
        parameters=free,
        signals={
            "joints": {"joints": ["slide"], "noise": {"position": 0.0005}},
            "wrist": {"site": "wrist", "quantity": "force", "noise": {"force": 0.2}, **wrist},
            "command": {"actuators": ["servo"], "quantity": "position"},
        },
        settings={**CHEAP, "identify": {**CHEAP["identify"], "rulers": {"gain": 0, "command_delay": 0}}},
    )
    model, rng = system.edits.apply(system.model, system.space.nominal), np.random.default_rng(0)
    data, rows = mujoco.MjData(model), []
    for step in range(600):
        data.ctrl[0] = 0.02 * np.sin(0.04 * (step - step % 2))
        rows.append((step * system.dt, data.qpos[0], *data.sensordata, data.ctrl[0]))
        mujoco.mj_step(model, data)
    time, position, *force, command = np.array(rows[::2]).T
    shown = np.stack(force, axis=1) + np.array([0.0, 0.0, 0.4]) + rng.normal(0.0, 0.2, (len(time), 3))
    log = Log.from_arrays(
        {
            "joints": {"time": time, "position": position + rng.normal(0.0, 0.0005, len(time))},
            "wrist": {"time": time, "force": shown},
            "command": {"time": time, "position": command},
        },
        system,
    )
    return system, log


def test_a_load_rests_on_the_bias_of_the_sensor_that_weighs_it() -> None:
    """It is 4 % of the load's weight, and the load hardly moves."""
    system, log = weighed()
    (load,) = identify(system, [log], None, IdentifyOptions()).parameters
    assert load.lower <= 1.0 <= load.upper
    assert any("it rests on" in text and "the bias of wrist.force along z" in text for text in load.reasons)


def test_a_bias_that_is_a_parameter_or_known_is_no_ruler() -> None:
    free, log = weighed(free=True)
    assert not any("the bias" in shift.text for shift in shifts(free, log, free.space.nominal))
    known = free.settings.identify.model_copy(update={"rulers": RulerSettings(force_bias=0.0)})
    system = weighed()[0]
    exact = replace(system, settings=system.settings.model_copy(update={"identify": known}))
    assert not any("the bias" in shift.text for shift in shifts(exact, log, exact.space.nominal))


#: A cart on a servo whose gains nobody knows.
FREE = """
<mujoco><option timestep="0.001"/><worldbody><body pos="0 0 1"><geom size="0.1" mass="50"/></body>
<body><joint name="slide" type="slide" axis="1 0 0" damping="5"/><geom size="0.1" mass="{}"/></body>
</worldbody><actuator><position name="servo" joint="slide" kp="400" kv="20"/></actuator></mujoco>
"""


@pytest.mark.medium
@pytest.mark.parametrize(("light", "share"), [(1.0, 0.1), (0.85, 0.1), (0.85, 0.0)])
def test_unknown_gains_rest_on_the_masses_of_what_moves(light: float, share: float) -> None:
    """Positions show ratios of gain, damping and mass; a model that is too light has gains too low."""
    words = ("gain", "actuator_damping")
    system = System.from_model(
        mujoco.MjSpec.from_string(FREE.format(2.0 * light)),
        parameters={
            "gain": {
                "nominal": 1.3,
                "prior_sd": 0.7,
                "targets": [{"actuator": "servo", "set": word, "mode": "scale"} for word in words],
            },
            "damping": {"targets": [{"joint": "slide", "set": "damping"}], "nominal": 6.0, "prior_sd": 0.7},
        },
        signals={
            "joints": {"joints": ["slide"], "noise": {"position": 0.0005}},
            "command": {"actuators": ["servo"], "quantity": "position"},
        },
        settings={
            **CHEAP,
            "identify": {**CHEAP["identify"], "rulers": {"gain": 0, "command_delay": 0, "mass": share}},
        },
    )
    model, rng = mujoco.MjModel.from_xml_string(FREE.format(2.0)), np.random.default_rng(0)
    data, rows = mujoco.MjData(model), []
    for step in range(4000):
        held = (step - step % 10) * system.dt
        data.ctrl[0] = 0.1 * np.sin(1.3 * held) + 0.1 * np.sin(15.0 * held)
        rows.append((step * system.dt, data.qpos[0], data.ctrl[0]))
        mujoco.mj_step(model, data)
    time, position, command = np.array(rows[::10]).T
    log = Log.from_arrays(
        {
            "joints": {"time": time, "position": position + rng.normal(0.0, 0.0005, len(time))},
            "command": {"time": time, "position": command},
        },
        system,
    )
    result = identify(system, [log], None, IdentifyOptions())
    gain, links = of(result, "gain"), f"the masses of the links ({2.0 * light:.3g} kg)"
    assert gain.verdict == "identified"
    assert (gain.lower <= 1.0 <= gain.upper) == bool(share), "not of the base, which does not move"
    assert (links in " ".join(gain.reasons)) == bool(share)
    assert (links in result.exact) != bool(share)


def ruler(name: str) -> Ruler:
    return Ruler(name, None, (), "scale", 0.1, "10%")


def test_what_explains_the_logs_as_well_is_named_with_the_change_that_it_alone_would_need() -> None:
    """The logs want gain - mass = 4 sd, and know nothing of the sum; of the limit they want nothing."""
    data = np.diag([0.0, 100.0, 100.0, 100.0])
    data[1, 2] = data[2, 1] = -100.0
    known = sealed(np.linalg.inv(data + np.eye(4)))
    mean = known @ np.array([0.0, 400.0, -400.0, 0.0])
    assert mean == pytest.approx([0.0, 2.0, -2.0, 0.0], abs=0.02), "as a posterior they share it"
    rulers = [ruler("the gain"), ruler("the masses"), ruler("the limit")]
    (text,) = _against(rulers, known, mean, [0, 1])
    assert "against the gain: they want +40% (40 sd), or -40% of the masses;" in text
    assert "make one of them a parameter" in text and "limit" not in text
    alone = sealed(np.linalg.inv(np.diag([1.0, 101.0, 1.0, 1.0])))
    (text,) = _against(rulers, alone, alone @ np.array([0.0, 400.0, 0.0, 0.0]), [0])
    assert "they want +40% (40 sd); measure it, or make it a parameter" in text
