"""A limited time is divided between a search and its conclusion; the clock is made by hand."""

from __future__ import annotations

import pytest

from amhe_cli.estimation.core.result import Iteration
from amhe_cli.estimation.offline import watch as module
from amhe_cli.estimation.offline.watch import Watch


class Clock:
    """A clock that the test moves."""

    def __init__(self) -> None:
        self.now = 100.0

    def monotonic(self) -> float:
        """Stands for `time.monotonic`."""
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    made = Clock()
    monkeypatch.setattr(module, "time", made)
    return made


def iteration(number: int) -> Iteration:
    return Iteration(number, "linearised, polish", 1.0, 0.1, 200, 0, (1.0,))


def test_the_search_stops_while_there_is_time_for_the_conclusion(clock) -> None:
    watch = Watch(lambda *_: None, 40.0, 6)
    watch.keep(600)
    done = 0
    while not watch.stopped:
        clock.now += 4.0  # an iteration of 200 rollouts takes 4 s, the conclusion of 600 takes 12 s
        done += 1
        watch.saw(iteration(done), 16)
    assert done == 7, "28 s of search, 12 s of conclusion"


def test_an_iteration_that_would_take_the_time_of_the_conclusion_is_not_begun(clock) -> None:
    watch = Watch(lambda *_: None, 20.0, 6)
    watch.keep(600)
    clock.now += 3.0  # a busy machine: an iteration takes 3 s, the conclusion 9 s
    watch.saw(iteration(1), 16)
    assert not watch.stopped
    clock.now += 6.0  # and twice as long the next time: 11 s are left, and 18 s are wanted
    watch.saw(iteration(2), 16)
    assert watch.stopped
    again = Watch(lambda *_: None, 20.0, 6)
    again.keep(600)
    clock.now += 4.5
    again.saw(iteration(1), 16)
    assert again.stopped, "4.5 s for the next, and 13.5 s for the conclusion, do not fit into 15.5 s"


def test_what_comes_before_the_search_says_nothing_of_its_pace(clock) -> None:
    watch = Watch(lambda *_: None, 40.0, 6)
    clock.now += 10.0  # the clips are chosen
    watch.keep(600)
    clock.now += 1.0
    watch.saw(iteration(1), 16)
    assert not watch.stopped, "4 s are wanted, and 29 s are left"


def test_checks_that_take_too_long_are_left_out_and_named(clock, caplog) -> None:
    watch = Watch(lambda *_: None, 40.0, 6)
    clock.now += 20.0
    watch.saw(iteration(1), 16)  # a tenth of a second each
    assert watch.allows("a second minimum", 150)
    assert not watch.allows("comparison of the logs' halves", 250)
    clock.now += 10.0
    watch.measured(1000)  # ten times as fast
    assert watch.allows("comparison of the logs' halves", 900)
    watch.report_skipped()
    assert caplog.text.count("left no time for: comparison of the logs' halves;") == 1


def test_without_a_limit_there_is_time_for_all_and_after_an_interruption_for_none(clock) -> None:
    watch = Watch(lambda *_: None, None, 6)
    clock.now += 1e6
    watch.saw(iteration(1), 16)
    assert not watch.stopped and watch.allows("a second minimum", 10**9)
    watch.interrupted = True
    assert watch.stopped and not watch.allows("a second minimum", 1)


def test_a_long_search_without_a_limit_says_how_long(clock, caplog) -> None:
    caplog.set_level("INFO", logger="amhe_cli")
    watch = Watch(lambda *_: None, None, 6)
    watch.keep(600)
    clock.now += 1.0
    watch.saw(iteration(1), 16)  # 15 s and 3 s are left
    assert not caplog.records
    watch = Watch(lambda *_: None, None, 6)
    watch.keep(600)
    for number in (1, 2):
        clock.now += 20.0
        watch.saw(iteration(number), 16)
    (said,) = caplog.messages  # 15 iterations of 20 s, and a conclusion of 60 s
    assert said.startswith("this may take 6 min more, at 200 rollouts an iteration")


def test_searches_that_share_a_watch_share_its_time_and_its_end(clock) -> None:
    """The second search measures a pace of its own; what its time has ended is not interrupted."""
    watch = Watch(lambda *_: None, 30.0, 6)
    for left in (26.0, 22.0):
        watch.keep(600)
        assert not watch.stopped and not watch.cut_short
        clock.now += 4.0
        watch.saw(iteration(1), 16)
        assert watch.affords(50.0 * left) and not watch.affords(50.1 * left)
    clock.now += 20.0
    assert watch.stopped and watch.cause == "it had 30 s"
    watch.interrupt()
    assert watch.cut_short and not watch.interrupted
