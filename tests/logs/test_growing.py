"""A log that a recorder still writes: only what is whole is read, from now on, and in the next file, too."""

from __future__ import annotations

from pathlib import Path

import pytest
from mcap.writer import CompressionType, Writer

from amhe_cli.core.errors import ConfigError
from amhe_cli.logs.live.sources import GrowingMcap


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
