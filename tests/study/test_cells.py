from amhe_cli.study.cells import Cell, cell_of, setting_of, words
from tests.study.cells_at_play import CODE


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
    known = {"parameters.motor_gain.held": 0.98, "parameters.motor_gain.held_sd": 0.01, "plant": "dry"}
    assert words(setting_of(known)) == 'plant="dry", a known robot'
