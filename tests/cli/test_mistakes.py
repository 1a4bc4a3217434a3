"""A mistake of the user is one line, has its exit code, and leaves nothing behind, whatever the command."""

from __future__ import annotations

import shlex
import shutil
from pathlib import Path

import pytest

from amhe_cli.cli.main import run
from tests.cli.conftest import BELIEF, names
from tests.conftest import MODELS

#: The files that lie where the commands are run.
FILES = {
    "rubbish": "{]",
    "robot.xml": "<mujoco/>",
    "pendulum.xml": (MODELS / "pendulum" / "scene.xml").read_text(encoding="utf-8"),
    "other.yaml": BELIEF.format(system="pendulum", mass=5.5),
    "heavy.yaml": BELIEF.format(system="go1_push", mass=50.0),
}

IDENTIFY = [
    ("--engine abacus", "no engine 'abacus'; there is: cpu, gpu, auto"),
    ("--topic joints", "SIGNAL=/name"),
    ("--topic jonts=/x", "did you mean 'joints'"),
    ("--system pendulu", "did you mean 'pendulum'"),
    ("--set clips.cuont=4", "did you mean 'count'"),
    ("--set clips.count", "clips.count=32"),
    ("--from 5 --to 3", "not after"),
    ("--from -1", "from"),
    ("--threads 0", "threads"),
    ("--max-time 0", "max-time"),
    ("--checkpoint nowhere/search.npz", "no folder 'nowhere'"),
    ("--held-out {log}", "both fitted and held out"),
    ("--fix damping=1 --fix damping=2", "'--fix': damping is given twice"),
    ("--fix damp=1", "--fix: no parameter 'damp' (did you mean 'damping'?)"),
]
REPLAY = [
    ("--prior-weight mass=1", "did you mean 'load_mass'?"),
    ("--prior-weight load_mass", "NAME=W"),
    ("--prior-weight load_mass=-1", "a number of at least 0"),
    ("--set mhe.widow=1", "window"),
]
RUN = [
    ("--task t9", "t9"),
    ("", "--task"),
    ("--task t1 --mode stale", "no stale belief"),
    ("--task t1 --mode true --method logrank", "--method is for the online estimator"),
    ("--task t1 --duration 0", "--seconds"),
    ("--task t1 --duration nan", "nan is not a finite number"),
    ("--task t1 --engine abacus", "no engine 'abacus'; there is: cpu, gpu, auto"),
    ("--task t1 --belief nowhere.yaml", "nowhere.yaml"),
    ("--task t1 --mode baseline --belief rubbish", "rubbish"),
    ("--task t1 --mode baseline --belief other.yaml", "pendulum"),
    ("--task t1 --mode baseline --belief heavy.yaml", "50"),
    ("--task t1 --plant rubbish", "rubbish"),
    ("--task t1 --plant pendulum.xml", "joint"),
    ("--task t1 --set control.horizn=4", "did you mean 'horizon'"),
    ("--task t1 --set control.samples=1", "control.samples"),
    ("--task t1 --pose-port 5", "--pose-port is of a real robot"),
    ("--task t1 --dry-run", "--dry-run is of a real robot"),
]
ROBOT = [
    ("--mode true", "adaptive or baseline"),
    ("--plant robot.xml", "--plant is the robot of a simulation"),
    ("--host 192.0.2.1 --set go1.arm=auto", "for the emulator"),
    ("--host 192.0.2.1 --set go1.slow=2", "go1.slow is for the emulator"),
    ("--pose motioncapture", "vicon:"),
    ("--set go1.box=go1", "same name"),
    ("--set go1.trips.tilt=-1", "go1.trips.tilt"),
    ("--set go1.trips.tilt=3", "go1.trips.tilt"),
    ("--set go1.trips.state_age=1000", "go1.trips.state_age"),
    ("--set go1.damping=0.05", "go1.damping"),
    ("--set go1.kd=[2,3,0.06]", "go1.kd"),
]
EVAL = [
    ("--ablate sampels=8,16", "no parameter 'sampels' (did you mean 'samples'?); there is: "),
    ("--ablate control.sampels=8", "no key 'sampels' (did you mean 'samples'?); there is: elites"),
    ("--ablate samples", "write KEY=VALUE,VALUE"),
    ("--ablate samples=many", "samples is 'many'"),
    ("--tasks t9", "no task 't9'"),
    ("--modes truth", "no mode 'truth' (did you mean 'true'?)"),
    ("--tasks t1 --modes stale", "nothing to run"),
    ("--belief t1", "TASK=FILE"),
    ("--belief t1=nowhere.yaml", "no file 'nowhere.yaml'"),
    ("--report nowhere", "nowhere"),
    ("--resume", "-o OUT"),
    ("--engine abacus", "no engine 'abacus'; there is: cpu, gpu, auto"),
]
PROBE = [
    ("--for 1.5", "2 s"),
    ("--task t9", "t9"),
    ("--system cube_toss", "nothing to drive"),
    ("--system pendulum --for 0.2", "1 s"),
    ("--system pendulum --box 4 0.6", "--box: pendulum has none"),
    ("--system pendulum --task t4", "--task: pendulum has none"),
    ("--system pendulum --target go1 --dry-run --host 127.0.0.1", "leave out --system"),
    ("--system pendulum --plant {models}/cube_toss/scene.xml", "--plant {models}/cube_toss/scene.xml"),
    ("--system my_go1", "controller"),
    ("--belief other.yaml", "pendulum"),
    ("--target go1 --box 4 0.6", "--box: the box of a real"),
    ("--target go1 --plant robot.xml", "--plant is the robot of a simulation"),
    ("--box 0 0.6", "--box"),
    ("--host 192.0.2.1", "--host is of a real robot"),
    ("--chirp", "a recipe drives joints as they are: give the --system of its robot"),
]
OTHERS = [
    ("calibrate --host 192.0.2.1 --set go1.slow=2", "go1.slow is for the emulator"),
    ("emulate --fault los=1", "did you mean 'loss'"),
    ("emulate --set go1.box_offset=[1,2,3]", "go1.box_offset"),
    ("emulate --set go1.box_offset=[0,0,0,0,0,.nan]", "go1.box_offset"),
]
MISTAKES = [
    *((f"identify {{log}} {line}", text) for line, text in IDENTIFY),
    *((f"mhe-replay {{log}} {line}", text) for line, text in REPLAY),
    *((f"run {line}", text) for line, text in RUN),
    *((f"run --task t1 --target go1 {line}", text) for line, text in ROBOT),
    *((f"eval -q {line}", text) for line, text in EVAL),
    *((f"probe {line}", text) for line, text in PROBE),
    *OTHERS,
]


