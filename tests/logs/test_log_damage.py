"""Logs that are damaged, cut or still being written."""

from __future__ import annotations

import logging
import resource
from mmap import mmap
from pathlib import Path

import numpy as np
import pytest
from mcap.opcode import Opcode
from mcap.writer import CompressionType, Writer

from amhe_cli.core.errors import AmheError, ConfigError, LogError
from amhe_cli.core.log import Log
from amhe_cli.logs import inspect_log, read_metadata, read_signals
from amhe_cli.logs.containers import mcap_file
from amhe_cli.logs.live.sources import GrowingMcap
from benchmarks import fuzz_logs
from tests.logs.log_makers import (
    DT,
    ROS1,
    ROS2,
    SETTINGS,
    SIGNALS,
    motion,
    write_bag,
    write_mcap,
    write_rosbag2,
    wrong_samples,
)

FORMATS = ("mcap", "mcap_plain", "mcap_loose", "db3", "bag", "bag_lz4", "bag_bz2")
STEPS = 120
#: Formats without checksums, and how many samples a flipped bit may spoil there: those of its message, or
#: of its chunk where compression copies it.
UNPROTECTED = {"db3": 1, "bag": 1, "bag_lz4": 40}


@pytest.fixture(scope="module")
def originals(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    folder = tmp_path_factory.mktemp("originals")
    two, one = motion(ROS2, STEPS), motion(ROS1, STEPS)
    from mcap.writer import CompressionType

    plain = CompressionType.NONE
    paths = {
        "mcap": write_mcap(folder / "a.mcap", two),
        "mcap_plain": write_mcap(folder / "b.mcap", two, compression=plain, enable_data_crcs=True),
        "mcap_loose": write_mcap(folder / "c.mcap", two, use_chunking=False, enable_data_crcs=True),
        "db3": write_rosbag2(folder / "d", two) / "d.db3",
        "bag": write_bag(folder / "e.bag", one),
        "bag_lz4": write_bag(folder / "f.bag", one, "lz4"),
        "bag_bz2": write_bag(folder / "g.bag", one, "bz2"),
    }
    return {name: path.read_bytes() for name, path in paths.items()}


def attempt(path: Path, content: bytes, caplog: pytest.LogCaptureFixture) -> Log | None:
    """Read damaged content; None where it is refused. Anything but a LogError fails the test."""
    path.write_bytes(content)
    caplog.clear()
    with caplog.at_level(logging.WARNING):
        try:
            return read_signals(path, SIGNALS, DT, SETTINGS)
        except LogError as error:
            assert str(path) in str(error)
            assert "\n" not in str(error)
            return None


@pytest.mark.medium
@pytest.mark.parametrize("name", FORMATS)
def test_cut_anywhere(
    name: str, originals: dict[str, bytes], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    content = originals[name]
    steps = []
    for percent in range(1, 100, 3):
        trajectory = attempt(tmp_path / "log", content[: len(content) * percent // 100], caplog)
        if trajectory is not None:
            assert caplog.records, f"{percent} %: nothing was said"
            assert not any(wrong_samples(trajectory).values()), f"{percent} %"
        steps.append(trajectory.steps if trajectory else 0)
    if name == "db3":  # sqlite would take what is missing for zeros
        assert not any(steps)
    else:
        assert steps[-2] > STEPS // 2, "most of a nearly complete log is recovered"
        assert steps[len(steps) // 2] > STEPS // 4


@pytest.mark.medium
@pytest.mark.parametrize("name", FORMATS)
def test_flipped_bits(
    name: str, originals: dict[str, bytes], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    rng = np.random.default_rng(20261121)
    read = 0
    flips = 100 if name in ("mcap", "db3", "bag") else 30
    for place in rng.integers(0, 8 * len(originals[name]), flips).tolist():
        content = bytearray(originals[name])
        content[place // 8] ^= 1 << place % 8
        trajectory = attempt(tmp_path / "log", bytes(content), caplog)
        if trajectory is None:
            continue
        read += 1
        wrong = wrong_samples(trajectory)
        assert max(wrong.values()) <= UNPROTECTED.get(name, 0), f"bit {place}: {wrong}"
        lost = (
            any(not series.sampled.all() for series in trajectory.series.values()) or trajectory.steps < STEPS
        )
        assert caplog.records or not lost or name in UNPROTECTED, f"bit {place}: data are lost without a word"
    if name != "mcap_loose":
        assert read > 0.75 * flips, "one bit must not cost the whole log"


@pytest.mark.parametrize(("mark", "least"), [(b"op=\x04", STEPS), (b"size=", 0.8 * STEPS)])
def test_a_bag_is_read_on_behind_its_damage(
    mark: bytes, least: float, originals: dict[str, bytes], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Its index lists the chunks that follow a damaged record, of an index or a chunk."""
    content = bytearray(originals["bag"])
    place = content.index(mark) - 4  # the length of a field
    content[place : place + 4] = b"\xff" * 4
    log = attempt(tmp_path / "log", bytes(content), caplog)
    assert log is not None
    assert not any(wrong_samples(log).values())
    assert least <= log.steps <= STEPS
    assert bool(caplog.records) == (log.steps < STEPS)


def test_a_bag_that_was_cut_between_two_records_is_said_to_be(
    originals: dict[str, bytes], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    content = originals["bag"]
    at = content.index(b"index_pos=") + len(b"index_pos=")
    assert attempt(tmp_path / "log", content[: int.from_bytes(content[at : at + 8], "little")], caplog)
    assert "the bag has no index" in caplog.text


@pytest.mark.parametrize("wrong", [None, 0, 1, 9, 2**63, 2**64 - 1])
def test_the_index_behind_a_chunk_is_used_but_not_believed(
    wrong: int | None, tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, believed = write_mcap(tmp_path / "a.mcap", motion(ROS2, STEPS), chunk_size=4000), []
    real = mcap_file.is_chain

    def is_chain(*given: np.ndarray) -> bool:
        believed.append(real(*given))
        return believed[-1]

    monkeypatch.setattr(mcap_file, "is_chain", is_chain)
    content = bytearray(path.read_bytes())
    at = len(mcap_file.MAGIC)
    while wrong is not None and at < len(content) - len(mcap_file.MAGIC):
        opcode, size = mcap_file.RECORD.unpack_from(content, at)
        for place in range(at + 23, at + 9 + size, 16) if opcode == Opcode.MESSAGE_INDEX else ():
            content[place : place + 8] = wrong.to_bytes(8, "little")
        at += 9 + size
    trajectory = attempt(path, bytes(content), caplog)
    assert trajectory is not None
    assert not any(wrong_samples(trajectory).values())
    assert trajectory.steps == STEPS
    assert len(believed) > 5
    assert sum(believed) == (
        len(believed) - 1 if wrong is None else 0
    )  # the first one holds declarations too


def test_an_index_behind_a_chunk_is_not_read_beyond_what_the_chunk_can_hold() -> None:
    empty = mcap_file.RECORD.pack(Opcode.MESSAGE_INDEX, 6) + bytes(6)
    one = mcap_file.RECORD.pack(Opcode.MESSAGE_INDEX, 22) + bytes(22)
    with mmap(-1, 10**6) as data:
        data[: len(one + 1000 * empty + one)] = one + 1000 * empty + one
        chunk = mcap_file.Piece(0, 0, True)
        assert len(mcap_file.indexed(data, chunk, 31 * 2000)) == 2
        assert len(mcap_file.indexed(data, chunk, 31 * 100)) == 1


@pytest.mark.medium
@pytest.mark.parametrize("kind", sorted(fuzz_logs.MAKERS))
def test_a_mutated_log_of_any_format_is_read_or_refused_in_one_line(kind: str, tmp_path: Path) -> None:
    """A few of the cases of benchmarks/fuzz_logs.py."""
    rng = np.random.default_rng(7)
    fuzz_logs.MAKERS[kind](tmp_path)
    path = next(tmp_path.iterdir())
    path = Path(f"{path}#0") if (path / "meta").is_dir() else path
    files = sorted(file for file in tmp_path.rglob("*") if file.is_file())
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for number in range(15):
        file = files[number % len(files)]
        content = file.read_bytes()
        file.write_bytes(fuzz_logs.mutated(content, rng))
        for look in (read_metadata, lambda path: inspect_log(path, fuzz_logs.SYSTEM)):
            try:
                look(path)
            except AmheError as error:
                assert str(path).removesuffix("#0") in str(error)
                assert "\n" not in str(error)
        file.write_bytes(content)
    # a wild time makes a long clock of it: `logs.tracks` stops at 10 million rows
    assert 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) < 400 * 2**20


class Recorder:
    """Writes JSON messages on /x, a chunk for every few of them; or none at all in chunks."""

    def __init__(self, path: Path, chunked: bool = True) -> None:
        self.file = path.open("wb")
        self.mcap = Writer(self.file, chunk_size=100, use_chunking=chunked, compression=CompressionType.NONE)
        self.mcap.start()
        schema = self.mcap.register_schema("x", "jsonschema", b"{}")
        self.channel = self.mcap.register_channel("/x", "json", schema)
        self.count = 0
        self.file.flush()

    def write(self, count: int) -> None:
        for _ in range(count):
            self.count += 1
            self.mcap.add_message(self.channel, self.count, b'{"value": 1.0, "more": "abcdefgh"}', self.count)
        self.file.flush()

    def finish(self) -> None:
        self.mcap.finish()
        self.file.close()


def stamps(transport: GrowingMcap) -> list[int]:
    return [ns for batch in transport.receive() for ns in batch.log_ns.tolist()]


@pytest.mark.parametrize("chunked", [True, False])
def test_messages_from_now_on_are_read_once_they_are_whole(tmp_path: Path, chunked: bool) -> None:
    path = tmp_path / "run.mcap"
    recorder = Recorder(path, chunked)
    recorder.write(20)
    transport = GrowingMcap(path, {"/x"})
    assert stamps(transport) == []
    recorder.write(11)
    recorder.finish()
    found = stamps(transport)
    assert found == list(range(found[0], 32)) and 18 <= found[0] <= 21
    assert stamps(transport) == [] and transport.notes() == []
    transport.close()


def test_half_a_record_waits_for_its_other_half(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "whole.mcap")
    recorder.write(5)
    recorder.finish()
    content, growing = (tmp_path / "whole.mcap").read_bytes(), tmp_path / "run" / "run.mcap"
    growing.parent.mkdir()
    growing.write_bytes(content[:8])
    transport, found = GrowingMcap(growing, None), []
    for end in range(8, len(content) + 7, 7):
        growing.write_bytes(content[:end])
        found += stamps(transport)
    assert found == [1, 2, 3, 4, 5]
    transport.close()


@pytest.mark.parametrize("names", [("run_9.mcap", "run_10.mcap"), ("9_run_2026.mcap", "10_run_2026.mcap")])
def test_it_goes_on_in_the_next_file(tmp_path: Path, names: tuple[str, str]) -> None:
    first = Recorder(tmp_path / names[0])
    transport = GrowingMcap(tmp_path, {"/x"})
    first.write(3)
    first.finish()
    assert stamps(transport) == [1, 2, 3]
    second = Recorder(tmp_path / names[1])
    second.write(9)
    second.finish()
    assert stamps(transport) == list(range(1, 10))
    transport.close()


def test_a_file_that_takes_its_place_is_read_from_its_start(tmp_path: Path) -> None:
    path = tmp_path / "current.mcap"
    old = Recorder(path)
    old.write(50)
    old.finish()
    transport = GrowingMcap(path, {"/x"})
    new = Recorder(tmp_path / "new.partial")
    new.write(4)
    new.finish()
    (tmp_path / "new.partial").replace(path)
    assert stamps(transport) == [1, 2, 3, 4]
    transport.close()


@pytest.mark.parametrize("damage", [bytes(50), b"\x06" + b"\xff" * 40])
def test_damage_is_one_line_and_ends_nothing(tmp_path: Path, damage: bytes) -> None:
    path = tmp_path / "run.mcap"
    recorder = Recorder(path, chunked=False)
    recorder.write(1)
    transport = GrowingMcap(path, {"/x"})
    stamps(transport)
    with path.open("ab") as file:
        file.write(damage)
    assert stamps(transport) == [] and stamps(transport) == []
    assert len(transport.notes()) == 1
    transport.close()
    recorder.file.close()


def test_what_cannot_be_followed_is_refused(tmp_path: Path) -> None:
    for path in (tmp_path, tmp_path / "none.mcap"):
        with pytest.raises(ConfigError, match=r"no \.mcap file to follow"):
            GrowingMcap(path, None)
