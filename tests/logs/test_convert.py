"""Logs that amhe writes: signals, and other formats converted."""

from __future__ import annotations

import errno
import os
import re
import resource
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

import amhe_cli as amhe
from amhe_cli.cli.main import run
from amhe_cli.core.errors import ConfigError, LogError
from amhe_cli.core.log import Samples, sampled
from amhe_cli.core.settings import LogSettings
from amhe_cli.core.signals import Signal
from amhe_cli.logs import LogWriter, read_metadata, read_signals, survey
from amhe_cli.logs.messages.writer import message_type, write_samples
from tests.logs.log_makers import DT, ROS2, SETTINGS, SIGNALS, motion, write_mcap, wrong_samples

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


JOINTS = Signal("joints", "/joints", ("position", "velocity", "effort"), names=("hip", "knee"))
BODY = Signal("body", "/body", ("position", "orientation", "linear_velocity", "angular_velocity"))
PLACE = Signal("place", "/place", ("position", "orientation"), type="geometry_msgs/msg/PoseStamped")
IMU = Signal("imu", "/imu", ("angular_velocity", "linear_acceleration"), type="sensor_msgs/msg/Imu")
FORCE = Signal("force", "/ft", ("force", "torque"))
VOLTS = Signal("volts", "/volts", ("value",), is_input=True)
ALL = (JOINTS, BODY, PLACE, IMU, FORCE, VOLTS)
WIDTHS = {"joints": 2, "volts": 3}


def some(signals: tuple[Signal, ...] = ALL, count: int = 40) -> Samples:
    rng, times = np.random.default_rng(0), DT * np.arange(1, count + 1)
    samples = {}
    for signal in signals:
        for quantity in signal.quantities:
            width = 4 if quantity == "orientation" else WIDTHS.get(signal.name, 3)
            values = rng.normal(size=(count, width))
            if quantity == "orientation":
                values /= np.linalg.norm(values, axis=1, keepdims=True)
            samples[signal.key(quantity)] = times, values
    return samples


def stamp(time: float) -> int:
    return round(1e9 * time)


def test_every_message_type_is_read_again_as_it_was_written(tmp_path: Path) -> None:
    samples, path = some(), tmp_path / "log.mcap"
    with LogWriter(path, {}) as log:
        write_samples(log, ALL, samples, stamp)
    read = read_signals(path, ALL, DT, SETTINGS)
    again = sampled(read)
    assert set(again) == set(samples)
    for key, (times, values) in samples.items():
        np.testing.assert_allclose(again[key][0] + 1e-9 * read.start_ns, times, atol=1e-9)
        np.testing.assert_allclose(np.abs((again[key][1] * values).sum()), (values**2).sum(), err_msg=key)
        if "orientation" not in key:  # whose sign is free
            np.testing.assert_allclose(again[key][1], values, atol=1e-12, err_msg=key)


def test_messages_lie_in_the_order_of_time_and_only_what_was_sampled_is_written(tmp_path: Path) -> None:
    late, early = np.array([0.3, 0.4]), np.array([0.1, 0.35])
    samples = {"volts.value": (late, np.ones((2, 3))), "joints.position": (early, np.ones((2, 2)))}
    with LogWriter(tmp_path / "log.mcap", {}) as log:
        write_samples(log, ALL, samples, stamp)
    with (tmp_path / "log.mcap").open("rb") as file:
        found = [(c.topic, m.log_time) for _, c, m in make_reader(file).iter_messages(log_time_order=False)]
    assert found == [
        ("/joints", 100_000_000), ("/volts", 300_000_000), ("/joints", 350_000_000), ("/volts", 400_000_000)
    ]  # fmt: skip


def test_a_type_that_cannot_be_written_is_refused_by_name() -> None:
    with pytest.raises(ConfigError, match=r"signal 'f' is of type x/msg/Foot; "):
        message_type(Signal("f", "/f", ("value",), type="x/msg/Foot"))
    with pytest.raises(ConfigError, match="signal 'f'"):
        message_type(Signal("f", "/f", ("position",), fields={"position": ("a.b",)}))


def test_what_was_written_before_the_disk_was_full_stays_readable(tmp_path: Path) -> None:
    path, names = tmp_path / "log.mcap", [str(number) for number in range(10_000)]
    noise = np.random.default_rng(0).normal(size=(60, len(names)))
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (3_000_000, before[1]))
        with LogWriter(path) as log:
            with pytest.raises(OSError, match="too large") as raised:
                for number, row in enumerate(noise):
                    log.joint_state("/joints", stamp(0.1 * number), names, row)
            log.diagnostics(stamp(7.0), 0, "the run itself ends well", {})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert raised.value.filename == str(path)
    assert [left.name for left in tmp_path.iterdir()] == ["log.mcap"]
    assert survey(path).topics[0].count > 10
