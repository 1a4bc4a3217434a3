"""How far an estimation is, on stderr: a live bar on a terminal, a line now and then elsewhere."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, TypeAlias, TypeVar

from amhe_cli.cli.session import Session

if TYPE_CHECKING:
    from rich.console import Console

    from amhe_cli.estimation.offline.result import Iteration

#: Called after each iteration with its record and the total expected.
OnIteration: TypeAlias = "Callable[[Iteration, int], None]"

T = TypeVar("T")

#: Seconds between lines where stderr is no terminal.
PLAIN_PERIOD = 5.0


@contextmanager
def progress(session: Session) -> Iterator[OnIteration]:
    """Give a function that shows each iteration as the session wants it shown."""
    console = session.console(stderr=True)
    if session.quiet:
        yield lambda iteration, total: None
    elif console.is_terminal:
        with _bar(console) as on_iteration:
            yield on_iteration
    else:
        yield _lines(session)


@contextmanager
def _bar(console: Console) -> Iterator[OnIteration]:
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(bar_width=24),
        MofNCompleteColumn(),
        TextColumn("{task.fields[state]}"),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=console, transient=True) as bars:
        task = bars.add_task("starting", total=None, state="")

        def show(iteration: Iteration, total: int) -> None:
            bars.update(
                task,
                description=iteration.method,
                total=total,
                completed=iteration.number,
                state=_state(iteration),
            )

        yield show


def _lines(session: Session) -> OnIteration:
    last = float("-inf")

    def show(iteration: Iteration, total: int) -> None:
        nonlocal last
        if time.monotonic() - last < PLAIN_PERIOD and iteration.number < total:
            return
        last = time.monotonic()
        session.say("", f"{iteration.method} {iteration.number}/{total}: {_state(iteration)}")

    return show


def _state(iteration: Iteration) -> str:
    return f"cost {iteration.cost:.4g}, sigma {iteration.sigma:.2g}"


def now_and_then(session: Session, state: Callable[[T], str]) -> Callable[[T], None]:
    """Say how far something is where stderr is no terminal, every PLAIN_PERIOD at most.

    Args:
        session: Whose stderr it is.
        state: What is said of the newest item.
    """
    last = float("-inf")

    def show(item: T) -> None:
        nonlocal last
        if time.monotonic() - last >= PLAIN_PERIOD:
            last = time.monotonic()
            session.say("", state(item))

    return show
