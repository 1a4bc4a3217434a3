"""The Python interface."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

import amhe_cli as amhe
from amhe_cli.core.bundled import bundled_root
from amhe_cli.core.errors import ConfigError, LogError
from tests.web.figures import panels

ROOT = Path(__file__).parents[2]
#: Few clips and iterations: these tests are about the calls.
CHEAP = {
    "clips": {"count": 6, "length": [0.4, 0.8]},
    "identify": {**{"iterations": 4}, **{"cmaes_iterations": 4}},
}


@pytest.fixture(scope="module")
def system() -> amhe.System:
    return amhe.System.load("pendulum", CHEAP)


@pytest.fixture(scope="module")
def log(system: amhe.System) -> amhe.Log:
    return amhe.read_log("example:pendulum", system, end=6.0)


@pytest.fixture(scope="module")
def result(system: amhe.System, log: amhe.Log) -> amhe.Result:
    return amhe.identify(system, log, threads=1)


@pytest.mark.medium
def test_ctrl_c_ends_a_loop_and_keeps_the_best_so_far(
    system: amhe.System, log: amhe.Log, tmp_path: Path
) -> None:
    begun: list[int] = []

    def press(iteration: Any, total: int) -> None:
        if iteration.number == 1:
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(amhe.Interrupted) as stop:
        for seed in range(3):
            begun.append(seed)
            amhe.identify(system, log, seed=seed, threads=1, progress=press)
    assert begun == [0] and isinstance(stop.value, KeyboardInterrupt)
    best = stop.value.result
    assert best.found.interrupted and len(best.found.iterations) == 1
    assert json.loads((best.save(tmp_path / "best") / "result.json").read_text())["interrupted"]


def python(text: str, folder: Path) -> str:
    """Run Python code in a fresh process in another folder; what it printed."""
    environment = os.environ | {"PYTHONPATH": str(ROOT), "MPLBACKEND": "Agg", "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", text], cwd=folder, env=environment, capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


#: Code before that of a page, so that its searches take little time.
LITTLE = """import functools, amhe_cli as amhe, amhe_cli.estimation.conclude as conclude
amhe.identify = functools.partial(amhe.identify, max_time=0.5)
conclude._missing = lambda fit, watch: watch.omits()
probe = amhe.probe
few = {"probe": {"candidates": 1, "pairs": 0}}
amhe.probe = lambda of, **how: probe(amhe.System.load(of.name, few), **how)
"""


def blocks(path: Path) -> str:
    return "\n".join(re.findall(r"^```python\n(.*?)^```", path.read_text(encoding="utf-8"), re.M | re.S))


def test_every_public_name_is_there_and_described() -> None:
    described = (ROOT / "docs" / "api.md").read_text(encoding="utf-8")
    for name in amhe.__all__:
        assert getattr(amhe, name) is not None
        assert name in dir(amhe)
        assert name.startswith("__") or f"`{name}`" in described, f"{name} is not in docs/api.md"
    with pytest.raises(AttributeError, match="no attribute 'identfy'"):
        _ = amhe.identfy  # type: ignore[attr-defined]


def test_the_package_imports_nothing_heavy(tmp_path: Path) -> None:
    heavy = ("numpy", "mujoco", "rich", "pydantic")
    text = f"import sys, amhe_cli; print([m for m in {heavy} if m in sys.modules])"
    assert python(text, tmp_path).strip() == "[]"


@pytest.mark.medium
def test_identify_imports_no_search_that_it_does_not_use(tmp_path: Path) -> None:
    text = "import sys, amhe_cli.api.identify; print([m for m in ('cmaes', 'scipy') if m in sys.modules])"
    assert python(text, tmp_path).strip() == "[]"


@pytest.mark.medium
def test_the_examples_of_the_docs_run(tmp_path: Path) -> None:
    printed = python(LITTLE + blocks(ROOT / "docs" / "api.md"), tmp_path)
    assert "no signal 'joint'" in printed
    assert {path.name for path in (tmp_path / "result").iterdir()} == {
        "belief.yaml", "identified.xml", "report.html", "result.json", "view.html",
    }  # fmt: skip


@pytest.mark.medium
def test_the_script_in_the_readme_runs(tmp_path: Path) -> None:
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    text = blocks(ROOT / "README.md")
    assert 5 < len(text.splitlines()) <= 25
    assert "load_mass" in python(LITTLE + text, tmp_path)


@pytest.mark.medium
def test_the_example_script_runs(tmp_path: Path) -> None:
    printed = python((ROOT / "examples" / "identify_arrays.py").read_text(encoding="utf-8"), tmp_path)
    assert re.search(r"damping +0\.0(29|30)\d*", printed), printed


@pytest.mark.medium
def test_the_notebook_runs(tmp_path: Path) -> None:
    notebook = json.loads((ROOT / "examples" / "notebook.ipynb").read_text(encoding="utf-8"))
    cells = ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert len(cells) > 5
    stored = json.dumps([cell.get("outputs") for cell in notebook["cells"]])
    assert "damping" in stored and 10_000 < len(stored) < 1_000_000, "it is to be read without running it"
    text = f"space = {{}}\nfor cell in {cells!r}:\n    exec(cell, space)"
    assert "damping" in python(text, tmp_path)


@pytest.mark.medium
def test_a_result_has_what_the_command_prints(result: amhe.Result) -> None:
    mass = result.parameters["load_mass"]
    assert mass.interval == (mass.lower, mass.upper) and mass.lower < mass.estimate < mass.upper
    assert str(result) == result.table
    for name in result.parameters:
        assert name in result.table
    assert "held-out: " in result.table and "report:" not in result.table
    assert "\x1b" not in result.table
    shown = result._repr_html_()
    table = shown.partition("<iframe")[0]
    assert (
        "overflow-x:auto" in table and "color:inherit" in table and "load_mass" in table and "#" not in table
    )
    assert repr(mass).startswith(f"<load_mass {mass.estimate:.4g} ± ") and mass.verdict in repr(mass)
    assert repr(result.belief).startswith("Belief('pendulum': load_mass ") and "\n" not in repr(result)
    assert "<iframe" in shown
    drawn = result.plot()
    clips = len({fit.clip for fit in result.fits})
    assert [panel["title"] for panel in panels(drawn.html)].count("joints.position") == clips
    assert "<iframe" in drawn._repr_html_()
    assert result.belief.sample(7).shape == (7, 4)


def test_the_model_has_the_identified_values(result: amhe.Result) -> None:
    model = result.model()
    assert isinstance(model, mujoco.MjModel)
    assert model.body("load").mass[0] == pytest.approx(result.parameters["load_mass"].estimate)


@pytest.mark.medium
def test_save_writes_what_the_command_writes(result: amhe.Result, tmp_path: Path) -> None:
    result.save(tmp_path / "out")
    record = json.loads((tmp_path / "out" / "result.json").read_text(encoding="utf-8"))
    assert (record["schema_version"], record["command"], record["seed"]) == (1, "identify", 0)
    assert [p["name"] for p in record["parameters"]] == list(result.parameters)
    assert amhe.Belief.load(tmp_path / "out" / "belief.yaml", result.system).names == result.belief.names
    mujoco.MjModel.from_xml_path(str(tmp_path / "out" / "identified.xml"))
    with pytest.raises(ConfigError, match="is not empty"):
        result.save(tmp_path / "out")
    result.save(tmp_path / "out", force=True)


@pytest.mark.medium
def test_a_belief_that_was_made_from_the_same_log_counts_it_twice(
    result: amhe.Result, system: amhe.System, log: amhe.Log, tmp_path: Path
) -> None:
    folder = result.save(tmp_path / "first")
    few = {"fix": {"damping": 0.035, "friction_loss": 0.03, "armature": 0.006}, "max_time": 1e-3}
    again = amhe.identify(system, log, prior=folder / "belief.yaml", **few)
    (text,) = (text for text in again.warnings if "counts twice" in text)
    assert "pendulum.mcap already" in text
    (tmp_path / "another.mcap").write_bytes(b"another run")
    other = replace(log, series=dict(log.series), file=tmp_path / "another.mcap", source="another.mcap")
    assert not any(
        "twice" in text for text in amhe.identify(system, other, prior=again.belief, **few).warnings
    )


@pytest.mark.medium
@pytest.mark.usefixtures("unexplained")
def test_system_and_logs_without_files_are_saved_as_well(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "arrays").mkdir()  # named as the logs are, and has nothing to do with them
    time = np.arange(0.0, 4.0, 0.01)
    system = amhe.System.from_model(
        bundled_root() / "models" / "pendulum" / "scene.xml",
        parameters={"damping": {"nominal": 0.02, "targets": [{"joint": "hinge", "set": "damping"}]}},
        signals={
            "joints": {"joints": ["hinge"], "noise": {"position": 0.01}},
            "command": {"actuators": ["servo"], "quantity": "position"},
        },
        settings=CHEAP,
    )
    position = 0.5 * np.sin(3.0 * time)
    arrays = {"joints": {"time": time, "position": position}, "command": {"time": time, "position": position}}
    log, held_out = (amhe.Log.from_arrays(arrays, system) for _ in range(2))
    assert log.file is None
    found = amhe.identify(system, log, held_out=held_out)
    found.save(tmp_path / "out")
    belief = amhe.Belief.load(tmp_path / "out" / "belief.yaml", system)
    assert belief.provenance["logs"] == {"arrays": log.digest()}
    assert (tmp_path / "out" / "report.html").stat().st_size > 10_000


def test_wrong_arguments_are_named(system: amhe.System, log: amhe.Log) -> None:
    with pytest.raises(ConfigError, match="`logs`: there is none"):
        amhe.identify(system, [])
    with pytest.raises(ConfigError, match="`logs`: give logs, made by read_log"):
        amhe.identify(system, ["swing.mcap"])  # type: ignore[list-item]
    with pytest.raises(ConfigError, match="`held_out`: .* is fitted too"):
        amhe.identify(system, log, held_out=log)
    for wrong, message in (
        ({"engine": "abacus"}, "no engine 'abacus'; there is: cpu, gpu, auto"),
        ({"method": "foo"}, "`method`: no method 'foo'; there is: cmaes, linearised"),
        ({"threads": 0}, "`threads`: 0 is no whole number of 1 or more"),
        ({"threads": -1}, "`threads`: -1 is no whole number"),
        ({"seed": -1}, "`seed`: -1 is no whole number of 0 or more"),
        ({"seed": 0.5}, "`seed`: 0.5 is no whole number"),
        ({"max_time": 0}, "`max_time`: 0 is no positive number of seconds"),
        ({"max_time": -1.0}, "`max_time`: -1.0 is no positive number"),
        ({"max_time": np.nan}, "`max_time`: nan is no positive number"),
        ({"checkpoint": "nowhere/search.json"}, "`checkpoint`: there is no folder 'nowhere'"),
        ({"checkpoint": ROOT}, "`checkpoint`: .* is a folder"),
    ):
        with pytest.raises(ConfigError, match=message):
            amhe.identify(system, log, **wrong)  # type: ignore[arg-type]
    for wrong, message in (
        ({"duration": 0}, "`duration`: 0 is no positive number of seconds"),
        ({"duration": -1}, "`duration`: -1 is no positive number"),
        ({"threads": 0}, "`threads`: 0 is no whole number"),
        ({"seed": -1}, "`seed`: -1 is no whole number"),
        ({"log": "nowhere/x.mcap"}, "`log`: there is no folder 'nowhere'"),
        ({"task": None}, "no task None; there is: "),
        ({"mode": "adaptiv"}, "did you mean 'adaptive'"),
    ):
        with pytest.raises(ConfigError, match=message):
            amhe.run(**wrong)  # type: ignore[arg-type]
    for wrong, message in (
        ({"seconds": np.nan}, "`seconds`: nan is no positive number"),
        ({"threads": 0}, "`threads`: 0 is no whole number"),
        ({"seed": -1}, "`seed`: -1 is no whole number"),
        ({"log": "nowhere/x.mcap"}, "`log`: there is no folder 'nowhere'"),
    ):
        with pytest.raises(ConfigError, match=message):
            amhe.probe(system, **wrong)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="`seed`: -1 is no whole number"):
        amhe.Estimator(system, seed=-1)
    with pytest.raises(ConfigError, match="`threads`: 0 is no whole number"):
        amhe.Estimator(system, threads=0)
    with pytest.raises(LogError, match="was not read for the system 'cube_toss': it has no "):
        amhe.identify(amhe.System.load("cube_toss"), log)
    with pytest.raises(ConfigError, match="`end`: 1 is not after `start` 2"):
        amhe.read_log("swing.mcap", system, start=2.0, end=1.0)
    with pytest.raises(ConfigError, match="`topics`: no signal 'joint'"):
        amhe.read_log("swing.mcap", system, topics={"joint": "/x"})


@pytest.mark.medium
def test_an_estimator_follows_a_log(system: amhe.System, log: amhe.Log) -> None:
    estimator = amhe.Estimator(system, seed=1)
    step, estimates = 25, []
    for row in range(0, log.steps - step, step):
        rows = np.arange(row, row + step)
        samples = {
            key: (log.dt * rows[series.sampled[rows]], series.values[rows[series.sampled[rows]]])
            for key, series in log.series.items()
        }
        estimates.append(estimator.update(samples))
        for times, values in samples.values():  # the loop's own arrays, to be filled again
            times[:] = values[:] = np.nan
    found = [one for one in estimates if one is not None]
    assert estimates[0] is None and len(found) > 15
    assert all(b.time > a.time for a, b in pairwise(found))
    truth = json.loads(log.metadata["truth"])
    assert found[-1].values["load_mass"] == pytest.approx(truth["load_mass"], rel=0.1)


@pytest.mark.medium
def test_an_estimator_takes_encoders_without_velocities(system: amhe.System, log: amhe.Log) -> None:
    estimator, step, found = amhe.Estimator(system, seed=1), 25, []
    given = [log.series[key] for key in ("joints.position", "command.position")]
    for row in range(0, log.steps - step, step):
        rows = np.arange(row, row + step)
        times = [log.dt * rows[series.sampled[rows]] for series in given]
        values = [series.values[rows[series.sampled[rows]]] for series in given]
        samples = {"joints.position": (times[0], values[0]), "command.position": (times[1], values[1])}
        found += [estimate for estimate in [estimator.update(samples)] if estimate is not None]
    assert len(found) > 15 and any(estimate.updated for estimate in found)
    truth = json.loads(log.metadata["truth"])
    assert found[-1].values["load_mass"] == pytest.approx(truth["load_mass"], rel=0.1)


@pytest.mark.parametrize(
    ("samples", "message"),
    [
        ({"joints.positon": (2.0, 0.0)}, r"no series 'joints.positon' \(did you mean 'joints.position'"),
        ({"joints.position": ([2.0, 2.1], [0.0, 0.1, 0.2])}, "joints.position: values of shape"),
        ({"joints.position": ([2.0, 2.1], [0.0, 0.1, 0.2, 0.3])}, "joints.position: values of shape"),
        ({"joints.position": ([2.0, 2.1], np.zeros((2, 2)))}, r"joints.position: .*, shape \(n, 1\)"),
        ({"joints.position": 2.0}, "joints.position: give a pair of times and values"),
        ({"joints.position": (["now"], [0.0])}, "joints.position: time is no array of numbers"),
        ({"joints.position": ([2.0], [np.inf])}, "joints.position: values is infinite somewhere"),
        ({"joints.position": ([2.0, np.nan], [0.0, 0.1])}, "joints.position: time is not finite at row 1"),
        ({"joints.position": ([2.1, 2.0], [0.0, 0.1])}, "at row 1 it goes from 2.1 to 2 s"),
        ({"joints.position": ([2.0, 2.0], [0.0, 0.1])}, "at row 1 it goes from 2 to 2 s"),
        (
            {"joints.position": ([0.0, 0.1], [0.0, 0.1])},
            "joints.position: time goes from 1 to 0 s; .*new Est",
        ),
        ({"joints.position": (1.0, 0.0)}, "joints.position: time goes from 1 to 1 s"),
        ({"joints.position": (2.0, 0.0)}, "joints.velocity is missing; give joints.position and joints.velo"),
        (
            {"joints.position": (2.0, 0.0), "joints.velocity": (2.1, 0.0)},
            "joints.velocity: its times differ from those of joints.position",
        ),
    ],
)
def test_wrong_samples_are_named_and_not_taken_in(system: amhe.System, samples, message: str) -> None:
    estimator, empty = amhe.Estimator(system), ([], [])
    first = {"joints.position": (1.0, 0.0), "joints.velocity": (1.0, 0.0), "command.position": empty}
    assert estimator.update(first) is None
    with pytest.raises(LogError, match=f"^samples: .*{message}"):
        estimator.update({"command.position": (2.0, 0.0), **samples})
    estimator.update({"command.position": (2.0, 0.0)})  # it was not taken in before
    estimator.update({"joints.position": ([1.5], [[0.0]]), "joints.velocity": (1.5, [0.0])})


def test_quaternions_and_widths_of_samples_are_checked() -> None:
    estimator = amhe.Estimator(amhe.System.load("cube_toss"))
    key = next(key for key in estimator._widths if key.endswith(".orientation"))
    with pytest.raises(LogError, match="orientation is no unit quaternion at row 0"):
        estimator.update({key: (0.0, [2.0, 0.0, 0.0, 0.0])})
    with pytest.raises(LogError, match=r"shape \(n, 4\)"):
        estimator.update({key: (0.0, [1.0, 0.0, 0.0])})


@pytest.mark.medium
def test_a_probe_says_what_it_will_reveal(system: amhe.System, tmp_path: Path) -> None:
    few = amhe.System.load("pendulum", CHEAP | {"probe": {"candidates": 2, "pairs": 0}})
    plan = amhe.probe(few, seconds=2.0, log=tmp_path / "probe.mcap")
    rows = {row["name"]: row for row in plan["parameters"]}
    assert 0.0 < rows["load_mass"]["expected_sd"] < rows["load_mass"]["prior_sd"]
    assert amhe.read_log(tmp_path / "probe.mcap", few).duration == pytest.approx(2.0, abs=0.1)


def test_a_run_gives_its_measures() -> None:
    measures = amhe.run("t1", "true", duration=0.2, settings={"control": {"samples": 5, "horizon": 6}})
    assert (measures["task"], measures["mode"], measures["success"]) == ("t1", "true", False)
    assert measures["goal_error_m"] > 0.5


def test_an_example_that_does_not_exist_is_one_line_that_lists_all() -> None:
    with pytest.raises(amhe.AmheError, match="no example 'pendulums' .did you mean 'pendulum'"):
        amhe.read_log("example:pendulums", amhe.System.load("pendulum"))


def test_system_and_log_are_one_line() -> None:
    system = amhe.System.load("pendulum")
    times = np.arange(0.0, 1.0, 0.01)
    zeros = np.zeros((times.size, 1))
    log = amhe.Log.from_arrays(
        {
            "joints": {"time": times, "position": zeros, "velocity": zeros},
            "command": {"time": times, "position": zeros},
        },
        system,
    )
    assert repr(system).startswith("System('pendulum': parameters load_mass, ")
    assert repr(log).startswith("Log('arrays', 0.99 s at ")
    assert "joints.position (1)" in repr(log)
    assert "\n" not in repr(system) + repr(log)


def test_logs_of_one_name_are_distinguished_in_the_provenance() -> None:
    from amhe_cli.system.provenance import hashes

    system = amhe.System.load("pendulum")
    times = np.arange(0.0, 1.0, 0.01)
    logs = []
    for scale in (1.0, 2.0, 3.0):
        wave = scale * np.sin(times)[:, None]
        arrays = {"joints": {"time": times, "position": wave, "velocity": wave}}
        logs.append(amhe.Log.from_arrays(arrays | {"command": {"time": times, "position": wave}}, system))
    found = hashes(logs)
    assert list(found) == ["arrays", "arrays #2", "arrays #3"]
    assert len(set(found.values())) == 3
