"""What a notebook shows of a log, a system and a belief: sections as on the pages of reports."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import singledispatch
from pathlib import Path

import numpy as np
from markupsafe import Markup

from amhe_cli.core.belief import Belief
from amhe_cli.core.errors import printable
from amhe_cli.core.log import Log
from amhe_cli.core.shown import Displayed, SavedView
from amhe_cli.core.signals import QUANTITIES, Series
from amhe_cli.core.statistics import Z90, correlation
from amhe_cli.estimation.core.result import Identification
from amhe_cli.logs.read import truth_in_metadata
from amhe_cli.report import numbers
from amhe_cli.report.identification import parameter_table
from amhe_cli.report.identification_page import headline, statements
from amhe_cli.report.page import Section
from amhe_cli.report.tables import NUMBER, STRONG, Table
from amhe_cli.system.system import System
from amhe_cli.web.page import said, template
from amhe_cli.web.plots import Curve, Panel, color_of, figure, shown_unit

#: Panels of a log's figure; the table has all series.
MOST_PANELS = 12


def shown(value: Displayed) -> SavedView:
    """The page of a value."""
    return view(tuple(sections_of(value)), type(value).__name__)


def view(sections: Sequence[Section], title: str) -> SavedView:
    """Sections as a page that a notebook can show."""
    return SavedView(template("shown.html.j2").render(title=f"amhe {title}", sections=sections), height=500)


def html_table(table: Table) -> Markup:
    """A table that takes the colours of the text around it, for notebooks."""
    line = "border:0;border-bottom:1px solid rgba(128,128,128,.3);padding:4px 12px 4px 0;background:none;"
    line += "white-space:nowrap"

    def row(cells: Sequence[str], name: str) -> Markup:
        sides = ("right" if "number" in look else "left" for look in table.looks)
        styled = [
            Markup('<{0} style="{1};text-align:{2}">{3}</{0}>').format(name, line, side, printable(str(text)))
            for side, text in zip(sides, cells, strict=True)
        ]
        return Markup("<tr style='background:none'>{}</tr>").format(Markup("").join(styled))

    rows = Markup("").join([row(table.head, "th"), *(row(one, "td") for one in table.rows)])
    return Markup(
        '<div style="overflow-x:auto"><table style="color:inherit;border-collapse:collapse">{}</table></div>'
    ).format(rows)


def result_html(found: Identification) -> str:
    """What was identified, as a table and sentences in the colours of the text around them."""
    notes = Markup("").join([Markup("<li>{}</li>").format(said(one.text)) for one in statements(found)])
    table = parameter_table(found.lines)
    # verdicts second, as on pages: a narrow frame shows them, too
    head, looks, *rows = ((row[0], row[-1], *row[1:-1]) for row in (table.head, table.looks, *table.rows))
    shown = html_table(Table(head, looks, rows))
    return str(Markup("<p><b>{}</b></p>{}<ul>{}</ul>").format(headline(found), shown, notes))


@singledispatch
def sections_of(value: Displayed) -> Iterator[Section]:
    """The sections of a value's page."""
    raise TypeError(f"no page shows a {type(value).__name__}")


@sections_of.register
def _of_log(log: Log) -> Iterator[Section]:
    about = [f"{log.duration:.4g} s in steps of {log.dt:g} s"]
    about += [f"{key} {text}" for key, text in log.metadata.items() if key in ("system", "seed")]
    truth = truth_in_metadata([log])
    about += [f"true values: {numbers.named(truth)}"] if truth else []
    about += [f"known: {numbers.named(log.known)}"] if log.known else []
    about += ["only validates"] if log.held_out else []
    rows = [
        (
            key,
            _rate(log, one),
            numbers.percent(float(one.valid.mean()) if one.valid.size else 0.0),
            _range(one, shown_unit(unit)[0]),
            shown_unit(unit)[1],
            ", ".join(one.columns),
        )
        for key, one, unit in _of_one_unit(log)
    ]
    head = ("series", "measured", "without gaps", "values", "unit", "columns")
    table = Table(head, ("name", NUMBER, NUMBER, NUMBER, "unit", "soft text"), rows)
    yield Section(Path(log.source).name, text=" · ".join(about), table=table, figure=log_figure(log))


