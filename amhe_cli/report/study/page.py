"""What `amhe eval` makes of its cells: summary, tables, figures, and the page."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from amhe_cli.core.files import plain
from amhe_cli.report.folder import write_page
from amhe_cli.report.numbers import MISSING
from amhe_cli.report.page import Section, Statement, page
from amhe_cli.report.study.figures import Floors, drawn
from amhe_cli.report.study.tables import FORMATS, StudyTable, tables
from amhe_cli.study.cells import words
from amhe_cli.study.goals import goals
from amhe_cli.study.store import Store, Study, write_file
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
    """Write summary.json, tables/ and report.html of all cells of a study.

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
    pictures = drawn(groups, tried, floors)
    write_page(store.folder, lambda: study_page(store.study, groups, failures, made, pictures))
    return Report(len(results) - len(failures), failures, content, made)


_SIGNS = (
    "S_R: share of the runs that came to the goal; S_T: in time. e_g: how far the box ended from its goal. "
    "RMSE: error of the forward speed. J: the controller's cost. t_exec: time of arrival. true's: of the run "
    "with the same seed that plans with the true parameters."
)
_ORIGIN = (
    "Every number is computed from the result files in cells/, one file for each run. A file's name contains "
    "a hash of task, mode, setting, seed, belief and code. `amhe eval --report` computes everything again."
)


def study_page(
    study: Study,
    groups: Groups,
    failures: Mapping[str, str],
    tables: Sequence[StudyTable],
    figures: Sequence[Section],
) -> str:
    """The page as HTML.

    Args:
        study: What all cells share.
        groups: The results.
        failures: Title of a cell -> why it has no result.
        tables: The tables, in order.
        figures: The figures, in order.
    """
    cells = f"{sum(group.n for group in groups)} cells"
    code, machine = (defaultdict(lambda: MISSING, told) for told in (study.code, study.machine))
    sections = [_section(table, study.cut_short) for table in tables] + list(figures)
    if failures:
        items = [f"{title}: {reason}" for title, reason in failures.items()]
        sections.append(Section("Cells without a result", items=items))
    goals = next((table.rows for table in tables if table.name == "goals"), ())
    reached = sum(row[-1] != "NO" for row in goals)
    seeds = sorted({group.n for group in groups.at_base()})
    number = " to ".join(str(n) for n in dict.fromkeys((*seeds[:1], *seeds[-1:])))
    sections.append(Section("How it was made", items=study.commands, files=True, note=_ORIGIN))
    return page(
        "eval",
        title="Tasks by beliefs by seeds",
        facts=(
            cells,
            f"begun {study.made.replace('T', ' ').replace('+00:00', ' UTC')}",
            f"amhe {code['amhe']} (sources {code['sources']}), MuJoCo {code['mujoco']}, "
            f"numpy {code['numpy']}, Python {machine['python']}",
            f"{machine['processor']}, {machine['cores']} cores",
        ),
        headline=f"{reached} of {len(goals)} goals reached, with {number} seeds."
        if goals
        else outcome(groups),
        statements=_statements(study, failures, goals),
        sections=sections,
    )


def _section(table: StudyTable, cut_short: bool) -> Section:
    """A table; runs that were cut short do not stand beside the paper's, which went to their end."""
    theirs = [name for name in table.table.head if name.startswith("paper: ")]
    if cut_short and theirs:
        title = table.title.partition(", beside")[0]
        return Section(title, table=table.table.without(*theirs), note="Runs were cut short: see above.")
    return Section(table.title, table=table.table, note=table.note)


def outcome(groups: Groups) -> str:
    """How many runs of each task and mode came to the goal: 'T4: baseline 1 of 3 at the goal, ...'."""
    tasks: dict[str, list[str]] = {}
    for group in groups.at_base():
        reached = int(group.values("success").sum())
        tasks.setdefault(group.task.upper(), []).append(f"{group.mode} {reached} of {group.n} at the goal")
    return "; ".join(f"{task}: {', '.join(told)}" for task, told in tasks.items()) + "."


def _statements(study: Study, failures: Mapping[str, str], goals: Sequence[Sequence[str]]) -> list[Statement]:
    stated = [
        Statement("bad", f"{of}: {what} is {f'{value} {unit}'.removesuffix(' -')}; the goal is {goal}.")
        for of, _, what, unit, value, goal, reached in goals
        if reached == "NO"
    ]
    if failures:
        has = "1 cell has" if len(failures) == 1 else f"{len(failures)} cells have"
        stated.append(Statement("bad", f"{has} no result."))
    if study.setting:
        stated.append(Statement("mixed", f"The operating point is not the default: {words(study.setting)}."))
    if study.cut_short:
        text = f"Runs were stopped after {study.duration:g} s, before the tasks' own limit."
        stated.append(Statement("mixed", text))
    return [*stated, Statement("good", _SIGNS)]
