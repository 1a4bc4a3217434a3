"""What an estimate owes to numbers that the model takes for granted, and what a log says of them."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
import pytest

from amhe_cli.core.arrays import sealed
from amhe_cli.core.each_log import searched
from amhe_cli.core.log import Log
from amhe_cli.core.settings import AssumedSettings
from amhe_cli.engine.open import open_engine
from amhe_cli.estimation.core.result import Identification, ParameterResult
from amhe_cli.estimation.identification import IdentifyOptions, identify
from amhe_cli.estimation.offline import search
from amhe_cli.estimation.offline.clips import ClipPool, whole
from amhe_cli.estimation.offline.problem import Problem
from amhe_cli.estimation.uncertainty import assumed as module
from amhe_cli.estimation.uncertainty.assumed import _against, assumed
from amhe_cli.estimation.uncertainty.fit import FinalFit, final_fit
from amhe_cli.estimation.uncertainty.ledger import Source, Term
from amhe_cli.system.description.load import find_system
from amhe_cli.system.system import System
from tests.estimation.conftest import CHEAP, NOISE, TRUTH, as_trajectory
from tests.estimation.test_identification import fall
from tests.estimation.uncertainty.test_parts import GAIN, MASS, cart, pushed

#: What a model lacks is not looked for here.
pytestmark = pytest.mark.usefixtures("unexplained")

#: All but what a test is about is exact.
EXACT = dict.fromkeys(AssumedSettings.model_fields, 0.0)

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


def settings(**given: float) -> dict[str, Any]:
    """A quick search, in which nothing but `given` is assumed."""
    return {**CHEAP, "identify": {**CHEAP["identify"], "assumed": EXACT | given}}


#: A limit of a servo's force that is unknown, and a factor on both its gain and that limit.
LIMIT = {"limit": {"targets": [{"actuator": "servo", "set": "force_limit"}]}}
SCALE = {
    "gain_scale": {
        "nominal": 1.0,
        "prior_sd": 0.1,
        "targets": [{"actuator": "servo", "set": "gain", "mode": "scale", "carry_limit": True}],
    }
}


def pendulum(limit: float, beside: Any = (), step: float = 0.002, **given: float) -> System:
    """The bundled pendulum, with a limit of its servo's torque [N m], and parameters beside its four.

    Its limit and its time step are assumed, and `given`.
    """
    spec = mujoco.MjSpec.from_file(str(find_system("pendulum") / "scene.xml"))
    spec.actuators[0].forcerange = [-limit, limit]
    spec.option.timestep = step
    bundled = System.load("pendulum")
    names = ("load_mass", "damping", "friction_loss", "armature")
    targets = ({"body": "load", "set": "mass"}, *({"joint": "hinge", "set": n} for n in names[1:]))
    return System.from_model(
        spec,
        parameters={
            p.name: {"nominal": p.nominal, "prior_sd": p.prior_sd, "targets": [target]}
            for p, target in zip(bundled.space.parameters, targets, strict=True)
        }
        | dict(beside),
        signals={
            "joints": {"joints": ["hinge"], "noise": {"position": NOISE[0], "velocity": NOISE[1]}},
            "command": {"actuators": ["servo"], "quantity": "position"},
        },
        settings=settings(**({"force_limit": 0.2, "time_step": 1.0} | given)),
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


def posed(system: System, log: Log) -> Problem:
    pool = ClipPool(system, [whole(log)], system.settings.clips)
    return Problem(system, pool, open_engine(system), 0)


def terms(system: System, log: Log, at: np.ndarray = TRUTH) -> Term:
    """What the estimate owes to assumed values, at the truth or at other values."""
    problem = posed(system, log)
    return assumed(final_fit(problem, search.restart(problem, system.space.z_of(at))))[0]


def about(found: Term, word: str) -> tuple[Source, np.ndarray]:
    """The source with a word in its name, and its error (d,)."""
    (k,) = (k for k, source in enumerate(found.sources) if word in source.name)
    return found.sources[k], found.errors[:, k]


def names(found: Term) -> list[str]:
    return [str(source) for source in found.sources]


def of(result: Identification, name: str) -> ParameterResult:
    return next(p for p in result.parameters if p.name == name)


def held(result: Identification) -> bool:
    return all(p.lower <= true <= p.upper for p, true in zip(result.parameters, TRUTH, strict=True))


# -- what they cost ------------------------------------------------------------------------------------------


#: The cart's joint, and one with a spring.
SPRING = ('type="slide"', 'type="slide" stiffness="20"')


def left_open(*shares: float) -> float:
    """Error of the mass where logs show its ratio to numbers that are known to these shares.

    They are right if all of them, and ln(mass), err by the same t: the data sheets and the prior N(0, 0.5^2)
    of ln(mass), which ends at ln(2), give t a variance and a mean.
    """
    precision = sum(np.log1p(-share) ** -2 for share in shares) + 0.5**-2
    return float(np.hypot(precision**-0.5, 0.5**-2 * np.log(2.0) / precision)) / 0.5


@pytest.mark.medium
def test_a_number_that_no_log_determines_costs_its_data_sheet() -> None:
    """Motion shows gain / mass: 10 % of the one are 10 % of the other."""
    system = cart(assumed=EXACT | {"gain": 0.1}, mass=MASS)
    found = terms(system, pushed(system), np.array([2.0]))
    source, error = about(found, "gain")
    assert str(source) == "the gain of motor (1)" and source.times() == "10 %" and not source.doubted
    assert left_open(0.1) == pytest.approx(-np.log(0.9) / 0.5, rel=0.02)
    assert abs(error[0]) == pytest.approx(left_open(0.1), rel=0.01)
    assert found.shared and found.kind == "assumed"
    mass = of(identify(system, [pushed(system)], None, IdentifyOptions()), "mass")
    assert (mass.verdict, mass.given) == ("conditional", "the gain of motor, 1")
    assert mass.reasons[0].text.startswith("given the gain of motor, 1: known to 10 %, that leaves 11 % open")
    assert mass.budget["assumed"] > 0.9 and mass.lower < 2.0 < mass.upper


def test_numbers_that_only_together_leave_the_estimate_open_cost_what_both_data_sheets_leave() -> None:
    """With an exact spring, the log knows the gain; with both assumed it knows ratios only."""
    both, one = (
        cart(SPRING, EXACT | given, mass=MASS) for given in ({"gain": 0.1, "stiffness": 0.2}, {"gain": 0.1})
    )
    found, known = (terms(system, pushed(system, stiffness=20.0), np.array([2.0])) for system in (both, one))
    assert np.sqrt(found.covariance[0, 0]) == pytest.approx(left_open(0.1, 0.2), rel=0.02)
    assert np.sqrt(known.covariance[0, 0]) < 0.2 * left_open(0.1)


def rubbing(noise: float) -> tuple[System, Log]:
    """A cart with a spring, dry friction and a drive: all but their common factor shows in its motion."""
    word = SPRING[1] + ' damping="2" frictionloss="1"'
    names = {"mass": {"body": "cart", "set": "mass"}} | {
        n: {"joint": "x", "set": n} for n in ("damping", "friction_loss")
    }
    targets = {name: {"prior_sd": 0.5, "targets": [target]} for name, target in names.items()}
    system = cart((SPRING[0], word), EXACT | {"gain": 0.1, "stiffness": 0.1}, **targets)
    data, rng, time = mujoco.MjData(system.model), np.random.default_rng(0), 0.01 * np.arange(1200)
    force = 6.0 * np.sin(5.0 * time) + 4.0 * np.cos(11.0 * time)
    states = np.empty((len(time), 2))
    for k, ctrl in enumerate(force):
        states[k], data.ctrl[0] = (data.qpos[0], data.qvel[0]), ctrl
        mujoco.mj_step(system.model, data)
    states += noise * rng.standard_normal(states.shape)
    state = {"time": time, "position": states[:, 0], "velocity": states[:, 1]}
    return system, Log.from_arrays({"state": state, "force": {"time": time, "effort": force}}, system)


def test_what_only_a_ratio_shows_is_open_however_little_the_log_errs() -> None:
    """Slopes of each number alone, between which dry friction has kinks, would know the common factor."""
    system, log = rubbing(2e-5)
    found = terms(system, log, system.space.nominal)
    shares = 2.0 * np.log(0.9) ** -2 + 3.0 * 0.5**-2
    assert np.sqrt(found.covariance.diagonal()) == pytest.approx(shares**-0.5 / 0.5, rel=0.05)


@pytest.mark.medium
def test_a_number_that_the_log_determines_costs_nothing_where_it_is_right_and_all_where_it_is_wrong() -> None:
    system = cart(SPRING, EXACT | {"stiffness": 0.2}, mass=MASS)
    right = terms(system, pushed(system, stiffness=20.0), np.array([2.0]))
    log = pushed(system, stiffness=17.0)
    stiffness = {"nominal": 20.0, "prior_sd": 0.5, "targets": [{"joint": "x", "set": "stiffness"}]}
    free = cart(SPRING, mass=MASS, stiffness=stiffness)
    fixed, truth = (of(identify(one, [log], None, IdentifyOptions()), "mass") for one in (system, free))
    known, apart = truth.sd / truth.estimate, abs(np.log(fixed.estimate / truth.estimate))
    assert np.sqrt(right.covariance[0, 0]) < 2.5 * known / 0.5, "what it costs to know both"
    assert apart > 10.0 * known
    # the error is the way to where the estimate would be, were the stiffness free
    error = np.sqrt(fixed.budget["assumed"]) * fixed.sd / fixed.estimate
    assert error == pytest.approx(apart, rel=0.1)
    (name,) = (reason.text for reason in fixed.reasons if reason.kind == "assumed")
    assert name.startswith("the logs speak against the stiffness of x, 20: known to 20 %")


def test_only_what_moves_the_estimate_is_a_source() -> None:
    found = terms(
        pendulum(50.0, gain=0.1, center_of_mass=0.01, time_step=0.0), swing(pendulum(50.0), unchanged)
    )
    assert names(found)[0] == "the gain of servo (4)"
    assert "the centre of mass of load along z" in names(found)
    assert "the centre of mass of load along y" not in names(found), "that is the axis"
    assert not any("limit" in name for name in names(found)), "it reaches neither of its two"


@pytest.mark.parametrize(
    ("given", "exact"),
    [
        ({}, {"gain", "center_of_mass", "mass", "geometry", "gravity", "command_delay"}),
        ({"gain": 0.1, "mass": 0.1, "geometry": 0.01, "gravity": 0.01, "time_step": 0.0},
         {"center_of_mass", "command_delay", "time_step"}),
    ],
)  # fmt: skip
def test_what_is_taken_as_exact_is_listed_where_it_acts(given: dict[str, float], exact: set[str]) -> None:
    system = pendulum(50.0, **given)
    problem = posed(system, swing(system, unchanged, 2.0))
    listed = assumed(final_fit(problem, search.restart(problem, system.space.z_of(TRUTH))))[1]
    assert set(listed) == exact and len(listed) == len(exact), "no limit is reached, and no spring is there"


def test_a_limit_that_acts_is_named_with_its_value_and_share() -> None:
    system = pendulum(limit=1.1)
    source, _ = about(terms(system, swing(system, unchanged)), "limit")
    assert str(source) == "the force limit of servo (1.1)" and source.times() == "20 %"
    assert source.acts is not None and 0.0 < source.acts < 1.0


def test_logs_with_known_values_move_what_is_searched() -> None:
    system = pendulum(1.1)
    log = swing(system, unchanged).with_(known={"damping": TRUTH[1]})
    fewer = replace(system, space=searched(system.space, [log]))
    found = terms(fewer, log, np.delete(TRUTH, 1))
    assert found.errors.shape[0] == 3
    assert np.abs(about(found, "limit")[1]).max() > 0.0


@pytest.mark.medium
def test_a_wrong_limit_is_named_and_the_interval_holds() -> None:
    system = pendulum(1.1)
    wrong = identify(system, [swing(system, weak_limit)], None, IdentifyOptions())
    assert held(wrong)
    assert any("the force limit of servo, 1.1" in r.text for p in wrong.parameters for r in p.reasons)


@pytest.mark.medium
def test_a_limit_as_a_parameter_is_found_and_not_assumed() -> None:
    result = identify(pendulum(1.1, LIMIT), [swing(pendulum(1.1), weak_limit)], None, IdentifyOptions())
    limit = of(result, "limit")
    assert limit.estimate == pytest.approx(0.88, rel=0.05)
    assert limit.lower < 0.88 < limit.upper
    assert not any("force limit" in reason.text for p in result.parameters for reason in p.reasons)


@pytest.mark.medium
@pytest.mark.parametrize("agree", [True, False])
def test_a_limit_that_follows_a_gain_may_be_off_beside_it(agree: bool) -> None:
    system, log = pendulum(1.1, SCALE), swing(pendulum(1.1), unchanged if agree else strong_servo)
    result = identify(system, [log], None, IdentifyOptions())
    truth = (*TRUTH, 1.0 if agree else 1.12)
    claims = {p.verdict for p in result.parameters if p.name in ("load_mass", "armature")}
    inside = [p.lower <= true <= p.upper for p, true in zip(result.parameters, truth, strict=True)]
    assert all(inside)
    if agree:
        assert claims <= {"identified", "conditional"}
    else:
        assert "identified" not in {p.verdict for p in result.parameters}
        assert any("the force limit of servo, 1.1" in r.text for p in result.parameters for r in p.reasons)


# -- time steps and delays -----------------------------------------------------------------------------------


@pytest.mark.medium
def test_a_world_of_finer_steps_is_held_and_the_step_is_recommended(caplog: pytest.LogCaptureFixture) -> None:
    system = pendulum(50.0, step=0.0025)
    wrong = identify(system, [swing(system, finer)], None, IdentifyOptions())
    assert held(wrong)
    assert "the time step is too long: at 1.25 ms the model explains" in caplog.text
    caplog.clear()
    terms(system, swing(system, unchanged))
    assert "time step" not in caplog.text


@pytest.mark.medium
def test_the_step_costs_little_where_the_log_shows_that_the_plant_has_it_too() -> None:
    system = pendulum(50.0, step=0.005)
    of_model, of_world = (terms(system, swing(system, plant)) for plant in (unchanged, finer))
    source, error = about(of_world, "time step")
    assert str(source) == "the time step (5 ms)" and source.doubted
    assert np.abs(of_model.errors).sum() < 0.1 * np.abs(error).sum()
    assert not terms(pendulum(50.0, step=0.005, time_step=0.0), swing(system, finer)).covariance.any()


@pytest.mark.medium
def test_commands_that_act_late_are_found_and_the_interval_holds(caplog: pytest.LogCaptureFixture) -> None:
    system = pendulum(50.0, command_delay=0.005)
    prompt = swing(system, unchanged)
    assert np.abs(terms(system, prompt).errors).max(initial=0.0) < 0.05, "the log knows when they act"
    assert "speak against" not in caplog.text
    acted = prompt["command.position"]
    early = replace(acted, values=np.roll(acted.values, -3, axis=0))  # logged 6 ms before they act
    late = replace(prompt, series={**prompt.series, "command.position": early})
    found = identify(system, [late], None, IdentifyOptions())
    assert held(found)
    (text,) = (line for line in caplog.messages if "speak against commands that act at once" in line)
    wanted = re.search(r"want \+([\d.]+) ms \((\d+) sd\)", text)
    assert wanted and abs(float(wanted[1]) - 6.0) < 0.5 and int(wanted[2]) > 3


@pytest.mark.medium
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


# -- contacts ------------------------------------------------------------------------------------------------


def sliding(noise: float, executor: Executor | None = None) -> FinalFit:
    """A sliding cube's final fit at the truth, of a log with this noise [SI]."""
    system = System.load("cube_toss", {**CHEAP, "clips": {"count": 4, "length": [0.1, 0.2]}})
    channels = tuple(replace(channel, noise=noise) for channel in system.channels)
    system = replace(system, channels=channels)
    engine = open_engine(system, executor=executor)
    pool = ClipPool(system, [whole(fall(system, noise))], system.settings.clips)
    problem = Problem(system, pool, engine, 0)
    z = np.zeros(len(system.space))
    z[0] = system.space.z_of(np.array([0.3, *system.space.nominal[1:]]))[0]
    return final_fit(problem, search.restart(problem, z))


