"""Of long logs some clips stand for all, and what is left out narrows no interval."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from amhe_cli.core.log import Log
from amhe_cli.engine.open import open_engine
from amhe_cli.estimation.core import linearise
from amhe_cli.estimation.core.information import information
from amhe_cli.estimation.core.linearise import FirstStates
from amhe_cli.estimation.core.result import ClipCount
from amhe_cli.estimation.identification import IdentifyOptions, identify
from amhe_cli.estimation.offline import search
from amhe_cli.estimation.offline.clips import ClipPool, whole
from amhe_cli.estimation.offline.problem import Problem, by_leverage
from amhe_cli.estimation.uncertainty.fit import final_fit
from amhe_cli.system.system import System
from tests.estimation.conftest import CHEAP, TRUTH


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
