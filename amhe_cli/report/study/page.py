"""`report.html` of a study: one page that opens without a network."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from amhe_cli.report.page import template
from amhe_cli.report.study.drawing import Picture
from amhe_cli.report.study.formats import Table
from amhe_cli.study.cells import words
from amhe_cli.study.store import Study
from amhe_cli.study.summary import Groups


def study_page(
    study: Study,
    groups: Groups,
    failures: Mapping[str, str],
    tables: Sequence[Table],
    pictures: Sequence[Picture],
) -> str:
    """The page.

    Args:
        study: What all cells share.
        groups: Its results.
        failures: Title of a cell -> why it brought none.
        tables: To show, in order.
        pictures: Likewise.
    """
    judged = [
        dict(zip(table.head, row, strict=True))
        for table in tables
        if table.name == "goals"
        for row in table.rows
    ]
    return template("study.html.j2").render(
        study=study,
        setting=words(study.setting),
        cells=sum(group.n for group in groups),
        seeds=sorted({group.n for group in groups.at_base()}),
        failures=failures,
        goals=judged,
        missed=[goal for goal in judged if goal["reached"] == "NO"],
        tables=tables,
        pictures=pictures,
    )
