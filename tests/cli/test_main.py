"""The command line as a whole: help, versions, wording, completion, options and progress."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import click
import pytest

from amhe_cli import __version__
from amhe_cli.cli import main as entry
from amhe_cli.cli import options
from amhe_cli.cli.command import Given, command, flag, options_of
from amhe_cli.cli.main import GROUPS, amhe, run
from amhe_cli.cli.options import MODES, TASKS
from amhe_cli.cli.progress import progress
from amhe_cli.cli.session import Session, in_options
from amhe_cli.core.errors import AmheError, ConfigError, EstimationError, LogError
from docs.make_cli_docs import FILE, document

HEAVY = ("cmaes", "jinja2", "matplotlib", "mcap", "mujoco", "numpy", "pydantic", "rich", "rosbags", "yaml")


def raising(error: BaseException):
    @command("t")
    def trial(session: Session, given: Given) -> None:
        raise error

    return trial


@pytest.fixture
def trial(monkeypatch: pytest.MonkeyPatch):
    """Run a command `trial` that raises an error; gives the exit code."""

    def run(error: BaseException, *arguments: str) -> int:
        monkeypatch.setitem(entry.amhe.commands, "trial", raising(error))
        return entry.run(["trial", *arguments])

    return run


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (AmheError("what"), 1),
        (EstimationError("what"), 1),
        (ConfigError("what"), 2),
        (click.UsageError("what"), 2),
        (LogError("what"), 4),
    ],
)
def test_an_expected_error_is_one_line_and_its_code(trial, capsys, error, code) -> None:
    assert trial(error) == code
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("amhe trial: error: what")
    assert len(err.splitlines()) == 1


def test_an_error_of_several_mistakes_gives_each_its_line(trial, capsys) -> None:
    assert trial(ConfigError("system.yaml:3:1: this\nsystem.yaml:9:4: that")) == 2
    assert capsys.readouterr().err.splitlines() == [
        "amhe trial: error: system.yaml:3:1: this",
        "  system.yaml:9:4: that",
    ]


def test_a_bug_shows_its_traceback_and_says_that_it_is_one(trial, capsys) -> None:
    assert trial(ZeroDivisionError("oh")) == 1
    err = capsys.readouterr().err
    assert "Traceback" in err
    assert "bug in amhe" in err.splitlines()[-1]


def test_a_full_disk_is_no_bug(trial, capsys) -> None:
    assert trial(OSError(28, "No space left on device", "out/report.html")) == 1
    assert capsys.readouterr().err == "amhe trial: error: out/report.html: No space left on device\n"


@pytest.mark.usefixtures("hangs_up")
@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 143)]
)
@pytest.mark.parametrize("writes", [True, False])
def test_an_interrupted_command_has_the_code_of_its_signal(monkeypatch, capsys, number, code, writes) -> None:
    @command("t", options.output if writes else ())
    def trial(session: Session, given: Given) -> None:
        signal.raise_signal(number)

    monkeypatch.setitem(entry.amhe.commands, "trial", trial)
    assert entry.run(["trial"]) == code
    said = "interrupted; nothing was written" if writes else "interrupted"
    assert capsys.readouterr().err.strip() == f"amhe trial: {said}"


def test_an_interruption_after_results_were_written_says_where_they_are(
    monkeypatch, capsys, tmp_path
) -> None:
    (tmp_path / "result.json").write_text("{}")
    os.utime(tmp_path / "result.json", (0, 0))  # of an earlier command

    @command("t", flag("--late", "Write it."), options.output)
    def trial(session: Session, given: Given) -> None:
        folder = given.reserve()
        if given.late:
            (folder / "result.json").write_text("{}")
        raise KeyboardInterrupt

    monkeypatch.setitem(entry.amhe.commands, "trial", trial)
    for more, lost in (([], "nothing was written"), (["--late"], f"the results are in {tmp_path}")):
        assert entry.run(["trial", "-o", str(tmp_path), "--force", *more]) == 130
        assert capsys.readouterr().err.strip() == f"amhe trial: interrupted; {lost}"


def test_a_signal_as_of_a_closed_terminal_silences_no_open_one(monkeypatch) -> None:
    keys, terminal = os.openpty()
    with os.fdopen(keys, "rb", 0) as screen, os.fdopen(terminal, "w") as stderr:
        monkeypatch.setattr(sys, "stderr", stderr)
        session = Session()
        session.terminate()
        session.say("", "still here")
        assert screen.read(100) == b"amhe: still here\r\n"
        screen.close()
        session.terminate()
        session.say("", "nobody reads it")
        assert os.fstat(terminal).st_rdev == Path(os.devnull).stat().st_rdev


def test_a_command_that_ignores_the_end_of_its_terminal_goes_on(monkeypatch, capsys) -> None:
    """As nohup has it."""

    @command("t")
    def trial(session: Session, given: Given) -> None:
        signal.raise_signal(signal.SIGHUP)

    monkeypatch.setitem(entry.amhe.commands, "trial", trial)
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        assert entry.run(["trial"]) == 0
    finally:
        signal.signal(signal.SIGHUP, before)


def logging_command(*messages: str):
    @command("t")
    def trial(session: Session, given: Given) -> None:
        import logging

        for message in messages:
            logging.getLogger("amhe_cli.somewhere").warning(message)
        print(len(session.warnings))

    return trial


@pytest.mark.parametrize(
    ("arguments", "code"), [(["trial"], 0), (["trial", "--strict"], 3), (["--strict", "trial"], 3)]
)
def test_strict_makes_a_warning_an_exit_code(monkeypatch, capsys, arguments, code) -> None:
    monkeypatch.setitem(entry.amhe.commands, "trial", logging_command("a gap", "a gap", "a jump"))
    assert entry.run(arguments) == code
    out, err = capsys.readouterr()
    assert out == "2\n"
    assert err.splitlines() == ["amhe trial: warning: a gap", "amhe trial: warning: a jump"]


def test_strict_without_warnings_is_done(monkeypatch) -> None:
    monkeypatch.setitem(entry.amhe.commands, "trial", logging_command())
    assert entry.run(["trial", "--strict"]) == 0


def test_an_unknown_option_names_the_nearest(capsys) -> None:
    assert entry.run(["identify", "--sede", "3"]) == 2
    err = capsys.readouterr().err
    assert err.startswith("amhe identify: error:")
    assert "--seed" in err


NO_PATHS = {"emulate", "calibrate", "drives", "help", "examples", "systems", "completion"}


@pytest.mark.parametrize("command", sorted(set(entry.amhe.commands) - NO_PATHS))
def test_a_path_that_does_not_exist_is_a_usage_error(command, capsys, tmp_path) -> None:
    task = ["--task", "t1", "--belief"]
    option = {
        "run": task,
        "eval": ["--report"],
        "probe": ["--belief"],
        "compare": ["pendulum", "--logs"],
        "watch": ["--source", "-", "--belief"],
        "record": ["--source", "-", "--msg-path"],
    }.get(command, [])
    assert entry.run([command, *option, str(tmp_path / "nothing.mcap")]) == 2
    assert "does not exist" in capsys.readouterr().err


def test_version_and_help(capsys) -> None:
    assert entry.run(["--version"]) == 0
    assert entry.run(["identify", "--version"]) == 0
    assert capsys.readouterr().out == f"amhe {__version__}\n" * 2
    assert entry.run([]) == 2


@pytest.mark.parametrize("command", sorted(entry.amhe.commands))
def test_every_command_says_what_it_is(command) -> None:
    found = entry.amhe.commands[command]
    assert found.help and found.short_help
    assert [one.name for one in found.params if isinstance(one, click.Option) and not one.help] == []


def test_the_documented_help_is_the_real_one() -> None:
    """Run `make docs` when this fails; white space may differ between versions of click."""
    assert FILE.read_text(encoding="utf-8").split() == document().split()


def test_nothing_heavy_is_loaded_for_help() -> None:
    code = f"import sys, amhe_cli.cli.main; print([m for m in {HEAVY!r} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_a_signal_after_the_end_changes_nothing_and_garbage_is_not_searched_for() -> None:
    """Of the command by its module; what has been imported stays to the end."""
    code = (
        "import atexit, gc, runpy, signal, sys; sys.argv[1:] = ['--help'];"
        "atexit.register(lambda: [signal.raise_signal(n) for n in (signal.SIGINT, signal.SIGTERM)]);"
        "atexit.register(lambda: print(gc.get_threshold(), gc.get_freeze_count() > 1000));"
        "runpy.run_module('amhe_cli', run_name='__main__')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert "identify" in done.stdout and done.stdout.splitlines()[-1] == "(700, 10, 100) True"


@pytest.mark.parametrize(
    ("option", "kind"), [("--from", "number"), ("--max-time", "number"), ("--seed", "whole number")]
)
def test_what_is_no_number_is_reported_in_plain_words(option, kind, capsys, tmp_path) -> None:
    assert entry.run(["identify", str(tmp_path), option, "abc"]) == 2
    assert f"'abc' is not a valid {kind}" in capsys.readouterr().err


def test_a_narrow_terminal_cuts_the_state_and_keeps_bar_and_time(monkeypatch, capsys) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("COLUMNS", "80")
    words = "12.3 s of 20 s, " + 10 * "the box is 1.2 m from its goal, "

    def shown(done: float) -> tuple[str, float, float]:
        return words, done, 20.0

    with progress(Session(), "run", shown, stays=True) as show:
        show(5.0)
    lines = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", capsys.readouterr().err).strip().splitlines()
    assert re.match(r"run \S+ 0:00:0\d 12\.3 s of 20 s, the box.*…", lines[-1])
    assert max(map(len, lines)) <= 80


@pytest.mark.medium
@pytest.mark.parametrize("closed", [">&-", "2>&-", ">&- 2>&- <&-"])
def test_closed_streams_end_no_command(closed: str, pendulum_log: Path, tmp_path: Path) -> None:
    command = f"{sys.executable} -m amhe_cli convert {pendulum_log} -o {tmp_path}/out.csv {closed}"
    done = subprocess.run(["sh", "-c", command], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    text = (tmp_path / "out.csv").read_text()
    assert "time [s]" in text and "wrote" not in text


SHOWN = [
    ("identify", "`held_out`: a.mcap is fitted too", "--held-out: a.mcap is fitted too"),
    ("identify", "`end`: 1 is not after `start` 2", "--to: 1 is not after --from 2"),
    ("identify", "`logs`: there is none", "LOG: there is none"),
    ("identify", "correct it with `logs.align=true`", "correct it with --set logs.align=true"),
    ("identify", "give it more with `identify.iterations`", "give it more with --set identify.iterations"),
    ("run", "or use `mode=baseline`", "or use --mode baseline"),
    ("run", "both need the same `go1.slow`", "both need the same --set go1.slow"),
    ("pool", "give `force=True` to write into it", "give --force to write into it"),
    ("pool", "give `out`", "give -o"),
    ("init", "`meshes=False` to do without", "--no-meshes to do without"),
    ("export", "`to`: one of urdf, mjcf", "--to: one of urdf, mjcf"),
    ("inspect", "call it `time`, or `time [ms]`; see `amhe inspect`", None),
    ("inspect", "give more with `logs.align`", None),
    ("identify", "`motors.q` is a field", None),
    ("pool", "`held_out` is of another command", None),
]


@pytest.mark.parametrize(("command", "text", "shown"), SHOWN)
def test_arguments_become_options_of_the_command(command: str, text: str, shown: str | None) -> None:
    assert in_options(text, options_of(amhe.commands[command])) == (text if shown is None else shown)


#: Options of a command beyond those that many commands share.
MOST = 16


def options_in(command: click.Command) -> set[str]:
    """Names of the arguments that a command's options give; four flags of one choice count once."""
    return {str(param.name) for param in command.params if isinstance(param, click.Option)}