@pytest.mark.parametrize(("line", "message"), MISTAKES)
def test_a_mistake_is_one_line_and_leaves_nothing(
    line: str, message: str, pendulum_log: Path, capsys
) -> None:
    for name, content in FILES.items():
        Path(name).write_text(content)
    if "my_go1" in line:
        shutil.copytree(MODELS / "go1_push", "my_go1")
    before, places = names("."), {"log": pendulum_log, "models": MODELS}
    assert run(shlex.split(line.format(**places))) == 2
    (said,) = capsys.readouterr().err.splitlines()
    assert message.format(**places) in said
    assert names(".") == before


@pytest.mark.parametrize(
    ("line", "code", "message"),
    [
        ("identify {log} --topic joints=/nothing", 4, "/nothing"),
        ("identify rubbish.mcap --system pendulum", 4, "error: rubbish.mcap: "),
        ("mhe-replay {log} --topic joints=/nothing", 4, "no topic '/nothing'"),
        ("mhe-replay {log} --system go1_push", 4, "about pendulum, not go1_push"),
        ("mhe-replay {log} --to 0.004", 1, "no window"),
    ],
)
def test_a_log_that_cannot_be_used_is_one_line(
    line: str, code: int, message: str, pendulum_log: Path, capsys
) -> None:
    Path("rubbish.mcap").write_bytes(bytes(range(256)) * 40)
    assert run(shlex.split(line.format(log=pendulum_log))) == code
    (said,) = capsys.readouterr().err.splitlines()
    assert message in said
    assert names(".") == ["rubbish.mcap"]


def test_settings_of_the_environment_are_checked_too(pendulum_log: Path, monkeypatch, capsys) -> None:
    monkeypatch.setenv("AMHE_CLIPS__CUONT", "4")
    assert run(["identify", str(pendulum_log)]) == 2
    assert "did you mean 'count'" in capsys.readouterr().err
