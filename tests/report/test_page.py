"""Parts of the report's pages: numbers, folders, what is shown and what is replayed."""

from __future__ import annotations

import io
import math
import re
import subprocess
import sys
from dataclasses import replace
from html import unescape
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

import amhe_cli as amhe
from amhe_cli.core.belief import belief_of
from amhe_cli.core.parameters import Parameter, ParameterSpace
from amhe_cli.report import numbers
from amhe_cli.report.folder import results
from amhe_cli.report.page import Section, Statement, page, result_page
from amhe_cli.report.replay import windows_line
from amhe_cli.report.replay_files import _together
from amhe_cli.report.tables import NUMBER, ONCE, PlainConsole, Table, rich_table
from tests.web.figures import panels

TABLE = Table(("name", "mass", "goal"), ("name", NUMBER, ""), [("a<b", "4.0", "NO"), ("c", "5.0", "yes")])
PROVENANCE = {
    "created": "2030-01-02T03:04:05+00:00", "command": "amhe run <t4>", "seed": 3,
    "versions": {"amhe": "0.1.0", "mujoco": "4.0.0"}, "logs": {"log.mcap": "ab" * 32},
}  # fmt: skip


def made(*sections: Section, warnings: tuple[str, ...] = ()) -> str:
    return page(
        "run", title="T1 & more", facts=("1 log",), headline="Failed.",
        statements=[Statement("bad", "The robot fell.")], sections=sections, warnings=warnings,
    )  # fmt: skip


def test_texts_are_escaped() -> None:
    html = made(Section("Motion", table=TABLE, items=["<li>"]))
    assert "<h1>T1 &amp; more</h1>" in html and "a&lt;b" in html and "<li>&lt;li&gt;</li>" in html


def test_warnings_are_listed_and_linked_from_the_summary() -> None:
    assert "warning" not in made(Section("Motion"))
    html = made(Section("Motion"), warnings=("a gap", "a jump"))
    assert '<a href="#warnings">2 warnings</a>' in html and html.index("a gap") > html.index('id="warnings"')


def test_contents_name_every_part_of_a_long_page() -> None:
    html = made(*(Section(name) for name in ("Held out", "Data", "What is missing", "Next")))
    for name, anchor in (("Held out", "held-out"), ("What is missing", "what-is-missing")):
        assert f'<a href="#{anchor}">{name}</a>' in html and f'id="{anchor}"' in html


def test_how_it_was_made_is_said_last() -> None:
    record = {"command": "run", "version": "0.1.0", "warnings": ["a gap"]}
    html = result_page(
        record, PROVENANCE, title="T", facts=(), headline="Done.", statements=(), sections=[Section("Motion")]
    )
    parts = ("Motion", "Warnings", "amhe run &lt;t4&gt;", "SHA-256 of log.mcap", "ab" * 32)
    assert sorted(parts, key=html.rindex) == list(parts)
    assert "2030-01-02 03:04:05 UTC" in html


def test_missed_goals_stand_out() -> None:
    html = made(Section("Goals", table=TABLE))
    assert html.count(' missed">NO') == html.count(' reached">yes') == 1


def test_a_table_for_a_terminal_has_its_numbers_flush_right() -> None:
    out = io.StringIO()
    Console(file=out, width=60).print(rich_table(Table(("", "m"), ("", NUMBER), [("a", "4"), ("b", "10.5")])))
    lines = [line.rstrip() for line in out.getvalue().splitlines()]
    assert lines[-2].endswith("   4")
    assert lines[-1].endswith("10.5")


def test_a_part_stands_once_in_a_wide_table_and_in_every_row_on_a_phone() -> None:
    rows = [("arm", "mass", "1", "2"), ("arm", "damping", "3", "4"), ("hand", "mass", "5", "6")]
    table = Table(("part", "number", "file", "log"), (ONCE, "", NUMBER, NUMBER), rows)
    html = made(Section("Numbers", table=table))
    assert re.findall(r'class="(once[^"]*)">(\w+)<', html) == [
        ("once", "arm"), ("once again", "arm"), ("once", "hand"),
    ]  # fmt: skip
    assert "\n.again { color: transparent; }" in html and ".cards .again { color: inherit; }" in html
    out = io.StringIO()
    Console(file=out, width=60).print(rich_table(table))
    assert out.getvalue().count("arm") == out.getvalue().count("hand") == 1


