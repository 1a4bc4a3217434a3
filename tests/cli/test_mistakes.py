"""Mistakes at the command line: values, names, settings."""

from __future__ import annotations

import json
import shlex
import shutil
from pathlib import Path

import pytest
from click.shell_completion import CompletionItem

from amhe_cli.cli.main import run
from amhe_cli.cli.settings import from_environment, gathered, parse_set
from amhe_cli.core.errors import ConfigError, printable
from amhe_cli.core.settings import Settings
from amhe_cli.logs import LogWriter
from amhe_cli.report.study.tables import StudyTable, markdown
from amhe_cli.robots.go1.settings import PushSettings
from amhe_cli.web.page import template
from tests.cli.conftest import BELIEF, names
from tests.conftest import MODELS, go1_system_with, write_pendulum_log

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
    ("--set control.samples=8", "--set control.samples: a setting of the robot go1, which the system pendul"),
    ("--from 5 --to 3", "not after"),
    ("--from -1", "from"),
    ("--threads 0", "threads"),
    ("--max-time 0", "max-time"),
    ("--checkpoint nowhere/search.npz", "no folder 'nowhere'"),
    ("--held-out {log}", "is fitted too; validation needs a log of its own"),
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
    ("--set control.nope=1", "setting control.nope: no key 'nope'"),
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


ESC = "\x1b]0;title\x07\x1b[31m"


@pytest.mark.parametrize(
    ("name", "shown"),
    [
        ("/arm[left]/state", "/arm[left]/state"),
        ("/a[/b]", "/a[/b]"),
        ("/a[bold]b", "/a[bold]b"),
        (f"/a{ESC}b", r"/a\x1b]0;title\x07\x1b[31mb"),
        ("/a\rusable\n/b", r"/a\rusable\n/b"),
        ("/a\u202eb\u2028", r"/a\u202eb\u2028"),
        ("/Stößel/力", "/Stößel/力"),
    ],
)
def test_a_name_in_a_log_is_shown_and_not_obeyed(tmp_path: Path, capsys, name: str, shown: str) -> None:
    with LogWriter(tmp_path / "log.mcap", {"place": name}) as log:
        for i in range(3):
            log.joint_state(name, 1_700_000_000_000_000_000 + i * 10**7, [f"hinge{name}"], [0.1])
    arguments = ["inspect", str(tmp_path / "log.mcap")]
    assert run(arguments) == 0
    out, err = capsys.readouterr()
    assert f"metadata: place = {shown}" in out and f"\n{shown} " in out
    assert f"of hinge{shown}" in " ".join(out.split())  # a narrow terminal wraps it
    assert run([*arguments, "--system", "pendulum"]) == 4, "not usable"
    out, more = capsys.readouterr()
    assert shown in "".join(line.strip() for line in out.splitlines())
    assert not set("\x1b\x07\r\u202e\u2028") & set(out + err + more)


def test_an_error_shows_a_name_and_does_not_obey_it(tmp_path: Path, capsys) -> None:
    with LogWriter(tmp_path / "log.mcap") as log:
        log.joint_state(f"/a{ESC}\nb", 1_700_000_000_000_000_000, ["hinge"], [0.1])
    assert run(["identify", str(tmp_path / "log.mcap"), "--system", "pendulum"]) == 4
    err = capsys.readouterr().err
    assert r"/a\x1b]0;title\x07\x1b[31m\nb" in err and "\x1b" not in err
    assert len(err.splitlines()) == 1


def test_pages_and_markdown_show_names_too() -> None:
    html = template("cells.html.j2").module.verdict(f"<b>{ESC}")
    assert r"&lt;b&gt;\x1b]0;" in html and "\x1b" not in html
    cell = "a|b\n<i>*x* [y](z) `c` _d_"
    text = markdown(StudyTable("t", "x_y [m]", ("head",), [(cell,)], []))
    assert r"| a\|b\\n\<i>\*x\* [y]\(z) \`c\` \_d\_ |" in text
    assert "**x_y [m]**" in text


def test_printable_keeps_what_can_be_seen() -> None:
    assert printable("5 ± 2 µm, — ≤ 3") == "5 ± 2 µm, — ≤ 3"
    assert printable("a\n\x1b", keep="\n") == "a\n\\x1b"


