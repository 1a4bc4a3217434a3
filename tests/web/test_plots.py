"""Figures as data, and as plots.js draws them in a real browser."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from amhe_cli.report.page import Section, page
from amhe_cli.web.plots import Curve, Mark, Panel, color_of, figure, thinned
from tests.view.browser import Browser
from tests.web.figures import panels


def html(*of: Panel) -> str:
    section = Section("Motion", figure=figure(of))
    return page("run", title="T", facts=(), headline="It ran.", statements=(), sections=[section])


def test_values_keep_four_digits_of_their_range_and_gaps_stay_open() -> None:
    time = np.linspace(1e3, 1e3 + 1.0, 5)
    (panel,) = panels(html(Panel("a<b", [Curve(time, np.array([0.0, 1 / 3, np.nan, np.inf, 2.0]))])))
    (line,) = panel["lines"]
    assert line["y"] == [0.0, 0.3333, None, None, 2.0]
    assert line["x"] == pytest.approx(time, abs=1e-4)
    assert panel["title"] == "a<b" and "a<b" not in html(Panel("a<b", []))


def test_a_long_line_keeps_its_peaks_and_gaps() -> None:
    y = np.zeros(100_000)
    y[70_001], y[200], y[50_000:60_000], y[30_100] = 5.0, -3.0, np.nan, np.nan
    x, kept = thinned(np.arange(y.size, dtype=float), y)
    assert len(x) <= 302 and np.nanmax(kept) == 5.0 and np.nanmin(kept) == -3.0
    assert {30_100.0, 50_000.0} <= set(x[np.isnan(kept)]), "gaps stay open, one of a single sample too"


def test_no_two_of_many_lines_are_alike() -> None:
    assert len({tuple(color_of(i).values()) for i in range(24)}) == 24


def test_no_panels_leave_nothing() -> None:
    assert figure([]) == ""


@pytest.fixture
def opened(tab: Browser, tmp_path: Path) -> Browser:
    time = np.linspace(0.0, 2.0, 21)
    lines = [
        Curve(time, 0.5 * time, "before", "before", "dashed", leads=False),
        Curve(time, time, "after"),
        Curve(time[::5], 1.1 * time[::5], "measured", "measured", "dots"),
    ]
    away = np.array([0.0, 1e9, 1.0])
    both = [
        Panel("angle", lines, "°", marks=[Mark((0.5, 1.0), "held out")]),
        Panel("a cause", [Curve(time, time**2, "force", "measured", "dots")], x="speed [m/s]"),
        Panel(
            "far", [Curve(time, time, "after"), Curve(np.array([0.0, 1.0, 2.0]), away, "before", leads=False)]
        ),
        Panel("high", [Curve(time, 100.0 + time)]),
    ]
    (tmp_path / "page.html").write_text(html(*both), encoding="utf-8")
    tab.open((tmp_path / "page.html").as_uri())
    tab.run("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    return tab


def pointed(one: Browser, panel: int, x: float, kind: str = "pointermove") -> Any:
    """The numbers above a panel with the pointer at a place of its x."""
    return one.run(
        f"(() => {{ const svg = document.querySelectorAll('.panel > svg')[{panel}];"
        "const { left, width, top } = svg.getBoundingClientRect();"
        f"const at = {{ clientX: left + LEFT + {x} * (width - LEFT - RIGHT), clientY: top + 40 }};"
        f"svg.dispatchEvent(new PointerEvent('{kind}', at));"
        "return [...document.querySelectorAll('.caption')].map((one) => one.lastChild.textContent); })()"
    )


pytestmark = pytest.mark.medium


def test_the_pointer_reads_the_nearest_sample_of_each_line_and_their_difference(opened: Browser) -> None:
    first, _, far, _ = pointed(opened, 0, 0.52)  # measured at 0, 0.5, 1, 1.5 and 2
    assert first == "1.00 s0.501.001.10Δ\u00a00.10"
    assert far.startswith("1.00 s"), "panels over the same x go together"
    assert opened.run("document.querySelectorAll('.panel circle').length") == 5


def test_panels_over_no_time_read_the_sample_that_is_nearest_to_the_pointer(opened: Browser) -> None:
    texts = pointed(opened, 1, 0.98)
    assert texts[0] == "" and texts[1].startswith("1.90 m/s3.6")


def test_what_runs_away_leaves_the_picture_and_flattens_nothing(opened: Browser) -> None:
    top = opened.run("Math.max(...[...document.querySelectorAll('.panel')[2].querySelectorAll('.axes text')]"
                     ".map((one) => Number(one.textContent)).filter(Number.isFinite))")  # fmt: skip
    assert 2.0 <= top < 10.0


def test_an_axis_holds_its_lines_and_marks_and_nothing_else(opened: Browser) -> None:
    texts = "document.querySelectorAll('.panel')[3].querySelectorAll('.axes text')"
    numbers = opened.run(f"[...{texts}].map((one) => Number(one.textContent)).filter(Number.isFinite)")
    high = [one for one in numbers if one > 2.0 or one < 0.0]
    assert len(high) >= 2 and min(high) >= 99.5 and max(high) <= 102.5
    assert numbers.count(0.0) <= 1, "only the time begins at 0"


def test_dragging_zooms_and_a_double_click_shows_all_again(opened: Browser) -> None:
    texts = "document.querySelector('.panel svg').querySelectorAll('.axes text')"
    ends = f"[...{texts}].map((one) => one.textContent)"
    whole = opened.run(ends)
    opened.run("Element.prototype.setPointerCapture = () => {}")
    pointed(opened, 0, 0.25, "pointerdown")
    pointed(opened, 0, 0.5, "pointerup")
    zoomed = opened.run(ends)
    assert zoomed != whole and "0.6" in zoomed and "2.0" not in zoomed
    pointed(opened, 0, 0.5, "dblclick")
    assert opened.run(ends) == whole


def test_a_legend_says_what_each_shape_is(opened: Browser) -> None:
    texts, shapes = (
        opened.run(f"[...document.querySelectorAll('.legend span')].map((one) => one.{what})")
        for what in ("textContent", "firstChild.className")
    )
    assert texts == ["before", "after", "measured", "held out", "force"]
    assert shapes == ["dashed", "line", "dots", "patch", "dots"]


def test_an_axis_has_at_least_two_numbers_and_never_too_many(opened: Browser) -> None:
    counts = opened.run(
        "(() => { const found = []; for (let high = 1; high < 100; high *= 1.01) "
        "for (const low of [0, 0.37 * high]) found.push(ticks(low, high, 3).length); return found; })()"
    )
    assert min(counts) == 2 and max(counts) <= 6
