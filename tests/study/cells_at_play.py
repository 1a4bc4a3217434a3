"""Results of cells that were never run."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from amhe_cli.core.errors import ConfigError
from amhe_cli.study.cells import Cell
from amhe_cli.study.results import CellResult, blank, result_of

CODE = {"amhe": "0.0.0", "sources": "0123456789ab", "mujoco": "4.0.0", "numpy": "2.0.0", "model": "ab"}


def played(request: Mapping[str, Any]) -> dict[str, Any]:
    """A run as `study.run.run_cell` would do it: seed 1 fails, seed 7 stops everything."""
    seed = request["cell"]["seed"]
    if seed == 7:
        raise ConfigError("a worker runs amhe 9.9.9, and this command 0.0.0: install the same everywhere")
    if seed == 1:
        return blank(request, "SimulationError: the plant diverged")
    return record(request)


def record(request: Mapping[str, Any], mode_matters: float = 1.0) -> dict[str, Any]:
    """What a good cell brings; the baseline is worse by `mode_matters`, and seeds differ a little."""
    cell = request["cell"]
    worse = mode_matters * (cell["mode"] != "true") + 0.01 * cell["seed"]
    rows = 60
    time = np.round(0.2 * np.arange(1, rows + 1), 2)
    trace = {
        "time": time.tolist(),
        "trunk_x": (0.2 * time).tolist(),
        "trunk_y": 0,
        "trunk_yaw": 0,
        "box_x": (0.6 + 0.2 * time / (1.0 + worse)).tolist(),
        "box_y": (0.02 * worse * np.sin(time)).tolist(),
        "box_yaw": 0,
        "foot_x": 0.2,
        "foot_y": -0.2,
        "speed": (0.2 + 0.02 * np.sin(7.0 * time)).tolist(),
        "command": 0.2,
        "running_cost": (1.0 + worse + np.sin(time) ** 2).tolist(),
        "belief/box_mass": 4.0 - worse,
        "belief/floor_friction": 0.4,
        "truth/box_mass": [4.0] * 30 + [6.0] * 30,
        "truth/floor_friction": 0.4,
    }
    outcome = {
        "success": cell["mode"] == "true",
        "on_time": cell["mode"] == "true",
        "fell": False,
        "goal_error_m": 0.02 + 0.1 * worse,
        "speed_rmse": 0.03 + 0.01 * worse,
        "cost": 1000.0 * (1.0 + worse),
        "time_s": 14.0 + 4.0 * worse,
        "path_rmse_m": 0.01,
    }
    return blank(request, None) | {"outcome": outcome, "trace": trace, "seconds": 1.0}


def result(cell: Cell, mode_matters: float = 1.0) -> CellResult:
    return result_of(record({"cell": cell.plain(), "code": CODE}, mode_matters))
