"""The figure of ablations: cost and success over the values of each setting."""

from __future__ import annotations

import json
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from amhe_cli.report.figures import IDENTIFIED, INITIAL, Grid
from amhe_cli.report.study.drawing import DEFAULT
from amhe_cli.study.ablations import Ablation


def ablation_figure(tried: Sequence[Ablation]) -> Figure:
    """One panel a setting: J to the left, with its sd; success to the right, with its interval."""
    grid = Grid(len(tried), min(3, len(tried)), height=2.95)
    figure = grid.figure()
    for index, ablation in enumerate(tried):
        axes = grid.axes(figure, index, bottom=0.5, top=0.45)
        place = axes.get_position()
        axes.set_position((place.x0, place.y0, place.width - 0.045, place.height))
        _panel(axes, ablation)
    return figure


def _panel(axes: Axes, ablation: Ablation) -> None:
    at = np.arange(len(ablation.values), dtype=float)
    costs = [group.spread("cost") for group in ablation.groups]
    rates = [group.spread("success") for group in ablation.groups]
    sd = np.nan_to_num([cost.sd for cost in costs])
    axes.errorbar(
        at - 0.05, [c.mean for c in costs], sd, fmt="o-", color=IDENTIFIED, markersize=4, capsize=2.5
    )
    axes.set_ylabel("cost J [-]", color=IDENTIFIED, labelpad=1.0)
    axes.set_ylim(bottom=0.0)
    right = axes.twinx()
    share = 100.0 * np.array([rate.mean for rate in rates])
    reach = 100.0 * np.array([[r.mean - r.low for r in rates], [r.high - r.mean for r in rates]])
    right.errorbar(
        at + 0.05, share, np.maximum(reach, 0.0), fmt="s:", color=INITIAL, markersize=4, capsize=2.5
    )
    right.set_ylim(-4.0, 104.0)
    right.set_ylabel("success [%]", color=INITIAL, labelpad=1.0)
    right.grid(visible=False)
    if ablation.default is not None:
        axes.axvline(ablation.default, color=DEFAULT, linestyle="--", linewidth=1.3)
    axes.set_xticks(at, [v if isinstance(v, str) else json.dumps(v) for v in ablation.values])
    axes.set_xlim(-0.4, len(at) - 0.6)
    n = sorted({group.n for group in ablation.groups})
    seeds = f"n = {n[0]}" if len(n) == 1 else f"n = {n[0]} to {n[-1]}"
    axes.set_title(f"{ablation.path}\n{ablation.task} {ablation.mode}, {seeds}", fontsize=8.5)
