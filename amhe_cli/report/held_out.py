"""What a page says of clips that were not fitted."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
from markupsafe import Markup

from amhe_cli.estimation.core.result import HeldOut, HorizonError
from amhe_cli.estimation.validation.prediction import FEWEST
from amhe_cli.report import figures, numbers
from amhe_cli.report.page import Section, Statement, cell
from amhe_cli.report.tables import NUMBER, STRONG, Table
from amhe_cli.web.plots import Curve, Panel, figure, shown_unit

#: In the names of channels of which each is the effort of one joint, along the measured motion.
_EFFORT = ".effort of "
#: Errors that a sentence names.
_SAID = 3


def held_out_statement(held_out: HeldOut | None) -> Iterator[Statement]:
    """What held-out clips say of the values, in a sentence."""
    if held_out is None or held_out.clips == 0:
        yield Statement(
            "bad", "Nothing was held out, so nothing shows that the values predict data that were not fitted."
        )
        return
    clips = (
        f"{held_out.clips} clips that were not fitted" if held_out.clips > 1 else "a clip that was not fitted"
    )
    costs = f"{held_out.initial_cost:.3g} → {held_out.cost:.3g}"
    falls = held_out.cost < held_out.initial_cost
    if math.isfinite(held_out.fitted_cost):
        first = f"{held_out.initial_fitted_cost:.3g} → {held_out.fitted_cost:.3g}"
        costs += f" (with first states fitted {first})"
        falls |= held_out.fitted_cost < held_out.initial_fitted_cost
    if falls:
        errors = [f"mean {name} {before} → {after}" for name, before, after in error_rows(held_out)]
        more = f", and {len(errors) - _SAID} more" if len(errors) > _SAID else ""
        told = ", ".join([f"On {clips}: cost {costs}", *errors[:_SAID]])
        yield Statement("good", f"{told}{more}.", "held-out" if more else "")
    else:
        yield Statement(
            "mixed",
            f"On {clips} the cost does not fall (cost {costs}): the values do not predict unseen data better "
            "than those before.",
        )


def better_text(errors: Sequence[HorizonError]) -> str:
    """'55 of 64 errors on data that was not fitted are smaller than before'; '' without errors."""
    better = sum(one.identified <= one.initial for one in errors)
    return (
        f"{better} of {len(errors)} errors on data that was not fitted are no larger than before"
        if errors
        else ""
    )


def held_out_section(held_out: HeldOut) -> Section:
    """Costs, and errors against the horizon, on held-out clips."""
    if not held_out.horizons:
        return Section("Held out", table=_validation_table(held_out), folded=False)
    few = any(one.clips < FEWEST for one in held_out.horizons)
    worse = any(one.identified > one.initial for one in held_out.horizons)
    return Section(
        "Held out",
        text="Predictions start from a recorded state of data that was not fitted and follow the recorded "
        "commands. Each cell is the rms error after so much time, before → after; n is the number of "
        "predictions. The last column goes to the end of the held-out parts; beside the name stands how far "
        f"the measured value moved by then. {better_text(held_out.horizons)}"
        f"{'; the others are red' * worse}.",
        table=horizon_table(held_out.horizons),
        figure=horizon_figure(held_out.horizons),
        note=f"Where n is below {FEWEST}, a point stands alone: it says little." * few,
        folded=False,
        remark=", ".join(f"{name} {before} → {after}" for name, before, after in _costs(held_out)),
    )


def _by_line(errors: Sequence[HorizonError]) -> dict[tuple[str, str], list[HorizonError]]:
    """The errors of each joint or pose, by its channel and name."""
    lines: dict[tuple[str, str], list[HorizonError]] = {}
    for one in errors:
        lines.setdefault((one.channel, one.column), []).append(one)
    return lines


def horizon_table(errors: Sequence[HorizonError]) -> Table:
    """A row for each joint or pose, columns for each horizon: what it moved, and both errors."""
    horizons = {(one.to_end, one.horizon): one.clips for one in errors}
    rows = []
    for (channel, column), line in _by_line(errors).items():
        found = {(one.to_end, one.horizon): one for one in line}
        cells = [_cell(found[key]) if key in found else numbers.MISSING for key in horizons]
        rows.append((column or channel, sized(line[-1].moved, line[-1].unit), *cells))
    head = [
        f"after {seconds:.3g} s{' (end)' * to_end}, n = {clips}"
        for (to_end, seconds), clips in horizons.items()
    ]
    return Table(("", "moves by", *head), ("name", f"{NUMBER} soft", *(NUMBER for _ in head)), rows)


def _cell(one: HorizonError) -> str:
    text = f"{sized(one.initial, one.unit)} → {sized(one.identified, one.unit)}"
    return cell("marked", "worse", text) if one.identified > one.initial else text


def horizon_figure(errors: Sequence[HorizonError]) -> Markup:
    """Both errors against the horizon, a panel for each joint or pose, in the order of `errors`.

    Where there are too many panels, those that were missed most are shown.
    """
    every = list(_by_line(errors).items())
    most = sorted(range(len(every)), key=lambda row: -_missed(every[row][1][-1]))[: figures.MAX_PANELS]
    return figure([_horizon_panel(every[row][0], every[row][1]) for row in sorted(most)])


def _horizon_panel(name: tuple[str, str], line: Sequence[HorizonError]) -> Panel:
    factor, unit = (1e3, "mm") if line[0].unit == "m" else shown_unit(line[0].unit)
    seconds = np.array([one.horizon for one in line])
    many = np.array([one.clips >= FEWEST for one in line])
    lines = []
    both = {"before": [one.initial for one in line], "after": [one.identified for one in line]}
    for color, values in both.items():
        shape = "dashed" if color == "before" else "line"
        known = factor * np.where(np.isfinite(values), values, np.nan)
        lines += [Curve(seconds, known, color, color, "dots")]
        lines += [Curve(seconds[many], known[many], "", color, shape)] if many.sum() > 1 else []
    return Panel(name[1] or name[0], lines, unit, "time after the start [s]", low=0.0)


def _missed(error: HorizonError) -> float:
    """Error before identification, in units of the motion where that is known."""
    return error.initial / error.moved if error.moved > 0.0 else error.initial


def sized(value: float, unit: str) -> str:
    """An error in degrees or millimetres, or in its own unit."""
    if math.isinf(value):
        return "diverged"
    if unit == "rad":
        return numbers.angle(value)
    return numbers.length(value) if unit == "m" else numbers.quantity(f"{value:.3g}", unit)


def error_rows(held_out: HeldOut) -> list[tuple[str, str, str]]:
    """Name, value before and after of each error that the system measures, as texts."""
    h = held_out
    rows = [
        ("position error", h.initial_position_error_m, h.position_error_m, "m"),
        ("orientation error", h.initial_orientation_error_rad, h.orientation_error_rad, "rad"),
    ]
    whole = {(one.channel, one.unit): one for one in reversed(h.errors)}
    joints = {"rad", "m"} if math.isnan(h.position_error_m) else {"rad"}  # a body's position has its row
    rows += [
        (f"{one.channel.split(_EFFORT)[-1]} error", one.initial, one.identified, one.unit)
        for (key, unit), one in sorted(whole.items())
        if _EFFORT in key or (key.endswith(".position") and unit in joints)
    ]
    return [
        (name, sized(before, unit), sized(after, unit))
        for name, before, after, unit in rows
        if not math.isnan(after)
    ]


def _costs(held_out: HeldOut) -> list[tuple[str, str, str]]:
    costs = [("cost", held_out.initial_cost, held_out.cost)]
    if math.isfinite(held_out.fitted_cost):
        costs.append(("with first states fitted", held_out.initial_fitted_cost, held_out.fitted_cost))
    return [(name, f"{before:.3g}", f"{after:.3g}") for name, before, after in costs]


def _validation_table(held_out: HeldOut) -> Table:
    rows = _costs(held_out) + [(f"mean {name}", *both) for name, *both in error_rows(held_out)]
    clips = f"{held_out.clips} clip{'s' * (held_out.clips != 1)}"
    return Table((clips, "before", "after"), ("", f"{NUMBER} soft", STRONG), rows)
