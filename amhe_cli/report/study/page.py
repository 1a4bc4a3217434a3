"""`report.html` of a study."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence

from amhe_cli.report.numbers import MISSING
from amhe_cli.report.page import Section, Statement, page
from amhe_cli.report.study.formats import StudyTable
from amhe_cli.study.cells import words
from amhe_cli.study.store import Study
from amhe_cli.study.summary import Groups

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
    return stated
