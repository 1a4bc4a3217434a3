"""What a model lacks, and what is wrong with a log: the statistics on arrays, and causes by name."""

from __future__ import annotations

import copy
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

import amhe_cli as amhe
from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.each_log import searched
from amhe_cli.engine.inverse import forces_along
from amhe_cli.estimation.core.result import Missing
from amhe_cli.estimation.explain.candidate import CauseMaker
from amhe_cli.estimation.explain.drives import _replaced, drive_causes
from amhe_cli.estimation.explain.efforts import unexplained_efforts
from amhe_cli.estimation.explain.explain import explain, forced
from amhe_cli.estimation.explain.inputs import mended
from amhe_cli.estimation.explain.joints import joint_causes
from amhe_cli.estimation.explain.motion import _FEW, _PIECE, _pieces
from amhe_cli.estimation.explain.regression import CauseColumns, Regression, blocks_of, memory_of
from amhe_cli.estimation.explain.unexplained import unexplained
from amhe_cli.estimation.offline.clips import whole
from amhe_cli.report.missing import rest
from amhe_cli.system.parameters.gear_friction import OWN as GEAR
from tests.matching.test_efforts import DT, PARAMETERS, path, recorded, system_of

EXAMPLE = Path(__file__).parents[2] / "examples" / "logs" / "pendulum.mcap"


def _columns(rng: np.random.Generator, n: int = 1500) -> tuple[list[CauseColumns], FloatArray]:
    """Ten smooth columns, and a residual of noise that remembers 15 samples."""
    width = np.hanning(31)
    smooth = np.array([np.convolve(x, width, "same") for x in rng.standard_normal((10, n))])
    noise = np.convolve(rng.standard_normal(n), np.ones(15) / 15**0.5, "same")
    return [CauseColumns((0,), x[None, :, None], 1) for x in smooth], noise[:, None]


def _regression(residual: FloatArray, nuisance: FloatArray) -> Regression:
    rows = [slice(0, len(residual))]
    return Regression(residual, nuisance, blocks_of(rows, memory_of(residual, rows)))


def test_blocks_are_longer_than_what_a_residual_remembers() -> None:
    blocks = blocks_of([slice(0, 500), slice(500, 900)], 20.0)

    assert min(b.stop - b.start for b in blocks) >= 40
    assert [b.start for b in blocks[1:]] == [b.stop for b in blocks[:-1]]
    assert blocks[-1].stop == 900


def test_columns_are_found_with_their_coefficients_and_no_other() -> None:
    rng = np.random.default_rng(0)
    columns, noise = _columns(rng)
    nuisance = columns[9].values
    residual = 0.5 * columns[2].values[0] - 0.3 * columns[5].values[0] + 2.0 * nuisance[0] + 0.5 * noise

    found, chance, left, fit = _regression(residual, nuisance).ladder(columns[:9], rng)

    assert [one.index for one in found] == [2, 5]
    assert abs(found[0].coefficients[0] - 0.5) < 4.0 * found[0].sd[0] < 0.1
    assert abs(found[1].coefficients[0] + 0.3) < 4.0 * found[1].sd[0] < 0.1
    assert fit == pytest.approx([2.0], abs=0.1)
    assert 0.0 < chance < 0.2
    assert left.std() == pytest.approx(0.5 * noise.std(), rel=0.1)


def test_nothing_is_named_where_there_is_nothing() -> None:
    """One of a hundred may be named by chance: none of 12, or one."""
    named = 0
    for seed in range(12):
        rng = np.random.default_rng(seed)
        columns, noise = _columns(rng)
        found, *_ = _regression(noise, columns[9].values).ladder(columns[:9], rng)
        named += bool(found)

    assert named <= 1


def test_the_simpler_of_two_that_explain_alike_is_named() -> None:
    rng = np.random.default_rng(1)
    columns, noise = _columns(rng)
    wider = CauseColumns((0,), np.concatenate((columns[3].values, columns[4].values)), 2)

    found, *_ = _regression(columns[3].values[0] + 0.3 * noise, columns[9].values).ladder(
        [wider, columns[3]], rng
    )

    assert [(one.index, one.rivals) for one in found] == [(1, (0,))]


