from pathlib import Path

import numpy as np
import pytest

from amhe_cli.core.bundled import bundled_root
from amhe_cli.core.settings import LogSettings
from amhe_cli.logs import LogWriter, read_truth

SECOND = 10**9


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """Mass 2 from 10 s on, 3 from 11 s on."""
    path = tmp_path / "log.mcap"
    with LogWriter(path, {}) as writer:
        for tenth in range(100, 121):
            mass = 2.0 if tenth < 110 else 3.0
            writer.joint_state("/amhe/truth", tenth * SECOND // 10, ["mass", "friction"], [mass, 0.5])
    return path


def test_a_value_holds_until_the_next_one(log: Path) -> None:
    stamps = np.array([10.0, 10.95, 11.0, 12.0]) * SECOND
    truth = read_truth(log, stamps.astype(np.int64), LogSettings())
    assert list(truth) == ["mass", "friction"]
    np.testing.assert_array_equal(truth["mass"], [2.0, 2.0, 3.0, 3.0])
    np.testing.assert_array_equal(truth["friction"], 0.5)


def test_nothing_is_true_before_the_first_value_and_the_last_holds(log: Path) -> None:
    truth = read_truth(log, np.array([9 * SECOND, 15 * SECOND]), LogSettings())
    np.testing.assert_array_equal(truth["mass"], [np.nan, 3.0])


def test_a_truth_that_is_stated_seldom_holds_and_is_no_loss(tmp_path: Path, caplog) -> None:
    with LogWriter(tmp_path / "log.mcap", {}) as writer:
        for tenth in [*range(100, 110), *range(150, 160)]:
            writer.joint_state("/amhe/truth", tenth * SECOND // 10, ["mass"], [2.0])
    truth = read_truth(tmp_path / "log.mcap", np.array([13 * SECOND]), LogSettings())
    np.testing.assert_array_equal(truth["mass"], [2.0])
    assert not caplog.records


def test_a_log_that_tells_no_truth_has_none() -> None:
    path = bundled_root() / "examples" / "logs" / "pendulum.mcap"
    assert read_truth(path, np.array([0]), LogSettings()) == {}