SHARED = options_in(
    command("t", options.where, options.narrowing, options.work, options.tuning, options.output)(
        lambda session, given: None
    )
)


@pytest.mark.parametrize("name", amhe.commands)
def test_a_command_has_at_most_16_options_of_its_own(name: str) -> None:
    assert len(options_in(amhe.commands[name]) - SHARED) <= MOST, "make the rarest a setting"


@pytest.mark.parametrize("name", amhe.commands)
def test_what_a_command_writes_is_named_by_o(name: str) -> None:
    options = {option for param in amhe.commands[name].params for option in param.opts}
    assert "--force" not in options or "-o" in options


@pytest.mark.parametrize("former", ["--for", "--duration"])
def test_a_length_is_in_seconds_by_any_of_its_names(former: str, capsys) -> None:
    assert run(["run", "--task", "t1", former, "x"]) == run(["run", "--task", "t1", "--seconds=x"]) == 2
    assert len(set(capsys.readouterr().err.splitlines())) == 1


def test_help_has_panels_and_one_line_of_what_is_common(capsys) -> None:
    assert run(["help", "identify"]) == 0
    shown = capsys.readouterr().out
    assert run(["identify", "--help"]) == 0
    assert capsys.readouterr().out == shown
    panels = [line.rstrip(":") for line in shown.splitlines() if line.endswith(":") and line[0] != " "]
    assert panels == ["Logs and system", "What is known", "Options", "Computing", "Settings", "Output"]
    assert sum("--strict" in line for line in shown.splitlines()) == 1
    assert run(["help", "identfy"]) == 2
    assert "did you mean 'identify'" in capsys.readouterr().err