def test_two_causes_are_named_where_one_that_is_none_has_a_little_of_both() -> None:
    """A mixture explains most alone, and needs two more to explain all; the two that are true explain all."""
    rng = np.random.default_rng(3)
    columns, noise = _columns(rng)
    parts = [one.values[0] for one in columns]
    mixture = CauseColumns((0,), (parts[2] + parts[3] + 0.3 * parts[4] + 0.3 * parts[5])[None], 1)
    residual = parts[2] + parts[3] + 0.2 * noise

    found, *_ = _regression(residual, columns[9].values).ladder([*columns[:9], mixture], rng)

    assert sorted(one.index for one in found) == [2, 3]
    assert min(one.share for one in found) > 0.2


def test_what_cannot_be_is_not_named() -> None:
    """A coefficient beyond the largest that can be: less friction than the model has."""
    rng = np.random.default_rng(2)
    columns, noise = _columns(rng)
    residual = 0.5 * columns[2].values[0] + 0.3 * noise
    some = [replace(columns[2], most=0.1), *columns[3:9]]

    found, *_ = _regression(residual, columns[9].values).ladder(some, rng)

    assert not any(one.index == 0 for one in found)


# -- the bundled pendulum, and logs of it that are wrong on purpose ----------------------------------------


@pytest.fixture(scope="module")
def pendulum() -> tuple[amhe.System, amhe.Log]:
    system = amhe.System.load("pendulum")
    return system, amhe.read_log(EXAMPLE, system)


def _explained(system: amhe.System, log: amhe.Log) -> Missing:
    return explain(system, [whole(log)], np.zeros(len(system.space)), np.random.default_rng(0))


def _times(log: amhe.Log, **factors: float) -> amhe.Log:
    series = dict(log.series)
    for name, factor in factors.items():
        key = name.replace("_", ".")
        series[key] = replace(series[key], values=factor * np.array(series[key].values))
    return replace(log, series=series)


@pytest.mark.medium
def test_a_log_with_the_other_sign_is_named_with_what_the_data_cannot_tell_from_it(
    pendulum: tuple[amhe.System, amhe.Log],
) -> None:
    system, log = pendulum

    first = _explained(system, _times(log, joints_position=-1.0, joints_velocity=-1.0)).rows[0]

    assert (first.kind, first.place) == ("joint sign", "hinge")
    assert first.share > 0.9
    assert "the log's command of servo has the other sign" in first.rivals


@pytest.mark.medium
def test_what_touches_is_not_looked_at_and_that_is_said(pendulum: tuple[amhe.System, amhe.Log]) -> None:
    system, log = pendulum
    model = copy.copy(system.model)
    positions = next(s.values for c in system.channels if c.source == "qpos" for s in [log[c.key]])
    angle = np.quantile(positions, 0.7)
    model.jnt_limited[0], model.jnt_range[0] = True, (-10.0, angle)  # at its end in three tenths of the log
    z, rng = np.zeros(len(system.space)), np.random.default_rng(0)
    found = forced(replace(system, model=model), [whole(log)], z, rng, 0)
    assert 0.1 < found.looked < 0.75
    assert "of the motion in which nothing touches" in rest(found)
    assert "nothing touches" not in rest(forced(system, [whole(log)], z, rng, 0))


@pytest.mark.medium
def test_degrees_are_named(pendulum: tuple[amhe.System, amhe.Log]) -> None:
    system, log = pendulum

    first = _explained(system, _times(log, command_position=180.0 / np.pi)).rows[0]

    assert (first.kind, first.text) == ("unit", "the log's command of servo is in degrees")


