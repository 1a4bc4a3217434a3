import base64
import hashlib
import json
import math
import re
from dataclasses import replace
from html import unescape
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from amhe_cli.core.files import plain
from amhe_cli.estimation.core.result import (
    VERDICTS,
    Against,
    ClipCount,
    HeldOut,
    HorizonError,
    Identification,
    Missing,
    MissingRow,
    ParameterResult,
    Reason,
)
from amhe_cli.report.figures import away, ellipse_figure
from amhe_cli.report.folder import PageError
from amhe_cli.report.identification import (
    held_out_line,
    identification_record,
    print_identification,
    write_identification,
)
from amhe_cli.report.identification_page import ALONE, Beside, identification_page, next_steps, statements
from amhe_cli.report.parameters import parted, reason_texts
from amhe_cli.system.system import System
from tests.report.synthetic import fit, identification, parameter
from tests.view.browser import Browser
from tests.web.figures import panels

ORIGIN = {
    "created": "2030-01-02T03:04:05+00:00",
    "command": "amhe identify <swing>.mcap",
    "seed": 0,
    "versions": {"amhe": "0.1.0", "mujoco": "4.0.0"},
    "system_files": {"system.yaml": "ab" * 32},
    "logs": {"swing.mcap": "cd" * 32},
    "held_out_logs": {},
}


WARNED = ("a gap of 0.6 s & more",)
#: A result without what takes long to draw, for what a page says elsewhere.
PLAIN: dict[str, Any] = {"fits": (), "iterations": ()}
TRUTH = {"load_mass": 0.74, "damping": 0.06, "another": 1.0}


def page(result: Identification, warnings: tuple[str, ...] = (), seen: Beside = ALONE) -> str:
    common = {"command": "identify", "version": "0.1.0", "seconds": 1.5, "warnings": list(warnings)}
    record = common | identification_record(result, TRUTH)
    return identification_page(result, record, ORIGIN, seen)


def stated(result: Identification) -> str:
    return " ".join(statement.text for statement in statements(result))


@pytest.fixture(scope="module")
def html() -> str:
    return page(identification(), WARNED)


@pytest.mark.medium
def test_the_page_needs_no_network(html: str) -> None:
    links = re.findall(r"""(?:src|href)=["']([^"']+)""", html)
    assert all(link.startswith("#") for link in links), links
    assert "<script src" not in html
    assert "url(http" not in html and "@import" not in html


def test_the_page_runs_its_own_script_only(html: str) -> None:
    (script,) = re.findall(r"<script>(.*?)</script>", html, re.DOTALL)
    policy = re.findall(r'Content-Security-Policy" content="([^"]*)"', html)[0]
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert policy.startswith("default-src 'none'; ") and f"script-src 'sha256-{digest}';" in policy


@pytest.mark.medium
def test_a_script_that_got_into_the_page_does_not_run(html: str, tab: Browser, tmp_path: Path) -> None:
    bad = "<script>window.ran = 1</script><img src=x onerror='window.ran = 1'></main>"
    (tmp_path / "page.html").write_text(html.replace("</main>", bad), encoding="utf-8")
    tab.open((tmp_path / "page.html").as_uri())
    assert tab.run("new Promise((done) => setTimeout(() => done(window.ran ?? 0), 200))") == 0
    assert tab.run("document.querySelector('.panel path') !== null"), "its own runs"


