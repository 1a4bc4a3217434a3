"""The system of a real SO-101 reads logs of their owners' kind: arrays in cells, times in microseconds."""

import json
from pathlib import Path

import numpy as np

import amhe_cli as amhe

FOLDER = Path(__file__).parents[2] / "examples" / "systems" / "so101"


def write(path: Path, word: str, rows: np.ndarray) -> None:
    lines = [f'{word},{20000 * i + 5},"{json.dumps(row.tolist())}"' for i, row in enumerate(rows)]
    path.write_text("\n".join(["type,timestamp,positions", *lines]) + "\n")


def test_a_log_of_sage_is_read(tmp_path: Path) -> None:
    system = amhe.System.load(FOLDER)
    wave = 0.3 * np.sin(np.linspace(0.0, 6.0, 100))[:, None] * np.arange(1, 7)
    write(tmp_path / "state_motor.csv", "STATE_MOTOR", wave)
    write(tmp_path / "control.csv", "CONTROL", wave + 0.02)
    log = amhe.read_log(tmp_path, system)
    measured, targets = log["joints.position"].values, log["targets.position"].values
    assert abs(log.duration - 1.98) < 0.02
    np.testing.assert_allclose(measured[::5], wave[: len(measured[::5])], atol=2e-3)
    np.testing.assert_allclose(targets[0], wave[0] + 0.02, atol=1e-9)


def test_the_nominal_model_is_the_makers() -> None:
    system = amhe.System.load(FOLDER)
    assert sum(name.endswith("_gain") for name in system.space.names) == 6
    np.testing.assert_allclose(system.model.actuator_gainprm[:, 0], 998.22)
