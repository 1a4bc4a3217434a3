"""The files of `amhe eval` that are made of its cells: summary, tables, figures, page."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from amhe_cli.core.files import plain
from amhe_cli.report.folder import write_page
from amhe_cli.report.study.figures import Floors, drawn
from amhe_cli.report.study.formats import FORMATS, StudyTable
from amhe_cli.report.study.page import study_page
from amhe_cli.report.study.tables import tables
from amhe_cli.study.goals import goals
from amhe_cli.study.store import Store, write_file
from amhe_cli.study.summary import Groups, ablations, summary


@dataclass(frozen=True, slots=True)
class Report:
    """Content of the files that were written.

    Args:
        cells: Number of cells with a result.
        failures: Title of a cell -> why it has no result.
        summary: Content of summary.json.
        tables: The tables, in order.
    """

    cells: int
    failures: Mapping[str, str]
    summary: Sequence[Mapping[str, Any]]
    tables: Sequence[StudyTable]


def write_study(store: Store, floors: Floors, modes: Sequence[str]) -> Report:
    """Write summary.json, tables/, figures/ and report.html of all cells of a study.

    Args:
        store: Store of the study.
        floors: Path and goal of each task, in order.
        modes: All modes, in order.
    """
    results = store.results()
    groups = Groups(results, store.study.setting, tuple(floors), modes)
    tried = ablations(groups, store.study.defaults)
    judged = [] if store.study.cut_short else goals(groups)  # goals are for whole runs
    made = tables(groups, tried, judged)
    content = plain(summary(groups))
    failures = {r.cell.title: r.reason for r in results if r.reason is not None}
    write_file(store.folder / "summary.json", json.dumps(content, indent=1, allow_nan=False) + "\n")
    (store.folder / "tables").mkdir(exist_ok=True)
    for table in made:
        for suffix, form in FORMATS.items():
            write_file(store.folder / "tables" / f"{table.name}.{suffix}", form(table))
    pictures = drawn(groups, tried, floors, store.folder / "figures")
    write_page(store.folder, lambda: study_page(store.study, groups, failures, made, pictures))
    return Report(len(results) - len(failures), failures, content, made)