def test_what_comes_with_amhe_is_listed(capsys) -> None:
    from amhe_cli.core.bundled import bundled_logs
    from amhe_cli.system.description.folders import bundled_systems

    assert run(["examples"]) == run(["systems"]) == 0
    lines = capsys.readouterr().out.splitlines()
    for name in bundled_logs():
        (line,) = (line for line in lines if line.startswith(f"example:{name} "))
        assert len(line.split()) > 3, "it says what the log is"
    assert {line.split()[0] for line in lines} >= set(bundled_systems())


def test_help_lists_each_command_once_in_a_group(capsys) -> None:
    assert run(["--help"]) == 0
    lines = capsys.readouterr().out.splitlines()
    named = [line.split()[0] for line in lines[lines.index("Start:") :] if line.startswith("  ")]
    assert sorted(named) == sorted(amhe.commands)
    assert [line.rstrip(":") for line in lines if line.rstrip(":") in GROUPS] == list(GROUPS)


ROOT = Path(__file__).parents[2]


def offered(capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, *words: str) -> set[str]:
    """What bash is given for the last of these words."""
    monkeypatch.setenv("COMP_WORDS", " ".join(("amhe", *words)))
    monkeypatch.setenv("COMP_CWORD", str(len(words)))
    monkeypatch.setenv("_AMHE_COMPLETE", "bash_complete")
    with pytest.raises(SystemExit):
        run([])
    lines = filter(None, capfd.readouterr().out.splitlines())
    return {
        value if kind == "plain" else f"<{kind}>"
        for kind, _, value in (line.partition(",") for line in lines)
    }


