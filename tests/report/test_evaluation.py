"""Evaluations: their page and the pages of results."""

import csv
import importlib.util
import io
import re
from pathlib import Path

import numpy as np
import pytest

from amhe_cli.report.study import tables
from amhe_cli.report.study.figures import drawn, final, over_time, since_change
from amhe_cli.report.study.page import study_page
from amhe_cli.robots.go1.tasks import TASKS
from amhe_cli.study.cells import Cell, Setting, setting_of
from amhe_cli.study.goals import change_of, goals
from amhe_cli.study.store import Study, start
from amhe_cli.study.summary import Groups, ablations
from tests.study.cells_at_play import CODE, record, result
from tests.web.figures import panels

MODES = ("true", "baseline", "stale", "adaptive")
DEFAULTS = {"control.samples": 8}
FLOORS = {name: task.floor for name, task in TASKS.items()}


@pytest.fixture(scope="module")
def groups() -> Groups:
    worse = {"true": 0.0, "baseline": 1.0, "adaptive": 0.03}
    cells = [
        Cell(task, mode, seed) for task in ("t1", "t3", "t4", "t5") for mode in worse for seed in range(3)
    ]
    cells += [Cell("t4", "adaptive", seed, setting_of({"control.samples": 16})) for seed in range(2)]
    return Groups([result(cell, worse[cell.mode]) for cell in cells], (), tuple(TASKS), MODES)


def made(groups: Groups, name: str) -> tables.StudyTable:
    every = tables.tables(groups, ablations(groups, DEFAULTS), goals(groups))
    return next(table for table in every if table.name == name)


def test_table_1_sets_t4_beside_the_papers_numbers(groups: Groups) -> None:
    table = made(groups, "table1")
    assert table.head[:4] == ("", "true (n = 3)", "baseline (n = 3)", "adaptive (n = 3)")
    row = {line[0]: line[1:] for line in table.rows}
    assert row["S_R [%]"] == ("100 ± 0", "0 ± 0", "0 ± 0", "100 ± 0", "13 ± 35", "87 ± 35")
    assert row["e_g [m]"][3:] == ("0.045 ± 0.020", "0.580 ± 0.230", "0.160 ± 0.240")


def test_table_2_has_only_tasks_that_were_run(groups: Groups) -> None:
    table = made(groups, "table2")
    assert [row[0] for row in table.rows] == [
        "T1 RMSE [m/s]", "T3 RMSE [m/s]", "T4 RMSE [m/s]", "T5 e_g [m]", "T5 RMSE [m/s]"
    ]  # fmt: skip
    assert table.rows[0][-3:] == ("0.134", "0.160", "0.139")


def test_differences_are_percent_of_the_true_mode_where_it_says_so(groups: Groups) -> None:
    table = made(groups, "differences")
    row = next(line for line in table.rows if line[0] == "t4 adaptive")
    assert row[4].startswith("+3.0 [")
    assert row[2].startswith("+0.003 [")


def test_goals_say_what_was_missed(groups: Groups) -> None:
    missed = {(row[0], row[2]) for row in made(groups, "goals").rows if row[-1] == "NO"}
    assert ("t4 adaptive", "S_R − true's") in missed
    assert ("t4 adaptive", "J / true's − 1") not in missed


@pytest.mark.medium
def test_the_page_begins_with_what_was_missed(groups: Groups) -> None:
    every = tables.tables(groups, ablations(groups, DEFAULTS), goals(groups))
    code = {name: "1" for name in ("amhe", "sources", "mujoco", "numpy")}
    machine = {name: "1" for name in ("python", "processor", "cores")}
    page = study_page(Study(code, DEFAULTS, machine=machine), groups, {}, every, [])
    goal_rows = made(groups, "goals").rows
    missed = sum(row[-1] == "NO" for row in goal_rows)
    assert 0 < missed < len(goal_rows)
    assert f"{len(goal_rows) - missed} of {len(goal_rows)} goals reached" in page
    assert page.count('class="bad">t') == missed
    assert re.search(r"t4 adaptive: S_R − true&#39;s is .* %; the goal is ≥ 0", page)


