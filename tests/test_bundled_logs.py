"""The example logs that every installation carries: small, and read without an option."""

from pathlib import Path

import pytest

from amhe_cli.cli.inputs import Inputs
from amhe_cli.core.bundled import bundled_root

LOGS = {"pendulum": "pendulum", "pusher": "pusher", "t1": "go1_push", "t4": "go1_push"}


@pytest.mark.parametrize(("name", "system"), LOGS.items())
def test_a_bundled_log_is_read_by_its_system_without_options(name: str, system: str) -> None:
    path = bundled_root() / "examples" / "logs" / f"{name}.mcap"
    assert path.stat().st_size < 2**20
    inputs = Inputs()
    opened = inputs.open([path])
    assert opened.name == system
    (log,) = inputs.read(opened, [path])
    assert log.duration > 5.0
    assert all(series.valid.mean() > 0.99 for series in log.series.values())
    assert ("truth" in log.metadata) == (name != "t4")  # the floor of t4 changes on the way


def test_no_bundled_log_is_forgotten_here() -> None:
    folder: Path = bundled_root() / "examples" / "logs"
    assert {path.stem for path in folder.glob("*.mcap")} == set(LOGS)
