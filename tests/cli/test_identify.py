"""amhe identify and calibrate, and results beside each other."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from unittest.mock import Mock

import mujoco
import numpy as np
import pytest
import yaml

from amhe_cli.cli.inputs import Inputs
from amhe_cli.cli.main import run
from amhe_cli.cli.settings import Overrides
from amhe_cli.core.errors import ConfigError
from amhe_cli.core.rotations import exp, multiply
from tests.cli.conftest import names
from tests.conftest import MODELS, write_pendulum_log
from tests.robots.go1.stand_ins import SLOW, Emulated, emulating

ROOT = Path(__file__).parents[2]

#: Little work, and nothing that only the report needs.
QUICK = [
    *("--set", "clips.count=6", "--set", "clips.length=[0.3, 0.5]"),
    *("--set", "identify.samples=12", "--set", "identify.iterations=3"),
]
FILES = ["belief.yaml", "identified.xml", "report.html", "result.json", "view.html"]


@pytest.fixture(scope="module")
def done(pendulum_log: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Output of one quick run; what it printed lies beside it."""
    out = tmp_path_factory.mktemp("identify") / "out"
    with redirect_stdout(StringIO()) as printed:
        assert (
            run(["identify", str(pendulum_log), "-o", str(out), "-q", "--json", "--seed", "3", *QUICK]) == 0
        )
    out.with_suffix(".json").write_text(printed.getvalue())
    return out


def test_it_writes_its_files(done: Path) -> None:
    assert names(done) == FILES


def test_result_json_has_the_keys_of_every_command_and_its_own(done: Path) -> None:
    record = json.loads((done / "result.json").read_text())
    assert json.loads(done.with_suffix(".json").read_text()) == record
    assert record["schema_version"] == 1
    assert record["command"] == "identify"
    assert record["system"] == "pendulum"
    assert record["seed"] == 3
    assert record["seconds"] > 0
    assert {"version", "warnings", "correlations", "clips"} <= set(record)
    assert {"cost", "initial_cost", "position_error_m", "orientation_error_rad"} <= set(record["held_out"])
    assert {"count", "diverged"} <= set(record["rollouts"])
    mass = record["parameters"][0]
    assert mass["name"] == "load_mass"
    assert mass["lower"] < mass["estimate"] < mass["upper"]
    assert mass["verdict"] in ("identified", "conditional", "weak", "prior", "model-sensitive")


def test_the_identified_model_loads_and_holds_the_estimate(done: Path) -> None:
    record = json.loads((done / "result.json").read_text())
    model = mujoco.MjModel.from_xml_path(str(done / "identified.xml"))
    assert model.body("load").mass[0] == pytest.approx(record["parameters"][0]["estimate"], rel=1e-4)


def test_the_belief_says_where_it_came_from(done: Path, pendulum_log: Path) -> None:
    origin = yaml.safe_load((done / "belief.yaml").read_text())["provenance"]
    assert origin["command"].startswith("amhe identify ")
    assert origin["seed"] == 3
    assert list(origin["logs"]) == [str(pendulum_log)]
    assert {"system.yaml", "scene.xml"} <= set(origin["system_files"])
    assert {"amhe", "mujoco"} <= set(origin["versions"])


@pytest.mark.medium
@pytest.mark.usefixtures("unexplained")
def test_a_model_needs_no_system_folder(pendulum_log: Path, tmp_path: Path) -> None:
    out, again = tmp_path / "out", tmp_path / "again"
    quiet, model = ("-q", *QUICK), ("--model", str(ROOT / "models" / "pendulum" / "scene.xml"))
    assert run(["identify", str(pendulum_log), *model, "--system", "pendulum", "-o", str(out)]) == 2
    assert not out.exists()
    blind = tmp_path / "blind.csv"  # no clip of it can be used
    blind.write_text("time,hinge_position,hinge_command\n0,0.1,0\n0.01,0.1,0\n0.02,0.1,0\n")
    assert run(["identify", str(blind), *model, "-o", str(out), *quiet]) != 0
    assert run(["identify", str(pendulum_log), *model, "-o", str(out), *quiet, "--fix", "no_such=1"]) == 2
    assert not out.exists(), "the mistake is mended, and the same folder is not refused"
    assert run(["identify", str(pendulum_log), *model, "-o", str(out), *quiet]) == 0
    assert names(out) == sorted([*FILES, "system"]) and names(out / "system") == ["scene.xml", "system.yaml"]
    assert run(["view", str(out), "--out", str(tmp_path / "page.html"), "-q"]) == 0
    for name, start in (("causes.html", "<!doctype html>"), ("causes.json", "{")):
        assert run(["explain", str(out), "-q", "-o", name]) == 0
        assert Path(name).read_text().startswith(start)
    assert run(["explain", str(out), "-q", "-o", "causes.json"]) == 2
    assert run(["export", str(out / "belief.yaml"), "--to", "mjcf", "-o", str(tmp_path / "to"), "-q"]) == 0
    system = ("--system", str(out / "system"))
    assert run(["identify", str(pendulum_log), *system, "-o", str(again), *quiet]) == 0
    first, second = (json.loads((one / "result.json").read_text()) for one in (out, again))
    assert first["parameters"] == second["parameters"]


