"""The hash of a cell covers the code that makes its result."""

import subprocess
import sys
from pathlib import Path

import pytest

import amhe_cli
from amhe_cli.study.cells import Cell, cell_of, setting_of, words
from amhe_cli.study.run import source_files
from tests.study.cells_at_play import CODE


def test_all_that_decides_a_cell_is_in_its_name() -> None:
    cell = Cell("t4", "baseline", 3, setting_of({"control.samples": 16}), "belief: 1", 40.0)
    others = [
        Cell("t1", "baseline", 3, cell.setting, cell.belief),
        Cell("t4", "true", 3, cell.setting, cell.belief),
        Cell("t4", "baseline", 4, cell.setting, cell.belief),
        Cell("t4", "baseline", 3, (), cell.belief),
        Cell("t4", "baseline", 3, cell.setting, None),
        Cell("t4", "baseline", 3, cell.setting, cell.belief, 20.0),
    ]
    names = {cell.file_name(CODE), *(other.file_name(CODE) for other in others)}
    names |= {cell.file_name(CODE | {name: "other"}) for name in CODE}
    assert len(names) == 1 + len(others) + len(CODE)
    assert cell.file_name(CODE).startswith("t4-baseline-03-")


def test_a_cell_survives_json() -> None:
    import json

    cell = Cell("t4", "true", 0, setting_of({"control.sigma_range": [0.2, 1.0], "control.refine": "never"}))
    again = cell_of(json.loads(json.dumps(cell.plain())))
    assert again == cell
    assert again.file_name(CODE) == cell.file_name(CODE)
    assert hash(again) == hash(cell)
    assert words(cell.setting) == 'control.refine="never", control.sigma_range=[0.2, 1.0]'
    known = {"parameters.motor_gain.held": 0.98, "parameters.motor_gain.held_sd": 0.01, "plant": "dry"}
    assert words(setting_of(known)) == 'plant="dry", a known robot'


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
