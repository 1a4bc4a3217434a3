"""The systems of docs/real.md read logs of their owners' kind; the logs themselves are not ours to bundle."""

from __future__ import annotations

import shutil
from pathlib import Path

import mujoco
import numpy as np
import pytest

import amhe_cli as amhe
from amhe_cli.logs.data_set import members

SYSTEMS = Path(__file__).parents[1] / "examples" / "systems"
#: Column names of position, velocity and torque of each joint, as the owners have them.
COLUMNS = {
    "simple_pendulum": ["position", "velocity", "torque"],
    "double_pendulum": [
        "pos_meas1", "pos_meas2", "vel_meas1", "vel_meas2", "tau_con1", "tau_con2", "tau_meas1", "tau_meas2",
    ],
}  # fmt: skip


def write_log(path: Path, system: amhe.System, columns: list[str], seconds: float = 5.0) -> np.ndarray:
    """Swing the model under slow torques; return times and positions, shape (n, 1 + nq)."""
    model, data = system.model, mujoco.MjData(system.model)
    rows = []
    for step in range(round(seconds / model.opt.timestep)):
        time = step * model.opt.timestep
        data.ctrl[:] = 0.5 * np.sin(2.0 * time + np.arange(model.nu))
        torques = np.tile(data.ctrl, 2 if "tau_con1" in columns else 1)
        rows.append([time, *data.qpos, *data.qvel, *torques])
        mujoco.mj_step(model, data)
    np.savetxt(path, rows, delimiter=",", header=",".join(["time", *columns]), comments="")
    return np.array(rows)[:, : 1 + model.nq]


@pytest.mark.parametrize("name", COLUMNS)
def test_an_owners_log_is_read_by_its_columns(name: str, tmp_path: Path) -> None:
    system = amhe.System.load(SYSTEMS / name)
    truth = write_log(tmp_path / "log.csv", system, COLUMNS[name])
    log = amhe.read_log(tmp_path / "log.csv", system)
    positions = log.series["joints.position"].values
    assert abs(len(positions) - len(truth)) <= 1
    np.testing.assert_allclose(positions[: len(truth)], truth[: len(positions), 1:], atol=1e-6)


@pytest.mark.parametrize("data_set", ["runs.yaml", "known.yaml"])
def test_the_data_sets_name_parts_of_two_logs(data_set: str, tmp_path: Path) -> None:
    system = amhe.System.load(SYSTEMS / "simple_pendulum")
    for name in ("energy_measured.csv", "energy_1kg_measured.csv"):
        write_log(tmp_path / name, system, COLUMNS["simple_pendulum"], seconds=1.0)
    shutil.copy(SYSTEMS / "simple_pendulum" / data_set, tmp_path)
    found = members(tmp_path / data_set, system)
    assert [(one.start, one.end) for one in found] == [(None, 4.6), (None, 7.5)]
    assert [one.known.get("weight", one.own) for one in found] in ([["weight"]] * 2, [0.5, 1.0])


def test_a_log_of_the_weighed_servo_is_two_where_its_torque_is_off(tmp_path: Path) -> None:
    """calibrate.yaml knows the load, and no torque after 2 s; weigh.yaml does not know the load."""
    folder = SYSTEMS / "xl330"
    system = amhe.System.load(folder)
    for name in ("calibrate", "weigh"):
        shutil.copy(folder / f"{name}.yaml", tmp_path)
    for name in ("kp400_lift_and_drop", "kp400_sin_time_square", "kp200_up_and_down"):
        (tmp_path / f"{name}.mcap").touch()
    on, off, other = members(tmp_path / "calibrate.yaml", system)
    assert (on.end, off.start, other.start) == (1.98, 2.0, None)
    assert [one.known.get("torque") for one in (on, off, other)] == [1, 0, 1]
    theta = system.space.nominal.copy()
    for name, value in off.known.items():
        theta[system.space.names.index(name)] = value
    dropped = system.edits.apply(system.model, theta)
    assert dropped.actuator_gainprm[0, 0] == dropped.actuator_biasprm[0, 1] == 0.0
    assert dropped.dof_damping[0] == pytest.approx(0.01)
    (weighed,) = members(tmp_path / "weigh.yaml", system)
    assert "load_mass" not in weighed.known
