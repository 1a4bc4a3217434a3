"""How far a command is, in words."""

from __future__ import annotations

import pytest

from amhe_cli.cli import progress
from amhe_cli.estimation.core.result import Iteration


def test_a_search_is_told_in_plain_words() -> None:
    fitting = Iteration(5, "linearised", 1.0449, 0.1, 32, 0, (0.5,), "explore")
    assert progress.of_search((fitting, 16)) == ("fitting, 5 of about 16: cost 1.045", 5, 16)
    checking = Iteration(14, "search for a second minimum", 1.0, 0.1, 0, 0, (), "conclusion")
    assert progress.of_search((checking, 15))[0] == "checking, 14 of 15: is there a second solution?"


@pytest.mark.parametrize(
    ("done", "seconds", "text"),
    [(4, 10.0, "x; about 30 s left"), (1, 20.0, "x; about 5 min left"), (0, 5.0, "x"), (16, 5.0, "x")],
)
def test_the_time_left_goes_on_at_the_pace_so_far(
    monkeypatch: pytest.MonkeyPatch, done: int, seconds: float, text: str
) -> None:
    clock = iter([100.0, 100.0 + seconds])
    monkeypatch.setattr(progress.time, "monotonic", lambda: next(clock))
    assert progress._with_time_left(lambda item: ("x", item, 16))(done)[0] == text