def test_friction_of_gears_is_no_missing_force() -> None:
    """Of a weight on a lever it is 0.2 times the difference of the motor's torque and gravity's, and more."""
    numbers = dict(GEAR) | {"load_friction_motor": 0.2, "load_friction_external": 0.2}
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><custom><numeric name="gear_friction/j" data="{" ".join(map(str, numbers.values()))}"/>
        </custom><worldbody><body><joint name="j" axis="0 1 0" frictionloss="0.1" damping="0.3"/>
        <geom pos="0.5 0 0" size="0.01" mass="2"/></body></worldbody>
        <actuator><motor joint="j"/></actuator></mujoco>"""
    )
    one = np.ones((1, 1))
    control = int(mujoco.mjtState.mjSTATE_CTRL)
    found = forces_along(model, 0.0 * one, one, 0.0 * one, 3.0 * one, control)

    assert found.friction[0, 0] == pytest.approx(0.1 + 0.2 * abs(2.0 * 9.81 * 0.5 - 3.0), rel=1e-6)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_what_lets_a_model_have_a_cause_is_valid(pendulum: tuple[amhe.System, amhe.Log], sign: float) -> None:
    """Of every cause, with coefficients of either sign; load friction and springs that pull have none."""
    system, log = pendulum
    free = system.fixing(only=["load_mass"])
    bare = {name: {"prior_sd": 0.0} for name in ("damping", "friction_loss", "armature")}
    found = unexplained(free, [whole(log)], np.zeros(1))
    assert found is not None
    kinds = set()
    maker = CauseMaker(free, found)
    for cause in (*joint_causes(maker), *drive_causes(maker)):
        c = sign * np.full(len(cause.force), 0.013)
        if entries := cause.repair(c, np.abs(c)) if cause.repair else {}:
            kinds.add(cause.kind)
            loaded = amhe.System.load("pendulum", {"parameters": {**bare, **entries}}, warn=False)
            assert entries.keys() <= {*loaded.space.names, *loaded.fixed}
    expected = {"load friction", "spring", "delay"} if sign < 0.0 else set()
    expected |= {"stribeck", "viscous", "dry", "armature"}  # the last three are parameters, fixed here
    assert kinds == expected | {"quadratic", "gain", "servo limit", "constant", "sine"}


def test_a_target_that_stands_still_has_no_later_force(pendulum: tuple[amhe.System, amhe.Log]) -> None:
    """As of a servo whose torque is off for the rest of a log: nothing divides by its change."""
    system, log = pendulum
    free = system.fixing(only=["load_mass"])
    found = unexplained(free, [whole(log)], np.zeros(1))
    assert found is not None
    maker, drive = CauseMaker(free, found), found.forces.by[:, 0, 0]
    alone = _replaced(maker, 0, drive, drive)
    np.testing.assert_allclose(_replaced(maker, 0, drive, drive, 0.0 * drive), [*alone, 0.0], rtol=1e-9)


@pytest.mark.medium
def test_late_commands_are_named_with_their_delay(pendulum: tuple[amhe.System, amhe.Log]) -> None:
    system, log = pendulum
    series = dict(log.series)
    early, steps = np.array(series["command.position"].values), round(0.02 / log.dt)
    early[:-steps] = early[steps:]
    series["command.position"] = replace(series["command.position"], values=early)

    rows = _explained(system, replace(log, series=series)).rows

    assert rows[0].kind == "delay"
    assert 0.01 < rows[0].repair["command_delay"]["nominal"] < 0.03  # to begin with: the slope of commands


XML = """<mujoco><option timestep="0.002"/><worldbody><body><joint name="hinge" axis="0 1 0" damping="0.05"/>
  <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.6"/><body name="load" pos="0 0 -0.3">
  <geom size="0.04" mass="0.3"/></body></body></worldbody>
  <actuator><position name="servo" joint="hinge" kp="6" kv="0.3"/></actuator></mujoco>"""
MOTOR = XML.replace('position name="servo"', 'motor name="motor"').replace(' kp="6" kv="0.3"', "")


def swung(stiffness: float) -> np.ndarray:
    """Times, positions and commands (n, 3) of the pendulum with a spring about 0.1 rad."""
    model = mujoco.MjModel.from_xml_string(XML)
    data, rng, rows = mujoco.MjData(model), np.random.default_rng(3), []
    hertz, phase = np.geomspace(0.2, 2.0, 6), rng.uniform(0.0, 6.0, 6)
    for k in range(6000):
        command = 0.4 * np.sin(2.0 * np.pi * hertz * (k // 5 * 0.01) + phase).sum()
        if k % 5 == 0:
            rows.append((k * 0.002, data.qpos[0] + rng.normal(0.0, 5e-4), command))
        data.ctrl[0], data.qfrc_applied[0] = command, -stiffness * (data.qpos[0] - 0.1)
        mujoco.mj_step(model, data)
    return np.array(rows)


@pytest.fixture(scope="module")
def sprung() -> tuple[amhe.System, amhe.Log]:
    """A pendulum whose spring of 0.8 N m/rad about 0.1 rad is not in its model."""
    system = amhe.System.from_model(
        mujoco.MjSpec.from_string(XML),
        parameters={"mass": {"nominal": 0.4, "prior_sd": 0.5, "scale": "log",
                             "targets": [{"body": "load", "set": "mass"}]}},
        signals={"joints": {"joints": ["hinge"], "noise": {"position": 5e-4}},
                 "command": {"actuators": ["servo"], "quantity": "position"}},
        settings={"clips": {"length": [0.4, 0.8], "count": 8}},
        warn=False,
    )  # fmt: skip
    time, position, command = swung(0.8).T
    arrays = {"joints": {"time": time, "position": position}, "command": {"time": time, "position": command}}
    return system, amhe.Log.from_arrays(arrays, system)


@pytest.mark.medium
def test_a_spring_is_named_with_its_stiffness_and_rest(sprung: tuple[amhe.System, amhe.Log]) -> None:
    found = _explained(*sprung)

    assert (found.rows[0].kind, found.rows[0].place) == ("spring", "hinge")
    assert found.rows[0].share > 0.9
    stiffness, rest = found.rows[0].repair.values()
    assert stiffness["nominal"] == pytest.approx(0.8, abs=0.05)
    assert rest["nominal"] == pytest.approx(0.1, abs=0.03)
    assert found.tested > 50


@pytest.mark.medium
def test_a_zero_of_a_servo_is_named_with_the_force_that_acts_alike(
    sprung: tuple[amhe.System, amhe.Log],
) -> None:
    system, _ = sprung
    time, position, command = swung(0.0).T
    arrays = {"joints": {"time": time, "position": position}, "command": {"time": time, "position": command}}
    arrays["command"]["position"] = command - 0.02

    row, *others = _explained(system, amhe.Log.from_arrays(arrays, system)).rows

    assert not others and (row.kind, row.place) == ("constant", "hinge")
    assert re.fullmatch(
        r"a constant force of 0.1[12]\d* ± \S+ N m, or a zero of its command that is off by -0.0[12]\S* "
        r"± \S+ rad",
        row.text,
    )
    entry = row.repair["servo_command_offset"]
    assert entry["targets"] == [{"signal": "command", "set": "bias", "actuator": "servo"}]
    assert entry["nominal"] == pytest.approx(-0.02, abs=0.002)


@pytest.mark.medium
@pytest.mark.parametrize(("stiffness", "factor", "kinds"), [(4.0, 1.0, set()), (0.0, 1e3, {"unit"})])
def test_a_command_that_acts_little_beside_a_spring_is_in_no_other_unit(
    stiffness: float, factor: float, kinds: set[str]
) -> None:
    """Divided by 57 or 1000 it would say as little as no command at all."""
    model = mujoco.MjModel.from_xml_string(MOTOR)
    data, rows = mujoco.MjData(model), []
    for k in range(6000):
        command = 0.3 * np.sin(np.array([1.3, 4.1, 9.7]) * (k // 5 * 0.01)).sum()
        if k % 5 == 0:
            rows.append((k * 0.002, data.qpos[0], command))
        data.ctrl[0], data.qfrc_applied[0] = command, -stiffness * data.qpos[0]
        mujoco.mj_step(model, data)
    time, position, command = np.array(rows).T
    signals = {"joints": {"joints": ["hinge"], "noise": {"position": 5e-4}},
               "command": {"actuators": ["motor"], "quantity": "value"}}  # fmt: skip
    mass = {"mass": {"nominal": 0.3, "targets": [{"body": "load", "set": "mass"}]}}
    spec = mujoco.MjSpec.from_string(MOTOR)
    system = amhe.System.from_model(spec, parameters=mass, signals=signals, warn=False)
    position = position + np.random.default_rng(0).normal(0.0, 5e-4, position.size)
    arrays = {"joints": {"time": time, "position": position}, "command": {"time": time, "value": command}}
    log = amhe.Log.from_arrays(arrays, system)

    found = mended(system, [whole(_times(log, command_value=factor))], np.random.default_rng(0))
    assert {one.kind for one in found} == kinds


@pytest.mark.medium
def test_identify_says_what_the_model_lacks(sprung: tuple[amhe.System, amhe.Log], tmp_path: Path) -> None:
    system, log = sprung

    result = amhe.identify(system, log, threads=1)

    assert result.found.missing is not None
    assert any("hinge: a spring of" in text for text in result.warnings)
    assert "a spring of" in result.table
    assert result.record()["missing"]["rows"][0]["kind"] == "spring"
    page = (result.save(tmp_path) / "report.html").read_text(encoding="utf-8")
    assert "What is missing" in page


LEVER = """<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody><body>
  <joint name="lever" axis="0 1 0" damping="0.05" armature="0.01"/><geom pos="0 0 -0.2" size="0.03"
  mass="0.35"/></body></worldbody><actuator>{}</actuator></mujoco>"""
SERVO = '<position name="servo" joint="lever" kp="20" kv="1" forcerange="-2.45 2.45"/>'


def _lever(servo: str, stiffness: float, **known: float) -> tuple[amhe.System, amhe.Log]:
    """A lever with a model of its servo, driven by voltage: so stiff [N m/rad] up to 2.45 N m, less 0.38."""
    model = mujoco.MjModel.from_xml_string(LEVER.format('<motor joint="lever"/>'))
    data, rng, rows, target, due = mujoco.MjData(model), np.random.default_rng(0), [], 0.0, 0.0
    for k in range(1500):
        if 0.01 * k >= due:
            target, due = rng.uniform(-1.4, 1.4), due + rng.uniform(0.5, 1.2)
        rows.append([0.01 * k, target, data.qpos[0] + rng.normal(0.0, 5e-4)])
        for _ in range(5):
            data.ctrl[0] = np.clip(stiffness * (target - data.qpos[0]), -2.45, 2.45) - 0.377 * data.qvel[0]
            mujoco.mj_step(model, data)
    time, targets, q = np.array(rows).T
    gain = {"kp": {"nominal": 40.0, "targets": [{"actuator": "servo", "set": "gain"}]}}
    system = amhe.System.from_model(
        mujoco.MjSpec.from_string(LEVER.format(servo)),
        parameters={"damping": {"nominal": 0.05, "targets": [{"joint": "lever", "set": "damping"}]}}
        | (gain if known else {}),
        signals={
            "joints": {"joints": ["lever"], "noise": {"position": 5e-4}},
            "command": {"actuators": ["servo"], "quantity": "position"},
        },
    )
    arrays = {
        "joints": {"time": time, "position": q[:, None]},
        "command": {"time": time, "position": targets[:, None]},
    }
    return system, replace(amhe.Log.from_arrays(arrays, system), known=known)


@pytest.mark.medium
def test_a_servo_that_acts_inside_a_limit_is_named_with_its_speed() -> None:
    """A drive by voltage: 60 N m/rad up to 2.45 N m, less 0.38 N m s/rad; its model is stiff to less."""
    system, log = _lever(SERVO, 60.0)

    row = _explained(system, log).rows[0]

    assert (row.kind, row.place) == ("servo limit", "servo")
    assert row.text.startswith("servo never exceeds 6.")
    assert {"servo_gain", "servo_force_limit", "damping"} <= row.repair.keys()


@pytest.mark.medium
def test_logs_that_know_their_gains_have_one_limit() -> None:
    """Twice as stiff in one log: 2.45 N m, and no other gain, which each log knows."""
    made = [_lever(SERVO.replace("20", "40"), kp, kp=kp) for kp in (20.0, 60.0)]
    logs = [log for _, log in made]
    system = made[0][0]
    system = replace(system, space=searched(system.space, logs))

    found = explain(
        system, [whole(log) for log in logs], np.zeros(len(system.space)), np.random.default_rng(0)
    )

    row = found.rows[0]
    assert (row.kind, row.place) == ("servo limit", "servo")
    assert "times its gains less 0.3" in row.text and "up to 2." in row.text
    assert "servo_force_limit" in row.repair and not {"kp", "servo_gain"} & row.repair.keys()


# -- torques along a measured motion -------------------------------------------------------------------------


@pytest.mark.medium
@pytest.mark.parametrize(
    ("change", "kind", "place"),
    [
        (lambda q, tau: tau, "", ""),
        (lambda q, tau: tau + [2.0, 0.0] * (q - 0.1), "spring", "a"),
        (lambda q, tau: tau * [1.0, -1.0], "torque scale", "b"),
        (lambda q, tau: np.concatenate((tau[:5], tau[:-5])), "torque delay", "torques"),
    ],
    ids=["as the model", "spring", "sign", "late"],
)
def test_what_torques_lack_is_named(
    change: Callable[[FloatArray, FloatArray], FloatArray], kind: str, place: str
) -> None:
    free = {name: PARAMETERS[name] for name in ("lower", "friction")}
    system = system_of(parameters=free | {"scale": PARAMETERS["scale"], "offset": PARAMETERS["offset"]})
    log = recorded(system, np.array(system.space.nominal))
    series = dict(log.series)
    tau = series["torque.effort"]
    changed = change(series["joints.position"].values, tau.values)
    series["torque.effort"] = replace(tau, values=changed)

    found = _explained(system, replace(log, series=series))

    first = [(row.kind, row.place) for row in found.rows[:1]]
    assert first == ([(kind, place)] if kind else [])
    if kind == "torque delay":  # five steps of 2 ms
        assert found.rows[0].text.startswith("its measured torques come ")
        assert float(found.rows[0].text.split()[4]) == pytest.approx(10.0, rel=0.1)
        assert found.rows[0].text.endswith("ms later than its motion")


def test_a_joint_that_stands_in_one_log_counts_in_the_others() -> None:
    system = system_of()
    both, z = recorded(system, np.array(system.space.nominal)), np.zeros(len(system.space))
    series, moved = dict(both.series), both["joints.position"]
    series["joints.position"] = replace(moved, values=moved.values * [1.0, 0.0])
    alone = replace(both, series=series, source="one alone")

    found = unexplained_efforts(system, [whole(both), whole(alone)], z)

    assert found is not None and found.weights is not None
    moves, stands = (found.weights[found.motion.log == i] for i in range(2))
    assert (stands[:, 1] == 0.0).all() and (stands[:, 0] > 0.0).mean() > 0.8
    assert np.median(moves[moves[:, 1] > 0.0, 1]) == pytest.approx(1.0)


def test_an_instant_between_two_gaps_has_no_change() -> None:
    system = system_of()
    z = np.zeros(len(system.space))
    found = unexplained_efforts(system, [whole(recorded(system, np.array(system.space.nominal)))], z)
    assert found is not None
    motion = replace(found.motion, stretches=(slice(0, 1), slice(1, len(found.motion.time))))
    change = CauseMaker(system, replace(found, motion=motion)).change(motion.time)
    np.testing.assert_allclose(change, [0.0, *np.ones(change.size - 1)], rtol=1e-6)


@pytest.mark.medium
def test_friction_that_sets_in_gradually_is_not_called_drag_above_a_speed() -> None:
    """Beyond the knee friction grows less: a force that holds back there would have the other sign."""
    free = {name: PARAMETERS[name] for name in ("lower", "friction")}
    system = system_of(parameters=free | {"scale": PARAMETERS["scale"], "offset": PARAMETERS["offset"]})
    log = recorded(system, np.array(system.space.nominal))
    series, moved = dict(log.series), np.gradient(path(DT * np.arange(log.steps), 0), DT, axis=0)
    tau, speed = series["torque.effort"], moved[: len(log["torque.effort"].values)]
    lacks = np.sign(speed) * np.maximum(1.0 - np.abs(speed) / 0.8, 0.0) * [2.0, 0.0]
    series["torque.effort"] = replace(tau, values=tau.values - lacks)

    found = _explained(system, replace(log, series=series))

    assert (found.rows[0].kind, found.rows[0].place) == ("stribeck", "a")
    assert "friction smaller by" in found.rows[0].text


@pytest.mark.parametrize(
    ("rows", "pieces", "instants"), [(60, 1, _FEW), (20, 1, 20), (9000, 9000 // 3 // _PIECE, 3000)]
)
def test_a_share_of_a_stretch_is_in_pieces_that_tell_something(rows: int, pieces: int, instants: int) -> None:
    """Of a log of many short stretches, a third of each would be too short to count."""
    found = list(_pieces(np.arange(rows), 1.0 / 3.0))
    assert (len(found), sum(piece.size for piece in found)) == (pieces, instants)
    assert found[0][0] == 0 and (pieces == 1 or found[-1][-1] == rows - 1)


def brick_explained(z: FloatArray, time: FloatArray) -> Missing:
    """What is missing of a brick of 1.2 kg at heights z (n,) [m]."""
    spec = mujoco.MjSpec.from_string(
        '<mujoco><worldbody><body name="brick" pos="0 0 20"><freejoint/><geom type="box" size=".1 .1 .1" '
        'mass="1.2"/></body></worldbody></mujoco>'
    )
    rng = np.random.default_rng(0)
    place = np.stack([0.3 * np.sin(5.0 * time), 0.3 * np.cos(5.0 * time), z], axis=1) + rng.normal(
        0.0, 1e-3, (len(z), 3)
    )
    system = amhe.System.from_model(
        spec,
        parameters={
            "mass": {"nominal": 1.2, "bounds": [0.5, 3.0], "targets": [{"body": "brick", "set": "mass"}]}
        },
        signals={"brick": {"body": "brick", "noise": {"position": 1e-3, "orientation": 1e-3}}},
    )
    turned = np.tile([1.0, 0.0, 0.0, 0.0], (len(z), 1)) + rng.normal(0.0, 1e-3, (len(z), 4))
    brick = {"time": time, "position": place, "orientation": turned}
    log = amhe.Log.from_arrays({"brick": brick}, system)
    return explain(system, [whole(log)], np.zeros(1), rng)


def test_a_hand_that_carries_a_free_body_is_named() -> None:
    """A hand throws a brick up eight times, and holds it for 1.6 s between."""
    time = np.arange(0.0, 16.8, 0.01)
    since = time % 2.1
    up = 0.05 * np.sin(2.0 * np.pi * (since - 0.5) / 1.6) ** 2
    found = brick_explained(20.0 + np.where(since < 0.5, 4.905 * since * (0.5 - since), up), time)
    assert found.rows[0].place == "brick z"
    assert "N against its weight of 11.8 N: something carries it" in found.rows[0].text


def test_a_body_that_falls_a_little_slowly_is_not_carried() -> None:
    """A clock or a gravity that is 5 % off is a small force against the weight, and no hand."""
    time = np.arange(0.0, 3.0, 0.01)
    found = brick_explained(20.0 + 0.95 * 4.905 * time * (3.0 - time), time)
    text = next(row.text for row in found.rows if row.place == "brick z")
    assert "constant force of 0.5" in text and "carries" not in text
