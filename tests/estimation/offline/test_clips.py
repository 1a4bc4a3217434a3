"""Clips: how logs are cut, and clips in which nothing moves."""

from __future__ import annotations

import re
import tracemalloc
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
import pytest

import amhe_cli as amhe
from amhe_cli.core.each_log import searched
from amhe_cli.core.log import Log
from amhe_cli.core.settings import ClipSettings
from amhe_cli.engine.open import open_engine
from amhe_cli.engine.rollout import Engine, Predicted, Rollouts
from amhe_cli.estimation.core import linearise
from amhe_cli.estimation.core.information import information
from amhe_cli.estimation.core.linearise import FirstStates
from amhe_cli.estimation.core.result import ClipCount
from amhe_cli.estimation.identification import IdentifyOptions, identify
from amhe_cli.estimation.offline import search
from amhe_cli.estimation.offline.clips import ClipPool, split_held_out, too_few, whole
from amhe_cli.estimation.offline.problem import Problem, by_leverage
from amhe_cli.estimation.uncertainty.fit import final_fit
from amhe_cli.system.parameters.contacts import needed_contacts
from amhe_cli.system.system import System
from tests.estimation.conftest import CHEAP, TRUTH
from tests.estimation.test_identification import fall

MODEL = """<mujoco><option timestep="0.005"/><worldbody><body><joint name="hinge" axis="0 1 0"/>
  <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="1"/></body></worldbody></mujoco>"""


@pytest.fixture
def model(tmp_path):
    path = tmp_path / "model.xml"
    path.write_text(MODEL)
    return path


def system(model, **noise: float) -> amhe.System:
    return amhe.System.from_model(
        model,
        parameters={"damping": {"targets": [{"joint": "hinge", "set": "damping"}], "nominal": 0.01}},
        signals={"joints": {"topic": "/j", "joints": ["hinge"], "noise": noise}},
    )


def refused(system: amhe.System, times: np.ndarray, position: np.ndarray) -> str:
    log = amhe.Log.from_arrays({"joints": {"time": times, "position": position[:, None]}}, system)
    with pytest.raises(amhe.AmheError) as raised:
        amhe.identify(system, log)
    return str(raised.value)


TIMES = np.arange(0.0, 3.0, 0.005)


def test_nothing_is_compared(model) -> None:
    assert "compares nothing with its logs" in refused(system(model), TIMES, np.sin(TIMES))


def test_milliseconds_are_taken_for_seconds(model) -> None:
    slow = 1000.0 * TIMES[:100]
    text = refused(system(model, position=0.001), slow, np.sin(slow))
    assert "joints.position has a sample every 4.95 s: check the unit of its times" in text


def test_the_log_has_gaps_everywhere(model) -> None:
    position = np.sin(TIMES)
    position[np.arange(position.size) % 100 > 2] = np.nan
    text = refused(system(model, position=0.001), TIMES, position)
    assert "joints.position has values in" in text
    assert "check its times, or loosen `logs.max_gap`" in text


def test_nothing_moves(model) -> None:
    text = refused(system(model, position=0.001), TIMES, np.zeros_like(TIMES))
    assert "record more than 3 s in which the system moves" in text


def test_a_noisy_log_does_not_make_another_one_motionless(model) -> None:
    own, noise = system(model, position=0.001), np.random.default_rng(0).normal(0.0, 0.1, TIMES.size)
    logs = [
        amhe.Log.from_arrays({"joints": {"time": TIMES, "position": position}}, own, name=name)
        for name, position in (("noisy", noise), ("moving", 0.2 * np.sin(TIMES)))
    ]
    pool = ClipPool(own, [whole(log) for log in logs], own.settings.clips)
    assert {clip.log.source for clip in pool.cut(1.0)} == {"moving"}


@pytest.mark.parametrize("count", [1, 5, 12])
@pytest.mark.parametrize("share", [0.1, 0.25])
def test_about_the_wanted_share_is_held_out(model, count: int, share: float) -> None:
    own = system(model, position=0.001)
    log = amhe.Log.from_arrays({"joints": {"time": TIMES, "position": np.sin(TIMES)}}, own)
    clips = ClipSettings(held_out=share, held_out_length=0.1)
    fitted, held = (sum(part.length for part in parts) for parts in split_held_out([log] * count, clips))
    assert held / (fitted + held) == pytest.approx(share, abs=0.06)


