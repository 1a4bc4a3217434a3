"""Figures of a replay's report."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import groupby

import numpy as np
from markupsafe import Markup

from amhe_cli.core.arrays import FloatArray
from amhe_cli.estimation.online.replay import Replay
from amhe_cli.report import numbers
from amhe_cli.web.plots import Curve, Mark, Panel, figure

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
    gated = [Mark(gate, "the gate", "before", "y")] if gate else []
    return figure(
        [
            Panel("misfit before the update, in noise sd", [Curve(time, misfit)], marks=marks, log=True),
            Panel(
                "excitation, in noise sd", [Curve(time, excitation, color="measured")],
                marks=[*marks, *gated], log=True, low=0.2 * gate or None,
            ),  # values far below the gate are all alike
            Panel(
                "update", [Curve(time, replay.update_ms, color="measured")], "ms",
                marks=[*marks, Mark(period, "its period", "before", "y")], low=0.0,
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