@pytest.mark.medium
@pytest.mark.usefixtures("unexplained")
def test_what_is_wrong_before_the_fit_is_said_first_and_kept(
    pendulum_log: Path, tmp_path: Path, capsys
) -> None:
    model = ROOT / "models" / "pendulum" / "scene.xml"
    (tmp_path / "stiff.xml").write_text(model.read_text().replace('kp="', 'kp="9999'))
    arguments = ["identify", str(pendulum_log), "--model", str(tmp_path / "stiff.xml"), "-o", "out", *QUICK]
    arguments += ["--require", "load_mass<0.1%"]
    assert run(arguments) == 3
    shown, progress = capsys.readouterr()
    assert "held-out: " in shown and "report: out/" in shown and "cost" in progress
    assert not Path("MUJOCO_LOG.TXT").exists()
    assert shown.startswith("first of all, ") and "time steps" in shown.partition("load_mass")[0]
    assert "not reached: load_mass is known to" in shown
    record = json.loads(Path("out/result.json").read_text())
    assert record["findings"][0]["kind"] == "stiff" and len(record["not_reached"]) == 1
    page = Path("out/report.html").read_text()
    assert page.index("Before the fit") < page.index("Held")
    assert run([*arguments, "--force", "--require", "no_such<5%"]) == 2


@pytest.mark.medium
def test_the_belief_is_a_prior_for_the_next_run(done: Path, pendulum_log: Path, capsys) -> None:
    arguments = ["identify", str(pendulum_log), "--belief", str(done / "belief.yaml"), "-q", "--json", *QUICK]
    assert run(arguments) == 0
    record = json.loads(capsys.readouterr().out)
    before = json.loads((done / "result.json").read_text())
    assert record["parameters"][0]["prior"] == pytest.approx(before["parameters"][0]["estimate"])


def test_a_folder_that_holds_something_is_refused_before_any_work(pendulum_log: Path, capsys) -> None:
    Path("out").mkdir()
    Path("out/mine").touch()
    assert run(["identify", str(pendulum_log), "-o", "out"]) == 2
    assert "--force" in capsys.readouterr().err
    assert names("out") == ["mine"]


def test_a_folder_that_cannot_be_written_is_refused_before_any_work(pendulum_log: Path, capsys) -> None:
    assert run(["identify", str(pendulum_log), "-o", "/proc/out"]) in (1, 2)  # root may write anywhere
    assert "/proc" in capsys.readouterr().err


@pytest.mark.medium
def test_max_time_and_checkpoint(pendulum_log: Path, capsys) -> None:
    arguments = [
        "identify",
        str(pendulum_log),
        "--checkpoint",
        "search",
        "--max-time",
        "1e-3",
        "--json",
        *QUICK,
    ]
    assert run([*arguments, "--strict", "-o", "first"]) == 3
    record = json.loads(capsys.readouterr().out)
    assert any("--max-time" in warning for warning in record["warnings"])
    assert not record["interrupted"]
    assert run([*arguments, "-o", "second"]) == 0  # goes on where an iteration was done in time


def test_a_log_that_names_no_system_says_what_to_do(capsys, tmp_path: Path) -> None:
    log = write_pendulum_log(tmp_path / "nameless.mcap", 0.2)
    for command in ("identify", "mhe-replay", "view"):
        assert run([command, str(log)]) == 2, "no system is guessed"
        assert (
            f"{log} does not say which system it is about: name one with --system" in capsys.readouterr().err
        )
    assert run(["identify", "example:arm"]) == 2
    assert "amhe init example:arm example:arm -o my_system/" in capsys.readouterr().err


def test_mistakes_in_options_are_found_before_logs_are_read(
    done: Path, pendulum_log: Path, capsys, monkeypatch
) -> None:
    belief = Path("belief.yaml")
    belief.write_text((done / "belief.yaml").read_text().replace("load_mass", "lode_mass"))
    monkeypatch.setattr("amhe_cli.logs.read_log", Mock(side_effect=AssertionError))
    for option, value in (("--fix", "damp=1"), ("--only", "damp"), ("--belief", str(belief))):
        assert run(["identify", str(pendulum_log), "-o", f"out{option}", option, value]) == 2
        assert "did you mean" in capsys.readouterr().err


