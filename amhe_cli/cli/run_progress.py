"""How far a run is, on stderr: a live bar on a terminal, a line now and then elsewhere."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, TypeAlias

from amhe_cli.cli.progress import now_and_then
from amhe_cli.cli.session import Session

if TYPE_CHECKING:
    from rich.console import Console

#: Called after each cycle with its numbers.
OnRow: TypeAlias = Callable[[Mapping[str, float]], None]


@contextmanager
def run_progress(session: Session, title: str) -> Iterator[OnRow]:
    """Give a function that shows each cycle as the session wants it shown."""
    console = session.console(stderr=True)
    if session.quiet:
        yield lambda row: None
    elif console.is_terminal:
        with _bar(console, title) as on_row:
            yield on_row
    else:
        yield now_and_then(session, _state)


@contextmanager
def _bar(console: Console, title: str) -> Iterator[OnRow]:
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(bar_width=24),
        TextColumn("{task.fields[state]}"),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=console, transient=True) as bars:
        task = bars.add_task(title, total=None, state="")

        def show(row: Mapping[str, float]) -> None:
            # the bar is the way that the box has made
            far = max(bars.tasks[task].total or 0.0, row["to_goal"])
            bars.update(task, total=far, completed=far - row["to_goal"], state=_state(row))

        yield show


def _state(row: Mapping[str, float]) -> str:
    return (
        f"{row['time']:.1f} s, box {row['to_goal']:.2f} m from the goal, "
        f"{row['speed']:+.2f} m/s, plan {row['plan_ms']:.0f} ms"
    )