def test_clips_to_validate_on_are_few_where_the_held_out_part_has_no_place_for_more(model) -> None:
    own = system(model, position=0.001)
    log = amhe.Log.from_arrays({"joints": {"time": TIMES, "position": np.sin(TIMES)}}, own)
    for length, few in ((0.36, False), (0.38, True)):  # of 3 s
        assert too_few([log], ClipSettings(held_out_length=length, held_out_least=2)) is few
    assert not too_few([log], ClipSettings(held_out=0.0, held_out_least=2))


def test_random_clips_are_not_counted_among_those_that_a_log_lacks(model) -> None:
    own = system(model, position=0.001)
    position = np.where(TIMES < 1.6, 0.0, np.sin(3.0 * TIMES))
    log = amhe.Log.from_arrays({"joints": {"time": TIMES, "position": position}}, own)
    pool = ClipPool(own, [whole(log)], own.settings.clips)
    assert len(pool.draw(np.random.default_rng(0), 20)) == 20
    assert (pool.motionless, pool.across_gaps) == (0, 0)
    pool.cut(0.5)
    assert (pool.motionless, pool.across_gaps) == (3, 0)


def test_of_throws_with_pauses_between_them_each_is_a_clip(model) -> None:
    """Side by side from the log's beginning, none had been whole."""
    own, throws = system(model, position=0.001), TIMES[TIMES < 0.8]
    times = np.concatenate([throws + start for start in (0.0, 2.3, 4.1, 7.7)])
    log = amhe.Log.from_arrays({"joints": {"time": times, "position": np.sin(3.0 * times)}}, own)
    pool = ClipPool(own, [whole(log)], ClipSettings(length=(0.5, 1.5)))
    starts = [clip.start * log.dt for clip in pool.cut(1.0)]
    assert starts == pytest.approx([0.0, 2.3, 4.1, 7.7], abs=0.02) and pool.across_gaps == 0
    assert len(pool.draw(np.random.default_rng(0), 20)) == 20


def test_where_hardly_any_place_holds_a_clip_those_side_by_side_are_taken(model) -> None:
    own, times = system(model, position=0.001), np.arange(0.0, 230.0, 0.005)
    position = np.where((times < 23.0) | (times > 24.3), np.nan, np.sin(times))
    log = amhe.Log.from_arrays({"joints": {"time": times, "position": position}}, own)
    problem = Problem(own, ClipPool(own, [whole(log)], own.settings.clips), open_engine(own), 0)
    assert problem.pool.draw(np.random.default_rng(0), 4) == []
    assert tuple(problem.drawn(np.random.default_rng(0), 4)) == problem.clips
    assert len(problem.clips) == 1


def problem(count: int, *logs: Log) -> Problem:
    system = System.load("pendulum", CHEAP | {"clips": {"count": count, "length": [0.4, 0.8]}})
    pool = ClipPool(system, [whole(log) for log in logs], system.settings.clips)
    return Problem(system, pool, open_engine(system), 0)


@pytest.mark.medium
def test_clips_that_are_left_out_narrow_no_interval(swing) -> None:
    log = swing(12.0)
    thinned, every = problem(1, log), problem(5, log)
    assert (len(thinned.clips), thinned.thinned) == (6, 14)
    assert (len(every.clips), every.thinned) == (20, 0)
    sd = [
        final_fit(one, search.restart(one, one.system.space.z_of(TRUTH))).posterior.sd
        for one in (thinned, every)
    ]
    ratio = np.exp(np.log(sd[0] / sd[1]).mean())
    assert ratio == pytest.approx(np.sqrt(20.0 / 6.0), rel=0.3)  # 1 before: as if all had been fitted


def test_clips_alike_are_taken_evenly_and_one_that_alone_knows_something_always() -> None:
    alike = np.tile(np.diag([4.0, 0.0]), (100, 1, 1))
    np.testing.assert_array_equal(by_leverage(alike, 10), np.arange(5, 100, 10))
    alike[33] = np.diag([0.0, 9.0])
    assert 33 in by_leverage(alike, 4)


@pytest.mark.medium
def test_of_a_long_log_the_clips_that_move_much_are_fitted(swing) -> None:
    calm, lively = swing(40.0, size=0.02), swing(4.0, seed=1)
    one = problem(2, calm, lively)
    assert one.thinned > 50
    # evenly, 1 of 12 would be; 3 of the 6 that there are were looked at
    assert sum(clip.log is lively for clip in one.clips) == 3


