"""Result of a cell: its outcome, and traces thin enough to keep thousands of cells."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, FiniteFloat, TypeAdapter, model_validator

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.errors import AmheError
from amhe_cli.study.cells import Cell, cell_of, setting_of

#: Time between two rows of a trace [s].
TRACE_STEP = 0.2
#: Columns of a trace and their decimals: sampled at the row's time, or the mean since the row before,
#: since speed and cost swing with every step of the robot.
_SAMPLED = {"box_x": 3, "box_y": 3, "box_yaw": 3, "trunk_x": 2, "trunk_y": 2, "trunk_yaw": 2}
_SAMPLED |= {"foot_x": 2, "foot_y": 2}
_AVERAGED = {"speed": 3, "command": 3, "running_cost": 2}
#: Columns of beliefs, their sd, and the truth: NAME follows.
_NAMED = ("belief/", "belief_sd/", "truth/")
_NAMED_DIGITS = 4


@dataclass(frozen=True, slots=True, eq=False)
class CellResult:
    """A cell and its result.

    Args:
        code: Versions and hashes of what decides a result.
        reason: Why the run failed; None: it did not.
        outcome: Content of the run's result.json; {} of a failed one.
        trace: Columns over time, each shape (n,); {} of a failed one.
        seconds: Wall-clock time that the run took [s].
    """

    cell: Cell
    code: Mapping[str, str]
    reason: str | None
    outcome: Mapping[str, Any]
    trace: Mapping[str, FloatArray]
    seconds: float

    def measure(self, name: str) -> float:
        """A number of the outcome; NaN if the run has none, for instance no goal error before a goal.

        Raises:
            AmheError: The number is absent, though every run of this version has it: other code wrote the
                result.
        """
        value = self.outcome.get(name, "")
        if value is not None and not isinstance(value, (int, float)):
            raise AmheError(f"{self.cell.title}: its result has no {name}; other code wrote it: run it again")
        return float("nan") if value is None else float(value)


class _Record(BaseModel):
    """The content of a result's file."""

    cell: dict[str, Any]
    code: dict[str, str]
    reason: str | None
    outcome: dict[str, Any]
    trace: dict[str, float | list[float | None] | None]
    seconds: FiniteFloat

    @model_validator(mode="after")
    def _check(self) -> _Record:
        """Refuse what no run has.

        Raises:
            ValueError: The cell is none, or a column is missing or of another length.
        """
        TypeAdapter(Cell).validate_python({**self.cell, "setting": setting_of(self.cell["setting"])})
        lengths = {len(column) for column in self.trace.values() if isinstance(column, list)}
        if self.reason is None and (len(lengths) != 1 or not {"time", *_AVERAGED} <= set(self.trace)):
            raise ValueError("a column is missing, or of another length")
        return self


def thinned(columns: Mapping[str, FloatArray], period: float) -> dict[str, Any]:
    """A trace as plain values: a row each `TRACE_STEP`, and the last row.

    A column that never changes is one number.

    Args:
        columns: Columns of a run's history, shape (cycles,) each.
        period: Time between two of its rows [s].
    """
    cycles = len(columns["time"])
    every = max(1, round(TRACE_STEP / period))
    starts = np.arange(0, cycles, every)
    ends = np.minimum(starts + every, cycles) - 1
    trace: dict[str, Any] = {"time": _rounded(columns["time"][ends], 2)}
    for name, digits in _SAMPLED.items():
        if name in columns:
            trace[name] = _rounded(columns[name][ends], digits)
    for name, digits in _AVERAGED.items():
        mean = np.add.reduceat(columns[name], starts) / (ends - starts + 1)
        trace[name] = _rounded(mean, digits)
    for name, values in columns.items():
        if name.startswith(_NAMED):
            trace[name] = _rounded(values[ends], _NAMED_DIGITS)
    return trace


def _rounded(values: FloatArray, digits: int) -> Any:
    """Values with as few characters as the digits need; null for NaN, which JSON lacks."""
    rows = [
        None if math.isnan(v) else int(v) if v == int(v) else v for v in np.round(values, digits).tolist()
    ]
    return rows[0] if len(rows) > 1 and len(set(rows)) == 1 else rows


def read_result(path: Path) -> CellResult:
    """The result in a file.

    Raises:
        AmheError: The file holds no result.
    """
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        return result_of(_Record.model_validate(record).model_dump())
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise AmheError(
            f"{path}: is no result of a cell; delete the file, and run the study again with `resume=True`"
        ) from None


def blank(request: Mapping[str, Any], reason: str | None) -> dict[str, Any]:
    """The record of a cell without a result: its request, and why there is no result."""
    return {"schema_version": 1, **request, "reason": reason, "outcome": {}, "trace": {}, "seconds": 0.0}


def result_of(record: Mapping[str, Any]) -> CellResult:
    """The result in a record, which `run.run_cell` makes."""
    columns = record["trace"]
    rows = len(columns.get("time", ()))
    trace = {
        name: np.array(values, float) if isinstance(values, list) else np.full(rows, values, dtype=float)
        for name, values in columns.items()
    }
    return CellResult(
        cell_of(record["cell"]), record["code"], record["reason"], record["outcome"], trace, record["seconds"]
    )
