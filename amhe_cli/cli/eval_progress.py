"""How far a study is, on stderr: a live bar with running means on a terminal, a line a cell elsewhere."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, TypeAlias

from amhe_cli.cli.session import Session

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from amhe_cli.study.results import CellResult

#: Called with each result.
OnResult: TypeAlias = "Callable[[CellResult], None]"


@contextmanager
def eval_progress(session: Session, total: int) -> Iterator[OnResult]:
    """Give a function that shows each result as the session wants it shown.

    Args:
        session: Of the command.
        total: Cells to come.
    """
    console = session.console(stderr=True)
    if session.quiet:
        yield lambda result: None
    elif console.is_terminal:
        with _live(console, total) as on_result:
            yield on_result
    else:
        yield _lines(session, total)


@contextmanager
def _live(console: Console, total: int) -> Iterator[OnResult]:
    from rich.console import Group
    from rich.live import Live
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (
        TextColumn("cells"),
        BarColumn(bar_width=24),
        MofNCompleteColumn(),
        TextColumn("{task.fields[left]}"),
        TimeElapsedColumn(),
    )
    bars, clock = Progress(*columns, console=console), _Clock(total)
    done: list[CellResult] = []
    task = bars.add_task("", total=total, left="")
    with Live(Group(bars, _means(done)), console=console, transient=True) as live:

        def show(result: CellResult) -> None:
            done.append(result)
            bars.update(task, completed=len(done), left=clock.left(len(done)))
            live.update(Group(bars, _means(done)))

        yield show


def _lines(session: Session, total: int) -> OnResult:
    done, clock = 0, _Clock(total)

    def show(result: CellResult) -> None:
        nonlocal done
        done += 1
        session.say("", f"{done}/{total}: {result.cell.title}: {_outcome(result)}; {clock.left(done)}")

    return show


class _Clock:
    """Foretells the end from the pace so far."""

    def __init__(self, total: int) -> None:
        self._total, self._begun = total, time.monotonic()

    def left(self, done: int) -> str:
        """'about 12 min left'."""
        seconds = (time.monotonic() - self._begun) / done * (self._total - done)
        if seconds < 90.0:
            return f"about {seconds:.0f} s left"
        return (
            f"about {seconds / 60:.0f} min left" if seconds < 5400.0 else f"about {seconds / 3600:.1f} h left"
        )


def _outcome(result: CellResult) -> str:
    if result.reason is not None:
        return f"failed: {result.reason}"
    word = "success" if result.measure("success") else "fell" if result.measure("fell") else "no success"
    return f"{word}, {result.measure('goal_error_m'):.3f} m from the goal, {result.measure('time_s'):.1f} s"


def _means(done: list[CellResult]) -> Table:
    """Running means of what came in this session."""
    import numpy as np
    from rich import box
    from rich.table import Table

    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False)
    for name in ("task", "mode", "n", "success", "e_g m", "RMSE m/s", "t_exec s"):
        table.add_column(name, justify="left" if name in ("task", "mode") else "right")
    groups: dict[tuple[str, str], list[CellResult]] = {}
    for result in done:
        if result.reason is None:
            groups.setdefault((result.cell.task, result.cell.mode), []).append(result)
    for (task, mode), results in sorted(groups.items()):
        names = ("success", "goal_error_m", "speed_rmse", "time_s")
        success, error, speed, seconds = (np.mean([r.measure(name) for r in results]) for name in names)
        table.add_row(
            task, mode, str(len(results)), f"{success:.0%}", f"{error:.3f}", f"{speed:.3f}", f"{seconds:.1f}"
        )
    return table
