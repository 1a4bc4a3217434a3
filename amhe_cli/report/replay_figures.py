"""Figures of a replay's report."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator

from amhe_cli.core.arrays import FloatArray
from amhe_cli.estimation.online.replay import Replay
from amhe_cli.report.figures import IDENTIFIED, INITIAL, INK, MEASURED, Grid, styled, svg, thinned

#: Colour of the line at a jump.
JUMP = "#b45309"
#: Background where windows had too little excitation.
STILL = "#e8edf3"
#: Background where a signal was missing, or rollouts diverged.
LOST = "#fee2e2"
_SHADES = {"still": STILL, "gap": LOST, "diverged": LOST}
_BAND = "#dbeafe"


def estimates_figure(replay: Replay) -> Markup:
    """Each parameter over time with its 90 % band, its true value where the log has one, and the marks."""
    space, times = replay.system.space, _held_until(replay)
    theta, lower, upper = (_held(replay.column(name)) for name in ("theta", "lower", "upper"))
    across = 3 if len(space) in (3, 5, 6) or len(space) > 8 else min(2, len(space))
    grid = Grid(len(space), across, height=2.5)
    with styled("estimates"):
        figure = grid.figure()
        for i, parameter in enumerate(space.parameters):
            axes = grid.axes(figure, i)
            _marks(axes, replay)
            axes.fill_between(times, lower[:, i], upper[:, i], color=_BAND, linewidth=0, step="post")
            if parameter.name in replay.truth:
                axes.step(times, _held(replay.truth[parameter.name]), where="post", color=INK, linewidth=1.3)
            axes.step(times, theta[:, i], where="post", color=IDENTIFIED, linewidth=1.5)
            axes.set_ylim(*_limits(replay, i))
            axes.set_xlim(times[0], times[-1])
            axes.set_xlabel("time [s]")
            axes.set_title(
                parameter.name if parameter.unit == "-" else f"{parameter.name} [{parameter.unit}]"
            )
        return svg(figure)


def windows_figure(replay: Replay) -> Markup:
    """Misfit and excitation of each window, and how long its update took."""
    grid = Grid(3, 3, height=2.4)
    setting = replay.system.settings.mhe
    with styled("windows"):
        figure = grid.figure()
        misfit, excitation, took = (grid.axes(figure, index) for index in range(3))
        _log_line(misfit, replay, replay.column("misfit"), IDENTIFIED)
        misfit.set_title("misfit before the update, in noise sd")
        _log_line(excitation, replay, replay.column("excitation"), MEASURED)
        excitation.axhline(setting.excitation, color=INITIAL, linewidth=1.2, linestyle="--")
        if setting.excitation:  # values far below the gate are all alike
            excitation.set_ylim(bottom=0.2 * setting.excitation)
        excitation.set_title("excitation, in noise sd; dashed: the gate")
        took.plot(*thinned(replay.times, replay.update_ms), color=MEASURED, linewidth=1.0)
        took.axhline(1e3 * setting.update_period, color=INITIAL, linewidth=1.2, linestyle="--")
        took.set_ylim(bottom=0.0)
        took.set_title("update [ms]; dashed: its period")
        for axes in (misfit, excitation, took):
            _marks(axes, replay)
            axes.set_xlim(replay.times[0], _held_until(replay)[-1])
            axes.set_xlabel("time [s]")
        return svg(figure)


def _held_until(replay: Replay) -> FloatArray:
    """Times of the estimates and of the update after the last one [s], shape (n + 1,)."""
    return np.append(replay.times, replay.times[-1] + replay.system.settings.mhe.update_period)


def _held(values: FloatArray) -> FloatArray:
    """Values (n, ...) with the last one repeated."""
    return np.concatenate((values, values[-1:]))


def _log_line(axes: Axes, replay: Replay, values: FloatArray, color: str) -> None:
    known = np.isfinite(values) & (values > 0.0)
    axes.plot(*thinned(replay.times, np.where(known, values, np.nan)), color=color, linewidth=1.2)
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter("{x:g}")
    axes.minorticks_off()


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


def _marks(axes: Axes, replay: Replay) -> None:
    """Shade stretches of skipped windows, and draw a line at each jump."""
    for mark, begin, end in _stretches(replay):
        if mark == "jump":
            axes.axvline(begin, color=JUMP, linewidth=1.0, linestyle=":")
        elif mark in _SHADES:
            axes.axvspan(begin, end, color=_SHADES[mark], linewidth=0, zorder=0)


def _stretches(replay: Replay) -> Iterator[tuple[str, float, float]]:
    """Consecutive windows with the same mark: mark, begin and end [s]; each jump by itself."""
    times = _held_until(replay)
    begin = 0
    for i, estimate in enumerate(replay.estimates):
        last = i + 1 == len(replay.estimates)
        if last or estimate.mark == "jump" or replay.estimates[i + 1].mark != estimate.mark:
            yield estimate.mark, float(times[begin]), float(times[i + 1])
            begin = i + 1