def test_contents_take_several_lines_on_a_phone() -> None:
    html = made(*(Section(name) for name in ("Held out", "Data", "What is missing", "Next")))
    assert re.search(r"\nnav {[^}]*flex-wrap: wrap", html) and not re.search(r"nav {[^}]*nowrap", html)


def test_columns_can_be_left_out() -> None:
    less = TABLE.without("mass")
    assert (less.head, less.looks, less.rows) == (
        ["name", "goal"],
        ["name", ""],
        [["a<b", "NO"], ["c", "yes"]],
    )


@pytest.mark.parametrize(
    ("estimate", "sd", "text"),
    [
        (0.742137, 0.00412, "0.7421 ± 0.0041"),
        (0.5, 0.25, "0.50 ± 0.25"),
        (123.456, 12.3, "123 ± 12"),
        (1234.5, 456.0, "1230 ± 460"),
        (3.2e-9, 1.0e-10, "3.20e-09 ± 1.0e-10"),
        (5.21e-4, 3.0e-5, "5.21e-04 ± 3.0e-05"),
        (5e-4, 0.1, "5e-04 ± 0.10"),
        (1.0, float("nan"), "1 ± –"),
        (-0.001, 0.25, "-1e-03 ± 0.25"),
        (0.0, 0.25, "0 ± 0.25"),
        (-1e-7, 0.0069, "0 ± 0.0069"),
        (0.005969, 6.8e-5, "0.005969 ± 0.000068"),
        (0.1, 1e-12, "0.1 ± 1e-12"),
    ],
)
def test_an_estimate_has_the_digits_that_its_sd_leaves(estimate, sd, text) -> None:
    assert numbers.with_sd(estimate, sd) == text


def test_a_narrow_terminal_cuts_no_cell() -> None:
    written = io.StringIO()
    console = PlainConsole(file=written, width=20)
    console.print(rich_table(Table(("drive", "gear"), ("", NUMBER), [("dynamixel:xl330-m288", "288.1234")])))
    assert "dynamixel:xl330-m288  288.1234" in written.getvalue() and console.width == 20


@given(st.floats(1e-8, 1e8), st.floats(1e-8, 1e8))
def test_rounding_moves_a_value_by_less_than_its_resolution(value, resolution) -> None:
    shown = float(numbers.rounded(value, resolution))
    assert math.isclose(shown, value, rel_tol=1e-5) or abs(shown - value) <= resolution


@pytest.mark.parametrize(
    ("fraction", "text"), [(0.99, "99 %"), (0.0123, "1.2 %"), (0.0, "0 %"), (math.inf, "–")]
)
def test_percent(fraction, text) -> None:
    assert numbers.percent(fraction) == text


def test_long_lists_are_cut() -> None:
    assert numbers.some(list("abc")) == "a, b and c"
    assert numbers.some(list("abcdefg")) == "a, b, c, d, e, f and g"
    assert numbers.some(list("abcdefgh")) == "a, b, c, d, e, f and 2 more"


def test_units() -> None:
    assert numbers.length(0.0092) == "9.2 mm"
    assert numbers.length(math.nan) == "–"
    assert numbers.angle(math.pi / 2) == "90°"
    assert numbers.quantity("0.3", "-") == "0.3"
    assert numbers.quantity("0.3", "kg") == "0.3 kg"


def filled(folder: Path) -> dict[str, str]:
    return {path.name: path.read_text() for path in folder.iterdir()}


def test_old_results_keep_their_page_until_the_new_page_is_there(tmp_path: Path) -> None:
    """A SIGKILL while the page was made had left new results without a page."""
    old = {"result.json": "old", "report.html": "old"}
    for name, text in old.items():
        (tmp_path / name).write_text(text)
    seen: list[dict[str, str]] = []

    def page() -> str:
        seen.append({name: (tmp_path / name).read_text() for name in old})
        return "new"

    with results(tmp_path, page, force=True) as scratch:
        (scratch / "result.json").write_text("new")
    assert seen == [old]
    assert filled(tmp_path) == dict.fromkeys(old, "new")


def test_ctrl_c_while_the_page_is_made_keeps_the_results(tmp_path: Path) -> None:
    (tmp_path / "report.html").write_text("old")

    def page() -> str:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), results(tmp_path, page, force=True) as scratch:
        (scratch / "result.json").write_text("new")
    assert filled(tmp_path) == {"result.json": "new"}


