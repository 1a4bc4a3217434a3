"""Lines about a replay."""

from typing import Any

import pytest

from amhe_cli.report.replay import windows_line


@pytest.mark.parametrize(
    ("counts", "line"),
    [
        ((61, 2, 5, 0, 0), "61 windows used (2 jumps detected), 5 skipped (too little excitation)"),
        ((1, 1, 0, 0, 0), "1 window used (1 jump detected)"),
        ((0, 0, 0, 3, 0), "0 windows used, 3 skipped (a missing signal)"),
        (
            (9, 0, 4, 2, 1),
            "9 windows used, 7 skipped "
            "(4 with too little excitation, 2 with a missing signal, 1 with diverged rollouts)",
        ),
    ],
)
def test_used_and_skipped_windows_are_counted(counts: tuple[int, ...], line: str) -> None:
    record: dict[str, Any] = dict(zip(("updated", "jumps", "still", "gaps", "lost"), counts, strict=True))
    assert windows_line(record) == line
