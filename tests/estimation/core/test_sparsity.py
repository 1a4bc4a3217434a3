"""Unknowns that move different measurements share rollouts, and nothing else changes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
import pytest

import amhe_cli as amhe
from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.settings import AssumedSettings
from amhe_cli.engine.open import open_engine
from amhe_cli.estimation.core.linearise import (
    FirstStates,
    alike,
    bounded,
    colours,
    linearise,
    patterns,
    within,
)
from amhe_cli.estimation.offline import search
from amhe_cli.estimation.offline.clips import ClipPool, whole
from amhe_cli.estimation.offline.problem import Problem
from amhe_cli.matching.cost import MatchingCost

ARMS = ("left", "right")
TRUTH = {"left_damping": 0.08, "left_armature": 0.012, "right_damping": 0.15, "right_armature": 0.02}
EXACT = dict.fromkeys(AssumedSettings.model_fields, 0.0)
CHEAP = {"clips": {"length": [0.5, 1.0]}, "identify": {"assumed": EXACT | {"time_step": 1.0}}}


def spec(apart: bool) -> mujoco.MjSpec:
    """Two arms of one joint: side by side, or the right one on the left one's end."""
    body = """<body name="{0}" pos="0 0 {1}"><joint name="{0}" axis="0 1 0" damping="0.1" armature="0.01"/>
    <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.4" contype="0" conaffinity="0"/>
    {2}</body>"""
    right = body.format("right", 0.0 if apart else -0.3, "")
    left = body.format("left", 0.0, "" if apart else right)
    servos = "".join(f'<position name="{arm}" joint="{arm}" kp="8" kv="0.2"/>' for arm in ARMS)
    return mujoco.MjSpec.from_string(
        f'<mujoco><option timestep="0.005" integrator="implicitfast"/><worldbody>{left}'
        f"{right if apart else ''}</worldbody><actuator>{servos}</actuator></mujoco>"
    )


def problem(apart: bool) -> Problem:
    """Damping and armature of both joints, and the delay of all commands, from 6 s of swinging."""
    parameters = {
        f"{arm}_{word}": {"targets": [{"joint": arm, "set": word}]}
        for arm in ARMS
        for word in ("damping", "armature")
    } | {"delay": {"nominal": 0.0125, "bounds": [0, 0.04], "scale": "linear", "prior_sd": 0.005,
                   "targets": [{"set": "command_delay"}]}}  # fmt: skip
    signals = {
        "joints": {"joints": list(ARMS), "noise": {"position": 0.001}},
        "command": {"actuators": list(ARMS), "quantity": "position"},
    }
    system = amhe.System.from_model(spec(apart), parameters=parameters, signals=signals, settings=CHEAP)
    model = system.edits.apply(system.model, np.array([*TRUTH.values(), 0.0125]))
    data, time = mujoco.MjData(model), np.arange(1201) * 0.005
    command = 0.4 * np.sin(np.outer(2.0 * np.pi * (0.2 + 0.3 * time) * time, [1.0, 1.13]))
    late, position = np.interp(time - 0.0125, time, np.arange(1201)), np.empty((1201, 2))
    for k, row in enumerate(late):
        position[k] = data.qpos
        data.ctrl[:] = [np.interp(row, np.arange(1201), u) for u in command.T]
        mujoco.mj_step(model, data)
    position += 0.001 * np.random.default_rng(0).standard_normal(position.shape)
    log = amhe.Log.from_arrays(
        {"joints": {"time": time, "position": position}, "command": {"time": time, "position": command}},
        system,
    )
    return Problem(system, ClipPool(system, [whole(log)], system.settings.clips), open_engine(system), 0)


@pytest.fixture(scope="module")
def apart() -> Problem:
    return problem(apart=True)


def test_unknowns_that_move_no_common_measurement_have_one_colour() -> None:
    moves = np.array([[1, 1, 1], [1, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, 0]], dtype=bool)
    found = colours(moves)
    assert found.max() == 2, "as many as move one measurement"
    clash = moves.astype(int) @ moves.T > 0
    assert (found[:, None] != found)[clash & ~np.eye(6, dtype=bool)].all()
    covered = np.zeros(moves.shape, dtype=bool)
    for rows, columns in patterns(moves):
        covered[rows[:, None], columns] = True
    np.testing.assert_array_equal(covered, moves)