@pytest.mark.medium
def test_an_interrupted_run_keeps_the_best_so_far(pendulum_log: Path) -> None:
    command = [sys.executable, "-m", "amhe_cli", "identify", str(pendulum_log), "-o", "out", *QUICK]
    command += ["--set", "identify.iterations=100000"]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    pipe = subprocess.PIPE
    with subprocess.Popen(command, text=True, env=environment, stdout=pipe, stderr=pipe) as process:
        assert process.stderr is not None
        for line in process.stderr:
            if "cost" in line:
                break
        process.terminate()
        out, err = process.communicate(timeout=60)
    assert process.returncode == 143, err
    assert "interrupted" in out
    assert names("out") == FILES
    assert json.loads(Path("out/result.json").read_text())["interrupted"] is True


@pytest.mark.medium
@pytest.mark.usefixtures("unexplained")
def test_workers_find_the_same_parameters_to_the_bit(tmp_path: Path, pendulum_log: Path) -> None:
    few = ("identify.iterations=1", "clips.count=8")
    quick = ["--to", "3", "-q", *(word for setting in few for word in ("--set", setting))]
    assert run(["identify", str(pendulum_log), "-o", str(tmp_path / "here"), *quick]) == 0
    assert run(["identify", str(pendulum_log), "-o", str(tmp_path / "there"), *quick, "--workers", "1"]) == 0
    here, there = (json.loads((tmp_path / out / "result.json").read_text()) for out in ("here", "there"))
    for own in ("seconds", "out"):
        del here[own], there[own]
    assert here == there


@pytest.mark.medium
@pytest.mark.usefixtures("unexplained")
def test_fixed_parameters_are_listed_and_condition_the_belief(done: Path, pendulum_log: Path, capsys) -> None:
    command = ["identify", str(pendulum_log), "-q", "--seed", "3", *QUICK, "--json", "-o", "out"]
    narrow = ["--belief", str(done / "belief.yaml"), "--only", "load_*", "--fix", "damping=0.05"]
    assert run([*command, *narrow]) == 0
    record = json.loads(capsys.readouterr().out)
    assert [p["name"] for p in record["parameters"]] == ["load_mass"]
    fixed = yaml.safe_load(Path("out/belief.yaml").read_text())["fixed"]
    assert fixed == record["fixed"] and list(fixed) == ["damping", "friction_loss", "armature"]
    before = json.loads((done / "result.json").read_text())["parameters"]
    assert fixed["damping"] == 0.05 and fixed["armature"] == pytest.approx(before[3]["estimate"])
    assert run([*command, "--force", "--fix", "damp=1"]) == 2
    assert "--fix: no parameter 'damp' (did you mean 'damping'?)" in capsys.readouterr().err
    assert run([*command, "--force", "--fix", "damping=0.04", "--fix", "damping=0.05"]) == 2
    assert "'--fix': damping is given twice" in capsys.readouterr().err


@pytest.mark.slow
def test_results_do_not_depend_on_the_threads_of_linear_algebra(tmp_path: Path) -> None:
    """The residuals of a legged robot are so many that products of them are computed by several threads."""
    found = []
    for threads in ("1", "2"):
        out = tmp_path / threads
        command = [sys.executable, "-m", "amhe_cli", "identify", str(ROOT / "examples/logs/t1.mcap"), "-q"]
        command += ["--to", "3"]
        quick = [*QUICK[2:], "--set", "clips.count=1", "--set", "identify.iterations=1", "--max-time", "0.01"]
        subprocess.run(
            [*command, *quick, "--threads", "1", "-o", str(out)],
            env=os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": threads},
            check=True,
            capture_output=True,
        )
        found.append(json.loads((out / "result.json").read_text())["parameters"])
    assert found[0] == found[1]


SAID = """\
system = "mine"
[noise]
joints.position = 0.007
[priors]
load_mass = 0.7
damping = {nominal = 0.03, prior_sd = 0.2}
[settings]
clips.count = 7
"""


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """A table that names no system, beside a system folder and what belongs to both."""
    shutil.copytree(MODELS / "pendulum", tmp_path / "logs" / "mine")
    (tmp_path / "logs" / "amhe.toml").write_text(SAID)
    path = tmp_path / "logs" / "run1.csv"
    path.write_text("time,q\n0,0.1\n0.01,0.1\n")
    return path