@pytest.mark.medium
def test_a_page_without_goals_says_what_came_out_and_no_run_that_was_cut_short_stands_beside_the_papers(
    groups: Groups,
) -> None:
    study = Study({}, DEFAULTS, duration=3.0)
    html = study_page(study, groups, {}, [made(groups, "table1")], [])
    assert "T4: true 3 of 3 at the goal, baseline 0 of 3 at the goal, adaptive 0 of 3 at the goal" in html
    assert "paper: " not in html and "Runs were cut short" in html
    assert "paper: Adaptive-MHE" in study_page(Study({}, DEFAULTS), groups, {}, [made(groups, "table1")], [])


def test_the_operating_point_of_an_ablation_is_marked(groups: Groups) -> None:
    assert [row[1] for row in made(groups, "ablations").rows] == ["8 *", "16"]


@pytest.mark.parametrize("name", ["table1", "table2", "measures", "differences", "goals", "ablations"])
def test_every_form_holds_every_row(groups: Groups, name: str) -> None:
    table = made(groups, name)
    assert tables.markdown(table).count("\n| ") == len(table.rows) + 2
    tex = tables.latex(table)
    assert tex.count(r" \\") == len(table.rows) + 1 and not set("±≤≥–−×") & set(tex)
    assert not [line for line in tex.splitlines() if "_" in line.replace(r"\_", "") and "label" not in line]
    assert list(table.table.rows) == list(table.rows) and len(table.table.looks) == len(table.head)
    assert len(list(csv.DictReader(io.StringIO(tables.comma_separated(table))))) == len(table.records)


def test_numbers_of_the_csv_are_not_rounded(groups: Groups) -> None:
    rows = csv.DictReader(io.StringIO(tables.comma_separated(made(groups, "table1"))))
    cost = next(row for row in rows if (row["mode"], row["measure"]) == ("adaptive", "cost"))
    assert float(cost["mean"]) == pytest.approx(1040.0)
    assert float(cost["paper_mean"]) == 51000.0
    assert float(cost["low"]) < 1040.0 < float(cost["high"])


def test_figures_show_every_mode_and_what_is_true(groups: Groups) -> None:
    sections = {
        one.title: panels(str(one.figure)) for one in drawn(groups, ablations(groups, DEFAULTS), FLOORS)
    }
    assert list(sections) == [
        "Paths of the box", "Tracking of the forward speed", "Density of the running cost",
        "Parameters over time", "T5: final configuration", "What each setting does",
    ]  # fmt: skip
    for panel in sections["Tracking of the forward speed"]:
        task = panel["title"].partition(":")[0].lower()
        names = [line["name"] for line in panel["lines"]]
        assert names[:-1] == [group.mode for group in groups.of(task)] and names[-1].startswith("command")
    for panel in sections["Paths of the box"]:
        path, goal = panel["lines"][-2:]
        assert (path["name"], goal["name"]) == ("path", "goal") and np.ptp(goal["x"]) > 0.05  # it is seen
        assert np.mean([*goal["x"][:2], *goal["x"][-2:]]) == pytest.approx(path["x"][-1], abs=1e-3)
    densities = sections["Density of the running cost"][0]["lines"]
    for line in densities:
        x, y = np.array(line["x"]), np.array(line["y"])
        assert np.sum(y) * (x[1] - x[0]) == pytest.approx(1.0, rel=0.05)
    cost, success = sections["What each setting does"][:2]
    assert cost["lines"][0]["x"] == success["lines"][0]["x"] == [8, 16]
    assert cost["marks"][0]["at"] == 8.0 and max(success["lines"][0]["y"]) <= 100.0


def test_the_box_that_was_measured_is_the_one_that_is_drawn() -> None:
    def widths(setting: Setting) -> set[float]:
        groups = Groups([result(Cell("t5", "true", 0, setting))], setting, tuple(TASKS), MODES)
        (panel,) = final(groups, "t5", FLOORS["t5"])
        return {round(float(np.ptp(line.y)), 6) for line in panel.lines}

    assert 0.3 in widths(())
    assert 0.3 not in widths(setting_of({"boxes.box": [0.2, 0.44, 0.3]}))
    assert 0.44 in widths(setting_of({"boxes.box": [0.2, 0.44, 0.3]}))