@pytest.mark.parametrize(
    ("counts", "line"),
    [
        ((61, 2, 5, 0, 0), "61 windows used (2 jumps detected), 5 skipped (too little excitation)"),
        ((1, 1, 0, 0, 0), "1 window used (1 jump detected)"),
        ((0, 0, 0, 3, 0), "0 windows used, 3 skipped (a missing signal)"),
        (
            (9, 0, 4, 2, 1),
            "9 windows used, 7 skipped "
            "(4 with too little excitation, 2 with a missing signal, 1 with diverged rollouts)",
        ),
    ],
)
def test_used_and_skipped_windows_are_counted(counts: tuple[int, ...], line: str) -> None:
    record: dict[str, Any] = dict(zip(("updated", "jumps", "still", "gaps", "lost"), counts, strict=True))
    assert windows_line(record) == line


@pytest.mark.filterwarnings("error")
def test_a_bias_of_zero_is_no_fault() -> None:
    parameters = (
        Parameter("mass", "kg", 4.0, 0.4, 40.0, log=True, prior_sd=0.5),
        Parameter("friction", "-", 0.5, 0.05, 5.0, log=True, prior_sd=0.5),
        Parameter("bias", "m", 0.0, -1.0, 1.0, log=False, prior_sd=0.2),
    )
    system: Any = SimpleNamespace(name="", space=ParameterSpace(parameters), fixed={}, parts={}, sets={})
    z_covariance = 0.01 * np.array([[1.0, -0.98, 0.0], [-0.98, 1.0, 0.0], [0.0, 0.0, 1.0]])
    belief = belief_of(system, np.zeros(3), z_covariance)
    last = SimpleNamespace(belief=belief, theta=belief.estimate, sd=belief.sd)
    done: Any = SimpleNamespace(system=system, estimates=[last])
    assert [one.text for one in _together(done)] == ["mass * friction"]


LOG = Path(__file__).parents[2] / "examples" / "logs" / "pendulum.mcap"


@pytest.fixture(scope="module")
def system() -> amhe.System:
    return amhe.System.load("pendulum")


@pytest.fixture(scope="module")
def log(system: amhe.System) -> amhe.Log:
    return amhe.read_log(LOG, system)


def written_page(value: amhe.Log | amhe.System | amhe.Belief) -> str:
    """The written_page in the frame that a notebook shows."""
    frame = re.fullmatch(r'<iframe [^>]*srcdoc="([^"]*)"></iframe>', value._repr_html_())
    assert frame
    found = unescape(frame[1])
    assert not re.search(r"(src|href)=|url\(|@import", re.sub(r'xlink:href="#|href="#|url\(#', "", found))
    return found


def texts(html: str) -> list[str]:
    """The texts of all table cells."""
    return [unescape(re.sub(r"<[^>]*>", "", cell)) for cell in re.findall(r"<td[^>]*>(.*?)</td>", html)]


def test_a_log_shows_each_series_with_its_numbers(log: amhe.Log, tmp_path: Path) -> None:
    shown = written_page(log)
    assert shown == log.plot().html
    cells = texts(shown)
    for key, one in log.series.items():
        row = cells[cells.index(key) :]
        assert row[5] == ", ".join(one.columns)
        known = np.degrees(one.values[one.valid])  # of a joint that turns
        assert row[3] == f"{known.min():.3g} to {known.max():.3g}"
    assert [panel["title"] for panel in panels(shown)] == list(log.series)
    assert "100 Hz" in cells and "50 Hz" in cells
    assert log.plot().save(tmp_path / "log.html").read_text().startswith("<!doctype html>")


@pytest.mark.medium
def test_a_bodys_position_is_in_metres_and_true_values_are_words() -> None:
    time = np.arange(0.0, 1.0, 0.01)
    go1 = amhe.System.load("go1_push")
    data = {
        "joints": {"time": time, "position": np.zeros((100, 12)), "velocity": np.zeros((100, 12))},
        "command": {"time": time, "position": np.zeros((100, 12))},
    }
    for body in ("trunk", "box"):
        turn = np.tile([1.0, 0.0, 0.0, 0.0], (100, 1))
        data[body] = {"time": time, "position": np.ones((100, 3)), "orientation": turn}
    log = replace(amhe.Log.from_arrays(data, go1), metadata={"truth": '{"box_mass": 4.0}'})
    shown = written_page(log)
    cells = texts(shown)
    assert cells[cells.index("box.position") + 4] == "m"
    assert {panel["title"]: panel.get("unit") for panel in panels(shown)}["box.position"] == "m"
    assert cells[cells.index("joints.position") + 4] == "°"
    assert cells[cells.index("command.position") + 4] == "°"
    assert "true values: box_mass 4" in shown