def test_what_is_said_beside_the_logs_holds(log: Path) -> None:
    system = Inputs().open([log])
    assert system.folder is not None and system.folder.resolve() == log.with_name("mine").resolve()
    assert system.space.named(system.space.nominal)["load_mass"] == pytest.approx(0.7)
    assert {p.name: p.prior_sd for p in system.space.parameters}["damping"] == pytest.approx(0.2)
    assert system.settings.clips.count == 7
    (position,) = (one for one in system.channels if one.key == "joints.position")
    assert position.noise == pytest.approx(0.007)


def test_options_win_and_another_system_is_not_concerned(log: Path) -> None:
    system = Inputs(overrides=Overrides({}, {"clips": {"count": 3}})).open([log])
    assert system.settings.clips.count == 3
    other = Inputs(system="pendulum").open([log])
    assert other.settings.clips.count != 7
    assert Inputs(system=log.with_name("mine")).open([log]).settings.clips.count == 7


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("sytem = 1", "no key 'sytem' (did you mean 'system'?)"),
        ("system = ", "amhe.toml: "),
        ('system = "nowhere"', "no system 'nowhere'"),
        ('system = "mine"\n[priors]\nmass = 1', "mass"),
    ],
)
def test_a_mistake_in_it_is_one_line(log: Path, text: str, said: str, capsys) -> None:
    log.with_name("amhe.toml").write_text(text)
    assert run(["identify", str(log), "-o", "out"]) == 2
    assert said in capsys.readouterr().err


def test_logs_of_two_folders_are_refused(log: Path, tmp_path: Path) -> None:
    other = shutil.copy(log, tmp_path / "run2.csv")
    with pytest.raises(ConfigError, match="beside some of the logs only"):
        Inputs().open([log, Path(other)])


TRUNK = (0.03, -0.012, -0.045, 0.02, -0.035, 0.3)
BOX = (-0.05, 0.02, -0.15, 0.0, 0.01, -1.2)


def at(emulated: Emulated) -> list[str]:
    here = ["--host", "127.0.0.1", "--port", str(emulated.port)]
    eyes = ["--pose-host", "127.0.0.1", "--pose-port", str(emulated.mocap_port), "--set", f"go1.slow={SLOW}"]
    return [*here, *eyes, "--set", "go1.connect_time=5"]


def off(name: str, offset: tuple[float, ...]) -> list[str]:
    return ["--set", f"go1.{name}_offset=[{','.join(map(str, offset))}]"]


@pytest.mark.slow
@pytest.mark.realtime
def test_offsets_are_found_again_and_make_the_robot_fit_to_run(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("natnet")
    monkeypatch.setattr("amhe_cli.robots.go1.link.open._CYCLES", 20)
    with emulating("--set", f"go1.slow={SLOW}", *off("trunk", TRUNK), *off("box", BOX)) as emulated:
        look = ["calibrate", "--seconds", "0.8", "-o", "out"]
        command = [sys.executable, "-m", "amhe_cli", *look, *at(emulated)]
        pressed, nobody = (
            subprocess.run(
                [*command, *more], input=keys, text=True, capture_output=True, timeout=120,
                env={"PYTHONPATH": str(ROOT)},
            )
            for keys, more in (("\n\n", ()), ("", ("--force",)))
        )  # fmt: skip
        check = ["run", "--task", "t1", "--target", "go1", "--dry-run", *at(emulated)]
        assert run([*check, "--config", "out/offsets.yaml"]) == 0
        assert run(check) == 1, "without the offsets it is refused"
    assert pressed.returncode == 0, pressed.stderr
    assert pressed.stderr.count("then press Enter") == 2
    assert "its head along the x axis" in pressed.stderr
    assert (nobody.returncode, "give --yes" in nobody.stderr) == (2, True)
    assert pressed.stdout.startswith(Path("out/offsets.yaml").read_text())
    found = json.loads(Path("out/result.json").read_text())
    for name, true in (("trunk_offset", TRUNK), ("box_offset", BOX)):
        np.testing.assert_allclose(found[name][:3], true[:3], atol=0.001, err_msg=name)
        wrong = multiply(exp(-np.array(found[name][3:])), exp(np.array(true[3:])))
        assert 2.0 * np.arccos(min(1.0, abs(wrong[0]))) < np.deg2rad(0.3), name
    assert sorted(path.name for path in Path("out").iterdir()) == ["offsets.yaml", "result.json"]


@pytest.mark.slow
@pytest.mark.realtime
def test_what_cannot_be_is_refused(capfd) -> None:
    pytest.importorskip("natnet")
    with emulating("--set", f"go1.slow={SLOW}", "--fault", "yup=1") as emulated:
        assert run(["calibrate", "--yes", *at(emulated)]) == 1
    err = capfd.readouterr().err
    assert "up axis z" in err
    assert sum("error:" in line for line in err.splitlines()) == 1
    assert list(Path().glob("*/*/*")) == []
