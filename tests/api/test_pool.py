"""`amhe pool`: beliefs that agree become one, others are refused by name."""

import json
from pathlib import Path

import numpy as np
import pytest

import amhe_cli as amhe
from amhe_cli.cli.main import run
from amhe_cli.core.belief import belief_of
from tests.estimation.conftest import TRUTH
from tests.estimation.uncertainty.test_assumed import pendulum, strong_servo, swing, unchanged

NAMES = ("load_mass", "damping", "friction_loss", "armature")


def saved(folder: Path, name: str, z: np.ndarray, log: str) -> str:
    path = folder / name / "belief.yaml"
    path.parent.mkdir()
    system = amhe.System.load("pendulum")
    belief_of(system, z, 0.01 * np.eye(4), {"logs": {f"{name}.mcap": log}}).save(path)
    return str(path)


def test_beliefs_that_agree_become_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(0)
    files = [saved(tmp_path, day, rng.normal(0.3, 0.1, 4), day) for day in ("mon", "tue", "wed")]
    out = tmp_path / "pooled.yaml"
    assert run(["pool", *files, "-o", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "the runs agree" in printed
    assert "mon" in printed
    system = amhe.System.load("pendulum")
    belief = amhe.Belief.load(out, system)
    sd = np.sqrt(np.diag(belief.covariance)) / system.space.prior_sd
    np.testing.assert_allclose(sd, (3 * 100.0 - 2.0) ** -0.5, rtol=1e-6)
    assert set(belief.provenance["logs"]) == {"mon.mcap", "tue.mcap", "wed.mcap"}  # type: ignore[arg-type]


@pytest.mark.medium
def test_what_rests_on_a_gain_is_known_no_better_from_two_runs() -> None:
    system = pendulum(50.0, gain=0.1, time_step=0.0)
    runs = [
        amhe.identify(system, [swing(system, unchanged, seconds)], seed=seed)
        for seed, seconds in ((0, 4.0), (1, 3.0))
    ]
    pooled = amhe.pool([run.belief for run in runs], system=system).belief
    sds = [belief.sd[0] / belief.estimate[0] for belief in (runs[0].belief, runs[1].belief, pooled)]
    assert sds[2] > 0.9 * min(sds[:2]), "it would be 0.7 times it if each log knew the gain anew"
    assert 0.9 < pooled.systematic[0, 0] / pooled.covariance[0, 0] <= 1.0


@pytest.mark.medium
def test_a_belief_that_rests_on_a_gain_as_prior_says_nothing_of_the_gain() -> None:
    """The gain is 12 % off, in both logs: the second knows no better what the first did not know."""
    system = pendulum(50.0, gain=0.1, time_step=0.0)
    first = amhe.identify(system, [swing(system, strong_servo, 3.0)])
    again = amhe.identify(system, [swing(system, strong_servo, 4.0)], prior=first.belief)
    sds = [one.belief.sd[0] / one.belief.estimate[0] for one in (first, again)]
    assert 0.95 * sds[0] < sds[1] < 1.15 * sds[0], "it would be 0.74 times it if the second knew the gain"
    assert again.parameters["load_mass"].lower < TRUTH[0] < again.parameters["load_mass"].upper


def test_a_contradiction_names_parameter_and_pair(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    other = np.array([0.0, 1.5, 0.0, 0.0])
    files = [saved(tmp_path, "mon", np.zeros(4), "a"), saved(tmp_path, "tue", other, "b")]
    assert run(["pool", *files, "-o", str(tmp_path / "pooled.yaml")]) == 1
    error = capsys.readouterr().err
    assert f"damping differs by 10.7 sd between {files[0]} and {files[1]}" in " ".join(error.split())
    assert not (tmp_path / "pooled.yaml").exists()


def test_a_log_counts_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = [saved(tmp_path, "mon", np.zeros(4), "a"), saved(tmp_path, "tue", np.zeros(4), "a")]
    assert run(["pool", *files]) == 2
    assert "both made of tue.mcap" in capsys.readouterr().err


def test_a_system_of_ones_own_is_asked_for_with_the_file_that_names_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = [saved(tmp_path, day, np.zeros(4), day) for day in ("mon", "tue")]
    for file in map(Path, files):
        file.write_text(file.read_text().replace("pendulum", "mine"))
    for command in (["pool", *files], ["export", files[0], "--to", "mjcf", "-o", str(tmp_path / "out")]):
        assert run(command) == 2
        assert f"{files[0]}: about the system 'mine'" in capsys.readouterr().err


def test_the_record(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = [saved(tmp_path, day, np.zeros(4), day) for day in ("mon", "tue")]
    assert run(["pool", *files, "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["chi_square"] == pytest.approx(0.0)
    assert [row["name"] for row in record["parameters"]] == list(NAMES)
    assert record["differences"][0]["between"] == files
