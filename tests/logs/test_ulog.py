"""ULog files of PX4, through pyulog."""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np
import pytest

from amhe_cli.core.errors import LogError
from amhe_cli.core.settings import LogSettings
from amhe_cli.core.signals import Signal
from amhe_cli.logs import read_signals, survey
from tests.logs.ulog_maker import write_ulog

DT = 0.01
T = DT * np.arange(200)
Q = np.stack((np.cos(T), np.sin(T)), axis=1).astype(np.float32)


def written(folder: Path, dropout: int = 0) -> Path:
    """One topic with an array, and two instances of another, each with a clock of its own."""
    stamps = (20_000_000 + np.round(1e6 * T)).astype(np.uint64)
    arm = {"timestamp": stamps, "timestamp_sample": stamps - np.uint64(500), "q": Q}
    slow = {"timestamp": stamps[::4], "x": Q[::4, 1], "count": np.arange(50, dtype=np.int32)}
    other = slow | {"x": -Q[::4, 1]}
    topics = {("arm", 0): arm, ("gyro", 0): slow, ("gyro", 1): other}
    return write_ulog(folder / "log.ulg", topics, dropout)


def test_topics_are_tables_with_arrays_and_microseconds(tmp_path: Path) -> None:
    path = written(tmp_path)
    signals = [
        Signal("joints", "arm", ("position",), columns={"position": ("q",)}),
        Signal("one", "arm", ("position",), columns={"position": ("q[1]",)}),
        Signal("gyro", "gyro_1", ("value",), columns={"value": ("x",)}),
    ]
    log = read_signals(path, signals, DT, LogSettings())
    assert log.start_ns == 20_000_000_000
    np.testing.assert_array_equal(log["joints.position"].values[: T.size], Q[: log.steps])
    np.testing.assert_array_equal(log["one.position"].values[:, 0], Q[: log.steps, 1])
    np.testing.assert_allclose(log["gyro.value"].values[::4, 0], -Q[: log.steps : 4, 1], rtol=1e-14)


def test_inspection_lists_them(tmp_path: Path) -> None:
    found = survey(written(tmp_path, dropout=250))
    assert found.format == "ULog (3 tables)"
    assert [topic.name for topic in found.topics] == ["arm", "gyro", "gyro_1"]
    assert found.topics[0].entries == ("timestamp", "timestamp_sample", "q[2]")
    assert found.topics[1].rate == pytest.approx(25.0)
    assert found.problems == ("the recorder dropped messages 1 times, 0.25 s in all",)


def test_what_was_said_before_the_recording_is_no_part_of_its_duration(tmp_path: Path) -> None:
    stamps = (20_000_000 + np.round(1e6 * T)).astype(np.uint64)
    early = {"timestamp": np.array([1_000_000], dtype=np.uint64), "x": Q[:1, 1]}
    arm = {"timestamp": stamps, "q": Q}
    found = survey(write_ulog(tmp_path / "log.ulg", {("arm", 0): arm, ("boot", 0): early}))
    assert found.duration == pytest.approx(T[-1])
    halves = {"timestamp": np.where(T < 1.0, stamps, stamps + np.uint64(60_000_000)), "q": Q}
    found = survey(write_ulog(tmp_path / "halves.ulg", {("arm", 0): halves}))
    assert found.duration == pytest.approx(60.0 + T[-1])


def test_without_the_extra_one_line_says_how_to_get_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pyulog", None)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(LogError, match=r"a ULog of PX4.*pip install 'amhe\[ulog\]'"):
        survey(written(tmp_path))


def test_zeros_at_its_end_are_left_out_and_between_its_messages_refused(tmp_path: Path) -> None:
    """pyulog takes a second for each megabyte of them."""
    whole, padded, torn = written(tmp_path), tmp_path / "padded.ulg", tmp_path / "torn.ulg"
    content = whole.read_bytes()
    padded.write_bytes(content + bytes(8 * 2**20))
    torn.write_bytes(content + bytes(2**20) + content[-100:])
    began = time.process_time()
    assert [t.entries for t in survey(padded).topics] == [t.entries for t in survey(whole).topics]
    with pytest.raises(LogError, match="a megabyte of zeros between its messages"):
        survey(torn)
    assert time.process_time() - began < 2.0
