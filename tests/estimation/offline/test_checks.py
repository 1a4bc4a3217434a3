"""How far details of contact that nobody measured may move an estimate."""

from __future__ import annotations

from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from amhe_cli.engine.open import open_engine
from amhe_cli.estimation.offline import search
from amhe_cli.estimation.offline.checks import allowed, shifts_of
from amhe_cli.estimation.offline.clips import ClipPool, whole
from amhe_cli.estimation.offline.posterior import final_fit
from amhe_cli.estimation.offline.problem import Problem
from amhe_cli.estimation.offline.verdicts import Shift
from amhe_cli.system.system import System
from tests.estimation.offline.conftest import CHEAP
from tests.estimation.offline.test_identification import fall


def test_a_change_is_allowed_until_the_misfit_has_risen_by_nine() -> None:
    assert [allowed(rise) for rise in (-5.0, 0.0, 9.0)] == [1.0, 1.0, 1.0]
    assert allowed(36.0) == pytest.approx(0.5), "the misfit rises with the square of the change"


def shifted(noise: float, executor: Executor | None = None) -> list[Shift]:
    """Shifts of a sliding cube's estimate at the truth, in a log with this noise [SI]."""
    system = System.load("cube_toss", {**CHEAP, "clips": {"count": 4, "length": [0.1, 0.2]}})
    channels = tuple(replace(channel, noise=noise) for channel in system.channels)
    system = replace(system, channels=channels)
    engine = open_engine(system, executor=executor)
    problem = Problem(
        system, ClipPool(system, [whole(fall(system, noise))], system.settings.clips), engine, 0
    )
    z = np.zeros(len(system.space))
    z[0] = system.space.z_of(np.array([0.3, *system.space.nominal[1:]]))[0]
    state = search.restart(problem, z)
    return shifts_of(problem, state, final_fit(problem, state))


def test_a_sharp_log_that_rules_soft_contacts_out_is_not_widened_by_them() -> None:
    sharp, blunt = shifted(1e-4), shifted(2e-2)
    assert all("as far as the log allows" in shift.text for shift in sharp)
    assert any("as far as the log allows" not in shift.text for shift in blunt)


def test_variants_are_rolled_out_by_the_workers_that_were_given() -> None:
    models: set[bytes] = set()

    class Noting(ThreadPoolExecutor):
        def submit(self, fn, /, *args, **kwargs):
            models.add(args[0])
            return super().submit(fn, *args, **kwargs)

    with Noting(1) as executor:
        spread = shifted(1e-4, executor)
    assert len(models) == 3, "the model itself, softer and harder"
    for one, other in zip(shifted(1e-4), spread, strict=True):
        np.testing.assert_array_equal(one.z, other.z)
