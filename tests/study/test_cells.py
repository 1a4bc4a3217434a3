from amhe_cli.study.cells import Cell, cell_of, grid, setting_of, words
from tests.study.cells_at_play import CODE

EXISTS = {"t1": ("true", "baseline"), "t4": ("true", "baseline", "stale")}


def test_all_that_decides_a_cell_is_in_its_name() -> None:
    cell = Cell("t4", "baseline", 3, setting_of({"control.samples": 16}), "belief: 1", 40.0)
    others = [
        Cell("t1", "baseline", 3, cell.setting, cell.belief),
        Cell("t4", "true", 3, cell.setting, cell.belief),
        Cell("t4", "baseline", 4, cell.setting, cell.belief),
        Cell("t4", "baseline", 3, (), cell.belief),
        Cell("t4", "baseline", 3, cell.setting, None),
        Cell("t4", "baseline", 3, cell.setting, cell.belief, 20.0),
    ]
    names = {cell.file_name(CODE), *(other.file_name(CODE) for other in others)}
    names |= {cell.file_name(CODE | {name: "other"}) for name in CODE}
    assert len(names) == 1 + len(others) + len(CODE)
    assert cell.file_name(CODE).startswith("t4-baseline-03-")


def test_a_cell_survives_json() -> None:
    import json

    cell = Cell("t4", "true", 0, setting_of({"control.sigma_range": [0.2, 1.0], "control.refine": "never"}))
    again = cell_of(json.loads(json.dumps(cell.plain())))
    assert again == cell
    assert again.file_name(CODE) == cell.file_name(CODE)
    assert hash(again) == hash(cell)
    assert words(cell.setting) == 'control.refine="never", control.sigma_range=[0.2, 1.0]'


def test_a_grid_goes_seed_by_seed_and_leaves_out_what_does_not_exist() -> None:
    cells = grid(["t1", "t4"], ["true", "stale"], 2, [(), ()], {}, EXISTS, 40.0)
    assert [(c.task, c.mode, c.seed) for c in cells] == [
        ("t1", "true", 0), ("t4", "true", 0), ("t4", "stale", 0),
        ("t1", "true", 1), ("t4", "true", 1), ("t4", "stale", 1),
    ]  # fmt: skip


def test_an_identified_belief_is_the_baselines_alone() -> None:
    cells = grid(["t1", "t4"], ["true", "baseline", "stale"], 1, [()], {"t4": "found"}, EXISTS, 40.0)
    assert {(c.task, c.mode) for c in cells if c.belief} == {("t4", "baseline")}
