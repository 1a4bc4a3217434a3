"""Of long logs some clips stand for all, and what is left out narrows no interval."""

from __future__ import annotations

import numpy as np
import pytest

from amhe_cli.core.log import Log
from amhe_cli.engine.open import open_engine
from amhe_cli.estimation.offline import search
from amhe_cli.estimation.offline.clips import ClipPool, whole
from amhe_cli.estimation.offline.posterior import final_fit
from amhe_cli.estimation.offline.problem import Problem
from amhe_cli.system.system import System
from tests.estimation.offline.conftest import CHEAP, TRUTH


def problem(log: Log, count: int) -> Problem:
    system = System.load("pendulum", CHEAP | {"clips": {"count": count, "length": [0.4, 0.8]}})
    return Problem(system, ClipPool(system, [whole(log)], system.settings.clips), open_engine(system), 0)


def test_clips_that_are_left_out_narrow_no_interval(swing) -> None:
    log = swing(12.0)
    thinned, every = problem(log, 1), problem(log, 5)
    assert (len(thinned.clips), thinned.thinned) == (6, 14)
    assert (len(every.clips), every.thinned) == (20, 0)
    sd = [
        final_fit(one, search.restart(one, one.system.space.z_of(TRUTH))).posterior.sd
        for one in (thinned, every)
    ]
    ratio = np.exp(np.log(sd[0] / sd[1]).mean())
    assert ratio == pytest.approx(np.sqrt(20.0 / 6.0), rel=0.3)  # 1 before: as if all had been fitted
