"""Pictures of clips in a report, and its figures under the pointer."""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from markupsafe import Markup

import amhe_cli as amhe
from amhe_cli.core.belief import belief_of
from amhe_cli.report.figures import Grid, correlation_figure, styled, svg, thinned
from amhe_cli.report.page import Origin, Page, Section
from amhe_cli.view.open import strips
from amhe_cli.view.strip import _outline
from tests.conftest import MODELS
from tests.view.browser import browser, needs_chromium

#: Where the tick labels and the ends of the line are, in shares of the first axes.
SHARES = """(() => {
  const svg = document.querySelector('svg[data-axes]'), [l, t, r, b] = JSON.parse(svg.dataset.axes)[0].box;
  const at = (x, y) => new DOMPoint(x, y).matrixTransform(svg.getScreenCTM());
  const start = at(l, b), end = at(r, t);
  const along = (x) => (x - start.x) / (end.x - start.x), up = (y) => (y - start.y) / (end.y - start.y);
  const found = { x: [], y: [], size: [r - l, b - t] };
  for (const text of svg.querySelectorAll('[class=x-new] text, [class=y-new] text, [id*=tick] text')) {
    const { left, right, top, bottom, width } = text.getBoundingClientRect();
    if (!width || getComputedStyle(text).visibility === 'hidden') continue;
    const below = (top + bottom) / 2 > start.y;
    const share = below ? along((left + right) / 2) : up((top + bottom) / 2);
    found[below ? 'x' : 'y'].push([text.textContent, share]);
  }
  const line = [...svg.querySelectorAll('[clip-path] [id^=line2d] path')].at(-1).getBoundingClientRect();
  return { ...found, line: [along(line.left), along(line.right)] };
})()"""

SVG = "{http://www.w3.org/2000/svg}"


def pictures(log: Path, z: float) -> list[tuple[str, list[ElementTree.Element]]]:
    """Names of the strips for an estimate z of all parameters, and their pictures."""
    system = amhe.System.load("pendulum")
    belief = belief_of(system, np.full(4, z), 1e-4 * np.eye(4))
    found = strips(system, [amhe.read_log(log, system)], [], belief)
    return [(name, ElementTree.fromstring(text).findall(f"{SVG}svg")) for name, text in found]


def ghosts(picture: ElementTree.Element) -> list[list[str]]:
    """Outlines of each ghost."""
    groups = [group for group in picture.findall(f"{SVG}g") if group.get("opacity") == "0.55"]
    return [[one.get("points", "") for one in group] for group in groups]


def test_the_worst_and_the_median_clip_at_three_instants(pendulum_log: Path) -> None:
    found = pictures(pendulum_log, 0.5)
    assert [name.partition(":")[0] for name, _ in found] == ["worst", "median"]
    for _, shown in found:
        times = [float(one.findall(f"{SVG}text")[0].text.split()[0]) for one in shown]  # type: ignore[union-attr]
        assert len(times) == 3
        assert np.diff(times) == pytest.approx(np.diff(times)[0], abs=0.05)
        nominal, identified = ghosts(shown[-1])
        assert nominal != identified


def test_all_bodies_are_inside_every_picture(pendulum_log: Path) -> None:
    for _, shown in pictures(pendulum_log, 0.5):
        for picture in shown:
            parts = list(picture)  # what stands still may leave it, and is drawn before the ghosts
            last = max(i for i, one in enumerate(parts) if one.tag == f"{SVG}g")
            bodies = [one.get("points", "") for one in parts[last:] if one.tag == f"{SVG}polygon"]
            places = np.array([pair.split(",") for text in bodies for pair in text.split()], dtype=float)
            assert (places > 0.0).all() and (places < (360.0, 250.0)).all()


def test_equal_parameters_give_equal_ghosts(pendulum_log: Path) -> None:
    for _, shown in pictures(pendulum_log, 0.0):
        for picture in shown:
            nominal, identified = ghosts(picture)
            assert nominal == identified


def test_a_model_without_shapes_has_no_pictures(pendulum_log: Path, tmp_path: Path) -> None:
    for name in ("scene.xml", "system.yaml"):
        text = (MODELS / "pendulum" / name).read_text(encoding="utf-8")
        (tmp_path / name).write_text(re.sub(r'<geom name="(rod|load)".*/>', "", text), encoding="utf-8")
    system = amhe.System.load(tmp_path)
    belief = belief_of(system, np.zeros(4), 1e-4 * np.eye(4))
    assert list(strips(system, [amhe.read_log(pendulum_log, system)], [], belief)) == []


def test_an_outline_holds_all_points_and_only_corners() -> None:
    inside = np.random.default_rng(0).uniform(1.0, 9.0, (50, 2))
    corners = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [0.0, 10.0]])
    found = _outline(np.concatenate((inside, corners, [[5.0, 0.0]])))
    assert sorted(found.tolist()) == sorted(corners.tolist())


