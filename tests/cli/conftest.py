"""What tests of commands share: each runs in a folder of its own, into which it writes."""

from pathlib import Path

import pytest

#: A belief.yaml of a system that has the parameters of go1_push, or claims to.
BELIEF = """\
schema_version: 1
system: {system}
parameters:
- {{name: box_mass, unit: kg, scale: log, estimate: {mass}}}
- {{name: box_inertia_scale, unit: '-', scale: log, estimate: 1.0}}
- {{name: floor_friction, unit: '-', scale: log, estimate: 0.5}}
covariance: [[0.01, 0, 0], [0, 0.01, 0], [0, 0, 0.01]]
"""


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands write below the folder that they are run in."""
    monkeypatch.chdir(tmp_path)


def names(folder: str | Path) -> list[str]:
    """Names of the files in a folder."""
    return sorted(path.name for path in Path(folder).iterdir())
