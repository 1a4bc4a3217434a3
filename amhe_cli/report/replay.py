"""The files of `amhe mhe-replay`, written together."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from amhe_cli.estimation.offline.result import Fit
from amhe_cli.estimation.online.prediction import Prediction
from amhe_cli.estimation.online.replay import Replay
from amhe_cli.report.folder import filling
from amhe_cli.report.replay_log import write_log
from amhe_cli.report.replay_page import replay_page
from amhe_cli.report.replay_record import estimates_csv


def write_replay(
    folder: Path,
    replay: Replay,
    predicted: Sequence[Prediction | None],
    fits: Sequence[Fit],
    record: Mapping[str, Any],
    origin: Mapping[str, Any],
) -> None:
    """Write estimates.mcap, estimates.csv, result.json and report.html, all or none.

    Args:
        folder: Where to; made if it does not exist.
        replay: What was found.
        predicted: What each estimate says of the newest part of its window.
        fits: Measured against predicted in a few windows.
        record: Content of result.json.
        origin: Provenance.
    """
    contents = {
        "estimates.csv": estimates_csv(replay),
        "result.json": json.dumps(record, indent=2, allow_nan=False) + "\n",
        "report.html": replay_page(replay, fits, record, origin),
    }
    metadata = {
        "system": replay.system.name,
        "log": Path(replay.windows[0].log.source).name,
        "method": str(origin["method"]),
        "seed": str(origin["seed"]),
        "version": str(record["version"]),
    }
    with filling(folder) as scratch:
        write_log(scratch / "estimates.mcap", replay, predicted, metadata)
        for name, text in contents.items():
            (scratch / name).write_text(text, encoding="utf-8")
