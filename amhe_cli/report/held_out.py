"""What a page says of clips that were not fitted."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from markupsafe import Markup

from amhe_cli.estimation.core.result import HeldOut, HorizonError, SpanError
from amhe_cli.report import figures, numbers
from amhe_cli.report.page import Key, Section, Statement
from amhe_cli.report.tables import NUMBER, STRONG, Table

#: In the names of channels of which each is the effort of one joint, along the measured motion.
_EFFORT = ".effort of "


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
    costs = f"from {held_out.initial_cost:.3g} to {held_out.cost:.3g}"
    costs += "" if _along(held_out) else " from recorded first states"
    falls = held_out.cost < held_out.initial_cost
    if math.isfinite(held_out.fitted_cost):
        costs += (
            f", and from {held_out.initial_fitted_cost:.3g} to {held_out.fitted_cost:.3g} from fitted ones"
        )
        falls |= held_out.fitted_cost < held_out.initial_fitted_cost
    if falls:
        yield Statement("good", f"On {clips} the cost goes {costs}{_errors(held_out)}.")
    else:
        yield Statement(
            "mixed",
            f"On {clips} the cost does not fall ({costs}): the values do not predict unseen data better "
            "than the initial ones.",
        )


def held_out_sections(held_out: HeldOut) -> Iterator[Section]:
    """Costs and errors on held-out clips, and errors over time."""
    yield Section("Validation on clips that were not fitted", table=_validation_table(held_out))
    if held_out.horizons:
        yield Section(
            "Error against horizon, on data that was not fitted",
            text="Predictions start from a recorded state and follow the recorded commands. Each cell is the "
            "rms error after so much time, before identification → after it; the last column goes to the end "
            "of the held-out parts, and beside the name stands how far the measured value moved by then.",
            legend=(
                Key("before identification", figures.INITIAL, "dashed"),
                Key("after it", figures.IDENTIFIED),
            ),
            table=horizon_table(held_out.horizons),
            figure=horizon_figure(held_out.horizons),
        )
    if held_out.errors and not _along(held_out):
        yield Section(
            "Error over time, on clips that were not fitted",
            text="Mean errors over spans of time from the clips' start: from the recorded first state, as "
            "you would predict, and with the first state fitted, as those of fitted clips are. What is left "
            "then is not the noise of the first sample.",
            table=_span_table(held_out.errors),
        )


def _by_line(errors: Sequence[HorizonError]) -> dict[tuple[str, str], list[HorizonError]]:
    """The errors of each joint or pose, by its channel and name."""
    lines: dict[tuple[str, str], list[HorizonError]] = {}
    for one in errors:
        lines.setdefault((one.channel, one.column), []).append(one)
    return lines


def horizon_table(errors: Sequence[HorizonError]) -> Table:
    """A row for each joint or pose, columns for each horizon: what it moved, and both errors."""
    horizons = list(dict.fromkeys((one.to_end, one.horizon) for one in errors))
    rows = []
    for (channel, column), line in _by_line(errors).items():
        found = {(one.to_end, one.horizon): one for one in line}
        cells = [
            f"{sized(one.initial, one.unit)} → {sized(one.identified, one.unit)}"
            if (one := found.get(key))
            else numbers.MISSING
            for key in horizons
        ]
        longest = line[-1]
        rows.append((column or channel, sized(longest.moved, longest.unit), *cells))
    head = [f"after {seconds:.3g} s{' (end)' * to_end}" for to_end, seconds in horizons]
    return Table(("", "moves by", *head), ("name", f"{NUMBER} soft", *(NUMBER for _ in head)), rows)


def horizon_figure(errors: Sequence[HorizonError]) -> Markup:
    """Both errors against the horizon, a panel for each joint or pose, in the order of `errors`.

    Where there are too many panels, those that were missed most are shown.
    """
    every = list(_by_line(errors).items())
    most = sorted(range(len(every)), key=lambda row: -_missed(every[row][1][-1]))[: figures.MAX_PANELS]
    lines = [every[row] for row in sorted(most)]
    grid = figures.Grid(len(lines), min(3, len(lines)), height=2.2)
    with figures.styled("horizon"):
        figure = grid.figure()
        for index, ((channel, column), line) in enumerate(lines):
            axes = grid.axes(figure, index)
            own = line[0].unit
            factor, unit = {"rad": (180.0 / math.pi, "°"), "m": (1e3, "mm")}.get(own, (1.0, own))
            seconds = [one.horizon for one in line]
            for values, color, style in (
                ([one.initial for one in line], figures.INITIAL, "o--"),
                ([one.identified for one in line], figures.IDENTIFIED, "o-"),
            ):
                known = [factor * value if math.isfinite(value) else math.nan for value in values]
                axes.plot(seconds, known, style, color=color, markersize=3, linewidth=1.2)
            axes.set_title(f"{column or channel} [{unit}]" if unit else column or channel)
            axes.set_xlabel("horizon [s]")
            axes.set_xlim(left=0.0)
            axes.set_ylim(bottom=0.0)
        return figures.svg(figure)


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


def _along(held_out: HeldOut) -> bool:
    """Whether efforts along the measured motion were compared: there are no first states."""
    return any(_EFFORT in one.channel for one in held_out.errors)


def _errors(held_out: HeldOut) -> str:
    return "".join(
        f", the mean {name} from {before} to {after}" for name, before, after in error_rows(held_out)
    )


def error_rows(held_out: HeldOut) -> list[tuple[str, str, str]]:
    """Name, initial and identified value of each error that the system measures, as texts."""
    h, length, angle = held_out, numbers.length, numbers.angle
    rows = [
        ("position error", length(h.initial_position_error_m), length(h.position_error_m)),
        ("orientation error", angle(h.initial_orientation_error_rad), angle(h.orientation_error_rad)),
    ]
    whole = {one.channel: one for one in reversed(h.errors)}
    rows += [
        (
            f"{one.channel.split(_EFFORT)[-1]} error",
            f"{one.initial:.3g} {one.unit}",
            f"{one.identified:.3g} {one.unit}",
        )
        for key, one in sorted(whole.items())
        if _EFFORT in key or (key.endswith(".position") and one.unit in ("rad", "rad or m"))
    ]
    return [row for row in rows if row[2] != numbers.MISSING]


def _validation_table(held_out: HeldOut) -> Table:
    clips = f"{held_out.clips} clip{'s' * (held_out.clips != 1)}"
    first = "" if _along(held_out) else ", from recorded first states"
    rows = [(f"cost{first}", f"{held_out.initial_cost:.4g}", f"{held_out.cost:.4g}")]
    if math.isfinite(held_out.fitted_cost):
        fitted = (f"{held_out.initial_fitted_cost:.4g}", f"{held_out.fitted_cost:.4g}")
        rows.append(("cost, with first states fitted", *fitted))
    rows += [(f"mean {name}", before, after) for name, before, after in error_rows(held_out)]
    return Table((clips, "initial", "identified"), ("", f"{NUMBER} soft", STRONG), rows)


def _span_table(errors: Sequence[SpanError]) -> Table:
    rows = [
        (
            f"{one.channel} [{one.unit}]",
            f"{one.start:.3g} to {one.end:.3g} s",
            *(f"{value:.3g}" for value in (one.initial, one.identified)),
            *(f"{value:.3g}" for value in (one.initial_fitted, one.identified_fitted)),
        )
        for one in errors
    ]
    columns = ("recorded: initial", "identified", "fitted: initial", "identified ")
    soft = f"{NUMBER} soft"
    return Table(("channel", "span", *columns), ("name", "", soft, STRONG, soft, STRONG), rows)
