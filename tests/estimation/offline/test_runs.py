"""Several runs: each alone, and the pair that disagrees is named and widens the interval."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import amhe_cli as amhe
from amhe_cli.estimation.offline import runs
from amhe_cli.estimation.offline.posterior import Disagreement, Posterior
from amhe_cli.estimation.offline.runs import runs_that_differ, spread_between
from amhe_cli.report.identification_page import _run_table
from tests import conftest

QUICK = {
    "clips": {"count": 6, "length": [0.4, 0.6]},
    "identify": {"iterations": 4, "profile_points": 0, "bootstrap": 10, "first_state": "never"},
}


def each(steps: np.ndarray) -> Any:
    """Runs with these steps (k, 3) in z, each known to an sd of 0.1."""
    return {
        i: Posterior(step, 101.0 * np.eye(3), 100.0 * np.eye(3), np.eye(3)) for i, step in enumerate(steps)
    }


def differing(monkeypatch: pytest.MonkeyPatch, steps: np.ndarray) -> dict[str, Any]:
    """What is named of these runs."""
    monkeypatch.setattr(runs, "acting", lambda *_: np.ones(3, dtype=bool))
    space = amhe.System.load("pendulum").space.without(["armature"])
    problem: Any = SimpleNamespace(system=SimpleNamespace(space=space, edits=SimpleNamespace(space=space)))
    logs = [SimpleNamespace(source=f"day{i + 1}/run.csv") for i in range(len(steps))]
    monkeypatch.setattr(runs, "names_of", lambda given: {i: logs[i].source for i in given})
    return runs_that_differ(problem, each(steps))


@pytest.mark.medium
def test_chance_names_no_pair(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    named = [bool(differing(monkeypatch, rng.normal(0.0, 0.1, (4, 3)))) for _ in range(100)]
    assert np.mean(named) < 0.1  # 1 % for each of three parameters


def test_the_farthest_pair_is_named_for_its_parameter_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    steps = np.zeros((4, 3))
    steps[:, 1] = (0.0, 0.1, 0.05, 1.0)
    found = differing(monkeypatch, steps)
    assert list(found) == ["day1/run.csv and day4/run.csv"]
    (difference,) = found.values()
    np.testing.assert_allclose(difference.value, [0.0, 1.0, 0.0])


#: A pair is named for the second of three parameters.
NAMED = {"one and other": Disagreement(np.array([0.0, 1.0, 0.0]), np.eye(3))}


@pytest.mark.parametrize("spread", (0.2, 1.0))
def test_the_spread_between_runs_is_recovered(spread: float) -> None:
    rng, found = np.random.default_rng(0), []
    for _ in range(300):
        steps = rng.normal(0.0, 0.1, (6, 3))
        steps[:, 1] += rng.normal(0.0, spread, 6)
        found.append(spread_between(each(steps), NAMED))
    mean = np.sqrt(np.mean(np.square(found), axis=0))
    assert mean[1] == pytest.approx(spread, rel=0.1)
    assert mean[0] == mean[2] == 0.0


def test_a_run_that_knows_nothing_has_no_share_in_the_spread() -> None:
    steps = np.zeros((4, 3))
    steps[:, 1] = (-0.5, 0.0, 0.5, 0.0)
    alone = each(steps)
    alone[3] = Posterior(steps[3], 1.01 * np.eye(3), 0.01 * np.eye(3), np.eye(3))
    np.testing.assert_allclose(spread_between(alone, NAMED), [0.0, np.sqrt(0.25 - 100.0 / 101.0**2), 0.0])


def test_two_runs_are_left_to_the_checks(monkeypatch: pytest.MonkeyPatch) -> None:
    assert differing(monkeypatch, np.array([[0.0, 0.0, 0.0], [5.0, 5.0, 5.0]])) == {}


@pytest.mark.medium
@pytest.mark.parametrize("dampings", [(0.033, 0.035, 0.041), (0.033, 0.041)])
def test_runs_are_told_apart_in_the_result(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, dampings: tuple[float, ...]
) -> None:
    system = amhe.System.load("pendulum", QUICK)
    logs, last = [], f"run{len(dampings)}.mcap"
    for i, damping in enumerate(dampings):
        monkeypatch.setitem(conftest.PENDULUM_TRUTH, "damping", damping)
        path = conftest.write_pendulum_log(tmp_path / f"run{i + 1}.mcap", 4.0, seed=i)
        logs.append(amhe.read_log(path, system))
    truth = {name: conftest.PENDULUM_TRUTH[name] for name in ("friction_loss", "armature", "load_mass")}
    result = amhe.identify(system, logs, fix=truth)
    damping = result.parameters["damping"]
    assert any(reason.startswith(f"run1.mcap and {last} disagree by +") for reason in damping.reasons)
    for run, value in zip(result.found.runs, dampings, strict=True):
        estimate, sd = run.values["damping"]
        assert abs(estimate - value) < 5.0 * sd
        assert len(dampings) == 2 or damping.lower < value < damping.upper
    table = _run_table(result.found)
    assert table.head[1:-2] == tuple(f"run{i + 1}.mcap" for i in range(len(dampings)))
    assert result.record()["runs"][0]["log"] == "run1.mcap"