def test_numerical_choices_are_rows_of_one_sd_each(monkeypatch: pytest.MonkeyPatch) -> None:
    """Contacts: half a factor of two, from twice as soft and twice as hard; the step: all the way to zero."""
    values: Iterator[float] = iter([4.0, 1.0, 0.5, 7.0])  # softer, harder, solved for longer, half the step
    judged = []

    def changed(fit: FinalFit, cost: Any, *, fitted: bool = False) -> tuple[Any, float]:
        judged.append(fitted)
        move = next(values)
        return module._Change(Source(""), np.full((1, 2), move), move), 0.0

    monkeypatch.setattr(module, "_changed", changed)
    rows = list(module._changes(sliding(1e-2)))
    names = ["the softness of contacts"] * 2 + ["the solver", "the time step"]
    assert [change.source.name for change in rows] == names
    assert judged == [False] * 3 + [True], "only the step's misfit is shown"
    # half of a factor of two is one sd, and either side has half of the variance
    half = 0.5 / np.sqrt(2.0)
    assert [change.slope[0, 0] for change in rows] == pytest.approx([half * 4.0, half * 1.0, 0.5, 2.0 * 7.0])
    assert [change.error for change in rows] == pytest.approx([change.slope[0, 0] for change in rows])
    assert rows[0].source.times() == "1.41 times"


