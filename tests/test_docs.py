"""README and docs: short enough, and what they link to or name exists."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path

import pytest

from amhe_cli.core.limits import Limits
from amhe_cli.estimation.core.result import VERDICTS
from tests.test_architecture import ALLOWED

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")] + sorted(
    (ROOT / "docs").rglob("*.md")
)
LINK = re.compile(r"\]\((?!https?:)([^)#]*)(?:#([^)]*))?\)")


def test_the_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text(encoding="utf-8")) < 9_000


def test_the_page_of_verdicts_gives_them_the_meanings_that_reports_give() -> None:
    text = (ROOT / "docs" / "verdicts.md").read_text(encoding="utf-8").partition("| rule |")[0]
    assert dict(re.findall(r"^\| `([\w-]+)` \| (.+) \|$", text, re.MULTILINE)) == VERDICTS


@pytest.mark.parametrize("page", ["README.md", "docs/ARCHITECTURE.md"])
def test_the_library_is_linked(page: str) -> None:
    links = {path for path, _ in LINK.findall((ROOT / page).read_text(encoding="utf-8"))}
    targets = {((ROOT / page).parent / path).resolve().relative_to(ROOT).as_posix() for path in links if path}
    assert {"docs/api.md", "examples/identify_arrays.py", "examples/notebook.ipynb"} <= targets


def anchor(heading: str) -> str:
    """The fragment that GitHub gives a heading."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    for path, fragment in LINK.findall(page.read_text(encoding="utf-8")):
        target = page.parent / path if path else page
        assert target.exists(), path
        if fragment:
            headings = re.findall(r"^#+ (.*)$", target.read_text(encoding="utf-8"), re.MULTILINE)
            assert fragment in map(anchor, headings), f"{path}#{fragment}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_named_modules_exist(page: Path) -> None:
    for name in set(re.findall(r"`([\w./]+\.py)`", page.read_text(encoding="utf-8"))):
        assert (ROOT / "amhe_cli" / name).exists() or (ROOT / name).exists(), name


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_no_conflict_is_left(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert [line for line in text.splitlines() if re.match(r"^(<{7}|={7}|>{7})( |$)", line)] == []


def test_the_table_of_limits_has_their_defaults() -> None:
    text = (ROOT / "docs" / "security.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(\w+)` \| .* \| ([\d,]+) \| .* \|$", text, re.MULTILINE)
    assert {name: int(value.replace(",", "")) for name, value in rows} == asdict(Limits())


def test_every_room_is_described() -> None:
    text = (ROOT / "docs" / "ARCHITECTURE.md").read_text(encoding="utf-8")
    assert [room for room in ALLOWED if f"| `{room}/` |" not in text] == []


@pytest.mark.medium
def test_the_site_holds_every_page_and_its_links_lead_somewhere(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(tmp_path)]
    done = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, env=os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    )
    assert done.returncode == 0, done.stderr
    pages = {page.stem for page in (ROOT / "docs").glob("*.md")} | {"index"}
    assert pages <= {page.stem for page in tmp_path.glob("*.html")}
    listed = re.findall(r": (\w+)\.md$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.MULTILINE)
    assert sorted(listed) == sorted(pages), "each page stands in the site's contents"
