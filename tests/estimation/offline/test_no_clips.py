"""Logs that cannot be fitted: the error names the cause."""

from __future__ import annotations

import numpy as np
import pytest

import amhe_cli as amhe
from amhe_cli.engine.open import open_engine
from amhe_cli.estimation.offline.clips import ClipPool, split_held_out, whole
from amhe_cli.estimation.offline.problem import Problem

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
