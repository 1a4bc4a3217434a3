"""Efforts along the measured motion: what an engine predicts, what is compared, what identification finds."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from amhe_cli.api.compare import compare
from amhe_cli.api.identify import identify
from amhe_cli.core.errors import ConfigError, SimulationError
from amhe_cli.core.log import Log
from amhe_cli.engine.inverse import forces_along, linear_in
from amhe_cli.engine.open import open_engine
from amhe_cli.estimation.offline.clips import whole
from amhe_cli.matching.cost import MatchingCost
from amhe_cli.matching.efforts import path_of
from amhe_cli.system.system import System

DT = 0.002
XML = """
<mujoco><option timestep="0.002"/><default><joint damping="0.2" frictionloss="0.3" armature="0.05"/></default>
<worldbody><body name="upper"><joint name="a" axis="0 1 0"/>
    <inertial pos="0 0 -0.2" mass="1.5" diaginertia="0.02 0.02 0.002"/>
    <body name="lower" pos="0 0 -0.4"><joint name="b" axis="0 1 0"/>
      <inertial pos="0.02 0 -0.15" mass="0.7" diaginertia="0.008 0.008 0.001"/></body></body>
</worldbody><actuator><position name="pa" joint="a" kp="300"/><motor name="mb" joint="b"/></actuator></mujoco>
"""
JOINTS = ["a", "b"]
PARAMETERS = {
    "lower": {"targets": [{"set": "mass", "body": "lower"}], "prior_sd": 0.3},
    "link": {"targets": [{"set": "pseudo_inertia", "body": "upper"}], "prior_sd": 0.3},
    "friction": {"targets": [{"set": "friction_loss", "joint": "a"}], "prior_sd": 0.5},
    "damping": {"targets": [{"set": "damping", "joint": "b"}], "prior_sd": 0.5},
    "offset": {
        "targets": [{"set": "bias", "signal": "torque", "quantity": "effort", "joint": "b"}],
        "nominal": 0.0, "bounds": [-1.0, 1.0], "prior_sd": 0.3,
    },
    "scale": {
        "targets": [{"set": "scale", "signal": "torque", "quantity": "effort", "joint": "a"}],
        "nominal": 1.0, "bounds": [0.8, 1.2], "prior_sd": 0.01, "scale": "linear",
    },
}  # fmt: skip
NO_FRICTION = {"targets": [{"set": "friction_loss", "joint": "a"}], "nominal": 1e-3, "prior_sd": 0.0}
SIGNALS = {
    "joints": {"joints": JOINTS, "noise": {"position": 1e-4}},
    "torque": {"joint_force": JOINTS, "noise": {"effort": 0.1}},
}
EXACT = {"identify": {"assumed": 0}}


def system_of(**changes):
    """The arm, its efforts to be matched."""
    given = {"parameters": PARAMETERS, "signals": SIGNALS, "settings": EXACT, "match": "effort"}
    return System.from_model(mujoco.MjSpec.from_string(XML), **(given | changes))


def path(t, derivative=0, rng=None):
    """Positions, or their derivatives, of two joints on sines of 0.2 to 1.3 Hz."""
    rng = rng or np.random.default_rng(8)
    w = 2 * np.pi * np.array([0.2, 0.5, 1.3])[:, None, None]
    phase, size = rng.uniform(0, 6, (3, 1, 2)), rng.uniform(0.2, 0.5, (3, 1, 2))
    return (size * w**derivative * np.sin(w * t[:, None] + phase + derivative * np.pi / 2)).sum(axis=0)


def recorded(system, theta, noise=1.0, seconds=12.0, seed=0):
    """A log of the arm at theta: torques are those that its motion needs."""
    t, rng = np.arange(0.0, seconds, DT), np.random.default_rng(seed)
    q, v, a = (path(t, k) for k in range(3))
    model = system.edits.apply(system.model, theta)
    tau = forces_along(model, q, v, a).needed + model.dof_frictionloss * np.sign(v)
    values = dict(zip(system.space.names, theta, strict=True))
    tau = np.array([values["scale"], 1.0]) * tau + np.array([0.0, values["offset"]])
    arrays = {
        "joints": {"time": t, "position": q + 1e-4 * noise * rng.standard_normal(q.shape)},
        "torque": {"time": t, "effort": tau + 0.1 * noise * rng.standard_normal(q.shape)},
    }
    return Log.from_arrays(arrays, system)


@pytest.fixture(scope="module")
def system():
    return system_of()


def truth(system, seed=0):
    """Parameters that are one prior sd or so off the nominal ones."""
    z = np.random.default_rng([seed, 7]).uniform(-1.2, 1.2, len(system.space))
    return system.space.theta_of(system.space.clip(z))


def test_the_table_of_an_engine_is_what_mujoco_computes(system):
    log, theta = recorded(system, truth(system)), truth(system, 1)
    cost = MatchingCost(system, [whole(log)], open_engine(system), system.settings.cost)
    found = cost.predict(system.space.z_of(theta)[None])
    model, along = system.edits.apply(system.model, theta), cost.clips.starts.along
    assert along is not None
    forces = forces_along(model, *along.flat).needed + model.dof_frictionloss * along.dry[0]
    values = dict(zip(system.space.names, theta, strict=True))
    assert found.values[0][0, 0, :, 0] == pytest.approx(values["scale"] * forces[:, 0], abs=1e-9)
    assert found.values[1][0, 0, :, 0] == pytest.approx(forces[:, 1] + values["offset"], abs=1e-9)
    with pytest.raises(SimulationError, match="nothing is rolled out"):
        cost.engine.rollout(theta[None], along.qpos[0], along.qvel[0], np.zeros((1, 1, 0)), np.ones(1, int))


def test_residuals_at_the_truth_are_the_noise(system):
    theta = truth(system)
    cost = MatchingCost(system, [whole(recorded(system, theta))], open_engine(system), system.settings.cost)
    residuals = cost.residuals(system.space.z_of(theta)[None])
    for observed, values in zip(cost.clips.observed, residuals.values, strict=True):
        white = values[0, 0, observed.mask[0], 0]
        assert white.std() == pytest.approx(1.0, abs=0.2)
        assert abs(np.corrcoef(white[1:], white[:-1])[0, 1]) < 0.3
        # little is compared where the joint turns over: its dry friction of 0.3 N m is not known there
        slow = np.abs(path((observed.rows[0] + 1) * DT, 1)[:, observed.channel.part]) < 0.01
        assert slow.any() and (np.ravel(observed.noise)[slow] > 0.1).all()


@pytest.mark.medium
def test_the_truth_is_found_within_its_intervals(system):
    outside = []
    for seed in range(4):
        theta = truth(system, seed)
        found = identify(system, recorded(system, theta, seed=seed), threads=1)
        for (name, p), value in zip(found.parameters.items(), theta, strict=True):
            if not p.interval[0] <= value <= p.interval[1]:
                outside.append(name)
        lower = found.parameters["lower"]
        assert lower.estimate == pytest.approx(theta[0], rel=0.1)
        assert set(found.found.noise_scale) == {"torque.effort of a", "torque.effort of b"}
        assert all(0.8 < scale < 1.2 for scale in found.found.noise_scale.values())
    assert len(outside) <= 0.25 * 4 * len(system.space)


@pytest.mark.parametrize(("wide", "rests"), [(0.0, 0), (2e-3, 0), (2e-3, 3)])
def test_efforts_of_slow_joints_count_little_however_far_their_motion_reaches(system, wide, rests):
    """Dry friction sets in gradually there, of every joint in another way; standing still is not slow."""
    log = recorded(system, truth(system))
    series, moved = dict(log.series), log["joints.position"]
    ripple = wide * np.sin(2 * np.pi * 9.0 * DT * np.arange(log.steps + 1))[:, None]
    series["joints.position"] = replace(moved, values=moved.values + ripple[: len(moved.values)])
    alone = replace(log, series=series)
    for key, own in series.items():  # then it stands for so many times as long
        ends = [np.repeat(each[-1:], rests * len(each), axis=0) for each in (own.values, own.valid)]
        values, valid = (np.concatenate(pair) for pair in zip((own.values, own.valid), ends, strict=True))
        series[key] = replace(own, values=values, valid=valid, sampled=np.ones(len(valid), dtype=bool))
    found, usual = (
        path_of(system, replace(log, series=series)),
        path_of(system, alone).motion.qvel.std(axis=0),
    )
    assert (found.motion.band.max() > 9.0) == bool(wide)
    inside = found.rows < log.steps - 500
    slow = np.abs(found.motion.qvel[found.at][inside]) < 0.05 * usual
    # what is not known of a friction of 0.3 N m, beside some 0.002 N m of noise
    assert slow.any() and (found.variance[inside][slow] > 0.1**2).all()
    assert (np.median(found.variance[inside], axis=0) < 0.02**2).all() and found.known[inside].mean() > 0.8


def test_what_is_known_of_slow_joints_follows_the_prior_of_their_friction(system):
    """Systems of one model have paths of their own where their priors differ."""
    wider = PARAMETERS | {"friction": PARAMETERS["friction"] | {"prior_sd": 1.0}}
    log = recorded(system, truth(system))
    more = path_of(system_of(parameters=wider), log).variance / path_of(system, log).variance
    # of 0.3 N m, one sd is 0.15 or 0.3 N m: 0.45 or 0.6 N m
    assert more[:, 0].max() == pytest.approx((0.6 / 0.45) ** 2, rel=0.01)
    assert more[:, 1] == pytest.approx(1.0)


def test_models_are_compared_by_their_efforts(system):
    theta = truth(system)
    log, smooth = recorded(system, theta), system_of(parameters={**PARAMETERS, "friction": NO_FRICTION})
    found = compare([system, smooth], [[log], [log]], threads=1)
    assert found.best == 0 and "predicts better" in found.verdicts[0]
    assert {name for name, _ in found.horizons[-1].errors} == {"torque.effort of a", "torque.effort of b"}


def test_a_motor_s_command_counts_as_its_torque_and_no_effort_is_refused():
    signals = {
        "joints": {"joints": JOINTS, "noise": {"position": 1e-4}},
        "torque": {"actuators": ["mb"]},
        "command": {"actuators": ["pa"]},
    }
    only = {name: PARAMETERS[name] for name in ("lower", "friction")}
    system = system_of(signals=signals, parameters=only)
    (effort,) = [c for c in system.channels if c.source == "effort"]
    assert (effort.key, effort.columns, system.inputs) == ("torque.effort", (1,), ())
    with pytest.raises(ConfigError, match="no signal measures an effort"):
        system_of(signals={"joints": SIGNALS["joints"], "command": {"actuators": ["pa"]}}, parameters=only)


def test_efforts_of_joint_states_are_compared_whatever_commands_them():
    signals = {
        "joints": {"joints": JOINTS, "noise": {"position": 1e-4, "effort": 0.1}},
        "command": {"actuators": ["pa"]},
    }
    only = {name: PARAMETERS[name] for name in ("lower", "friction")}
    system = system_of(signals=signals, parameters=only)
    assert [c.columns for c in system.channels if c.compared] == [(0, 1)]
    assert system.inputs == ()


LOAD = {
    "load": {"targets": [{"set": "load_friction_motor", "joint": "a"}], "nominal": 0.0, "bounds": [-1.0, 1.0],
             "scale": "linear", "prior_sd": 0.2},
}  # fmt: skip


def test_friction_of_gears_grows_with_the_effort():
    """Of a motor that gives tau, k tau is lost in its gear, beside the dry friction."""
    system, plain, k = system_of(parameters=PARAMETERS | LOAD), system_of(), 0.2
    log = recorded(plain, plain.space.nominal, noise=0.0)
    cost = MatchingCost(system, [whole(log)], open_engine(system), system.settings.cost)
    thetas = np.array([[*plain.space.nominal, load] for load in (0.0, k)])
    none, grown = cost.predict(system.space.z_of(thetas)).values[0][:, 0, :, 0]
    way = cost.clips.starts.along.dry[0, cost._wanted[0].rows[0], 0]
    np.testing.assert_allclose(grown - none, way * k * np.abs(grown), atol=0.01 * np.abs(none).max())
    assert np.abs(grown - none).max() > 0.5


def test_what_grows_with_load_is_found_in_efforts():
    system, plain, k = system_of(parameters=PARAMETERS | LOAD), system_of(), 0.15
    log = recorded(plain, plain.space.nominal)
    (key,) = (key for key in log.series if key.endswith("effort"))
    values = np.array(log.series[key].values)
    speed = path(DT * np.arange(len(values)), 1)[:, 0]
    values[:, 0] /= 1.0 - k * np.sign(speed * values[:, 0])  # tau = needed + k |tau| sign(dq)
    series = {**log.series, key: replace(log.series[key], values=values)}
    found = identify(system, [replace(log, series=series)], seed=0).parameters["load"]
    assert abs(found.estimate - k) < 3.0 * found.sd < 0.06


@pytest.mark.medium
def test_both_count_each_look_at_a_log_half():
    only = {name: PARAMETERS[name] for name in ("lower", "damping", "offset")}
    t, rng, found = np.arange(0.0, 8.0, DT), np.random.default_rng(4), {}
    effort = system_of(parameters=only)
    theta = truth(effort, 5)
    model, values = effort.edits.apply(effort.model, theta), dict(zip(only, theta, strict=True))
    model.actuator_gainprm, model.actuator_biasprm = 0.0, 0.0
    data, wanted, speed, moved, given = mujoco.MjData(model), path(t), path(t, 1), [], []
    data.qpos, data.qvel = wanted[0], speed[0]
    for q, v in zip(wanted, speed, strict=True):
        moved.append(np.array(data.qpos))
        data.qfrc_applied = 200.0 * (q - data.qpos) + 8.0 * (v - data.qvel)
        given.append(np.array(data.qfrc_applied))
        mujoco.mj_step(model, data)
    noise = 1e-3 * rng.standard_normal((2, *wanted.shape))
    arrays = {
        "joints": {"time": t, "position": moved + noise[0]},
        "torque": {"time": t, "effort": given + np.array([0.0, values["offset"]]) + noise[1]},
    }
    noises = {"joints": {"position": 1e-3}, "torque": {"effort": 1e-3}}
    signals = {name: {**SIGNALS[name], "noise": noises[name]} for name in SIGNALS}
    for match in ("effort", "motion", "both"):
        system = system_of(parameters=only, signals=signals, match=match)
        found[match] = identify(system, Log.from_arrays(arrays, system), threads=1).parameters
    for name, value in values.items():
        sd = {match: rows[name].sd for match, rows in found.items()}
        assert abs(found["both"][name].estimate - value) < 3.0 * sd["both"] + 1e-3
        assert 0.9 * min(sd.values()) < sd["both"] < 1.6 * min(sd["effort"], sd["motion"])
        assert found["both"][name].prior == pytest.approx(found["effort"][name].prior)
        assert found["both"][name].verdict == found["effort"][name].verdict


def test_moments_that_are_free_one_by_one_stay_those_of_a_body():
    """However far apart the values are: no effort is predicted for what cannot be."""
    moments = {
        f"i{axis}": {"targets": [{"set": "inertia", "body": "upper", "axis": axis}], "prior_sd": 0.3}
        for axis in "xyz"
    }
    system = system_of(parameters=moments)
    theta = np.array([[0.2, 0.002, 0.0002], [0.002, 0.2, 0.02], [0.02, 0.021, 0.002]])
    written = system.edits.written(theta)["body_inertia"][:, 1]
    assert (2.0 * written.max(axis=1) <= (1.0 + 1e-9) * written.sum(axis=1)).all()
    assert written[2] == pytest.approx(theta[2])


def test_efforts_are_linear_in_an_inertia_as_a_whole_and_not_in_a_centre_of_mass_alone():
    centre = {"set": "center_of_mass", "body": "lower", "axis": "x"}
    alone = {"x": {"targets": [centre], "nominal": 0.02, "bounds": [-0.2, 0.2], "prior_sd": 0.05}}
    assert linear_in(system_of(parameters={name: PARAMETERS[name] for name in ("lower", "link")}).edits)
    assert not linear_in(system_of(parameters=alone).edits)