RAIL = """<mujoco><worldbody><body name="arm"><joint name="swing"/><geom size=".1"/></body>
<body name="lift" pos="1 0 0"><joint name="lift" type="slide"/><geom size=".1"/></body>
</worldbody></mujoco>"""


def test_joints_that_slide_stand_apart_from_joints_that_turn() -> None:
    signals = {"joints": {"joints": ["swing", "lift"], "noise": {"position": 0.01, "velocity": None}}}
    mass = {"nominal": 1.0, "targets": [{"body": "lift", "set": "mass"}]}
    system = amhe.System.from_model(
        mujoco.MjSpec.from_string(RAIL), parameters={"mass": mass}, signals=signals
    )
    time = np.arange(0.0, 1.0, 0.01)
    position = np.stack((np.sin(time), 0.1 * time), axis=1)
    log = amhe.Log.from_arrays({"joints": {"time": time, "position": position}}, system)
    cells, shown = texts(written_page(log)), panels(written_page(log))
    at = [i for i, text in enumerate(cells) if text == "joints.position"]
    assert [(cells[i + 4], cells[i + 5]) for i in at] == [("°", "swing"), ("m", "lift")]
    assert [one["unit"] for one in shown if one["title"] == "joints.position"] == ["°", "m"]
    assert [one["unit"] for one in shown if one["title"] == "joints.velocity"] == ["°/s", "m/s"]


def test_a_gap_stays_open(log: amhe.Log) -> None:
    key = "joints.position"
    one = log[key]
    valid = one.valid.copy()
    valid[500:1500] = False
    cut = replace(log, series={key: replace(one, valid=valid)})
    ((line,),) = [panel["lines"] for panel in panels(cut.plot().html)]
    open_from, to = (line["x"][i] for i in (line["y"].index(None) - 1, -1))
    assert 0.9 < open_from <= 1.0 and to > 14.9, "the line ends at the gap, and begins again after it"
    assert "87 %" in texts(written_page(cut)), "1000 of 7501 rows are missing"


def test_names_are_text_and_a_log_without_samples_is_a_table(log: amhe.Log) -> None:
    one = log["joints.position"]
    odd = replace(one, columns=("<script>alert(1)</script>",), valid=np.zeros_like(one.valid))
    shown = written_page(replace(log, series={"a<b>.value": odd}, source="<i>x</i>"))
    assert "<script>alert" not in shown and "a<b>" not in shown and "<i>x" not in shown
    assert not panels(shown)


def test_a_system_shows_its_unknowns_and_its_signals(system: amhe.System) -> None:
    cells = texts(written_page(system))
    for parameter in system.space.parameters:
        row = cells[cells.index(parameter.name) :]
        assert float(row[1]) == pytest.approx(parameter.nominal, rel=1e-3)
        assert row[5] == system.sets[parameter.name]
    assert {"/joint_states", "/joint_commands", "drives the model", "is compared"} <= set(cells)
    fixed = written_page(system.fixing({"damping": 0.03}))
    assert "Taken as known: damping 0.03" in fixed


def test_a_belief_shows_estimates_and_correlations(system: amhe.System) -> None:
    d = len(system.space)
    known = belief_of(system, np.zeros(d), 0.01 * (np.eye(d) + 0.5 * (np.ones((d, d)) - np.eye(d))))
    shown = written_page(known)
    cells = texts(shown)
    low, high = np.quantile(known.sample(40_000, 0), [0.05, 0.95], axis=0)
    for i, name in enumerate(known.names):
        interval = cells[cells.index(name) + 3]
        assert [float(end) for end in interval.split(" to ")] == pytest.approx([low[i], high[i]], rel=0.03)
    assert cells.count("0.50") == d * (d - 1)
    assert "Correlations" not in written_page(known.about([known.names[0]]))


@pytest.mark.medium
def test_nothing_of_it_is_loaded_before_it_is_shown() -> None:
    text = (
        "import sys, amhe_cli as amhe; amhe.Log, amhe.System, amhe.Belief; "
        "print([m for m in ('matplotlib', 'jinja2', 'amhe_cli.report') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