@pytest.mark.medium
def test_a_mesh_that_is_not_found_costs_no_result(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    room = "amhe_cli.report.identification"
    monkeypatch.setattr(f"{room}.identified_xml", lambda *_: "<mujoco/>")
    monkeypatch.setattr(f"{room}.identified_assets", lambda _: {"assets/a.stl": tmp_path / "nowhere.stl"})
    result = identification()
    common = {"command": "identify", "version": "0.1.0", "seconds": 1.5, "warnings": []}
    record = common | identification_record(result, TRUTH)
    system = System.load("pendulum", warn=False)
    write_identification(tmp_path / "out", system, result, result.belief, record, ORIGIN)
    assert (tmp_path / "out" / "belief.yaml").is_file()
    assert "identified.xml needs assets/a.stl beside it" in caplog.text


def test_the_page_names_the_command_that_shows_its_result() -> None:
    result = identification(**PLAIN)
    common = {"command": "identify", "version": "0.1.0", "seconds": 1.5, "warnings": []}
    record = common | identification_record(result, TRUTH) | {"out": "my result"}
    seen = Beside(page="<p>", link="view.html#clip=2&t=1.5")
    html = identification_page(result, record, ORIGIN, seen)
    assert (
        "<li>look: amhe view &#39;my result&#39;</li>" in html and 'href="view.html#clip=2&amp;t=1.5"' in html
    )
    assert "amhe view" not in identification_page(result, record, ORIGIN), "efforts have no view"


def test_what_to_do_next_is_to_mend_a_model_that_misses_its_logs() -> None:
    zeros = np.zeros(3)
    row = MissingRow("spring", "hip", "a spring", 0.9, (), {"hip_stiffness": {}}, ("q", zeros, zeros, zeros))
    against = Against("misfit", "it misses")
    missed = replace(identification(), unexplained=(against,), missing=Missing((row,), 0.02, 9))
    assert next_steps(missed, "r", True) == [
        "look: amhe view r",
        "mend: amhe identify with --repair tries spring@hip",
    ]
    touching = replace(missed, missing=None)
    assert next_steps(touching, "r", True) == ["look: amhe view r", "why: amhe explain r"]
    assert [line.split(":")[0] for line in next_steps(identification(), "r", True)] == [
        *("look", "use", "randomise")
    ]
    in_log = replace(missed, missing=Missing((replace(row, against=None), row), 0.02, 9))
    assert next_steps(in_log, "r", True) == ["look: amhe view r"]


def test_of_many_parameters_those_that_are_priors_have_a_part_of_their_own() -> None:
    many = [replace(parameter(3 * (i % 2)), name=f"p{i}") for i in range(30)]
    names, one = tuple(p.name for p in many), np.ones(30)
    belief = replace(
        identification().belief, names=names, units=("-",) * 30, log=(True,) * 30, estimate=one,
        covariance=np.eye(30),
    )  # fmt: skip
    html = page(
        identification(
            parameters=tuple(many), belief=belief, correlations=np.eye(30), combinations=(), **PLAIN
        )
    )
    known, _, apart = html.partition('<details id="15-parameters-that-the-logs-hardly-narrow-down"')
    assert known.count('class="verdict identified">') == 16 and '<td class="name">p1<' not in known
    assert '<td class="name">p1<' in apart and "p1, p3, p5, p7, p9, p11 and 9 more" in known


def test_the_page_stays_small(html: str) -> None:
    assert len(html) < 200_000


def test_the_page_of_a_robot_with_many_joints_stays_small() -> None:
    rng = np.random.default_rng(0)
    fits = []
    for clip in range(8):
        for one in fit(f"walk.mcap {clip}", clip < 4, rng):
            wide = {
                k: np.tile(getattr(one, k), (1, 12))[:, :12] for k in ("measured", "initial", "identified")
            }
            fits += [
                replace(one, channel=f"{one.channel}{i}", columns=tuple("abcdefghijkl"), **wide)
                for i in range(4)
            ]
    assert len(page(identification(fits=tuple(fits)))) < 600_000


def test_the_page_shows_what_was_found(html: str) -> None:
    for text in (
        "load_mass",
        "0.7421 ± 0.0041",
        "1 of 4 parameters is identified, and 1 is determined if a number that was given is right",
        "a gap of 0.6 s &amp; more",
    ):
        assert text in html
    assert "amhe identify &lt;swing&gt;.mcap" in html
    titles = [panel["title"] for panel in panels(html)]
    assert titles.count("arm.position") == 3


def test_the_page_is_well_formed(html: str) -> None:
    open_tags: list[str] = []

    class Checker(HTMLParser):
        def handle_starttag(self, tag: str, attrs: object) -> None:
            if tag not in ("meta", "br", "path", "use", "rect", "line", "circle"):
                open_tags.append(tag)

        def handle_endtag(self, tag: str) -> None:
            if open_tags and open_tags[-1] == tag:
                open_tags.pop()

        def handle_startendtag(self, tag: str, attrs: object) -> None: ...

    Checker().feed(html)
    assert open_tags == []


@pytest.mark.medium
def test_the_same_result_gives_the_same_page(html: str) -> None:
    assert page(identification(), WARNED) == html


def test_the_poorest_result_still_has_a_page() -> None:
    nan = math.nan
    lone = replace(parameter(3), sd=nan, lower=nan, upper=nan, shrinkage=nan, reasons=())
    belief = identification().belief
    result = identification(
        parameters=(lone,),
        belief=replace(
            belief, names=("armature",), units=("-",), log=(True,), estimate=[0.01], covariance=[[0.5]]
        ),
        correlations=np.array([[1.0]]),
        combinations=(),
        held_out=None,
        iterations=(),
        fits=(),
        noise_scale={},
        interrupted=True,
    )
    assert "No parameter is identified" in page(result)
    assert "interrupted" in stated(result)
    assert "Nothing was held out" in stated(result)


def test_a_prediction_that_runs_away_does_not_spoil_the_picture() -> None:
    one = fit("toss", True, np.random.default_rng(0))[1]
    runaway = np.array(one.initial)
    runaway[100:] = np.inf
    runaway[50:100] = 1e12
    html = page(identification(fits=(replace(one, initial=runaway),), iterations=()))
    (before,) = (line for line in panels(html)[0]["lines"] if line["name"] == "before")
    assert before["y"][100:] == [None] * (len(before["y"]) - 100) and before["leads"] is False


@pytest.mark.medium
def test_paper_holds_every_column_of_the_tables(html: str, tab: Browser, tmp_path: Path) -> None:
    (tmp_path / "page.html").write_text(html, encoding="utf-8")
    beyond = (
        "Math.max(...[...document.querySelectorAll('.wide')].map((one) => one.scrollWidth - one.clientWidth))"
    )
    tab.open((tmp_path / "page.html").as_uri(), width=390)
    assert tab.run(beyond) <= 0, "on a phone a row takes some lines"
    tab.open((tmp_path / "page.html").as_uri(), width=718)  # A4 with margins of 1 cm
    tab.ask("Emulation.setEmulatedMedia", media="print")
    assert tab.run(beyond) <= 0


@pytest.mark.medium
def test_a_usual_screen_shows_every_verdict_whole(tab: Browser, tmp_path: Path) -> None:
    """The last column was cut off, and with it the end of each verdict."""
    found = replace(parameter(0), name="shoulder_friction_loss", verdict="model-sensitive")
    changed = identification(parameters=(found, *(parameter(i) for i in range(1, 4))))
    (tmp_path / "page.html").write_text(page(changed), encoding="utf-8")
    cut = (
        "Math.max(...[...document.querySelectorAll('.wide')].map((one) => one.scrollWidth - one.clientWidth))"
    )
    tab.open((tmp_path / "page.html").as_uri(), width=1280)
    assert tab.run(cut) <= 0


@pytest.mark.medium
def test_a_reason_of_many_parameters_is_said_once() -> None:
    def with_reasons(i: int, *reasons: str) -> ParameterResult:
        return replace(parameter(i), reasons=tuple(Reason("assumed", (), 1.0, text) for text in reasons))

    rests = [f"given the time step, 2 ms: that leaves {share} open" for share in ("8 %", "22 %", "11 %")]
    rows = (*(with_reasons(i, text) for i, text in enumerate(rests)), with_reasons(3, "it is alone"))
    html = page(identification(parameters=rows, **PLAIN))
    assert html.count("given the time step") == 1
    assert (
        "1: given the time step, 2 ms: that leaves 8 to 22 % open: load_mass (8 %), "
        "damping (22 %), friction_loss (11 %)" in html
    )
    assert html.count("reason 1 below") == 3 and "it is alone" in html


def test_a_conditional_value_names_what_it_rests_on_however_small_its_share() -> None:
    repeats = Reason("repeats", (), 0.9, "residuals repeat")
    found = replace(parameter(0), verdict="conditional", given="the base's tilt", reasons=(repeats,))
    assert reason_texts(found) == ["given the base's tilt", "residuals repeat"]
    named = replace(repeats, text="given the base's tilt: that leaves 3 % open")
    assert reason_texts(replace(found, reasons=(repeats, named)))[0] == named.text


def test_distance_from_a_value_near_zero_is_in_prior_sd() -> None:
    offset = replace(parameter(0), estimate=1e-6, prior=0.0, prior_sd=0.05)
    assert away(np.array([0.1]), offset.estimate, offset, log=False) == pytest.approx([2.0], rel=1e-4)
    scale = replace(parameter(0), estimate=2.0, prior=1.0, prior_sd=0.5)
    assert away(np.array([2.0 * np.e]), scale.estimate, scale, log=True) == pytest.approx([2.0])


def test_the_page_says_where_each_interval_comes_from(html: str) -> None:
    """Shares below half a percent are left out, and kinds that no parameter has."""
    fold = html[html.rindex("Where each interval comes from") :].split("</table>")[0]
    assert re.findall(r'<td class="soft text">([^<]*)</td>', fold) == [
        "noise 80 %, prior 20 %", "assumed 60 %, noise 40 %", "repeats 40 %, curvature 30 %, noise 30 %",
        "prior 100 %",
    ]  # fmt: skip
    assert fold.count("width:60.0%;--c:var(--mixed)") == 1 and "with twice the prior's sd" in unescape(fold)
    assert len(re.findall(r'<td class="number"[^>]*>10 %</td>', fold)) == 4, (
        "by how much of its sd each estimate would move"
    )
    assert "numbers of the model that are no parameters" in fold and "identify.model_error" not in fold


@pytest.mark.medium
def test_dropped_clips_are_named_only_where_there_are_any(html: str) -> None:
    assert "2 because nothing moves in them and 1 because they contain a gap were dropped" in html
    none = page(identification(clips=ClipCount(18, 6, 0, 0), diverged=0, **PLAIN))
    assert "dropped" not in none and "rollouts diverged" not in none


@pytest.mark.medium
def test_a_dark_screen_gets_a_dark_page_and_paper_a_light_one(
    html: str, tab: Browser, tmp_path: Path
) -> None:
    (tmp_path / "page.html").write_text(html, encoding="utf-8")
    light = (
        "['backgroundColor', 'color'].map((name) => getComputedStyle(document.body)[name].match(/\\d+/g)"
        ".reduce((sum, one) => sum + Number(one), 0) / 765)"
    )
    tab.open((tmp_path / "page.html").as_uri(), dark=True)
    back, ink = tab.run(light)
    assert back < 0.2 and ink > 0.8
    stroke = "getComputedStyle(document.querySelector('.panel path.dots')).stroke"
    assert tab.run(stroke) == "rgb(203, 213, 225)"
    dark = [{"name": "prefers-color-scheme", "value": "dark"}]
    tab.ask("Emulation.setEmulatedMedia", media="print", features=dark)
    back, ink = tab.run(light)
    assert back == 1.0 and ink < 0.2
    assert tab.run(stroke) == "rgb(71, 85, 105)"


def test_error_against_horizon_is_in_degrees_and_millimetres() -> None:
    def line(channel: str, column: str, unit: str, errors: list[tuple[float, float]]) -> list[HorizonError]:
        return [
            HorizonError(channel, column, unit, 0.1 * 2**i, i == len(errors) - 1, 5 - i, 2.0, before, after)
            for i, (before, after) in enumerate(errors)
        ]

    horizons = (
        *line("arm.position", "hinge", "rad", [(0.1, 0.02), (0.2, 0.2025), (0.4, np.pi / 180)]),
        *line("box.position", "", "m", [(0.01, 0.002), (0.02, 0.003), (np.inf, 0.004)]),
    )
    known = identification(**PLAIN)
    assert known.held_out is not None
    found = page(replace(known, held_out=replace(known.held_out, horizons=horizons)))
    assert "22.9° → 1°" in found and "diverged → 4 mm" in found
    assert "after 0.1 s, n = 5" in found and "after 0.4 s (end), n = 3" in found
    assert "5 of 6 errors on data that was not fitted are no larger than before" in found
    assert found.count('class="worse"') == 1 and '<span class="worse">11.5° → 11.6°</span>' in found
    shown = {panel["title"]: panel for panel in panels(found)}
    hinge, box = shown["hinge"], shown["box.position"]
    assert (hinge["unit"], box["unit"]) == ("°", "mm")
    dots, joined, *_ = hinge["lines"]
    assert dots["y"] == pytest.approx([5.73, 11.46, 22.9], rel=1e-2)
    assert joined["shape"] == "dashed" and len(joined["x"]) == 2, "no line through the point with n = 3"
    assert box["lines"][0]["y"] == [10.0, 20.0, None]


def test_words_warn_when_validation_does_not_improve() -> None:
    nan = math.nan
    text = stated(identification(held_out=HeldOut(3, 2.0, 1.9, nan, nan, nan, nan)))
    assert "do not predict unseen data better" in text
    good = stated(identification(held_out=HeldOut(1, 1.0, 9.0, 0.009, 0.042, 0.02, 0.3)))
    assert "On a clip that was not fitted: cost 9 → 1, mean position error 42 mm → 9 mm" in good


def test_a_short_log_says_of_which_fit_its_curves_are() -> None:
    short = replace(ClipCount(18, 6, 0, 0), refitted=True)
    found = page(identification(clips=short))
    assert "held-out clips judged a fit without them, and the values here fit them too" in found
    assert "swing.mcap 20.00-21.50 s, curves of a first fit, without this clip." in found
    assert "not fitted." not in found and "6 held out of a first fit" in found


def test_a_value_at_its_bound_has_a_next_step_and_no_use(tmp_path: Path) -> None:
    found = identification()
    stuck = Reason("bound", ("damping",), 1.0, "it stops at its upper bound 0.2: the data want more")
    weak = [replace(p, verdict="weak", reasons=(stuck,)) for p in found.parameters]
    steps = next_steps(replace(found, parameters=tuple(weak)), tmp_path, view=True)
    (tmp_path / "system").mkdir()
    assert "in FOLDER/system.yaml, if they may be wrong, then: amhe identify LOG --system FOLDER" in steps[1]
    assert [step.partition(":")[0] for step in steps] == ["look", "mend"]
    steps = next_steps(replace(found, parameters=tuple(weak)), tmp_path, view=True)
    assert f"{tmp_path}/system/system.yaml" in steps[1]


def test_only_what_is_known_better_than_its_parts_is_called_known() -> None:
    text = stated(identification())
    known = "damping to 3.1 % and friction_loss to 42 %, but damping * friction_loss^0.07 to 1.2 %"
    assert f"{known}: know one better and the other follows." in text
    assert "damping^-0.07" not in text


def test_an_ellipse_holds_the_correlation_of_its_pair() -> None:
    (panel,) = panels(ellipse_figure(identification(), [("damping", "friction_loss")]))
    before, after, _ = panel["lines"]
    x, y = (np.log(after[axis]) for axis in ("x", "y"))
    assert np.corrcoef(x[1:], y[1:])[0, 1] == pytest.approx(-0.83, abs=0.01)
    assert np.ptp(x) == pytest.approx(2.0 * 2.146 * 0.031, rel=0.01)
    assert np.ptp(np.log(before["x"])) == pytest.approx(2.0 * 2.146, rel=0.01)


def test_the_first_overlay_is_of_the_clip_that_was_missed_most(html: str) -> None:
    rng = np.random.default_rng(0)
    near, far = (fit(name, True, rng)[0] for name in ("near", "far"))
    far = replace(far, initial=far.initial + 1.0)
    drawn = panels(page(identification(fits=(near, far, *fit("fitted", False, rng)))))
    first, rest = drawn[:2]
    assert np.array(first["lines"][0]["y"]) == pytest.approx(np.degrees(far.initial[:, 0]), abs=0.1)
    assert first["height"] > 200 and rest["title"] == "measured − after" and first["unit"] == "°"
    assert rest["marks"][0]["at"] == pytest.approx([-np.degrees(0.01), np.degrees(0.01)])


def test_words_name_every_verdict_that_is_not_identified() -> None:
    text = stated(identification())
    assert "damping: determined by the logs, given the gain of servo, 4." in text
    assert "friction_loss: the logs narrow it down: use" in text
    assert "armature: the logs hardly narrow it down: the value is your prior" in text
    assert "Misfit 3.6 times the noise (arm.velocity 3.6 and arm.position 1): about 1" in text
    assert "The model misses something there, or the noise is larger than declared." in text


def test_the_record_has_the_keys_that_scripts_rely_on() -> None:
    record = json.loads(json.dumps(identification_record(identification(), TRUTH), allow_nan=False))
    keys = ("name", "unit", "estimate", "prior", "prior_sd", "sd", "lower", "upper", "shrinkage", "verdict")
    assert set(keys) <= set(record["parameters"][0])
    damping = record["parameters"][1]
    assert damping["given"] == "the gain of servo, 4" and damping["budget"] == {"noise": 0.4, "assumed": 0.6}
    assert damping["doubled_prior"] == pytest.approx(0.1 * 0.0512 * 0.031)
    (reason,) = damping["reasons"]
    assert reason.keys() == {"kind", "parameters", "size", "text"} and reason["kind"] == "assumed"
    assert record["held_out"]["cost"] == 1.08
    assert record["held_out"]["position_error_m"] is None
    assert record["rollouts"] == {"count": 9216, "diverged": 3}
    assert np.array(record["correlations"]).shape == (4, 4)
    assert record["clips"]["fitted"] == 18
    assert record["truth"] == {"load_mass": 0.74, "damping": 0.06}


def test_plain_values() -> None:
    assert plain({"a": np.float64("inf"), "b": (np.int64(2), np.array([1.0, np.nan]))}) == {
        "a": None,
        "b": [2, [1.0, None]],
    }


@pytest.mark.parametrize(("width", "left_out"), [(75, "shrinkage and prior"), (80, "shrinkage"), (100, "")])
def test_the_table_fits_a_terminal(tmp_path, width, left_out) -> None:
    console = Console(width=width, record=True, highlight=False, file=(tmp_path / "out").open("w"))
    print_identification(identification(), tmp_path / "out", console, TRUTH)
    text = console.export_text()
    assert "0.7421 ± 0.0041" in text
    assert "model-sensitive" not in text and "damping: given the gain of servo, 4" in text
    assert "cost 14.2 -> 1.08" in text
    assert "load_mass 0.74, damping 0.06; outside the 90 % interval: damping" in " ".join(text.split())
    assert "report.html" in text
    assert (f"left out here, as the terminal is narrow: {left_out}" in text) == bool(left_out)
    assert all(
        len(line) <= width
        for line in text.splitlines()
        if not line.startswith(("report:", "look:", "use:", "randomise:"))
    )


def test_a_tiny_terminal_cuts_no_number(tmp_path) -> None:
    console = Console(width=40, record=True, highlight=False, file=(tmp_path / "out").open("w"))
    print_identification(identification(), tmp_path, console, {})
    assert "0.7354 to 0.7488" in console.export_text()


def test_the_terminal_says_that_a_value_stops_at_its_bound_whatever_its_verdict(tmp_path) -> None:
    bound = Reason("bound", (), 1.0, "it stops at its lower bound 0.7: the data want less")
    first, *others = identification().parameters
    stopped = replace(first, verdict="identified", reasons=(bound, *first.reasons))
    console = Console(width=100, record=True, highlight=False, file=(tmp_path / "out").open("w"))
    print_identification(identification(parameters=(stopped, *others)), tmp_path, console, {})
    assert f"load_mass: {bound.text}" in console.export_text()


def test_the_held_out_line() -> None:
    line = held_out_line(HeldOut(20, 1.2, 8.0, 0.0085, 0.031, 0.05, 0.2))
    assert line == "20 clips: cost 8 -> 1.2, position error 31 mm -> 8.5 mm, orientation error 11.5° -> 2.86°"


def test_a_fault_of_the_page_costs_no_result(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    system = System.load("pendulum", warn=False)
    (tmp_path / "report.html").write_text("of another result")

    def fail(*of: object) -> str:
        raise RuntimeError("a glyph")

    monkeypatch.setattr("amhe_cli.report.identification.identification_page", fail)
    result = identification()
    with pytest.raises(PageError, match=r"could not be made \(RuntimeError: a glyph\); the results"):
        write_identification(tmp_path, system, result, result.belief, {}, ORIGIN)
    written = {path.name for path in tmp_path.iterdir()}
    assert {"belief.yaml", "identified.xml", "result.json"} <= written and "report.html" not in written


@pytest.mark.medium
def test_a_dollar_in_a_name_is_a_dollar_and_no_formula() -> None:
    found = identification()
    name = "a$^$_{\x1b"
    named = replace(
        found,
        parameters=tuple(replace(p, name=name + p.name) for p in found.parameters),
        belief=replace(found.belief, names=tuple(name + n for n in found.belief.names)),
        fits=tuple(replace(f, channel=name) for f in found.fits),
    )
    html = page(named)
    assert r"a$^$_{\x1bdamping" in html and "\x1b" not in html


@pytest.mark.medium
def test_a_link_opens_its_part(html: str, tab: Browser, tmp_path: Path) -> None:
    (tmp_path / "page.html").write_text(html, encoding="utf-8")
    tab.open((tmp_path / "page.html").as_uri())
    tab.run("location.hash = '#data'")
    opened = "document.getElementById('data').open"
    assert tab.run(f"new Promise((done) => setTimeout(() => done({opened}), 100))")


def test_of_many_parameters_those_that_rest_on_their_priors_stand_apart() -> None:
    one, *_ = identification().parameters
    few = [replace(one, name=f"{verdict}{i}", verdict=verdict) for i in range(8) for verdict in VERDICTS]
    assert parted(few[:20]) == (few[:20], [])
    shown, apart = parted(few)
    assert {p.verdict for p in apart} == {"prior"} and len(apart) == 8 and len(shown) == 32
