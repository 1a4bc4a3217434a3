"""Every kind of reason, and every warning, has an entry in docs/troubleshooting.md, which help prints."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from amhe_cli.cli.advice import entries, entry_of
from amhe_cli.cli.main import amhe, run

ROOT = Path(__file__).parents[1]


def test_every_kind_of_reason_has_an_entry() -> None:
    code = (ROOT / "amhe_cli" / "estimation" / "uncertainty" / "verdicts.py").read_text()
    kinds = set(re.findall(r'Reason\(\s*"(\w+)"', code)) | {"assumed", "parts", "minimum"}
    texts = re.search(r"_TEXTS = \{(.*?)\n\}", code, re.DOTALL)
    assert texts is not None
    kinds |= set(re.findall(r'^    "(\w+)":', texts[1], re.MULTILINE))
    assert kinds >= {"bound", "misfit", "idle", "open", "together", "search"}
    assert kinds - entries().keys() == set()


def literal(node: ast.expr) -> str | None:
    """A text with 'x' for what is filled in; None: it is not written here."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return re.sub(r"%[-+.\w]*?[a-z]", "x", node.value)
    if isinstance(node, ast.JoinedStr):
        return "".join(str(one.value) if isinstance(one, ast.Constant) else "x" for one in node.values)
    return None


def warnings() -> Iterator[tuple[str, str]]:
    """Place and text of each warning of the library."""
    for path in sorted((ROOT / "amhe_cli").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and getattr(node.func, "attr", "") == "warning":
                text = literal(node.args[0])
                if text is not None and text.replace("x", "").strip(" :'"):
                    yield (
                        f"{path.name}:{node.lineno}",
                        text.replace("topic x", "topic 'x'").replace("signal x", "signal 'x'"),
                    )


def test_every_warning_has_an_entry() -> None:
    found = dict(warnings())
    assert len(found) > 40
    assert {place: text for place, text in found.items() if entry_of(text) is None} == {}


def test_a_message_names_its_entry_and_help_prints_it(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    log = tmp_path / "run.csv"
    log.write_text("time,q\n0,1\n0.1,2\n")
    assert run(["identify", str(log), "-o", str(tmp_path / "out")]) == 2
    assert capsys.readouterr().err.endswith("(amhe help no-system)\n")
    assert run(["help", "no-system"]) == 0
    assert "amhe init" in capsys.readouterr().out
    assert not entries().keys() & amhe.commands.keys(), "a command's name would hide the entry"
