"""The current estimate of a replay, on stderr: a live line on a terminal, one now and then elsewhere."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, TypeAlias

from amhe_cli.cli.progress import now_and_then
from amhe_cli.cli.session import Session

if TYPE_CHECKING:
    from rich.console import Console

    from amhe_cli.estimation.online.horizon import Estimate

#: Called with each estimate.
OnEstimate: TypeAlias = "Callable[[Estimate], None]"

#: Parameters that a line has room for.
_SHOWN = 4


@contextmanager
def replay_progress(session: Session, total: int) -> Iterator[OnEstimate]:
    """Give a function that shows each of `total` estimates as the session wants it shown."""
    console = session.console(stderr=True)
    if session.quiet:
        yield lambda estimate: None
    elif console.is_terminal:
        with _bar(console, total) as on_estimate:
            yield on_estimate
    else:
        yield now_and_then(session, _state)


@contextmanager
def _bar(console: Console, total: int) -> Iterator[OnEstimate]:
    from rich.progress import BarColumn, Progress, TextColumn

    columns = (BarColumn(bar_width=16), TextColumn("{task.fields[state]}"))
    with Progress(*columns, console=console, transient=True) as bars:
        task = bars.add_task("", total=total, state="")
        yield lambda estimate: bars.update(task, advance=1, state=_state(estimate))


def _state(estimate: Estimate) -> str:
    """'5.9 s: box_mass 4.15 ± 0.24, floor_friction 0.459 ± 0.021; jump'."""
    from amhe_cli.report.numbers import with_sd

    rows = list(zip(estimate.belief.names, estimate.theta, estimate.sd, strict=True))
    told = ", ".join(f"{name} {with_sd(float(value), float(sd))}" for name, value, sd in rows[:_SHOWN])
    more = ", ..." if len(rows) > _SHOWN else ""
    return f"{estimate.time:.1f} s: {told}{more}; {estimate.mark}"