@pytest.mark.medium
def test_held_out_clips_have_a_limit_too(swing, pendulum) -> None:
    system = System.load("pendulum", CHEAP | {"clips": {"count": 1, "length": [0.4, 0.8]}})
    found = identify(system, [swing(4.0)], [swing(12.0, seed=1)], IdentifyOptions())
    assert (found.clips.fitted, found.clips.held_out) == (6, 6)


@pytest.mark.medium
def test_clips_that_take_turns_give_the_same_slopes_in_less_memory(swing, monkeypatch) -> None:
    one = problem(4, swing(16.0))
    cost, z = one.cost(one.clips), np.full(len(one.system.space), 0.1)
    first = FirstStates.recorded(len(one.clips), cost.nx)

    def found() -> tuple:
        tracemalloc.start()
        slopes = one.linearised(cost, z, first, 0.1 * np.eye(len(z)), one.rng(1))
        known = information(slopes)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return slopes.gain, slopes.curves, slopes.residual, known.matrix, known.score, peak

    *together, peak = found()
    monkeypatch.setattr(linearise, "TURN_BYTES", peak // 50)
    *in_turns, less = found()
    for before, after in zip(together, in_turns, strict=True):
        np.testing.assert_array_equal(before, after)
    assert less < 0.6 * peak


def test_the_number_of_fitted_clips_is_told_of_how_many() -> None:
    assert ClipCount(144, 96, 0, 0, thinned=1030).fitted_of == "144 of 1174 clips"
    assert ClipCount(24, 8, 0, 0).fitted_of == "24 clips"


XML = """
<mujoco>
  <option timestep="0.005" cone="elliptic"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 1"/>
    <body name="pusher" mocap="true" pos="-0.5 0 0.1"><geom name="tip" type="sphere" size="0.05"/></body>
    <body name="block" pos="0 0 0.1">
      <freejoint/>
      <geom name="block" type="box" size="0.1 0.1 0.1" mass="1"/>
    </body>
  </worldbody>
  <contact>
    <pair name="slide" geom1="floor" geom2="block"/>
    <pair name="push" geom1="tip" geom2="block"/>
  </contact>
</mujoco>
"""


def idle_system() -> System:
    return System.from_model(
        mujoco.MjSpec.from_string(XML.replace('size="0.05"/>', 'size="0.05" contype="0" conaffinity="0"/>')),
        name="push",
        parameters={
            "mass": {"targets": [{"body": "block", "set": "mass"}]},
            "tip_friction": {"targets": [{"pair": "push", "set": "sliding_friction"}]},
        },
        signals={
            "block": {"body": "block", "noise": {"position": 0.001, "orientation": 0.01}},
            "pusher": {"mocap": "pusher"},
        },
        settings={"clips": {"count": 4, "length": [0.3, 0.4], "still": 0.0}},
        warn=False,
    )


def idle_problem(made: System, offset: float) -> Problem:
    """A pusher that moves to and fro, its pose measured with an offset; the block slides before it."""
    times = np.arange(0.0, 2.0, 0.01)
    upright = np.tile([1.0, 0.0, 0.0, 0.0], (len(times), 1))
    x, zero = 0.3 * times, 0.0 * times
    block = np.stack([x, zero, zero + 0.1], axis=1)
    tip = np.stack([x - 0.145 - offset, zero, zero + 0.1], axis=1)
    arrays = {
        "block": {"time": times, "position": block, "orientation": upright},
        "pusher": {"time": times, "position": tip, "orientation": upright},
    }
    log = Log.from_arrays(arrays, made)
    return Problem(made, ClipPool(made, [whole(log)], made.settings.clips), open_engine(made), 0)


def test_a_pusher_whose_frame_is_wrong_touches_nothing_and_the_reason_gives_the_gap() -> None:
    found = idle_problem(idle_system(), 0.4)
    assert found.idle.keys() == {"mass", "tip_friction"}
    for reason in found.idle.values():
        gap = re.match(r"nothing touches: geom '\w+' and geom '\w+' come no nearer than (\S+) m in", reason)
        assert gap is not None and 0.25 < float(gap[1]) < 0.4  # the block slows down, the pusher does not
        assert "frames" in reason


def test_where_they_touch_a_mass_before_a_kinematic_pusher_is_idle_for_another_reason() -> None:
    found = idle_problem(idle_system(), 0.0)
    assert found.idle.get("mass") == "no measurement in these logs depends on it"
    assert not any("nothing touches" in reason for reason in found.idle.values())


@pytest.mark.parametrize(
    ("target", "pairs"),
    [
        ({"body": "block", "set": "mass"}, {("block", "tip")}),
        ({"pair": "slide", "set": "sliding_friction"}, {("floor", "block")}),
    ],
)
def test_the_contacts_that_a_parameter_needs(target: dict, pairs: set) -> None:
    made = System.from_model(
        mujoco.MjSpec.from_string(XML),
        parameters={"one": {"targets": [target]}},
        signals={"block": {"body": "block", "noise": {"position": 0.001}}},
        warn=False,
    )
    ((_, cells),) = made.edits.by_parameter()
    found = {tuple(made.model.geom(g).name for g in pair) for pair in needed_contacts(made.model, cells)}
    assert found == pairs


def test_a_nominal_value_that_is_far_too_small_is_the_reason() -> None:
    # mujoco#3284: a search that starts at 1e-8 stays there
    tiny = {"nominal": 2e-8, "bounds": [1e-8, 10.0], "targets": [{"joint": "hinge", "set": "damping"}]}
    made = System.from_model(
        mujoco.MjSpec.from_string(
            '<mujoco><worldbody><body><joint name="hinge" axis="0 1 0"/><geom type="capsule" '
            'fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.4"/></body></worldbody></mujoco>'
        ),
        parameters={"damping": tiny},
        signals={"joints": {"joints": ["hinge"], "noise": {"position": 0.001}}},
        settings={"clips": {"length": [0.3, 0.4]}},
        warn=False,
    )
    times = np.arange(0.0, 2.0, 0.01)
    arrays = {"joints": {"time": times, "position": np.cos(6.0 * times)[:, None]}}
    log = Log.from_arrays(arrays, made)
    found = Problem(made, ClipPool(made, [whole(log)], made.settings.clips), open_engine(made), 0)
    assert "give a nominal value of the right size" in found.idle["damping"]


class Coarse:
    """An engine whose rounding contacts have amplified, as on a graphics card."""

    precision = float(np.finfo(np.float32).eps)

    def __init__(self, engine: Engine) -> None:
        self.engine, self.rng = engine, np.random.default_rng(0)

    def rollout(self, theta: Any, qpos: Any, qvel: Any, inputs: Any, lengths: Any) -> Rollouts:
        return self.engine.rollout(theta, qpos, qvel, inputs, lengths)

    def predict(self, theta: Any, starts: Any, errors: Any, wanted: Any) -> Predicted:
        done = self.engine.predict(theta, starts, errors, wanted)
        return Predicted(tuple(v + 0.01 * self.rng.normal(size=v.shape) for v in done.values), done.completed)

    def upon(self, model: Any, edits: Any = None) -> Engine:
        return Coarse(self.engine.upon(model, edits))


def test_rounding_behind_contacts_is_no_effect_of_a_parameter() -> None:
    """The motion of a tossed cube does not depend on its mass."""
    cube = System.load("cube_toss", {**CHEAP, "clips": {"count": 4, "length": [0.1, 0.2]}})
    pool = ClipPool(cube, [whole(fall(cube))], cube.settings.clips)
    active = Problem(cube, pool, Coarse(open_engine(cube)), 0).active
    assert dict(zip(cube.space.names, active, strict=True)) == {
        "friction": True, "inertia_scale": True, "contact_damping": True, "mass": False,
    }  # fmt: skip


@pytest.mark.medium
def test_of_many_logs_each_value_of_its_own_is_seen(pendulum: System, swing) -> None:
    """Clips that show what moves what are few, and some of each log with a value of its own."""
    logs = [swing(1.5, seed=i).with_(own={"friction_loss": f"servo {i}"}) for i in range(20)]
    idle_system = replace(pendulum, space=searched(pendulum.space, logs))
    pool = ClipPool(idle_system, [whole(log) for log in logs], idle_system.settings.clips)
    assert Problem(idle_system, pool, open_engine(idle_system), 0).active.all()
