import json
import zipfile

import numpy as np
import pytest

from amhe_cli.core.errors import AmheError
from amhe_cli.study.cells import Cell
from amhe_cli.study.results import read_result, result_of, thinned
from tests.study.cells_at_play import CODE, record


def columns(cycles: int) -> dict[str, np.ndarray]:
    time = 0.02 * np.arange(1, cycles + 1)
    names = ("trunk_x", "trunk_y", "trunk_yaw", "box_x", "box_y", "box_yaw", "command")
    flat = {name: np.zeros(cycles) for name in names}
    return flat | {
        "time": time,
        "box_x": 0.6 + 0.2 * time,
        "speed": 0.2 + 0.1 * (-1.0) ** np.arange(cycles),
        "running_cost": np.arange(float(cycles)),
        "belief/box_mass": np.linspace(4.0, 5.0, cycles),
        "plan_ms": np.full(cycles, 17.0),
    }


def test_a_trace_keeps_the_last_row_and_says_what_never_changes_once() -> None:
    trace = thinned(columns(33), 0.02)
    assert trace["time"] == [0.2, 0.4, 0.6, 0.66]
    assert trace["box_x"] == [0.64, 0.68, 0.72, 0.732]
    assert trace["trunk_y"] == 0
    assert "plan_ms" not in trace
    assert len(trace["belief/box_mass"]) == 4


def test_what_nobody_knows_yet_is_null_and_comes_back_as_nan() -> None:
    sd = np.where(np.arange(30) < 15, np.nan, 0.12345)
    trace = thinned(columns(30) | {"belief_sd/box_mass": sd}, 0.02)
    assert trace["belief_sd/box_mass"] == [None, 0.1234, 0.1234]
    plain = record({"cell": Cell("t1", "true", 0).plain(), "code": CODE}) | {"trace": trace}
    again = result_of(json.loads(json.dumps(plain, allow_nan=False))).trace["belief_sd/box_mass"]
    assert np.isnan(again[0])
    assert again[1] == 0.1234


def test_what_swings_within_a_row_is_averaged_and_sums_stay() -> None:
    trace = thinned(columns(40), 0.02)
    assert trace["speed"] == pytest.approx(0.2)
    assert 10 * sum(trace["running_cost"]) == pytest.approx(sum(range(40)))


def test_a_whole_episode_is_small() -> None:
    noisy = {
        name: values + np.random.default_rng(0).normal(0, 1, 2000) for name, values in columns(2000).items()
    }
    assert len(json.dumps(thinned(noisy, 0.02), separators=(",", ":"))) < 20_000


def test_a_result_has_all_rows_of_every_column() -> None:
    result = result_of(record({"cell": Cell("t1", "true", 0).plain(), "code": CODE}))
    assert {values.shape for values in result.trace.values()} == {(60,)}
    assert result.measure("success") == 1.0


def test_a_number_that_does_not_exist_is_nan_but_a_key_of_other_code_is_an_error() -> None:
    plain = record({"cell": Cell("t1", "true", 0).plain(), "code": CODE})
    result = result_of(plain | {"outcome": plain["outcome"] | {"path_rmse_m": None}})
    assert np.isnan(result.measure("path_rmse_m"))
    with pytest.raises(AmheError, match="t1 true, seed 0: its result has no goal_error; other code"):
        result.measure("goal_error")


def test_a_file_that_is_none_is_refused_by_its_name(tmp_path) -> None:
    path = tmp_path / "t1-true-00-0.json"
    path.write_text('{"cell": ')
    with pytest.raises(AmheError, match="t1-true-00-0.json: is no result.*delete the file.*resume=True"):
        read_result(path)


def test_a_packed_file_that_is_none_is_not_to_be_deleted(tmp_path) -> None:
    with zipfile.ZipFile(tmp_path / "cells.zip", "w") as archive:
        archive.writestr("t1-true-00-0.json", '{"cell": ')
    (packed,) = zipfile.Path(tmp_path / "cells.zip").iterdir()
    with pytest.raises(AmheError, match="cells.zip/t1-true-00-0.json: is no result.*; restore the archive"):
        read_result(packed)