def known(fit: FinalFit, slopes: Any = None) -> tuple[np.ndarray, np.ndarray]:
    """Sd and mean of each numerical choice that a fit's log leaves, in its own sd; of given slopes alike."""
    changes = [module._Change(Source(""), by) for by in slopes.by.swapaxes(0, 1)] if slopes else None
    changes = list(module._changes(fit)) if changes is None else changes
    covariance, mean, _ = module._Nuisances(fit, changes, [], slopes).posterior
    return np.sqrt(covariance.diagonal()), mean


def test_a_sharp_log_knows_how_soft_contacts_are() -> None:
    sharp, blunt = (known(sliding(noise))[0][:2] for noise in (1e-4, 2e-2))
    assert sharp.max() < 0.3 * blunt.min()


def test_jitter_of_slopes_is_no_information() -> None:
    """The square of slopes that jitter would fix any number; of one that they resolve a log knows as much."""
    rng, fit = np.random.default_rng(0), sliding(1e-2)
    shape = fit.slopes.residual.shape
    even = rng.standard_normal((60, *shape))
    error = np.array([1.0, 0.5, 0.5])
    by = np.moveaxis(error[:, None, None] * rng.standard_normal((3, *shape)), 0, 1)
    by[:, 2] += 5.0 * np.sign(rng.standard_normal(shape))
    passed = known(fit, module._Slopes(by, error, 1e-9 * even))[0]
    sd, mean = known(fit, module._Slopes(by, error, even))
    assert passed.max() < 0.2, "as if they did not jitter"
    assert sd[:2].min() > 0.9
    assert np.abs(mean[:2]).max() < 0.1
    assert sd[2] < 3.0 * passed[2]


