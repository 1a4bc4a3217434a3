"""A replay in sentences, in figures, on a page and on a terminal, and the files of `amhe mhe-replay`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup
from rich.console import Console

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.files import json_text
from amhe_cli.estimation.core.result import Fit
from amhe_cli.estimation.online.replay import Prediction, Replay
from amhe_cli.report import figures, numbers
from amhe_cli.report.folder import results
from amhe_cli.report.page import (
    Section,
    Statement,
    Tone,
    diverged_statement,
    fixed_statement,
    print_result,
    result_page,
)
from amhe_cli.report.replay_files import MARKS, estimates_csv, write_log
from amhe_cli.report.tables import NUMBER, STRONG, Table
from amhe_cli.web.plots import Curve, Mark, Panel, figure

#: An honest 90 % interval holds the truth in 90 % of all cases; a share below this one is pointed out.
_HONEST = 0.8


def write_replay(
    folder: Path,
    replay: Replay,
    predicted: Sequence[Prediction | None],
    fits: Sequence[Fit],
    record: Mapping[str, Any],
    provenance: Mapping[str, Any],
    force: bool = True,
) -> None:
    """Write estimates.mcap, estimates.csv, result.json and report.html, all or none.

    Args:
        folder: Folder of the files; made if it does not exist.
        predicted: For each estimate its prediction of the newest part of its window.
        fits: Measured against predicted in a few windows.
        record: Content of result.json.
        provenance: Versions, hashes, seed and command.
        force: Write into a folder that is not empty.
    """
    contents = {"estimates.csv": estimates_csv(replay), "result.json": json_text(record)}
    metadata = {
        "system": replay.system.name,
        "log": Path(replay.windows[0].log.source).name,
        "method": str(provenance["method"]),
        "seed": str(provenance["seed"]),
        "version": str(record["version"]),
    }
    with results(folder, lambda: replay_page(replay, fits, record, provenance), force) as scratch:
        write_log(scratch / "estimates.mcap", replay, predicted, metadata)
        for name, text in contents.items():
            (scratch / name).write_text(text, encoding="utf-8")


def print_replay(record: Mapping[str, Any], folder: Path, console: Console) -> None:
    """Print the parameters at the end, how many windows were used, and where the page is."""
    head = f"{record['log']}, at {record['end_s']:.2f} s"
    print_result(head, parameter_table(record), statements(record), folder, console)


def replay_page(
    replay: Replay, fits: Sequence[Fit], record: Mapping[str, Any], provenance: Mapping[str, Any]
) -> str:
    """The page as HTML; for the arguments see `write_replay`."""
    settings = record["settings"]
    return result_page(
        record,
        provenance,
        title=record["system"],
        facts=(
            Path(record["log"]).name,
            f"{record['method']}, window {settings['window']:g} s, "
            f"update every {settings['update_period']:g} s",
            f"{record['rollouts']['count']:,} rollouts",
        ),
        headline=headline(record),
        statements=statements(record),
        sections=list(_sections(replay, fits, record)),
        settings={
            f"mhe.{name}": numbers.named(value) if isinstance(value, Mapping) else value
            for name, value in settings.items()
            if value
        },
    )


def headline(record: Mapping[str, Any]) -> str:
    """The final estimates in one line."""
    final = [
        f"{p['name']} {numbers.quantity(numbers.with_sd(p['estimate'], p['sd']), p['unit'])}"
        for p in record["parameters"]
    ]
    return f"At {record['end_s']:.1f} s: {', '.join(final)}."


def statements(record: Mapping[str, Any]) -> list[Statement]:
    """What a reader should know before using a number."""
    found, known = [], [p for p in record["parameters"] if p["coverage"] is not None]
    if record["interrupted"]:
        told = f"The replay was interrupted: the estimates end at {record['end_s']:.1f} s."
        found.append(Statement("mixed", told))
    if known:
        held = numbers.joined([f"of {p['name']} in {numbers.percent(p['coverage'])}" for p in known])
        honest: Tone = "good" if all(p["coverage"] >= _HONEST for p in known) else "mixed"
        found.append(Statement(honest, f"The 90 % interval held the true value {held} of the updates."))
    if together := [f"{c['text']} (sd {numbers.percent(c['sd'])})" for c in record["combinations"]]:
        told = f"Known more precisely together than apart: {numbers.joined(together)}."
        found.append(Statement("good", told))
    found += fixed_statement(record["fixed"])
    found.append(Statement("good" if record["updated"] else "bad", f"{windows_line(record)}."))
    ms, period = record["update_ms"], 1e3 * record["settings"]["update_period"]
    if ms["p50"] is not None:
        longer = 1.0 / record["real_time_factor"]
        told = (
            f"An update took {ms['p50']:.0f} ms (median) and {ms['p99']:.0f} ms (99th percentile); the "
            f"update period is {period:g} ms. The replay took {longer:.1f} times as long as the log."
        )
        found.append(Statement("good" if ms["p99"] <= period else "mixed", told))
    return [*found, *diverged_statement(record["rollouts"]["diverged"], record["rollouts"]["count"])]


def windows_line(record: Mapping[str, Any]) -> str:
    """The windows in words: '61 windows used (2 jumps detected), 5 skipped (too little excitation)'."""
    used, jumps = record["updated"], record["jumps"]
    reasons = {
        "too little excitation": record["still"],
        "a missing signal": record["gaps"],
        "diverged rollouts": record["lost"],
    }
    reasons = {reason: count for reason, count in reasons.items() if count}
    text = f"{used} window{'s' * (used != 1)} used"
    if jumps:
        text += f" ({jumps} jump{'s' * (jumps != 1)} detected)"
    if len(reasons) == 1:
        text += "".join(f", {count} skipped ({reason})" for reason, count in reasons.items())
    elif reasons:
        listed = ", ".join(f"{count} with {reason}" for reason, count in reasons.items())
        text += f", {sum(reasons.values())} skipped ({listed})"
    return text


def parameter_table(record: Mapping[str, Any]) -> Table:
    """The final estimates; with truth and coverage where the log has true values."""
    head = ("parameter", "estimate ± sd", "unit", "90 % interval", "before", "truth", "coverage")
    looks = ("name", STRONG, "unit", NUMBER, f"{NUMBER} soft", NUMBER, NUMBER)
    rows = [
        (
            p["name"],
            numbers.with_sd(p["estimate"], p["sd"]),
            numbers.unit_of(p["unit"]),
            numbers.interval(p["lower"], p["upper"]),
            f"{p['start']:.3g}",
            numbers.MISSING if p["truth"] is None else f"{p['truth']:.4g}",
            numbers.MISSING if p["coverage"] is None else numbers.percent(p["coverage"]),
        )
        for p in record["parameters"]
    ]
    table = Table(head, looks, rows)
    return table if _has_truth(record) else table.without("truth", "coverage")


def _has_truth(record: Mapping[str, Any]) -> bool:
    return any(p["truth"] is not None for p in record["parameters"])


def _sections(replay: Replay, fits: Sequence[Fit], record: Mapping[str, Any]) -> Iterator[Section]:
    marks = set(replay.marks)
    yield Section("Estimates", figure=estimates_figure(replay))
    yield Section(
        "Final estimates",
        table=parameter_table(record),
        note="Coverage is the share of the updates in which the 90 % interval held the true value. Errors of "
        "consecutive updates are alike, so the coverage of one log can be far from 90 %."
        if _has_truth(record)
        else "",
    )
    yield Section(
        "Windows",
        figure=windows_figure(replay),
        note=Markup(" ").join(
            Markup("<b>{}</b>: {}.").format(name, text) for name, text in MARKS.items() if name in marks
        ),
    )
    clips = [list(group) for _, group in groupby(fits, lambda fit: fit.clip)]
    for clip in clips:
        yield Section(
            f"Measured against predicted, {clip[0].clip}",
            text="The windows that were used with the smallest, the median and the largest misfit. "
            "Before: with the estimate before the replay; after: with the estimate after the window."
            if clip is clips[0]
            else "",
            figure=figures.fit_figure(clip),
            folded=clip is not clips[-1],
        )


#: Marks of windows that a figure shows: what they mean, and their colour.
_SHOWN = {
    "jump": ("jump detected", "amber"),
    "still": ("window skipped: too little excitation", "still"),
    "gap": ("window skipped: missing signal or diverged rollouts", "lost"),
    "diverged": ("window skipped: missing signal or diverged rollouts", "lost"),
}


def estimates_figure(replay: Replay) -> Markup:
    """Each parameter over time with its 90 % band, its true value where the log has one, and the marks."""
    space, times, marks = replay.system.space, _held_until(replay), [*_marks(replay)]
    theta, lower, upper = (_held(replay.column(name)) for name in ("theta", "lower", "upper"))
    panels = []
    for i, p in enumerate(space.parameters):
        band = (lower[:, i], upper[:, i])
        lines = [Curve(times, theta[:, i], "estimate, with its 90 % interval", "after", "step", band)]
        if p.name in replay.truth:
            lines.append(Curve(times, _held(replay.truth[p.name]), "true value in the log", "ink", "step"))
        low, high = _limits(replay, i)
        panels.append(
            Panel(p.name, lines, numbers.unit_of(p.unit), marks=marks, low=low, high=high, height=190)
        )
    return figure(panels, 3 if len(space) in (3, 5, 6) or len(space) > 8 else 2)


def windows_figure(replay: Replay) -> Markup:
    """Misfit and excitation of each window, and how long its update took."""
    setting, marks, time = replay.system.settings.mhe, [*_marks(replay)], replay.times
    misfit, excitation = (
        np.where(values > 0.0, values, np.nan)
        for values in (replay.column("misfit"), replay.column("excitation"))
    )
    gate, period = setting.excitation, 1e3 * setting.update_period
    gated = [Mark(gate, "the gate of excitation", "before", "y")] if gate else []
    return figure(
        [
            Panel("misfit before the update, in noise sd", [Curve(time, misfit)], marks=marks, log=True),
            Panel(
                "excitation, in noise sd", [Curve(time, excitation, color="measured")],
                marks=[*marks, *gated], log=True, low=0.2 * gate or None,
            ),  # values far below the gate are all alike
            Panel(
                "update", [Curve(time, replay.update_ms, color="measured")], "ms",
                marks=[*marks, Mark(period, "the period of updates", "before", "y")], low=0.0,
            ),
        ]
    )  # fmt: skip


def _held_until(replay: Replay) -> FloatArray:
    """Times of the estimates and of the update after the last one [s], shape (n + 1,)."""
    return np.append(replay.times, replay.times[-1] + replay.system.settings.mhe.update_period)


def _held(values: FloatArray) -> FloatArray:
    """Values (n, ...) with the last one repeated."""
    return np.concatenate((values, values[-1:]))


def _limits(replay: Replay, i: int) -> tuple[float, float]:
    """Limits that hold the estimates and the truth; the band of the first third may leave the picture."""
    parameter = replay.system.space.parameters[i]
    theta, settled = replay.column("theta")[:, i], len(replay.estimates) // 3
    shown = [theta, replay.column("lower")[settled:, i], replay.column("upper")[settled:, i]]
    truth = replay.truth.get(parameter.name)
    if truth is not None:
        shown.append(truth[np.isfinite(truth)])
    values = np.concatenate(shown)
    margin = 0.08 * float(values.max() - values.min()) or 0.1 * abs(float(values[0])) or 1.0
    low = float(values.min()) - margin
    return (max(low, 0.0) if parameter.log else low), float(values.max()) + margin


def _marks(replay: Replay) -> Iterator[Mark]:
    """Shades of stretches of skipped windows, and a line at each jump."""
    times, rows = _held_until(replay), enumerate(replay.estimates)
    for mark, group in groupby(rows, lambda row: row[1].mark):
        if mark not in _SHOWN:
            continue
        text, color = _SHOWN[mark]
        first, *rest = [i for i, _ in group]
        if mark == "jump":
            yield from (Mark(float(times[i]), text, color) for i in (first, *rest))
        else:
            yield Mark((float(times[first]), float(times[(first, *rest)[-1] + 1])), text, color)