#: Names of the bundled logs.
EXAMPLES = {path.stem for path in (ROOT / "examples" / "logs").iterdir() if path.suffix in (".mcap", ".csv")}


@pytest.mark.parametrize(
    ("words", "answers"),
    [
        (["ide"], {"identify"}),
        (["identify", "--max"], {"--max-time"}),
        (["identify", "x"], {"<file>"}),
        (["identify", "exa"], {f"example:{name}" for name in EXAMPLES}),
        (["identify", "example:pen"], {"example:pendulum"}),
        (["identify", "--system", "pen"], {"<dir>", "pendulum"}),
        (["identify", "--system", "arms/r"], {"<dir>", "arms/right"}),
        (["identify", "example:t1", "--system", "cu"], {"<dir>", "cube_toss"}),
        (["run", "--task", ""], set(TASKS)),
        (["run", "--mode", "a"], {"adaptive"}),
        (["run", "--target", "g"], {"go1"}),
        (["eval", "--tasks", "t1,h"], {"t1,hw1", "t1,hw2"}),
        (["eval", "--modes", ""], set(MODES)),
        (["mhe-replay", "--prior-weight", "box"], {"box_mass=", "box_inertia_scale="}),
        (["identify", "x.mcap", "--system", "pendulum", "--fix", "load"], {"load_mass="}),
        (["identify", "--system", "pendulum", "--only", "load_mass,a"], {"load_mass,armature"}),
        (["convert", "x.mcap", "--each", ""], {"csv", "npz", "folder"}),
        (["mhe-replay", "--system", "arms/right", "--prior-weight", ""], {"grip="}),
        (["mhe-replay", "example:pendulum", "--prior-weight", "load"], {"load_mass="}),
        (["mhe-replay", "--system", "nowhere", "--prior-weight", ""], set()),
    ],
)
def test_what_is_offered(
    words: list[str], answers: set[str], tmp_path: Path, capfd, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "arms" / "right").mkdir(parents=True)
    (tmp_path / "arms" / "right" / "system.yaml").write_text("parameters: {grip: {targets: []}}\n")
    (tmp_path / "arms" / "rough").mkdir()
    monkeypatch.chdir(tmp_path)
    assert offered(capfd, monkeypatch, *words) == answers