@pytest.mark.medium
def test_variants_are_rolled_out_by_the_workers_that_were_given() -> None:
    models: set[bytes] = set()

    class Noting(ThreadPoolExecutor):
        def submit(self, fn, /, *args, **kwargs):
            models.add(args[0])
            return super().submit(fn, *args, **kwargs)

    here = assumed(sliding(1e-4))[0]
    with Noting(1) as executor:
        spread = assumed(sliding(1e-4, executor))[0]
    assert len(models) >= 5, "the model itself, softer, harder, at half the step, solved for longer"
    np.testing.assert_array_equal(here.errors, spread.errors)


# -- forces and masses ---------------------------------------------------------------------------------------


#: A cart on a servo, whose load stands on a force sensor.
WRIST = """
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
        mujoco.MjSpec.from_string(WRIST),
        parameters=free,
        signals={
            "joints": {"joints": ["slide"], "noise": {"position": 0.0005}},
            "wrist": {"site": "wrist", "quantity": "force", "noise": {"force": 0.2}, **wrist},
            "command": {"actuators": ["servo"], "quantity": "position"},
        },
        settings=settings(force_bias=0.05),
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
    assert any(
        "the bias of wrist.force along z: known to 5 % of its largest value" in r.text for r in load.reasons
    )


def test_a_bias_that_is_a_parameter_is_not_assumed() -> None:
    free, log = weighed(free=True)
    assert not terms(free, log, free.space.nominal).sources


@pytest.mark.medium
@pytest.mark.parametrize(("light", "share"), [(1.0, 0.1), (0.85, 0.1), (0.85, 0.0)])
def test_an_unknown_gain_rests_on_the_masses_of_what_moves(light: float, share: float) -> None:
    """Motion shows the ratio of gain and mass; a model that is too light has a gain that is too low."""
    system = cart(('mass="1"', f'mass="{2.0 * light}"'), EXACT | {"mass": share}, gain=GAIN)
    result = identify(system, [pushed(system)], None, IdentifyOptions())
    (gain,) = result.parameters
    assert (gain.lower <= 1.0 <= gain.upper) == bool(share)
    named = ("conditional", f"the masses of the links, {2.0 * light:.3g} kg")
    assert (gain.verdict, gain.given) == (named if share else ("identified", ""))
    assert ("mass" in result.exact) != bool(share)


def test_what_explains_the_logs_as_well_is_named_with_the_change_that_it_alone_would_need() -> None:
    """The logs want gain - mass = 4 sd, and know nothing of the sum; of the limit they want nothing."""
    data = np.diag([0.0, 100.0, 100.0, 100.0])
    data[1, 2] = data[2, 1] = -100.0
    known = sealed(np.linalg.inv(data + np.eye(4)))
    mean = known @ np.array([0.0, 400.0, -400.0, 0.0])
    assert mean == pytest.approx([0.0, 2.0, -2.0, 0.0], abs=0.02), "as a posterior they share it"
    words = ("the solver", "the gain", "the masses", "the limit")
    sources = [Source(word, amount=10.0, unit="%") for word in words]
    (text,) = _against(sources, known, mean, np.array([1, 2]))
    assert "against the gain: they want +40 % (40 sd), or -40 % of the masses;" in text
    assert "make one of them a parameter" in text and "limit" not in text
    alone = sealed(np.linalg.inv(np.diag([1.0, 101.0, 1.0, 1.0])))
    (text,) = _against(sources, alone, alone @ np.array([0.0, 400.0, 0.0, 0.0]), np.array([1]))
    assert "they want +40 % (40 sd); measure it, or make it a parameter" in text
