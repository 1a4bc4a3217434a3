"""The page of `amhe view` in a real browser."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import amhe_cli as amhe
from amhe_cli.view.open import view_of
from amhe_cli.view.server import PageServer
from tests.view.browser import PIXELS, Browser, Chromium

FRAMES = "new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => done(player.now))))"

#: Share of the scene's pixels that differ from those of the call before.
CHANGED = """(() => {
  const c = document.getElementById('scene'), gl = c.getContext('webgl2');
  const p = new Uint8Array(4 * c.width * c.height);
  gl.readPixels(0, 0, c.width, c.height, gl.RGBA, gl.UNSIGNED_BYTE, p);
  const shown = new Uint32Array(p.buffer), before = window.shown ?? shown;
  window.shown = shown;
  return shown.filter((pixel, i) => pixel !== before[i]).length / shown.length;
})()"""


@pytest.fixture(scope="module")
def page(pendulum_log: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    system = amhe.System.load("pendulum")
    belief = system.space.nominal * 1.2
    known = amhe.Belief("pendulum", system.space.names, tuple(p.unit for p in system.space.parameters),
                        (True,) * 4, belief, 1e-4 * np.eye(4))  # fmt: skip
    log = amhe.read_log(pendulum_log, system)
    verdicts = {"load_mass": "identified"}
    view = view_of(system.starting_from(known, belief_anyway=True)[0], [log], belief=known, verdicts=verdicts)
    path = tmp_path_factory.mktemp("page") / "page.html"
    path.write_text(view.page(report="report.html"), encoding="utf-8")
    return path


@pytest.fixture
def opened(page: Path, tab: Browser) -> Browser:
    tab.cut_off()
    tab.open(page.as_uri())
    return tab


def test_a_failure_leaves_a_picture(chromium: Chromium, tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), chromium.tab(tmp_path) as one:
        one.open("about:blank")
        _ = 1 / 0
    assert (tmp_path / "failure.png").read_bytes().startswith(b"\x89PNG")


def seek(one: Browser, share: float) -> None:
    one.run(
        f"(() => {{ const t = document.getElementById('time'); t.value = +t.min + {share} * (t.max - t.min); "
        f"t.dispatchEvent(new Event('input')); return {FRAMES}; }})()"
    )


def test_it_opens_from_a_file_without_a_network_and_draws(opened: Browser, page: Path) -> None:
    _, colors = opened.run(PIXELS)
    assert colors > 50
    assert opened.requests == [page.as_uri()]
    assert opened.run("document.getElementById('failure').hidden")


def test_a_lost_graphics_context_is_said_and_comes_back(opened: Browser) -> None:
    before, scene = opened.run(PIXELS), "document.getElementById('scene')"
    opened.run(f"window.context = {scene}.getContext('webgl2').getExtension('WEBGL_lose_context')")
    for event, ask in (("lost", "loseContext"), ("restored", "restoreContext")):
        opened.run(
            f"new Promise((done) => {{ {scene}.addEventListener('webglcontext{event}', done, {{once: true}});"
            f" context.{ask}(); }}).then(() => {FRAMES})"
        )
        said = opened.run("document.getElementById('failure').innerText")
        assert ("Reload the page" in said) == (event == "lost"), said
        assert opened.run(f"getComputedStyle({scene}).visibility") == {"lost": "hidden"}.get(event, "visible")
    assert opened.run(PIXELS) == before


def test_scrubbing_changes_time_picture_and_numbers(opened: Browser) -> None:
    seek(opened, 0.1)
    first, clock = opened.run(PIXELS), opened.run("document.getElementById('clock').textContent")
    seek(opened, 0.9)
    assert opened.run(PIXELS)[0] != first[0]
    assert opened.run("document.getElementById('clock').textContent") != clock


def test_a_lone_plot_is_as_wide_as_its_part_of_the_page(opened: Browser) -> None:
    widths = opened.run(
        "[document.querySelectorAll('.panel > svg').length, document.getElementById('panels').clientWidth, "
        "document.querySelector('.panel > svg').clientWidth]"
    )
    assert widths[0] == 1 and widths[1] == widths[2] > 600


def test_numbers_beside_a_plot_have_the_colours_of_its_legend(opened: Browser) -> None:
    seek(opened, 0.5)
    key = opened.run(
        "[...document.querySelectorAll('.legend span')]"
        ".map((one) => [one.textContent, one.firstChild.style.getPropertyValue('--c')])"
    )
    numbers = opened.run(
        "[...document.querySelector('.panel .caption').querySelectorAll('b')]"
        ".filter((one) => !one.title.includes('\u2212')).map((one) => [one.title, one.style.color])"
    )
    assert [name for name, _ in key] == ["before", "after", "measured"]
    assert sorted(numbers) == sorted(key)


def test_playing_goes_on_and_pausing_stops(opened: Browser) -> None:
    seek(opened, 0.0)
    start = opened.run("player.now")
    opened.run("document.getElementById('play').click()")
    assert opened.run("document.getElementById('play').getAttribute('aria-label')") == "Pause"
    moved = opened.run(
        "new Promise((done) => { const wait = () => player.now > "
        + str(start)
        + " ? done(player.now) : setTimeout(wait, 20); wait(); })"
    )
    assert moved > start
    opened.run("document.getElementById('play').click()")
    assert opened.run(FRAMES) == opened.run(FRAMES)


def test_a_step_is_one_frame(opened: Browser) -> None:
    seek(opened, 0.0)
    start = opened.run("player.now")
    opened.run("document.getElementById('forth').click()")
    assert opened.run("player.now - " + str(start)) == pytest.approx(opened.run("player.take.tracks[0].step"))


def test_a_ghost_comes_and_goes(opened: Browser) -> None:
    seek(opened, 1.0)
    shown = opened.run(PIXELS)[0]
    toggle = "[...document.querySelectorAll('#layers input')][1].click()"
    opened.run(toggle)
    hidden = opened.run(f"{FRAMES}.then(() => {PIXELS})")[0]
    assert hidden != shown
    opened.run(toggle)
    assert opened.run(f"{FRAMES}.then(() => {PIXELS})")[0] == shown


def test_a_ghost_that_nearly_coincides_with_its_body_leaves_no_patches(opened: Browser) -> None:
    opened.run("player.choose(player.takes[0])")
    seek(opened, 0.02)
    changed = []
    for hidden in ([0, 1, 2], [1, 2], []):  # rows of measured, before, after
        opened.run(
            "[...document.querySelectorAll('#layers input')].slice(0, 3).forEach((box, i) => "
            f"{{ if (box.checked === {hidden}.includes(i)) box.click(); }})"
        )
        opened.run(FRAMES)
        changed.append(opened.run(CHANGED))
    _, body, ghosts = changed
    assert 0.0 < ghosts < 0.3 * body  # the edges of the ghosts


def test_the_worst_clip_comes_first_and_another_can_be_chosen(opened: Browser) -> None:
    costs = opened.run("player.takes.map((take) => take.costs.at(-1))")
    assert len(costs) >= 3
    assert costs == sorted(costs, reverse=True)
    opened.run("document.querySelectorAll('.clip')[1].click()")
    assert opened.run(
        "player.take === player.takes[1] && player.now >= player.take.start && player.now <= player.take.stop"
    )
    opened.run("document.getElementById('whole').click()")
    assert opened.run("player.end") == pytest.approx(8.0, abs=0.1)


def test_every_control_has_a_name(opened: Browser) -> None:
    nameless = opened.run(
        "[...document.querySelectorAll('button, select, input, canvas[role], [role=listbox]')]"
        ".filter((e) => ![e.getAttribute('aria-label'), e.textContent, e.labels?.[0]?.textContent]"
        ".some((text) => text?.trim())).length"
    )
    assert nameless == 0
    assert opened.run("document.documentElement.lang") == "en"


#: The farthest of all corners from the middle of the picture: 1 is at its edge.
FARTHEST = """(() => {
  const { stage, now } = player, { wide, half } = stage.lens(), { around, above, away } = stage.camera;
  const at = player.middle(player.take, player.recording.track, now);
  const back = [Math.cos(around) * Math.cos(above), Math.sin(around) * Math.cos(above), Math.sin(above)];
  const right = unit(cross([0, 0, 1], back)), top = cross(back, right), eye = add(at, times(back, away));
  return Math.max(...player.take.tracks.flatMap((track) => stage.corners(track.at(now - player.take.start))).map((corner) => {
    const place = less(corner, eye), deep = -dot(place, back);
    return Math.max(Math.abs(dot(place, right)) / wide, Math.abs(dot(place, top))) / (half * deep);
  }));
})()"""  # noqa: E501


@pytest.mark.medium
@pytest.mark.parametrize("width", [390, 1280])
def test_all_that_moves_stays_in_the_picture(opened: Browser, page: Path, width: int) -> None:
    opened.open(page.as_uri(), width, 900)
    farthest = []
    for clip in range(3):
        opened.run(f"player.choose(player.takes[{clip}])")
        for share in (0.0, 0.3, 0.6, 1.0):
            seek(opened, share)
            farthest.append(opened.run(FARTHEST))
    assert 0.6 < max(farthest) < 1.0, farthest


def test_an_address_names_a_clip_and_a_time(opened: Browser, page: Path) -> None:
    start = opened.run("player.takes[2].start")
    opened.open(f"{page.as_uri()}#clip=3&t={start + 0.2:.2f}")
    assert opened.run("player.takes.indexOf(player.take)") == 2
    assert opened.run("player.now") == pytest.approx(start + 0.2, abs=0.01)
    opened.run("location.hash = '#clip=1'")
    assert opened.run(f"{FRAMES}.then(() => player.takes.indexOf(player.take))") == 0


def test_verdicts_and_the_report_stand_on_the_page(opened: Browser) -> None:
    assert opened.run("document.querySelector('#report a').getAttribute('href')") == "report.html"
    assert opened.run("document.querySelector('#parameters .verdict').textContent") == "identified"


def test_colours_of_distance_mean_the_same_in_every_clip(opened: Browser) -> None:
    opened.run("document.getElementById('distance').click()")
    scales = set()
    for i in range(3):
        opened.run(f"player.choose(player.takes[{i}])")
        scales.add(opened.run(f"{FRAMES}.then(() => document.getElementById('most').textContent)"))
    assert len(scales) == 1


def test_a_served_page_predicts_again_when_a_slider_is_dragged(
    page: Path, tab: Browser, pendulum_log: Path
) -> None:
    system = amhe.System.load("pendulum")
    view = view_of(system, [amhe.read_log(pendulum_log, system)])
    with PageServer(view.page(asks=True), answer=view.answer) as server:
        tab.open(server.address)
        tab.run(
            "(() => { const one = document.querySelector('.slide input'); one.value = 0.9; "
            "one.dispatchEvent(new Event('input')); })()"
        )
        cost = tab.run(
            "new Promise((done) => { const wait = () => player.take.yours ? done(player.take.yours.cost) : "
            "setTimeout(wait, 20); wait(); })"
        )
        mass = tab.run("player.sliders.get('load_mass')()")
    values = {name: str(value) for name, value in system.space.named(system.space.nominal).items()}
    assert mass > 1.2 * float(values["load_mass"])
    asked = view.answer({"take": "0", **values, "load_mass": str(mass)})
    assert cost == pytest.approx(asked["cost"])
    assert "yours: cost" in tab.run("document.getElementById('tried').textContent")


@pytest.mark.medium
def test_what_is_left_is_the_misfit_in_units_of_the_noise(opened: Browser) -> None:
    pick = "document.getElementById('channel')"
    opened.run(f"{pick}.value = LEFT_OVER; {pick}.dispatchEvent(new Event('change'))")
    panels = opened.run("document.querySelectorAll('.panel > svg').length")
    assert panels == opened.run("player.data.columns.filter((column) => column.noise).length")
    left = "player.data.columns.map((column, k) => player.left({ ...column, k }))"
    shown = opened.run("player.plots.panels[0].lines.map((line) => [line.name, Array.from(line.y)])")
    assert [name for name, _ in shown] == ["before", "after"]
    missed = np.array(opened.run(f"Math.max(...{left})"))
    own = np.array([value for value in shown[1][1] if value is not None])
    assert 0.1 * missed < np.sqrt(np.mean(own**2)) < 10.0 * missed
