"""`report.html` of a study."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence

from amhe_cli.report.numbers import MISSING
from amhe_cli.report.page import Origin, Page, Section, Statement
from amhe_cli.report.study.formats import StudyTable
from amhe_cli.report.tables import NUMBER, Table
from amhe_cli.study.cells import words
from amhe_cli.study.store import Study
from amhe_cli.study.summary import Groups


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
    cells, unknown = sum(group.n for group in groups), lambda: MISSING
    code, machine = defaultdict(unknown, study.code), defaultdict(unknown, study.machine)
    lacking = [
        Section(
            "Cells without a result",
            items=[f"{title}: {reason}" for title, reason in failures.items()],
            name="failures",
        )
    ]
    return Page(
        command="eval",
        title="Tasks by beliefs by seeds",
        facts=(
            f"{cells} cells",
            f"begun {study.made.replace('T', ' ').replace('+00:00', ' UTC')}",
            f"amhe {code['amhe']} (sources {code['sources']}), MuJoCo {code['mujoco']}, "
            f"numpy {code['numpy']}, Python {machine['python']}",
            f"{machine['processor']}, {machine['cores']} cores",
        ),
        headline=_headline(groups, tables),
        statements=_statements(study, failures, tables),
        sections=[*map(_section, tables), *figures, *(lacking if failures else [])],
        warnings=(),
        origin=Origin(
            study.commands,
            note="Every number is computed from the result files in cells/, one file for each run. A "
            "file's name contains a hash of task, mode, setting, seed, belief and code. `amhe eval --report` "
            "computes everything again.",
        ),
    ).html()


def _goals(tables: Sequence[StudyTable]) -> list[dict[str, str]]:
    """Rows of the table of goals."""
    return [
        dict(zip(table.head, row, strict=True))
        for table in tables
        if table.name == "goals"
        for row in table.rows
    ]


def _headline(groups: Groups, tables: Sequence[StudyTable]) -> str:
    goals = _goals(tables)
    if not goals:
        return f"{sum(group.n for group in groups)} cells."
    reached = sum(goal["reached"] != "NO" for goal in goals)
    seeds = sorted({group.n for group in groups.at_base()})
    number = f"{seeds[0]} to {seeds[-1]}" if len(seeds) > 1 else f"{seeds[0]}"
    return f"{reached} of {len(goals)} goals reached, with {number} seeds."


def _statements(study: Study, failures: Mapping[str, str], tables: Sequence[StudyTable]) -> list[Statement]:
    stated = [
        Statement(
            "bad",
            f"{goal['']}: {goal['measure']} is {goal['value [95 % interval]']}"
            f"{'' if goal['unit'] == '-' else ' ' + goal['unit']}; the goal is {goal['goal']}.",
        )
        for goal in _goals(tables)
        if goal["reached"] == "NO"
    ]
    if failures:
        count = len(failures)
        text = f"{count} cells have no result." if count > 1 else "1 cell has no result."
        stated.append(Statement("bad", text))
    if study.setting:
        stated.append(Statement("mixed", f"The operating point is not the default: {words(study.setting)}."))
    if study.cut_short:
        text = f"Runs were stopped after {study.duration:g} s, before the tasks' own limit."
        stated.append(Statement("mixed", text))
    return stated


def _section(table: StudyTable) -> Section:
    looks = ("", *(NUMBER for _ in table.head[1:]))
    return Section(table.title, table=Table(table.head, looks, table.rows), note=table.note, name=table.name)
