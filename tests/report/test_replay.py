"""Lines about a replay."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from amhe_cli.core.belief import belief_of
from amhe_cli.core.parameters import Parameter, ParameterSpace
from amhe_cli.report.replay import windows_line
from amhe_cli.report.replay_files import _together


@pytest.mark.parametrize(
    ("counts", "line"),
    [
        ((61, 2, 5, 0, 0), "61 windows used (2 jumps detected), 5 skipped (too little excitation)"),
        ((1, 1, 0, 0, 0), "1 window used (1 jump detected)"),
        ((0, 0, 0, 3, 0), "0 windows used, 3 skipped (a missing signal)"),
        (
            (9, 0, 4, 2, 1),
            "9 windows used, 7 skipped "
            "(4 with too little excitation, 2 with a missing signal, 1 with diverged rollouts)",
        ),
    ],
)
def test_used_and_skipped_windows_are_counted(counts: tuple[int, ...], line: str) -> None:
    record: dict[str, Any] = dict(zip(("updated", "jumps", "still", "gaps", "lost"), counts, strict=True))
    assert windows_line(record) == line


@pytest.mark.filterwarnings("error")
def test_a_bias_of_zero_is_no_fault() -> None:
    parameters = (
        Parameter("mass", "kg", 4.0, 0.4, 40.0, log=True, prior_sd=0.5),
        Parameter("friction", "-", 0.5, 0.05, 5.0, log=True, prior_sd=0.5),
        Parameter("bias", "m", 0.0, -1.0, 1.0, log=False, prior_sd=0.2),
    )
    system: Any = SimpleNamespace(name="", space=ParameterSpace(parameters), fixed={}, parts={}, sets={})
    z_covariance = 0.01 * np.array([[1.0, -0.98, 0.0], [-0.98, 1.0, 0.0], [0.0, 0.0, 1.0]])
    belief = belief_of(system, np.zeros(3), z_covariance)
    last = SimpleNamespace(belief=belief, theta=belief.estimate, sd=belief.sd)
    done: Any = SimpleNamespace(system=system, estimates=[last])
    assert [one.text for one in _together(done)] == ["mass * friction"]