def test_a_mean_over_seeds_ends_where_most_of_them_have_ended() -> None:
    long, short = result(Cell("t1", "true", 0)), result(Cell("t1", "true", 1))
    short = type(short)(
        short.cell, short.code, None, short.outcome, {n: v[:20] for n, v in short.trace.items()}, 1.0
    )
    time, mean, sd = over_time([long, short, short], lambda r: r.trace["box_x"])
    assert time[-1] == pytest.approx(4.0)
    assert np.isfinite(mean).all()
    assert (sd >= 0.0).all()


def test_time_is_counted_from_the_change() -> None:
    changed = result(Cell("t4", "true", 0))
    assert change_of(changed) == pytest.approx(6.2)
    assert since_change(changed) == pytest.approx(6.2)
    time, truth, _ = over_time([changed], lambda r: r.trace["truth/box_mass"], since_change)
    assert truth[np.argmin(np.abs(time))] == pytest.approx(6.0)
    assert truth[np.argmin(np.abs(time)) - 1] == pytest.approx(4.0)


ROOT = Path(__file__).parents[2]


@pytest.fixture
def pages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The script, about a study and a page of its own."""
    spec = importlib.util.spec_from_file_location("make_results", ROOT / "docs" / "make_results.py")
    assert spec and spec.loader
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    monkeypatch.setattr(script, "STUDIES", tmp_path / "results")
    monkeypatch.setattr(script, "PAGE", tmp_path / "page.md")
    monkeypatch.setattr("amhe_cli.report.study.page.drawn", lambda *of: [])
    return script


def stored(folder: Path) -> None:
    machine = {"processor": "abacus", "cores": "2", "python": "3"}
    store = start(
        folder, Study(CODE, {}, (), 40.0, ("amhe eval -o x",), "2026-01-01T00:00:00", machine), False, False
    )
    for mode in ("true", "baseline"):
        for seed in range(2):
            cell = Cell("t4", mode, seed)
            store.write(cell, record({"cell": cell.plain(), "code": CODE}))


def test_blocks_are_filled_and_filled_again_the_same(pages, tmp_path: Path) -> None:
    stored(tmp_path / "results" / "main")
    (tmp_path / "page.md").write_text(
        "by hand\n<!-- results main/table1 -->\nold\n<!-- end -->\nbetween\n"
        "<!-- results main/made -->\n<!-- end -->\n<!-- results other/goals -->\nkept\n<!-- end -->\n"
    )
    pages.main()
    first = (tmp_path / "page.md").read_text()
    assert "| S_R [%] | 100 ± 0 | 0 ± 0 | 100 ± 0 |" in first
    assert "old" not in first
    assert all(text in first for text in ("by hand", "between", "kept", "amhe eval -o x", "processor abacus"))
    pages.main()
    assert (tmp_path / "page.md").read_text() == first


def test_goals_that_are_missed_are_picked(pages, tmp_path: Path) -> None:
    stored(tmp_path / "results" / "main")
    (tmp_path / "page.md").write_text("<!-- results main/missed -->\n<!-- end -->\n")
    pages.main()
    rows = (tmp_path / "results" / "main" / "tables" / "goals.md").read_text().splitlines()[4:]
    missed = [row for row in rows if "NO" in row]
    shown = (tmp_path / "page.md").read_text()
    assert f"{len(rows) - len(missed)} of {len(rows)} goals are reached" in shown
    assert [row for row in shown.splitlines() if row.startswith("| t4")] == missed


def test_a_block_that_cannot_be_filled_is_reported(pages, tmp_path: Path) -> None:
    stored(tmp_path / "results" / "main")
    (tmp_path / "page.md").write_text("<!-- results main/ablations -->\n<!-- end -->\n")
    with pytest.raises(SystemExit, match="makes no table 'ablations'"):
        pages.main()


def test_without_a_study_it_says_how_to_make_one(pages) -> None:
    with pytest.raises(SystemExit, match="amhe eval -o docs/results/main"):
        pages.main()


def test_the_blocks_of_the_real_page_are_well_formed(pages) -> None:
    text = (ROOT / "docs" / "results.md").read_text(encoding="utf-8")
    assert text.count("<!-- results ") == text.count("<!-- end -->") == len(pages.BLOCK.findall(text)) > 0