def test_every_command_offers_its_options(capfd, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, offering in amhe.commands.items():
        own = {option for param in offering.params for option in param.opts if option.startswith("--")}
        assert own <= offered(capfd, monkeypatch, name, "--"), name


def test_the_answer_is_quick_because_nothing_heavy_is_imported() -> None:
    words = ("amhe", "mhe-replay", "--system", "pendulum", "--prior-weight", "load")
    environment = {"COMP_WORDS": " ".join(words), "COMP_CWORD": "5", "_AMHE_COMPLETE": "bash_complete"}
    done = subprocess.run(
        [sys.executable, "-X", "importtime", "-m", "amhe_cli"],
        env=os.environ | environment | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout == "plain,load_mass=\n"
    imported = {line.rpartition("|")[2].strip().split(".")[0] for line in done.stderr.splitlines()}
    assert not imported & {"numpy", "mujoco", "pydantic", "matplotlib", "rich"}


@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_other_shells_are_answered_too(shell: str, capfd, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COMP_WORDS", "amhe inspect")
    monkeypatch.setenv("COMP_CWORD", "2" if shell == "zsh" else "example:pen")
    monkeypatch.setenv("_AMHE_COMPLETE", f"{shell}_complete")
    if shell == "zsh":
        monkeypatch.setenv("COMP_WORDS", "amhe inspect example:pen")
    with pytest.raises(SystemExit):
        run([])
    assert "example:pendulum" in capfd.readouterr().out


def test_the_scripts_are_those_of_the_mechanism_and_documented(capsys) -> None:
    page = (ROOT / "docs" / "cli.md").read_text(encoding="utf-8")
    for shell in ("bash", "zsh", "fish"):
        assert f"amhe completion {shell}" in page
        assert run(["completion", shell]) == 0
        assert f"_AMHE_COMPLETE={shell}_complete" in capsys.readouterr().out


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
def test_bash_itself_completes(tmp_path: Path) -> None:
    (tmp_path / "amhe").write_text(f'#!/bin/sh\nexec {sys.executable} -m amhe_cli "$@"\n')
    (tmp_path / "amhe").chmod(0o755)
    script = """
        source <(amhe completion bash)
        COMP_WORDS=(amhe identify --max); COMP_CWORD=2
        _amhe_completion amhe
        echo "${COMPREPLY[*]}"
        complete -p amhe
    """
    environment = os.environ | {"PATH": f"{tmp_path}:{os.environ['PATH']}", "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        ["bash", "--norc", "-c", script], env=environment, capture_output=True, text=True, check=False
    )
    assert done.stdout.splitlines()[0] == "--max-time", done.stderr
    assert "-F _amhe_completion amhe" in done.stdout
