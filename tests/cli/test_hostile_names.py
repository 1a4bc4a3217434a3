"""Names from files: shown as they are, never obeyed; and what a log may not choose."""

import json
import shutil
from pathlib import Path

import pytest
from click.shell_completion import CompletionItem

from amhe_cli.cli.main import run
from amhe_cli.core.errors import printable
from amhe_cli.logs import LogWriter
from amhe_cli.report.study.tables import StudyTable, markdown
from amhe_cli.web.page import template
from tests.conftest import MODELS, write_pendulum_log

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
    assert run(["view", str(log), "--save", str(tmp_path / "page.html")]) == 0
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
