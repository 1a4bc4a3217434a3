"""`report.html` of a run: one page that opens without a network."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from markupsafe import Markup

from amhe_cli.report import run_figures, run_words
from amhe_cli.report.page import template
from amhe_cli.robots.go1.history import History
from amhe_cli.robots.go1.tasks import Task


def run_page(
    task: Task,
    history: History,
    record: Mapping[str, Any],
    origin: Mapping[str, object],
    units: Mapping[str, str],
    period: float,
) -> str:
    """The page.

    Args:
        task: That was done.
        history: Of the run.
        record: Content of result.json.
        origin: Provenance: versions, hashes, seed, command.
        units: Of the parameters, by name.
        period: Of control, by the computer's clock [s].
    """
    return template("run.html.j2").render(
        task=task,
        record=record,
        origin=origin,
        headline=run_words.headline(record),
        statements=run_words.statements(record, task, period),
        changes=run_words.changes(task),
        measures=run_words.measures(record),
        figures=_figures(task, history, record, units, period),
    )


def _figures(
    task: Task, history: History, record: Mapping[str, Any], units: Mapping[str, str], period: float
) -> dict[str, Markup | None]:
    """SVGs by name; of a run that never began there is none."""
    if not history.cycles:
        return dict.fromkeys(("path", "motion", "belief", "cost", "planning"))
    return {
        "path": Markup(run_figures.path_figure(history, task)),
        "motion": Markup(run_figures.motion_figure(history, task)),
        "belief": Markup(run_figures.belief_figure(history, units)),
        "cost": Markup(run_figures.cost_figure(record["cost_terms"])),
        "planning": Markup(run_figures.planning_figure(history, 1e3 * period)),
    }
