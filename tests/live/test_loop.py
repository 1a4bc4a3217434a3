"""The loop that drives a run: what it warns of, and when."""

from __future__ import annotations

import logging
from types import SimpleNamespace
from unittest.mock import Mock

import pytest

from amhe_cli.core.errors import OperatorStopError
from amhe_cli.estimation.online.workers import Trouble
from amhe_cli.live.loop import drive
from amhe_cli.robots.go1.judge import History
from amhe_cli.robots.go1.run import RunOptions, open_run


class Troubled(History):
    """Counts the estimator's troubles, and nothing else of a cycle."""

    def add(self, cycle) -> dict[str, float]:
        self._estimated(cycle)
        return {}


def test_a_trouble_of_the_estimator_is_a_warning_at_once_and_counted_in_the_end(caplog) -> None:
    died = [Trouble(3.2, "the estimator died")]
    cycles = [SimpleNamespace(time=t, news=news, over=False) for t, news in enumerate([[], died, [], died])]
    seen: list[list[str]] = []

    def on_cycle(cycle, row) -> None:
        seen.append(list(caplog.messages))

    with caplog.at_level(logging.WARNING, "amhe_cli"):
        episode = Mock(cycles=lambda: iter(cycles), judge=Mock(verdict=(0, "")))
        drive(episode, Mock(), Troubled(Mock()), lambda: False, on_cycle)
    once = ["at 3.2 s the estimator died"]
    assert seen == [[], [], once, once]
    assert caplog.messages == [*once, "at 3.2 s the estimator died; 2 times"]


@pytest.mark.parametrize("stop", [OperatorStopError("key"), RuntimeError("broken")])
def test_a_stop_by_the_operator_is_an_interruption_and_no_error(stop: Exception) -> None:
    episode = Mock(cycles=Mock(side_effect=stop))
    ending = drive(episode, Mock(), Troubled(Mock()), lambda: False, Mock())
    operator = isinstance(stop, OperatorStopError)
    assert ending.interrupted == operator
    assert ending.error is (None if operator else stop)


def test_the_first_plan_makes_no_simulations(monkeypatch: pytest.MonkeyPatch) -> None:
    """It would take twice the time of the others, while a robot waits."""
    run = open_run(RunOptions("t1", duration=0.1))
    monkeypatch.setattr("mujoco.batch.Batch", None)
    assert next(run.episode.cycles()).plan.step is not None
