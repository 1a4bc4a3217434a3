"""How often the online 90 % intervals hold the truth in closed loop, by the size of the systematic part.

    python benchmarks/online_intervals.py                   of the stored runs, docs/results/now
    python benchmarks/online_intervals.py FOLDER --had 0    of a study whose runs declared none

Uses adaptive runs, before the change of box or floor (from 3 s on) and after it (from 1.5 s on). Prints the
mean error of mass and friction, and how often the intervals hold, in percent. `mhe.systematic` leaves
estimates as they are: the part in the stored intervals (--had) can be subtracted, and another one added.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from tempfile import TemporaryDirectory
from zipfile import ZipFile

import numpy as np
from rich.console import Console
from rich.table import Table

from amhe_cli.core.statistics import Z90
from amhe_cli.study.goals import BEGUN, SETTLED, change_of, deviations
from amhe_cli.study.results import CellResult, read_result

STUDY = Path(__file__).resolve().parent.parent / "docs" / "results" / "now"
#: Sizes of the systematic part, as a share of mass and friction.
PARTS = (0.0, 0.06, 0.08, 0.1, 0.12, 0.15)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("study", type=Path, nargs="?", default=STUDY)
    parser.add_argument("--had", type=float, default=0.1, help="what the runs declared (0.1)")
    arguments = parser.parse_args()
    table = Table(
        "task", "when", "mass off", "friction off", *(f"held, {part:g}" for part in PARTS), title="%"
    )
    shares = []
    for task, when, off, sd in _phases(_results(arguments.study)):
        own = np.maximum(sd**2 - arguments.had**2, 0.0)
        held = [(np.abs(off) < Z90 * np.sqrt(own + part**2)).mean(axis=0) for part in PARTS]
        shares.append(held)
        table.add_row(
            task, when, *(f"{100 * value:+.0f}" for value in np.expm1(off.mean(axis=0))), *map(_percent, held)
        )
    table.add_row("all alike", "", "", "", *map(_percent, np.mean(shares, axis=0)))
    Console(width=110).print(table)


def _results(study: Path) -> list[CellResult]:
    """Those of a study, packed ones too, but for those that were run again."""
    with TemporaryDirectory() as scratch:
        if (packed := study / "cells.zip").is_file():
            ZipFile(packed).extractall(scratch)
        files = {f.name: f for part in (Path(scratch), study / "cells") for f in part.glob("*.json")}
        return [read_result(files[name]) for name in sorted(files)]


def _phases(results: list[CellResult]):
    """Task, phase, errors of the logarithms of mass and friction over all seeds, and their sd, (m, 2)."""
    found: dict[tuple[str, str], list[tuple[np.ndarray, np.ndarray]]] = {}
    for result in results:
        if result.reason is None and result.cell.mode == "adaptive" and result.cell.task != "t5":
            for when, rows in _parts(result):
                found.setdefault((result.cell.task, when), []).append(rows)
    for (task, when), rows in sorted(found.items()):
        yield task, when, np.concatenate([off for off, _ in rows]), np.concatenate([sd for _, sd in rows])


def _parts(result: CellResult):
    time, change = result.trace["time"], change_of(result)
    off, sd = deviations(result)
    end = np.inf if change is None else change
    for when, rows in (
        ("before", (time >= BEGUN) & (time < end)),
        ("after", time >= end + SETTLED),
    ):
        if rows.any():
            yield when, (off[rows], sd[rows])


def _percent(held: np.ndarray) -> str:
    return ", ".join(f"{100 * share:.0f}" for share in held)


if __name__ == "__main__":
    main()
