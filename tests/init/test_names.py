"""Joints in messages of types that are not built in: the example names paths that the log has."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
import yaml

from amhe_cli.cli.main import run
from amhe_cli.core.errors import ConfigError
from amhe_cli.core.settings import LogSettings
from amhe_cli.core.signals import Signal
from amhe_cli.init.folder import _topics, init_system
from amhe_cli.init.names import joint_paths
from amhe_cli.init.signals import fields_example
from amhe_cli.logs import LogWriter, read_signals

#: As a model has them; the motors of the robot are FR, FL, RR, RL.
LEGS = [f"{leg}_{part}_joint" for leg in ("FL", "FR", "RL", "RR") for part in ("hip", "thigh", "calf")]


@pytest.fixture
def go2(tmp_path: Path) -> tuple[Path, Path]:
    """A model of twelve joints, and a log of unitree_go/LowState with its own definition."""
    bodies = "".join(
        f"<body><joint name='{name}' axis='1 0 0'/><geom size='.1' mass='1'/></body>" for name in LEGS
    )
    model = tmp_path / "go2.xml"
    model.write_text(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")
    path, package = tmp_path / "go2.mcap", "unitree_go/msg/"
    with LogWriter(path) as log:
        log.define(
            f"{package}MotorState", "uint8 mode\nfloat32 q\nfloat32 dq\nfloat32 tau_est\nuint32[2] reserve"
        )
        log.define(
            f"{package}LowState",
            "uint8[2] head\nunitree_go/MotorState[20] motor_state\nfloat32[4] foot_force",
        )
        for i in range(50):
            motors = [{"mode": 1, "q": 0.01 * i + k, "dq": 0.5} for k in range(20)]
            log.write("/lowstate", f"{package}LowState", 10**18 + i * 10**7, {"motor_state": motors})
    return model, path


def test_the_example_reads_the_log_in_the_order_of_the_motors(
    go2: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model, path = go2
    with pytest.raises(
        ConfigError, match=r"fields: \{position: \['motor_state\[0\].q', 'motor_state\[1\].q'"
    ):
        init_system(model, [path], tmp_path / "out")
    (topic,) = _topics([path], None)
    entry = yaml.safe_load("\n".join(fields_example(mujoco.MjModel.from_xml_path(str(model)), topic)))[
        "states"
    ]
    assert entry["joints"][:4] == ["FR_hip_joint", "FR_thigh_joint", "FR_calf_joint", "FL_hip_joint"]
    fields = {key: tuple(paths) for key, paths in entry["fields"].items()}
    log = read_signals(path, [Signal("s", "/lowstate", tuple(fields), fields=fields)], 0.01, LogSettings())
    np.testing.assert_allclose(log["s.position"].values[7], 0.07 + np.arange(12), atol=1e-6)
    assert run(["inspect", str(path)]) == 0
    assert "fields by path of head, motor_state[0].mode, motor_state[0].q" in " ".join(
        capsys.readouterr().out.split()
    )


@pytest.mark.parametrize(
    ("paths", "found"),
    [
        ({"joints.pos": 7, "joints.vel": 7}, {"position": "joints.pos[{}]", "velocity": "joints.vel[{}]"}),
        ({"a[0].angle": None, "a[1].angle": None}, {"position": "a[{}].angle"}),
        ({"q": 2, "dq": 1}, {"position": "q[{}]"}),
        ({"temperature": 12}, {}),
    ],
)
def test_paths_by_their_names(paths: dict[str, int | None], found: dict[str, str]) -> None:
    assert joint_paths(paths, 2) == found


@pytest.mark.parametrize(
    "columns",
    ["px py pz qw qx qy qz", "cube_x cube_y cube_z cube_qx cube_qy cube_qz cube_qw"],
    ids=["bare", "named"],
)
def test_columns_of_a_pose_are_those_of_the_free_body(columns: str, tmp_path: Path) -> None:
    body = "<body name='cube'><freejoint/><geom size='.1' mass='1'/></body>"
    (tmp_path / "cube.xml").write_text(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
    time, names = np.arange(0.0, 1.0, 0.01), columns.split()
    values = {name: np.sin(time + i) for i, name in enumerate(names)}
    turn = [name for name in names if "q" in name]
    length = np.sqrt(sum(values[name] ** 2 for name in turn))
    values |= {name: values[name] / length for name in turn}
    rows = np.column_stack([time, *(values[name] for name in names)])
    log = tmp_path / "log.csv"
    np.savetxt(log, rows, delimiter=",", header="t," + ",".join(names), comments="")

    init_system(tmp_path / "cube.xml", [log], tmp_path / "cube")

    signal = yaml.safe_load((tmp_path / "cube" / "system.yaml").read_text())["signals"]["cube"]
    assert signal["body"] == "cube"
    found = [*signal["columns"]["position"], *signal["columns"]["orientation"]]
    assert [name[-1] for name in found] == list("xyzwxyz")
    assert set(found) == set(names)
