"""How far a command is, on stderr: a live bar on a terminal, a line now and then elsewhere."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, TypeAlias, TypeVar

from amhe_cli.cli.session import Session

if TYPE_CHECKING:
    from rich.console import Console

    from amhe_cli.estimation.core.result import Iteration

T = TypeVar("T")
#: What is shown of an item: its state in words, how much is done, and how much there is in all, if known.
Shown: TypeAlias = tuple[str, float, float | None]

#: Seconds between lines where stderr is no terminal.
PLAIN_PERIOD = 5.0


@contextmanager
def progress(
    session: Session,
    title: str,
    shown: Callable[[T], Shown],
    stays: bool = False,
    every: bool = False,
    left: bool = False,
) -> Iterator[Callable[[T], None]]:
    """Give a function that shows each item as the session wants it shown.

    Args:
        session: The session of the command.
        title: What stands before the bar.
        shown: What is shown of an item.
        stays: The last state stays on the terminal in the end.
        every: Each item has a line where stderr is no terminal, not one now and then.
        left: Say how long it will still take, at the pace so far.
    """
    shown = _with_time_left(shown) if left else shown
    console = session.console(stderr=True)
    if session.quiet:
        yield lambda item: None
    elif console.is_terminal:
        with _bar(console, title, shown, stays) as show:
            yield show
    else:
        yield _lines(session, shown, 0.0 if every else PLAIN_PERIOD)


def of_words(state: str) -> Shown:
    """What is shown of a state in words."""
    return state, 0.0, None


def of_messages(count: int) -> Shown:
    """What is shown of a number of messages."""
    return f"{count:,} messages", count, None


def of_search(item: tuple[Iteration, int]) -> Shown:
    """What is shown of an iteration of a search, and of how many there will be about."""
    iteration, total = item
    return iteration.summary(total), iteration.number, total


def of_steps(item: tuple[str, int]) -> Shown:
    """What is shown of what is being done, and of the steps until then, of which nobody knows how many."""
    doing, done = item
    return f"step {done}: {doing}", done, None


def _with_time_left(shown: Callable[[T], Shown]) -> Callable[[T], Shown]:
    """What is shown of an item, and the time that is left."""
    began = time.monotonic()

    def longer(item: T) -> Shown:
        state, done, total = shown(item)
        if total is None or not 0 < done < total:
            return state, done, total
        seconds = (time.monotonic() - began) * (total - done) / done
        told = f"{seconds:.0f} s" if seconds < 90.0 else f"{seconds / 60.0:.0f} min"
        return f"{state}; about {told} left", done, total

    return longer


@contextmanager
def _bar(
    console: Console, title: str, shown: Callable[[T], Shown], stays: bool
) -> Iterator[Callable[[T], None]]:
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
    from rich.table import Column

    # the state takes what is left of the line: a narrow terminal cuts its end, not the bar or the time
    rest = TextColumn("{task.fields[state]}", markup=False, table_column=Column(no_wrap=True, ratio=1))
    columns = (TextColumn("{task.description}"), BarColumn(bar_width=24), TimeElapsedColumn(), rest)
    with Progress(*columns, console=console, transient=not stays, expand=True) as bars:
        task = bars.add_task(title, total=None, state="")

        def show(item: T) -> None:
            state, done, total = shown(item)
            bars.update(task, total=total, completed=done, state=state)

        yield show


def _lines(session: Session, shown: Callable[[T], Shown], period: float) -> Callable[[T], None]:
    last = float("-inf")

    def show(item: T) -> None:
        nonlocal last
        state, done, total = shown(item)
        if time.monotonic() - last >= period or (total is not None and done >= total > 0):
            last = time.monotonic()
            session.say("", state)

    return show
