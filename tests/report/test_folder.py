"""Results and their page: all or none, and no fault of the page costs a result."""

from __future__ import annotations

from pathlib import Path

import pytest

from amhe_cli.report.folder import results


def filled(folder: Path) -> dict[str, str]:
    return {path.name: path.read_text() for path in folder.iterdir()}


def test_old_results_keep_their_page_until_the_new_page_is_there(tmp_path: Path) -> None:
    """A SIGKILL while the page was made had left new results without a page."""
    old = {"result.json": "old", "report.html": "old"}
    for name, text in old.items():
        (tmp_path / name).write_text(text)
    seen: list[dict[str, str]] = []

    def page() -> str:
        seen.append({name: (tmp_path / name).read_text() for name in old})
        return "new"

    with results(tmp_path, page, force=True) as scratch:
        (scratch / "result.json").write_text("new")
    assert seen == [old]
    assert filled(tmp_path) == dict.fromkeys(old, "new")


def test_ctrl_c_while_the_page_is_made_keeps_the_results(tmp_path: Path) -> None:
    (tmp_path / "report.html").write_text("old")

    def page() -> str:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), results(tmp_path, page, force=True) as scratch:
        (scratch / "result.json").write_text("new")
    assert filled(tmp_path) == {"result.json": "new"}
