"""`amhe convert`: names, metadata, refusals; that samples survive is in test_every_format."""

from __future__ import annotations

import errno
import os
import re
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

import amhe_cli as amhe
from amhe_cli.cli.main import run
from amhe_cli.core.errors import ConfigError, LogError
from amhe_cli.core.settings import LogSettings
from amhe_cli.core.signals import Signal
from amhe_cli.logs import read_metadata, read_signals, survey
from tests.logs.log_makers import ROS2, SIGNALS, motion, write_mcap, wrong_samples

LOGS_PAGE = Path(__file__).parents[2] / "docs" / "your_log.md"


@pytest.fixture
def made(tmp_path: Path) -> Path:
    return write_mcap(tmp_path / "made.mcap", motion(ROS2, 50))


@pytest.mark.parametrize("form", ["copy.csv", "copy.npz", "copy"])
def test_metadata_stamps_and_poses_survive(form: str, made: Path) -> None:
    out = made.with_name(form)
    amhe.convert(made, out)
    assert read_metadata(out) == {"system": "made", "seed": "7"}
    again = read_signals(out, SIGNALS, 0.01, LogSettings())
    assert again.start_ns == read_signals(made, SIGNALS, 0.01, LogSettings()).start_ns
    assert wrong_samples(again) == dict.fromkeys(again.series, 0)


def test_columns_of_a_table_keep_their_names_units_and_blank_cells(tmp_path: Path) -> None:
    (tmp_path / "run.csv").write_text(
        "time [ms],q1_deg,p [mm],a,word\n"
        + "".join(f"{20 * i},{i},{i},{'' if i % 2 else i},x\n" for i in range(99))
    )
    for name in ("a.csv", "a.npz", "a"):
        amhe.convert(tmp_path / "run.csv", tmp_path / name)
        columns = {"value": ("q1_deg", "p", "a")}
        log = read_signals(
            tmp_path / name, [Signal("s", "", ("value",), columns=columns)], 0.02, LogSettings()
        )
        np.testing.assert_allclose(log["s.value"].values[4], [np.deg2rad(4.0), 0.004, 4.0], rtol=1e-12)
        only = read_signals(
            tmp_path / name, [Signal("a", "", ("value",), columns={"value": ("a",)})], 0.02, LogSettings()
        )
        assert only["a.value"].sampled[:5].tolist() == [True, False, True, False, True]


def test_a_time_known_by_its_unit_is_no_value(tmp_path: Path) -> None:
    (tmp_path / "run.csv").write_text("Zeit [ms],q\n" + "".join(f"{20 * i},{i}\n" for i in range(9)))
    amhe.convert(tmp_path / "run.csv", tmp_path / "a.csv")
    assert b"Zeit" not in (tmp_path / "a.csv").read_bytes()


def test_columns_may_have_any_name(tmp_path: Path) -> None:
    head = "time [s],file,allow_pickle"
    (tmp_path / "run.csv").write_text(head + "\n" + "".join(f"{0.02 * i:g},{i},{i}\n" for i in range(9)))
    amhe.convert(tmp_path / "run.csv", tmp_path / "a.npz")
    amhe.convert(tmp_path / "a.npz", tmp_path / "a.csv")
    assert (tmp_path / "a.csv").read_text().startswith(head)


