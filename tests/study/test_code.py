"""The hash of a cell covers the code that makes its result, and no other."""

import subprocess
import sys
from pathlib import Path

import pytest

import amhe_cli
from amhe_cli.study.code import _RUNS_CELLS, imported_by, source_hash

PACKAGE = Path(amhe_cli.__file__).parent
#: Runs a short cell in a fresh process, and prints our modules that were loaded by then.
RUN = """
import sys
from amhe_cli.study.code import code
from amhe_cli.study.run import run_cell
setting = {"control.samples": 5, "control.horizon": 8, "mhe.update_period": 0.06}
cell = {"task": "t4", "mode": "adaptive", "seed": 0, "setting": setting, "belief": None, "duration": 0.2}
assert run_cell({"cell": cell, "code": code()})["reason"] is None
print(*(name for name in sys.modules if name.startswith("amhe_cli.")))
"""


@pytest.mark.medium
def test_every_module_that_runs_in_a_cell_is_covered() -> None:
    loaded = subprocess.run([sys.executable, "-c", RUN], capture_output=True, text=True, check=True).stdout
    covered = imported_by(_RUNS_CELLS, PACKAGE)
    assert {"amhe_cli.robots.go1.history", "amhe_cli.study.results", "amhe_cli.matching.cost"} <= set(covered)
    assert set(loaded.split()) - set(covered) == set()


@pytest.mark.medium
def test_command_line_pages_and_tables_are_not_covered() -> None:
    covered = imported_by(_RUNS_CELLS, PACKAGE)
    outside = ("amhe_cli.cli", "amhe_cli.report", "amhe_cli.study.goals", "amhe_cli.study.summary")
    assert [name for name in covered if name.startswith(outside)] == []


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """`run` imports `core.maths` through a function of `loop`, and `page` for type checking only."""
    texts = {
        "__init__.py": "", "core/__init__.py": "", "core/maths.py": "", "page.py": "",
        "run.py": "from typing import TYPE_CHECKING\nfrom pack import loop\nimport numpy\n"
        "if TYPE_CHECKING:\n    from pack.page import Page\n",
        "loop.py": "def go():\n    from pack.core.maths import sine\n    import pack.run\n",
    }  # fmt: skip
    for name, text in texts.items():
        path = tmp_path / "pack" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return tmp_path / "pack"


def test_modules_are_followed_through_functions_and_circles(package: Path) -> None:
    assert set(imported_by("pack.run", package)) == {
        "pack.run",
        "pack.loop",
        "pack.core",
        "pack.core.maths",
    }


def test_the_hash_changes_with_what_is_imported_and_with_nothing_else(package: Path) -> None:
    before = source_hash("pack.run", package)
    (package / "page.py").write_text("title = 'other'")
    assert source_hash("pack.run", package) == before
    (package / "core" / "maths.py").write_text("sine = 0")
    assert source_hash("pack.run", package) != before
