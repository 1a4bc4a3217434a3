"""Which clips are fitted: some of many, and what is said where there are none."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

import amhe_cli as amhe
from amhe_cli.core.log import Log
from amhe_cli.engine.open import open_engine
from amhe_cli.estimation.core import linearise
from amhe_cli.estimation.core.information import information
from amhe_cli.estimation.core.linearise import FirstStates
from amhe_cli.estimation.core.result import ClipCount
from amhe_cli.estimation.identification import IdentifyOptions, identify
from amhe_cli.estimation.offline import search
from amhe_cli.estimation.offline.clips import ClipPool, split_held_out, whole
from amhe_cli.estimation.offline.problem import Problem, by_leverage
from amhe_cli.estimation.uncertainty.fit import final_fit
from amhe_cli.system.system import System
from tests.estimation.conftest import CHEAP, TRUTH

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
    fitted, held = (sum(part.length for part in parts) for parts in split_held_out([log] * count, share))
    assert held / (fitted + held) == pytest.approx(share, abs=0.06)


def test_random_clips_are_not_counted_among_those_that_a_log_lacks(model) -> None:
    own = system(model, position=0.001)
    position = np.where(TIMES < 1.6, 0.0, np.sin(3.0 * TIMES))
    log = amhe.Log.from_arrays({"joints": {"time": TIMES, "position": position}}, own)
    pool = ClipPool(own, [whole(log)], own.settings.clips)
    assert len(pool.draw(np.random.default_rng(0), 20)) == 20
    assert (pool.motionless, pool.across_gaps) == (0, 0)
    pool.cut(0.5)
    assert (pool.motionless, pool.across_gaps) == (3, 0)


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
