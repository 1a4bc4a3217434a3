"""`report.html` of a replay: one page that opens without a network."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby
from typing import Any

from markupsafe import Markup

from amhe_cli.estimation.offline.result import Fit
from amhe_cli.estimation.online.replay import Replay
from amhe_cli.report import figures, replay_figures, replay_words
from amhe_cli.report.page import template


def replay_page(
    replay: Replay, fits: Sequence[Fit], record: Mapping[str, Any], origin: Mapping[str, object]
) -> str:
    """The page.

    Args:
        replay: What was found.
        fits: Measured against predicted in a few windows.
        record: Content of result.json.
        origin: Provenance: versions, hashes, seed, command.
    """
    return template("replay.html.j2").render(
        record=record,
        origin=origin,
        headline=replay_words.headline(record),
        statements=replay_words.statements(record),
        marks=replay_words.MARKS,
        seen=set(replay.marks),
        colours={"jump": replay_figures.JUMP, "still": replay_figures.STILL, "silent": replay_figures.SILENT},
        estimates=Markup(replay_figures.estimates_figure(replay)),
        windows=Markup(replay_figures.windows_figure(replay)),
        fits=[
            {"clip": clip, "svg": Markup(figures.fit_figure(list(group)))}
            for clip, group in groupby(fits, lambda fit: fit.clip)
        ],
    )
