"""Completion by the shell's own mechanism: what it asks the command, and real bash where it is installed."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from amhe_cli.cli.main import amhe, run
from amhe_cli.cli.options import MODES, TASKS

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
    for name, command in amhe.commands.items():
        own = {option for param in command.params for option in param.opts if option.startswith("--")}
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
