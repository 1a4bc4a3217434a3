"""The files of `amhe run` that are made when it is over."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from amhe_cli.report.run_page import run_page
from amhe_cli.robots.go1.history import History
from amhe_cli.robots.go1.tasks import Task
from amhe_cli.system.system import System


def write_run(
    folder: Path,
    task: Task,
    system: System,
    history: History,
    record: Mapping[str, Any],
    origin: Mapping[str, object],
) -> None:
    """Write result.json and report.html.

    Args:
        folder: That holds the log already.
        task: That was done.
        system: That was simulated.
        history: Of the run.
        record: Content of result.json.
        origin: Provenance.
    """
    text = json.dumps(record, indent=2, allow_nan=False) + "\n"
    (folder / "result.json").write_text(text, encoding="utf-8")
    units = {p.name: p.unit for p in system.space.parameters}
    # by the computer's clock, as the times of cycles are
    period = system.settings.control.period * record.get("link", {}).get("slow", 1.0)
    page = run_page(task, history, record, origin, units, period)
    (folder / "report.html").write_text(page, encoding="utf-8")
