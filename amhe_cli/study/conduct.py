"""Run the cells of a study on any executor, and keep each result as soon as it arrives."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from amhe_cli.core.errors import AmheError
from amhe_cli.study.cells import Cell
from amhe_cli.study.executors import Pool, gathered
from amhe_cli.study.results import CellResult, blank, result_of
from amhe_cli.study.store import Store


def conduct(
    store: Store,
    cells: Sequence[Cell],
    run: Callable[[Mapping[str, Any]], dict[str, Any]],
    pool: Pool,
    stopped: Callable[[], bool],
    on_result: Callable[[CellResult], None],
) -> None:
    """Run cells; one that fails is recorded with its reason and does not stop the others.

    Args:
        store: Store of the results; it is written to from here, so that workers need no common disk.
        cells: Cells to run.
        run: Runs one cell: from a request to the content of a result file.
        pool: Executor that the cells are run on.
        stopped: Called now and then; returns whether to give up the cells that are running.
        on_result: Called with each result.

    Raises:
        AmheError: A failure that would stop every cell: other code on a worker, a full disk, a scheduler that
            is gone.
    """
    requests = {cell: {"cell": cell.plain(), "code": dict(store.study.code)} for cell in cells}
    for cell, brought in gathered(run, requests, pool, stopped):
        if isinstance(brought, AmheError):
            raise brought
        if isinstance(brought, Exception):
            brought = blank(requests[cell], f"{type(brought).__name__}: {brought}")
        store.write(cell, brought)
        on_result(result_of(brought))
