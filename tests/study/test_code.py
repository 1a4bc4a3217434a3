"""The hash of a cell covers the code that makes its result."""

import subprocess
import sys
from pathlib import Path

import pytest

import amhe_cli
from amhe_cli.study.run import source_files

PACKAGE = Path(amhe_cli.__file__).parent
#: Runs a short cell in a fresh process, and prints our modules that were loaded by then.
RUN = """
import sys
from amhe_cli.study.run import code
from amhe_cli.study.run import run_cell
setting = {"control.samples": 5, "control.horizon": 8, "mhe.update_period": 0.06}
cell = {"task": "t4", "mode": "adaptive", "seed": 0, "setting": setting, "belief": None, "duration": 0.2}
assert run_cell({"cell": cell, "code": code()})["reason"] is None
print(*(module.__file__ for name, module in sys.modules.items() if name.startswith("amhe_cli.")))
"""


@pytest.mark.medium
def test_every_module_that_runs_in_a_cell_is_covered() -> None:
    loaded = subprocess.run([sys.executable, "-c", RUN], capture_output=True, text=True, check=True).stdout
    files = {Path(file).relative_to(PACKAGE).as_posix() for file in loaded.split()}
    assert {"robots/go1/judge.py", "study/results.py", "matching/cost.py"} <= files
    assert files - set(source_files(PACKAGE)) == set()


def test_the_hash_changes_with_a_source() -> None:
    files = source_files(PACKAGE)
    assert not [name for name in files if name.startswith(("cli/", "report/")) or "goals" in name]
    assert len(files["matching/cost.py"]) == 64
