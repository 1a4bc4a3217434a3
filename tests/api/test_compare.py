"""`amhe compare`: systems fitted to the same logs, and scored on the same clips."""

import json
from pathlib import Path

import pytest

import amhe_cli as amhe
from amhe_cli.cli.compare import _parted

QUICK = {
    "clips": {"count": 6},
    "identify": {"iterations": 3, "profile_points": 3, "first_state": "never"},
}


@pytest.mark.medium
def test_the_model_that_can_follow_the_logs_wins(tmp_path: Path, pendulum_log: Path) -> None:
    free = amhe.System.load("pendulum", QUICK)
    stiff = free.fixing({"damping": 0.4})
    logs = [[amhe.read_log(pendulum_log, one)] for one in (free, stiff)]
    found = amhe.compare([free, stiff], logs)
    assert found.names == ("pendulum-1", "pendulum-2")
    assert found.best == 0
    assert found.verdicts[0].startswith(
        "pendulum-1 predicts better than pendulum-2: its error is smaller by "
    )
    assert "pendulum-2" in found.table
    found.save(tmp_path / "out")
    record = json.loads((tmp_path / "out" / "result.json").read_text())
    assert record["best"] == "pendulum-1"
    assert record["horizons"][0]["against_best"]["pendulum-2"]["lower"] > 1.0
    page = (tmp_path / "out" / "report.html").read_text()
    assert "pendulum-1 predicts best." in page
    assert (tmp_path / "out" / "pendulum-2" / "identified.xml").is_file()


def test_a_shell_pattern_behind_logs(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "system.yaml").touch()
    (tmp_path / "run2.csv").touch()
    given = ["pendulum", str(tmp_path / "mine"), str(tmp_path / "run2.csv")]
    assert _parted(given) == (given[:2], (tmp_path / "run2.csv",))


def test_wrong_arguments_are_one_line(pendulum_log: Path) -> None:
    system = amhe.System.load("pendulum")
    log = amhe.read_log(pendulum_log, system, end=1.0)
    with pytest.raises(amhe.AmheError, match="two or more"):
        amhe.compare([system], [[log]])
    with pytest.raises(amhe.AmheError, match="the same logs"):
        amhe.compare([system, system], [[log], []])
