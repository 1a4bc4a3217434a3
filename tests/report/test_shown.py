"""What a notebook shows of logs, systems, beliefs and results."""

import re
import subprocess
import sys
from dataclasses import replace
from html import unescape
from pathlib import Path

import numpy as np
import pytest

import amhe_cli as amhe
from amhe_cli.core.belief import belief_of
from tests.web.figures import panels

LOG = Path(__file__).parents[2] / "examples" / "logs" / "pendulum.mcap"


@pytest.fixture(scope="module")
def system() -> amhe.System:
    return amhe.System.load("pendulum")


@pytest.fixture(scope="module")
def log(system: amhe.System) -> amhe.Log:
    return amhe.read_log(LOG, system)


def page(value: amhe.Log | amhe.System | amhe.Belief) -> str:
    """The page in the frame that a notebook shows."""
    frame = re.fullmatch(r'<iframe [^>]*srcdoc="([^"]*)"></iframe>', value._repr_html_())
    assert frame
    found = unescape(frame[1])
    assert not re.search(r"(src|href)=|url\(|@import", re.sub(r'xlink:href="#|href="#|url\(#', "", found))
    return found


def texts(html: str) -> list[str]:
    """The texts of all table cells."""
    return [unescape(re.sub(r"<[^>]*>", "", cell)) for cell in re.findall(r"<td[^>]*>(.*?)</td>", html)]


def test_a_log_shows_each_series_with_its_numbers(log: amhe.Log, tmp_path: Path) -> None:
    shown = page(log)
    assert shown == log.plot().html
    cells = texts(shown)
    for key, one in log.series.items():
        row = cells[cells.index(key) :]
        assert row[5] == ", ".join(one.columns)
        assert row[3] == f"{one.values[one.valid].min():.3g} to {one.values[one.valid].max():.3g}"
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
    shown = page(log)
    cells = texts(shown)
    assert cells[cells.index("box.position") + 4] == "m"
    assert {panel["title"]: panel.get("unit") for panel in panels(shown)}["box.position"] == "m"
    assert cells[cells.index("joints.position") + 4] == "m or rad"
    assert "true values: box_mass 4" in shown


def test_a_gap_stays_open(log: amhe.Log) -> None:
    key = "joints.position"
    one = log[key]
    valid = one.valid.copy()
    valid[500:1500] = False
    cut = replace(log, series={key: replace(one, valid=valid)})
    ((line,),) = [panel["lines"] for panel in panels(cut.plot().html)]
    open_from, to = (line["x"][i] for i in (line["y"].index(None) - 1, -1))
    assert 0.9 < open_from <= 1.0 and to > 14.9, "the line ends at the gap, and begins again after it"
    assert "87 %" in texts(page(cut)), "1000 of 7501 rows are missing"


def test_names_are_text_and_a_log_without_samples_is_a_table(log: amhe.Log) -> None:
    one = log["joints.position"]
    odd = replace(one, columns=("<script>alert(1)</script>",), valid=np.zeros_like(one.valid))
    shown = page(replace(log, series={"a<b>.value": odd}, source="<i>x</i>"))
    assert "<script>alert" not in shown and "a<b>" not in shown and "<i>x" not in shown
    assert not panels(shown)


def test_a_system_shows_its_unknowns_and_its_signals(system: amhe.System) -> None:
    cells = texts(page(system))
    for parameter in system.space.parameters:
        row = cells[cells.index(parameter.name) :]
        assert float(row[1]) == pytest.approx(parameter.nominal, rel=1e-3)
        assert row[5] == system.sets[parameter.name]
    assert {"/joint_states", "/joint_commands", "drives the model", "is compared"} <= set(cells)
    fixed = page(system.fixing({"damping": 0.03}))
    assert "Taken as known: damping 0.03" in fixed


def test_a_belief_shows_estimates_and_correlations(system: amhe.System) -> None:
    d = len(system.space)
    known = belief_of(system, np.zeros(d), 0.01 * (np.eye(d) + 0.5 * (np.ones((d, d)) - np.eye(d))))
    shown = page(known)
    cells = texts(shown)
    low, high = np.quantile(known.sample(40_000, 0), [0.05, 0.95], axis=0)
    for i, name in enumerate(known.names):
        interval = cells[cells.index(name) + 3]
        assert [float(end) for end in interval.split(" to ")] == pytest.approx([low[i], high[i]], rel=0.03)
    assert cells.count("0.50") == d * (d - 1)
    assert "Correlations" not in page(known.about([known.names[0]]))


@pytest.mark.medium
def test_nothing_of_it_is_loaded_before_it_is_shown() -> None:
    text = (
        "import sys, amhe_cli as amhe; amhe.Log, amhe.System, amhe.Belief; "
        "print([m for m in ('matplotlib', 'jinja2', 'amhe_cli.report') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