@needs_chromium
def test_a_report_shows_numbers_under_the_pointer_and_zooms(tmp_path: Path) -> None:
    with styled("test"):
        figure = (grid := Grid(1, 1, 3.0)).figure()
        axes = grid.axes(figure, 0)
        axes.plot(*thinned(np.linspace(0.0, 8.0, 9), np.linspace(2.0, 4.0, 9)))
        axes.set_xlim(0.0, 8.0)
        axes.set_ylim(2.0, 4.0)
        element = svg(figure)
    with browser(tmp_path / "profile") as one:
        one.open(page_with(element, tmp_path))
        one.run("document.querySelector('svg[data-axes]').scrollIntoView()")
        middle = one.run(
            "(() => { const svg = document.querySelector('svg[data-axes]'), [l, t, r, b] = "
            "JSON.parse(svg.dataset.axes)[0].box, m = svg.getScreenCTM(); const at = (x, y) => "
            "{ const p = new DOMPoint(x, y).matrixTransform(m); return [p.x, p.y]; };"
            "return [at((l + r) / 2, (t + b) / 2), at(r - 20, b - 20)]; })()"
        )

        def mouse(kind: str, place: list[float], **more: object) -> None:
            one.ask("Input.dispatchMouseEvent", type=kind, x=place[0], y=place[1], **more)

        def drag(start: list[float], end: list[float]) -> None:
            mouse("mousePressed", start, button="left", clickCount=1)
            mouse("mouseMoved", end, button="left", buttons=1)
            mouse("mouseReleased", end, button="left", clickCount=1)

        mouse("mouseMoved", middle[0])
        x, y = map(float, one.run("document.querySelector('.tip').textContent").split(","))
        assert (x, y) == pytest.approx((4.0, 3.0), abs=0.05)
        before = one.run(SHARES)
        drag(*middle)
        width, height = before["size"]
        right, low = 8.0 * (1.0 - 20.0 / width), 2.0 + 2.0 * 20.0 / height
        after = one.run(SHARES)
        assert len(after["x"]) > 2 and len(after["y"]) > 2
        for name, first, last in (("x", 4.0, right), ("y", low, 3.0)):
            for text, share in after[name]:
                assert 0.0 <= share <= 1.0, "a tick label that has left the plot"
                assert float(text) == pytest.approx(first + share * (last - first), abs=0.02 * (last - first))
        assert after["line"] == pytest.approx([-4.0 / (right - 4.0), 4.0 / (right - 4.0)], abs=0.01)
        one.run("document.querySelector('svg[data-axes]').dispatchEvent(new Event('dblclick'))")
        assert one.run(SHARES) == before


def page_with(figure: Markup, folder: Path) -> str:
    """Address of a page that has a figure."""
    page = Page("identify", "x", (), "h", (), [Section("f", figure=figure)], (), Origin(("amhe",)))
    (folder / "page.html").write_text(page.html(), encoding="utf-8")
    return (folder / "page.html").as_uri()


@needs_chromium
def test_a_double_click_keeps_the_names_of_correlations(tmp_path: Path) -> None:
    names = ("load_mass", "friction_loss", "armature")
    with browser(tmp_path / "profile") as one:
        one.open(page_with(correlation_figure(names, np.eye(3)), tmp_path))
        shown = (
            "[...document.querySelectorAll('[id^=xtick] text')].filter((one) => "
            "getComputedStyle(one).visibility === 'visible').map((one) => one.textContent)"
        )
        assert one.run(shown) == list(names)
        one.run("document.querySelector('svg[data-axes]').dispatchEvent(new Event('dblclick'))")
        assert one.run(shown) == list(names)


@needs_chromium
def test_curves_stay_above_the_grid_and_shades_below_it(tmp_path: Path) -> None:
    with styled("test"):
        figure = (grid := Grid(1, 1, 3.0)).figure()
        axes = grid.axes(figure, 0)
        axes.plot([0.0, 1.0], [0.0, 1.0])
        axes.axvspan(0.2, 0.4, zorder=0)
        element = svg(figure)
    order = (
        "[...document.querySelectorAll('#axes_1 > g > g[transform] > g, #axes_1 > g[id^=matplotlib]')]"
        ".map((one) => one.id.replace(/_?\\d+$/, ''))"
    )
    with browser(tmp_path / "profile") as one:
        one.open(page_with(element, tmp_path))
        one.run("document.querySelector('svg[data-axes]').dispatchEvent(new Event('dblclick'))")
        assert one.run(order) == ["patch", "matplotlib.axis", "matplotlib.axis", "line2d"]