def test_arms_side_by_side_share_rollouts_and_arms_in_a_row_do_not(apart: Problem) -> None:
    assert apart.sparsity is not None and problem(apart=False).sparsity is None
    assert apart.sparsity.unknowns(first=True) == 5, "of nine: a damping, an armature, a delay, a first state"
    assert [list(group) for group in apart.alike or []] == [[2, 3], [0, 1], [4]]


def test_other_priors_on_the_same_clips_are_looked_at_for_what_is_new(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    before = problem(apart=True)
    assert before.active.all() and before.sparsity is not None
    space = before.system.space
    wider = replace(space.parameters[0], prior_sd=3.0 * space.prior_sd[0])
    system = replace(before.system, space=replace(space, parameters=(wider, *space.parameters[1:])))
    pool = ClipPool(system, before.pool.parts, system.settings.clips)
    anew = replace(before, system=system, pool=pool)
    known = replace(anew, like=before)
    tried, residuals = list[int](), MatchingCost.residuals

    def counted(cost: MatchingCost, z: FloatArray, first: FloatArray | None = None) -> Any:
        tried.append(len(z))
        return residuals(cost, z, first)

    monkeypatch.setattr(MatchingCost, "residuals", counted)
    assert known.active.all()
    assert tried == [2, 2, 2], "a step of what is new in some clips and the others, and its gaps elsewhere"
    for key, columns in anew._moved[0].items():
        np.testing.assert_array_equal(known._moved[0][key], columns)
    elsewhere = replace(known, only=tuple(known.usable[:1]))
    assert elsewhere._like is None, "other clips may show other things"


@pytest.mark.parametrize("shared", [True, False])
def test_slopes_of_many_clips_take_half_the_memory_where_nothing_touches(
    shared: bool, apart: Problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    cost, z, sparsity = apart.cost(apart.clips), np.full(5, 0.2), apart.sparsity if shared else None
    first = FirstStates.recorded(len(apart.clips), cost.nx)

    def slopes() -> np.ndarray:
        return linearise(
            cost, z, first, 1e-3 * np.eye(5), 0, np.random.default_rng(0), sparsity=sparsity
        ).gain

    whole = slopes()
    monkeypatch.setattr("amhe_cli.estimation.core.linearise.TURN_BYTES", 1000)
    in_turns = slopes()
    assert in_turns.nbytes == (0.5 if shared else 1.0) * whole.nbytes
    np.testing.assert_allclose(in_turns, whole, rtol=1e-6 if shared else 0.0)


def test_what_touches_may_move_everything(apart: Problem, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Problem, "touches", True)
    assert apart.part(np.arange(3)).sparsity is apart.sparsity, "a part knows what the whole knows"
    assert Problem(apart.system, apart.pool, apart.engine, 0).sparsity is None


@pytest.mark.parametrize("straight", [False, True])
def test_slopes_are_the_same_with_fewer_rollouts(apart: Problem, straight: bool) -> None:
    cost = apart.cost(apart.clips)
    z, first = np.full(5, 0.2), FirstStates.recorded(len(apart.clips), cost.nx)

    def slopes(sparsity, straight):
        rng = np.random.default_rng(0)
        return linearise(cost, z, first, 1e-3 * np.eye(5), 0, rng, sparsity=sparsity, straight=straight)

    dense, shared = slopes(None, False), slopes(apart.sparsity, straight)
    assert shared.rollouts == (6 if straight else 11) * len(apart.clips)
    assert dense.rollouts == 19 * len(apart.clips)
    size = np.sqrt((dense.gain**2).mean(axis=(0, 2)))
    error = np.sqrt(((shared.gain - dense.gain) ** 2).mean(axis=(0, 2)))
    assert (error < 2e-3 * size).all(), error / size
    np.testing.assert_allclose(shared.bend, 0.0 if straight else dense.bend, atol=1e-5)


def test_recorded_first_states_have_no_groups(apart: Problem) -> None:
    identify = apart.settings.identify.model_copy(update={"first_state": "never"})
    settings = apart.settings.model_copy(update={"identify": identify})
    part = replace(apart.part(np.arange(2)), system=replace(apart.system, settings=settings))
    state = search.restart(part, np.zeros(len(apart.system.space)))
    assert np.isfinite(search.advance(part, state).z).all()


def test_samples_of_a_group_stay_in_the_valley_that_it_shares_with_others() -> None:
    covariance = np.array([[1.0, 0.0, 0.999], [0.0, 0.01, 0.0], [0.999, 0.0, 1.0]])
    groups = [np.array([0, 1]), np.array([2])]
    part = within(covariance, groups)
    assert part[0, 0] == pytest.approx(1.0 - 0.999**2) and part[0, 2] == 0.0
    shape = bounded(part, np.full(3, 1e-4), np.ones(3, dtype=bool), groups)
    np.testing.assert_allclose(shape @ shape.T, part, atol=1e-12)
    np.testing.assert_array_equal(within(covariance, None), covariance)


@pytest.mark.medium
def test_two_arms_are_identified_from_a_few_rollouts(apart: Problem) -> None:
    result = amhe.identify(apart.system, [apart.pool.parts[0].log], seed=0)
    for name, true in (TRUTH | {"delay": 0.0125}).items():
        found = result.parameters[name]
        assert found.estimate == pytest.approx(true, rel=0.05), name
        assert found.verdict == ("conditional" if name == "delay" else "identified"), name
        assert abs(found.estimate - true) < 4.0 * found.sd, name
    delay = result.parameters["delay"].reasons[0].text
    assert delay.startswith("given the time step, 5 ms:"), (
        "first velocities of noisy positions do not show it"
    )
    assert result.found.iterations[-1].rollouts < 13 * len(apart.clips), "one candidate for each unknown"


@pytest.mark.parametrize("unknowns", [1, 8, 21])
def test_unknowns_that_move_the_same_come_together_in_the_order_of_their_flags(unknowns: int) -> None:
    rng = np.random.default_rng(unknowns)
    moves = (rng.random((5, unknowns)) < 0.4)[rng.integers(5, size=40)]
    kinds, group = np.unique(moves, axis=0, return_inverse=True)
    assert [rows.tolist() for rows in alike(moves)] == [
        np.flatnonzero(group == number).tolist() for number in range(len(kinds))
    ]


def test_a_mass_with_its_centre_on_the_axis_is_felt_where_the_centre_moves() -> None:
    """At the prior's mean the second joint does not feel it; a pattern of that alone would drop its slope."""
    arm = mujoco.MjSpec.from_string(
        """<mujoco><worldbody><body name='a'><joint name='a' axis='0 1 0'/>
        <inertial pos='0.1 0 0' mass='1' diaginertia='0.01 0.01 0.01'/>
        <body name='b' pos='0.2 0 0'><joint name='b' axis='0 1 0'/>
        <inertial pos='0 0.05 0' mass='1' diaginertia='0.01 0.01 0.01'/></body></body></worldbody></mujoco>"""
    )
    parameters = {
        "mass": {"prior_sd": 0.1, "targets": [{"set": "mass", "body": "b", "carry_inertia": False}]},
        "centre": {"nominal": 0.0, "bounds": [-0.5, 0.5], "scale": "linear", "prior_sd": 0.02,
                   "targets": [{"set": "center_of_mass", "body": "b", "axis": "x"}]},
    } | {f"damping_{joint}": {"nominal": 0.1, "targets": [{"set": "damping", "joint": joint}]}
         for joint in "ab"}  # fmt: skip
    signals = {
        "joints": {"joints": ["a", "b"], "noise": {"position": 3e-4}},
        "torque": {"joint_force": ["a", "b"], "noise": {"effort": 0.01}},
    }
    system = amhe.System.from_model(arm, parameters=parameters, signals=signals, match="effort")
    time = np.arange(0.0, 8.0, 0.01)
    position = np.sin(np.outer(time, [2.0, 3.0]))
    measured = {"joints": {"time": time, "position": position}, "torque": {"time": time, "effort": position}}
    log = amhe.Log.from_arrays(measured, system)
    pool = ClipPool(system, [whole(log)], system.settings.clips)
    sparsity = Problem(system, pool, open_engine(system), 0).sparsity
    assert sparsity is not None
    moved = np.concatenate(list(sparsity.z.values()), axis=1)
    assert moved[0].all() and not moved[2:].all()