@pytest.fixture
def own_system(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a system, which is the current one."""
    shutil.copytree(MODELS / "pendulum", tmp_path / "own")
    monkeypatch.chdir(tmp_path)
    return tmp_path / "own"


@pytest.mark.parametrize("way", ["own", "./own", "own/system.yaml", "absolute", "models/../own"])
def test_a_log_chooses_no_folder(own_system: Path, way: str, tmp_path: Path, capsys) -> None:
    name = str(own_system) if way == "absolute" else way
    log = write_pendulum_log(tmp_path / "log.mcap", 0.2, system=name)
    assert run(["inspect", str(log)]) == 0
    out, err = capsys.readouterr()
    assert "for system" not in out
    assert repr(name) in err
    for command in (["identify", "-o", "out"], ["mhe-replay", "-o", "out"]):
        assert run([command[0], str(log), *command[1:]]) == 2, command
        err = capsys.readouterr().err
        assert repr(name) in err and "give its folder with --system DIR" in err
    assert run(["inspect", str(log), "--system", "own"]) == 0


def test_a_log_chooses_no_model(tmp_path: Path, capsys) -> None:
    (tmp_path / "mine.xml").write_text("<mujoco/>")
    stated = json.dumps({"model": str(tmp_path / "mine.xml"), "clips": {"count": 4}})
    log = write_pendulum_log(tmp_path / "log.mcap", 3.0, system="pendulum", overrides=stated)
    assert run(["inspect", str(log), "--system", "pendulum"]) == 0
    capsys.readouterr()
    assert run(["view", str(log), "--out", str(tmp_path / "page.html")]) == 0
    assert "mine.xml" not in capsys.readouterr().err


def test_completion_opens_no_folder_that_a_log_names(own_system: Path, tmp_path: Path) -> None:
    import click

    from amhe_cli.cli.completion import parameters

    log = write_pendulum_log(tmp_path / "log.mcap", 0.1, system="own")
    context = click.Context(click.Command("identify"))
    context.args = [str(log)]
    offered: list[CompletionItem] = parameters()(context, click.Option(["--fix"]), "")
    assert offered == []
    context.params = {"system": "own"}
    assert "load_mass" in {item.value for item in parameters()(context, click.Option(["--fix"]), "")}


LOGS = MODELS.parent / "examples" / "logs"


def test_options_are_nested_and_typed() -> None:
    options = [
        "clips.count=8",
        "clips.length=[0.3, 1e-1]",
        "logs.align=true",
        "signals.cube.topic=/x",
        "clips.count=9",
    ]
    assert parse_set(options) == {
        "clips": {"count": 9, "length": [0.3, 0.1]},
        "logs": {"align": True},
        "signals": {"cube": {"topic": "/x"}},
    }


@pytest.mark.parametrize(
    ("option", "text"),
    [*((one, "write KEY=VALUE") for one in ("clips.count", "=3", ".a=3", "a..b=3")),
     ("clips.length=[1, 2", "is not a value")],
)  # fmt: skip
def test_what_is_no_assignment_is_refused(option: str, text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        parse_set([option])


def test_environment_variables_have_two_underscores_between_levels() -> None:
    environment = {
        "AMHE_CLIPS__HELD_OUT_LENGTH": "0.4",
        "AMHE_PARAMETERS__load_mass__NOMINAL": "2",
        "AMHE_PARAMETERS__MASS__NOMINAL": "3",
        "AMHE_THREADS": "4",
        "HOME": "/home",
    }
    assert from_environment(environment) == {
        "clips": {"held_out_length": 0.4},
        "parameters": {"load_mass": {"nominal": 2}, "mass": {"nominal": 3}},
    }


def test_a_file_is_read_with_the_same_care(tmp_path: Path) -> None:
    path = tmp_path / "config.yaml"
    path.write_text("clips: {count: 3}\n")
    assert gathered(path, {}, []).shared == {"clips": {"count": 3}}
    path.write_text("clips: {count: 3, count: 4}\n")
    with pytest.raises(ConfigError, match="here twice"):
        gathered(path, {}, [])


def test_shared_settings_of_a_robot_do_not_reach_a_system_without_it(tmp_path: Path) -> None:
    file = tmp_path / "config.yaml"
    file.write_text("control: {samples: 8}\ngo1: {kp: 20}\nclips: {count: 3}\n")
    given = gathered(file, {"AMHE_CONTROL__HORIZON": "9", "AMHE_CLIPS__COUNT": "4"}, ["mhe.window=1"])
    common = {"clips": {"count": 4}, "mhe": {"window": 1}}
    assert given.suited(MODELS / "pendulum") == (common, Settings)
    robots = {"control": {"samples": 8, "horizon": 9}, "go1": {"kp": 20}}
    assert given.suited(MODELS / "go1_push") == (common | robots, PushSettings)


def test_a_log_states_the_weakest_settings() -> None:
    given = gathered(None, {"AMHE_CLIPS__COUNT": "4"}, [])
    settings, _ = given.suited(MODELS / "pendulum", {"clips": {"count": 1, "still": 2}})
    assert settings == {"clips": {"count": 4, "still": 2}}


@pytest.mark.parametrize("command", ["identify", "probe"])
def test_misspelt_settings_of_a_robot_in_its_file_have_their_place(
    command: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    folder = tmp_path / "mine"
    row = go1_system_with("  control: {nope: 3}", folder)
    log = [] if command == "probe" else [str(LOGS / "t1.mcap")]
    assert run([command, *log, "--system", str(folder), "-o", str(tmp_path / "out")]) == 2
    # a long line is broken where it is shown
    assert f"system.yaml:{row}:13: no key 'nope'" in capsys.readouterr().err