def test_topics_that_would_share_a_file_are_refused(tmp_path: Path) -> None:
    with amhe.LogWriter(tmp_path / "log.mcap") as log:
        for topic in ("/a/b", "/a_b"):
            log.joint_state(topic, 10**18, ["j"], np.zeros(1))
    with pytest.raises(ConfigError, match="'a/b' and 'a_b' would share a file"):
        amhe.convert(tmp_path / "log.mcap", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_folder_has_a_file_for_each_topic(made: Path) -> None:
    amhe.convert(made, made.with_name("folder"))
    assert sorted(path.name for path in made.with_name("folder").iterdir()) == [
        "joint_states.csv",
        "odom.csv",
    ]
    head = made.with_name("folder").joinpath("joint_states.csv").read_text().splitlines()
    assert head[0].startswith("# amhe: {")
    assert head[1].startswith("time [s],position.hip,position.knee,position.ankle,velocity.hip")
    assert head[2].startswith("0.0,")


def test_nothing_is_overwritten_without_force(made: Path) -> None:
    for name in ("out.csv", "out.npz", "out"):
        out = made.with_name(name)
        amhe.convert(made, out)
        with pytest.raises(ConfigError, match=f"{name}: exists; choose another name, or give `force=True`"):
            amhe.convert(made, out)
        amhe.convert(made, out, force=True)
    with pytest.raises(ConfigError, match=r"a\.mcap: a log is written as .* rosbags-convert"):
        amhe.convert(made, made.with_name("a.mcap"))


def test_a_topic_that_is_missing_leaves_no_file(made: Path) -> None:
    system = amhe.System.load(
        "pendulum",
        {"signals": {"joints": {"topic": "/joint_state", "joints": ["hinge"], "noise": {"position": 0.1}}}},
    )
    for name in ("out.csv", "out"):
        with pytest.raises(LogError, match="no topic '/joint_state' .did you mean '/joint_states'"):
            amhe.convert(made, made.with_name(name), system)
    assert [path.name for path in made.parent.iterdir()] == ["made.mcap"]


def test_the_command(made: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(made.parent)
    assert run(["convert", "made.mcap", "-o", "one.csv"]) == 0
    assert capsys.readouterr().out == "wrote one.csv\n"
    assert run(["convert", "made.mcap", "-o", "one.csv"]) == 2
    assert "exists; choose another name, or give --force" in capsys.readouterr().err
    assert run(["convert", "made.mcap", "one.csv", "-o", "all"]) == 2
    assert "--each" in capsys.readouterr().err
    assert run(["convert", "made.mcap", "one.csv", "-o", "all", "--each", "npz"]) == 0
    assert sorted(path.name for path in Path("all").iterdir()) == ["made.npz", "one.npz"]
    assert {topic.name for topic in survey(Path("all/made.npz")).topics} == {"made"}


def test_the_recorder_in_the_docs_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    section = LOGS_PAGE.read_text(encoding="utf-8").split("## Your own recorder")[1]
    block = re.findall(r"^```python\n(.*?)^```", section, re.M | re.S)[0]
    robot = [(10**18 + i * 10**7, [0.1, i], [0.2, 100.0], [0.3, 0.0]) for i in range(100)]
    exec(block, {"robot": robot})
    names = ("elbow", "shoulder")
    signals = [
        Signal("joints", "/joint_states", ("position", "velocity"), names=names),
        Signal("command", "/joint_commands", ("position",), names=names, is_input=True),
    ]
    log = read_signals(Path("run.mcap"), signals, 0.01, LogSettings())
    np.testing.assert_allclose(log["joints.position"].values, [(i, 0.1) for i in range(100)])
    assert log["joints.velocity"].values[0].tolist() == [100.0, 0.2]
    assert log["command.position"].values[0].tolist() == [0.0, 0.3]


def test_a_topic_names_no_odd_file(tmp_path: Path) -> None:
    with amhe.LogWriter(tmp_path / "log.mcap") as log:
        for i in range(3):
            log.joint_state("/a\0b\x1b[31m/c\n", 1_700_000_000_000_000_000 + i * 10**7, ["hinge"], [0.1])
    amhe.convert(tmp_path / "log.mcap", tmp_path / "out")
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["a_b_[31m_c_.csv"]


def test_a_file_whose_name_is_no_utf8(tmp_path: Path) -> None:
    path = Path(os.fsdecode(os.fsencode(tmp_path) + b"/x\xff.csv"))
    path.write_text("time,y\n0,1\n1,2\n")
    amhe.convert(path, tmp_path / "out")
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["x\\udcff.csv"]


def test_a_full_disk_is_no_fault_of_the_log(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(import_module("amhe_cli.logs.convert"), "write_csv", full)
    with pytest.raises(OSError) as error:
        amhe.convert(made, tmp_path / "copy.csv")
    assert error.value.errno == errno.ENOSPC