@sections_of.register
def _of_system(system: System) -> Iterator[Section]:
    space, sets = system.space, system.sets
    ends = [space.theta_of(np.full(len(space), side * Z90)) for side in (-1.0, 1.0)]
    rows = [
        (
            p.name, f"{p.nominal:.4g}", numbers.unit_of(p.unit), numbers.interval(float(low), float(high)),
            f"{p.lower:.4g} to {p.upper:.4g}", sets.get(p.name, ""),
        )
        for p, low, high in zip(space.parameters, *ends, strict=True)
    ]  # fmt: skip
    head = ("parameter", "nominal", "unit", "90 % of the prior", "bounds", "sets")
    fixed = f"Taken as known: {numbers.named(system.fixed)}." if system.fixed else ""
    looks = ("name", STRONG, "unit", NUMBER, f"{NUMBER} soft", "soft text")
    yield Section(system.name, table=Table(head, looks, rows), note=fixed)
    signals = [
        (
            one.name, "drives the model" if one.is_input else "is compared", one.topic,
            ", ".join(one.quantities), ", ".join(one.names),
        )
        for one in system.signals
    ]  # fmt: skip
    looks = ("name", "", "name", "", "soft text")
    yield Section("Signals", table=Table(("signal", "", "topic", "quantities", "entries"), looks, signals))


@sections_of.register
def _of_belief(belief: Belief) -> Iterator[Section]:
    values = zip(belief.estimate, belief.sd, *belief.interval, strict=True)
    rows = [
        (name, numbers.with_sd(value, spread), numbers.unit_of(unit), numbers.interval(lower, upper))
        for name, unit, (value, spread, lower, upper) in zip(belief.names, belief.units, values, strict=True)
    ]
    fixed = f"It rests on {numbers.named(belief.fixed)}, taken as known." if belief.fixed else ""
    table = Table(
        ("parameter", "estimate ± sd", "unit", "90 % interval"), ("name", STRONG, "unit", NUMBER), rows
    )
    yield Section(f"Belief about {belief.system}", table=table, note=fixed)
    if 1 < len(belief.names) <= MOST_PANELS and (belief.sd > 0.0).all():
        values = [[f"{value:.2f}" for value in row] for row in correlation(belief.covariance)]
        rows = [(name, *row) for name, row in zip(belief.names, values, strict=True)]
        looks = ("name", *(NUMBER for _ in rows))
        yield Section("Correlations", table=Table(("", *belief.names), looks, rows))


def log_figure(log: Log) -> Markup:
    """Each series over time, a panel each, gaps left open; '' for a log without samples."""
    drawn = [each for each in _of_one_unit(log) if each[1].valid.any()][:MOST_PANELS]
    return figure([_panel(log, *each) for each in drawn], 2)


def _of_one_unit(log: Log) -> Iterator[tuple[str, Series, str]]:
    """Each series with its unit; joints that turn apart from those that slide."""
    for key, one in log.series.items():
        usual = QUANTITIES.get(key.rpartition(".")[2], "any")
        units = log.units.get(key) or (usual if " or " not in usual else "",)
        for unit in dict.fromkeys(units):
            at = [i for i in range(len(one.columns)) if units[i % len(units)] == unit]
            part = (
                one
                if len(at) == len(one.columns)
                else replace(one, values=one.values[:, at], columns=tuple(one.columns[i] for i in at))
            )
            yield key, part, unit * (unit not in ("-", "any"))


def _panel(log: Log, key: str, one: Series, unit: str) -> Panel:
    time = log.dt * np.arange(log.steps, dtype=np.float64)
    factor, unit = shown_unit(unit)
    columns = factor * np.where(one.valid[:, None], one.values, np.nan).T
    names = [*one.columns, *map(str, range(len(one.columns), len(columns)))] if len(columns) > 1 else [""]
    lines = [
        Curve(time, values, name, **color_of(i))
        for i, (name, values) in enumerate(zip(names, columns, strict=True))
    ]
    return Panel(key, lines, unit)


def _rate(log: Log, one: Series) -> str:
    rows = np.flatnonzero(one.sampled)
    return f"{(rows.size - 1) / np.ptp(rows) / log.dt:.4g} Hz" if rows.size > 1 else numbers.MISSING


def _range(one: Series, factor: float) -> str:
    known = factor * one.values[one.valid]
    known = known[np.isfinite(known)]
    return f"{known.min():.3g} to {known.max():.3g}" if known.size else numbers.MISSING
