"""`make results-report`: pages hold what the stored cells say."""

import importlib.util
from pathlib import Path

import pytest

from amhe_cli.study.cells import Cell
from amhe_cli.study.store import Study, start
from tests.study.cells_at_play import CODE, record

ROOT = Path(__file__).parents[2]


@pytest.fixture
def pages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The script, about a study and a page of its own."""
    spec = importlib.util.spec_from_file_location("make_results", ROOT / "docs" / "make_results.py")
    assert spec and spec.loader
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    monkeypatch.setattr(script, "STUDIES", tmp_path / "results")
    monkeypatch.setattr(script, "PAGE", tmp_path / "page.md")
    monkeypatch.setattr("amhe_cli.report.study.page.drawn", lambda *of: [])
    return script


def stored(folder: Path) -> None:
    machine = {"processor": "abacus", "cores": "2", "python": "3"}
    store = start(
        folder, Study(CODE, {}, (), 40.0, ("amhe eval -o x",), "2026-01-01T00:00:00", machine), False, False
    )
    for mode in ("true", "baseline"):
        for seed in range(2):
            cell = Cell("t4", mode, seed)
            store.write(cell, record({"cell": cell.plain(), "code": CODE}))


def test_blocks_are_filled_and_filled_again_the_same(pages, tmp_path: Path) -> None:
    stored(tmp_path / "results" / "main")
    (tmp_path / "page.md").write_text(
        "by hand\n<!-- results main/table1 -->\nold\n<!-- end -->\nbetween\n"
        "<!-- results main/made -->\n<!-- end -->\n<!-- results other/goals -->\nkept\n<!-- end -->\n"
    )
    pages.main()
    first = (tmp_path / "page.md").read_text()
    assert "| S_R [%] | 100 ± 0 | 0 ± 0 | 100 ± 0 |" in first
    assert "old" not in first
    assert all(text in first for text in ("by hand", "between", "kept", "amhe eval -o x", "processor abacus"))
    pages.main()
    assert (tmp_path / "page.md").read_text() == first


def test_goals_that_are_missed_are_picked(pages, tmp_path: Path) -> None:
    stored(tmp_path / "results" / "main")
    (tmp_path / "page.md").write_text("<!-- results main/missed -->\n<!-- end -->\n")
    pages.main()
    rows = (tmp_path / "results" / "main" / "tables" / "goals.md").read_text().splitlines()[4:]
    missed = [row for row in rows if "NO" in row]
    shown = (tmp_path / "page.md").read_text()
    assert f"{len(rows) - len(missed)} of {len(rows)} goals are reached" in shown
    assert [row for row in shown.splitlines() if row.startswith("| t4")] == missed


def test_a_block_that_cannot_be_filled_is_reported(pages, tmp_path: Path) -> None:
    stored(tmp_path / "results" / "main")
    (tmp_path / "page.md").write_text("<!-- results main/ablations -->\n<!-- end -->\n")
    with pytest.raises(SystemExit, match="makes no table 'ablations'"):
        pages.main()


def test_without_a_study_it_says_how_to_make_one(pages) -> None:
    with pytest.raises(SystemExit, match="amhe eval -o docs/results/main"):
        pages.main()


def test_the_blocks_of_the_real_page_are_well_formed(pages) -> None:
    text = (ROOT / "docs" / "results.md").read_text(encoding="utf-8")
    assert text.count("<!-- results ") == text.count("<!-- end -->") == len(pages.BLOCK.findall(text)) > 0
