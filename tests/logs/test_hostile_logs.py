"""Logs made to cost memory or time: each ends soon, in a line that says what is wrong or how to allow it."""

from __future__ import annotations

import json
import os
import resource
import sqlite3
import struct
import subprocess
import sys
import time
import tracemalloc
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TypeAlias

import lz4.frame
import numpy as np
import pytest
import zstandard
from google.protobuf.descriptor_pb2 import FileDescriptorProto, FileDescriptorSet
from mcap.writer import CompressionType, Writer

from amhe_cli.core.errors import AmheError, LogError
from amhe_cli.core.limits import limit
from amhe_cli.logs import Survey, survey
from amhe_cli.logs.containers.folder import open_log
from amhe_cli.logs.containers.raw import Unfolder
from tests.logs.log_makers import ROS2, motion, write_rosbag2
from tests.logs.test_tables import dataset

#: Memory that a hostile log may take beyond what the process has [bytes].
MEMORY = 1500 * 2**20
#: Processor time that one may take [s], on a slow machine.
SECONDS = 30.0


@pytest.fixture(autouse=True)
def _bounded() -> Iterator[None]:
    """Fail a test that takes more memory than a bounded reader needs."""
    pages = int(Path("/proc/self/statm").read_text().split()[0]) if Path("/proc/self/statm").exists() else 0
    before = resource.getrlimit(resource.RLIMIT_AS)
    if pages:
        resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + MEMORY, before[1]))
    begun = time.process_time()
    yield
    resource.setrlimit(resource.RLIMIT_AS, before)
    assert time.process_time() - begun < SECONDS


def refused(path: Path) -> str:
    """The one line that refuses a log."""
    with pytest.raises(AmheError) as error:
        survey(path)
    assert "\n" not in str(error.value) and str(path) in str(error.value)
    return str(error.value)


def damage(found: Survey) -> str:
    return " ".join([*found.problems, *(note for topic in found.topics for note in topic.notes)])


def record(opcode: int, body: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(body)) + body


def mcap_of(path: Path, *chunks: tuple[str, int, bytes]) -> Path:
    """An MCAP of chunks: compression, size once unfolded, bytes."""
    body = b"".join(
        record(6, struct.pack("<QQQI", 0, 1, size, 0) + struct.pack("<I", len(kind)) + kind.encode()
               + struct.pack("<Q", len(packed)) + packed)
        for kind, size, packed in chunks
    )  # fmt: skip
    path.write_bytes(b"\x89MCAP0\r\n" + record(1, bytes(8)) + body)
    return path


def zeros(kind: str, mib: int) -> bytes:
    """So many MiB of zeros, packed without holding them."""
    if kind == "zstd":
        packer = zstandard.ZstdCompressor().compressobj(size=mib * 2**20)
        return b"".join([*(packer.compress(bytes(2**20)) for _ in range(mib)), packer.flush()])
    with lz4.frame.LZ4FrameCompressor() as packer:
        return b"".join(
            [packer.begin(), *(packer.compress(bytes(2**20)) for _ in range(mib)), packer.flush()]
        )


@pytest.mark.medium
@pytest.mark.parametrize("kind", ["zstd", "lz4"])
def test_a_chunk_of_zeros(kind: str, tmp_path: Path) -> None:
    found = survey(mcap_of(tmp_path / "log", (kind, 257 * 2**20, zeros(kind, 257))))
    assert "a piece of 257 MiB is beyond the limit piece_mib = 256 (`limit` piece_mib=1024" in damage(found)
    within = zeros(kind, 24)
    with limit(piece_mib=32):
        found = survey(mcap_of(tmp_path / "log", (kind, 24 * 2**20, within)))
        assert "has no place there" in damage(found)
        assert "beyond the limit growth = 100" in refused(
            mcap_of(tmp_path / "log", *[(kind, 24 * 2**20, within)] * 2)
        )


def test_a_frame_says_its_size_before_it_takes_memory() -> None:
    with pytest.raises(ValueError, match="a zstd frame of 67108864 bytes where at most 1000 are allowed"):
        Unfolder(0).unfold("zstd", zeros("zstd", 64), 1000)


@pytest.mark.medium
def test_messages_that_unfold_one_by_one(tmp_path: Path) -> None:
    folder = write_rosbag2(tmp_path / "log", motion(ROS2, 100))
    bomb = zeros("zstd", 96)
    with sqlite3.connect(folder / "log.db3") as database:
        database.execute("UPDATE messages SET data = ?", (bomb,))
    text = (folder / "metadata.yaml").read_text()
    (folder / "metadata.yaml").write_text(
        text.replace("compression_mode: ''", "compression_mode: MESSAGE").replace(
            "compression_format: ''", "compression_format: zstd"
        )
    )
    assert "beyond the limit growth = 100" in refused(folder)


def test_messages_that_unfold_are_read_in_pieces(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = write_rosbag2(tmp_path / "log", motion(ROS2, 50))
    plain = survey(folder)
    with sqlite3.connect(folder / "log.db3") as database:
        for number, data in database.execute("SELECT id, data FROM messages").fetchall():
            database.execute("UPDATE messages SET data = ? WHERE id = ?", (zstandard.compress(data), number))
    text = (folder / "metadata.yaml").read_text()
    (folder / "metadata.yaml").write_text(text.replace("compression_mode: ''", "compression_mode: MESSAGE"))
    monkeypatch.setattr("amhe_cli.logs.containers.folder._BATCH_BYTES", 1000)
    assert len(list(open_log(folder).batches(None))) > 10
    assert survey(folder).topics == plain.topics


TABLES = {
    "topics": "id, name TEXT, type TEXT, serialization_format TEXT, offered_qos_profiles TEXT",
    "message_definitions": "topic_type TEXT, encoding TEXT, encoded_message_definition TEXT, "
    "type_description_hash TEXT",
    "messages": "id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB",
}
ENDLESS = {
    "topics": "SELECT n AS id, 't' || n AS name, 'a/msg/B' AS type, 'cdr' AS serialization_format FROM c",
    "message_definitions": "SELECT 't' || n AS topic_type, 'ros2msg' AS encoding, "
    "hex(zeroblob(100000000)) AS encoded_message_definition, '' AS type_description_hash FROM c",
    "messages": "SELECT n AS id, 1 AS topic_id, n AS timestamp, zeroblob(1000000) AS data FROM c",
}


def database_of(path: Path, **instead: str) -> Path:
    with sqlite3.connect(path) as database:
        for name, columns in TABLES.items():
            database.execute(instead.get(name, f"CREATE TABLE {name} ({columns})"))
        if "topics" not in instead:
            database.execute("INSERT INTO topics VALUES (1, '/a', 'std_msgs/msg/Float64', 'cdr', '')")
    return path


@pytest.mark.parametrize("name", ["topics", "messages"])
def test_tables_that_are_endless_views(name: str, tmp_path: Path) -> None:
    count = "WITH RECURSIVE c(n) AS (SELECT 1 UNION ALL SELECT n + 1 FROM c)"
    path = database_of(tmp_path / "log.db3", **{name: f"CREATE VIEW {name} AS {count} {ENDLESS[name]}"})
    assert f"'{name}' in this database is a view, or computes its content" in refused(path)


def test_columns_that_compute_their_content(tmp_path: Path) -> None:
    columns = TABLES["messages"].replace("data BLOB", "data BLOB AS (zeroblob(500000000))")
    path = database_of(tmp_path / "log.db3", messages=f"CREATE TABLE messages ({columns})")
    with sqlite3.connect(path) as database:
        database.executemany("INSERT INTO messages VALUES (?, 1, ?)", [(i, i) for i in range(50)])
    assert "computes its content" in refused(path)


@pytest.mark.medium
def test_pages_that_stand_for_many(tmp_path: Path) -> None:
    """Every page of the table's tree names the same child many times: rows without end in 50 kB."""
    folder = write_rosbag2(tmp_path / "log", motion(ROS2, 300))
    content = bytearray((folder / "log.db3").read_bytes())
    size = int.from_bytes(content[16:18], "big")
    with sqlite3.connect(folder / "log.db3") as database:
        (root,) = database.execute("SELECT rootpage FROM sqlite_master WHERE name = 'messages'").fetchone()
    top = size * (root - 1)
    cells = int.from_bytes(content[top + 3 : top + 5], "big")
    assert content[top] == 5 and cells > 10, "an interior page"
    first_leaf = next(page for page in range(root, len(content) // size) if content[size * page] == 13)
    levels = [root - 1, *range(first_leaf, first_leaf + 6)]
    page = bytes(content[top : top + size])
    for place, number in enumerate(levels):
        copy = bytearray(page)
        below = levels[place + 1] + 1 if place + 1 < len(levels) else first_leaf + 20
        for cell in range(cells):
            at = int.from_bytes(copy[12 + 2 * cell : 14 + 2 * cell], "big")
            copy[at : at + 4] = below.to_bytes(4, "big")
        copy[8:12] = below.to_bytes(4, "big")
        content[size * number : size * (number + 1)] = copy
    path = tmp_path / "log.db3"
    path.write_bytes(content)
    try:
        found = damage(survey(path))
    except LogError as error:
        found = str(error)
    assert found


def cdr_log(path: Path, definition: str, payloads: list[bytes], channels: int = 1) -> Path:
    """An MCAP of a type of our own: the payloads go round over the channels."""
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start("ros2", "test")
        schema = writer.register_schema("a/msg/B", "ros2msg", definition.encode())
        numbers = [writer.register_channel(f"/t{i}", "cdr", schema) for i in range(channels)]
        for i, payload in enumerate(payloads):
            writer.add_message(numbers[i % channels], i, b"\0\1\0\0" + payload, i)
        writer.finish()
    return path


LEVELS = "".join(f"\n{'=' * 80}\nMSG: a/L{i}\nL{i + 1}[100] x\n" for i in range(5))


@pytest.mark.medium
@pytest.mark.parametrize(
    "definition", [f"L0[100] x\n{LEVELS}{'=' * 80}\nMSG: a/L5\nfloat64[0] s\n", "B next\n"]
)
def test_definitions_that_multiply_without_using_a_byte(definition: str, tmp_path: Path) -> None:
    found = survey(cdr_log(tmp_path / "log", definition, [bytes(200 + i) for i in range(300)]))
    assert "its definition has no end" in damage(found) + (found.topics[0].problem or "")


def test_a_database_that_unfolds(tmp_path: Path) -> None:
    path = tmp_path / "a.db3.zstd"
    path.write_bytes(zeros("zstd", 64))
    with limit(piece_mib=1, growth=10):
        assert "beyond the limit growth = 10" in refused(path)


def test_messages_that_all_differ(tmp_path: Path) -> None:
    payloads = [struct.pack("<I", 4000 + i) + bytes(4 * (4000 + i)) for i in range(20)]
    path = cdr_log(tmp_path / "log", "string[] s\n", payloads)
    with limit(fields=20_000):
        found = survey(path)
    words = "the fields of its many layouts are beyond the limit fields = 20000 (`limit` fields=80000"
    assert words in damage(found)
    assert "beyond" not in damage(survey(path))


@pytest.mark.medium
def test_more_topics_than_a_robot_has(tmp_path: Path) -> None:
    path = cdr_log(tmp_path / "log", "float64 x\n", [bytes(8)] * 5001, 5001)
    assert "5001 topics are beyond the limit topics = 5000 (`limit` topics=20000 raises it)" in refused(path)


def protobuf_log(path: Path, files: list[FileDescriptorProto] | bytes, payloads: list[bytes]) -> Path:
    """An MCAP of messages of the type `t.M` of a descriptor set."""
    described = files if isinstance(files, bytes) else FileDescriptorSet(file=files).SerializeToString()
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start()
        about = writer.register_schema("t.M", "protobuf", described)
        channel = writer.register_channel("/x", "protobuf", about)
        for i, payload in enumerate(payloads):
            writer.add_message(channel, i + 1, payload, i + 1)
        writer.finish()
    return path


def proto(name: str, types: Mapping[str, Sequence[str]], *imports: str) -> FileDescriptorProto:
    """A file of message types: the kind of each field, '*' for a list; a capital is a message."""
    file = FileDescriptorProto(name=name, package="t", syntax="proto3", dependency=imports)
    for type_name, kinds in types.items():
        message = file.message_type.add(name=type_name)
        for number, kind in enumerate(kinds, start=1):
            plain = kind.rstrip("*")
            added = message.field.add(name=f"f{number}", number=number, label=3 if plain != kind else 1)
            added.type = {"double": 1, "int64": 3, "string": 9}.get(plain, 11)
            if added.type == 11:
                added.type_name = f".t.{plain}"
            added.name = "name" if plain == "string" else added.name
    return file


Hostile: TypeAlias = tuple[list[FileDescriptorProto] | bytes, list[bytes]]


def nested(levels: int) -> bytes:
    """A descriptor set of types within types."""
    body = b"\x0a\x01N"
    for field in [3] * levels + [4, 1]:
        named = b"\x0a\x01M" if field != 1 else b""
        body = named + bytes([8 * field + 2, 0x80 | len(body) & 0x7F, len(body) >> 7]) + body
    return body


def wide(payload: bytes, *kinds: str) -> Hostile:
    return [proto("a", {"M": kinds, "W": ["double"] * 4000})], [payload]


#: What is hostile -> descriptors, messages, and a word of what is said of them.
PROTOBUF: dict[str, tuple[Callable[[], Hostile], str]] = {
    "imports in a circle": (
        lambda: ([proto("a", {"M": ["double"]}, "b"), proto("b", {}, "a")], [b""]), "is damaged",
    ),
    "an import that is missing": (lambda: ([proto("a", {"M": ["double"]}, "b")], [b""]), "is damaged"),
    "types in 400 levels": (lambda: (nested(400), [b""]), "is damaged"),
    "20^12 fields": (
        lambda: (
            [proto("a", {"M": ["A0"] * 20, **{f"A{i}": [f"A{i + 1}"] * 20 for i in range(12)}, "A12": []})],
            [b""],
        ),
        "",
    ),
    "50,000 fields": (lambda: ([proto("a", {"M": ["double"] * 50_000})], [b""]), "is damaged"),
    "a definition of 2 MiB": (
        lambda: ([proto("a", {"M": ["double"], **{f"{i:07}" * 20: [] for i in range(15_000)}})], [b""]),
        "beyond the limit definition_mib = 1",
    ),
    "a varint without an end": (lambda: wide(b"\x08" + b"\xff" * 2**20, "int64"), "1 message damaged"),
    "a length that lies": (lambda: wide(b"\x0a\xff\xff\xff\xff\x07", "W"), "1 message damaged"),
    "messages in 400 levels": (lambda: wide(b"\x0b" * 400, "M"), "1 message damaged"),
    "empty messages of a wide type": (
        lambda: wide(b"\x0a\x00" * 2**20, "W*"), "beyond the limit piece_mib",
    ),
    "more messages than a robot has parts": (
        lambda: ([proto("a", {"M": ["E*"], "E": []})], [b"\x0a\x00" * 2**17]), "",
    ),
    "a list of 2^23 integers": (
        lambda: wide(b"\x0a\x80\x80\x80\x04" + b"\x01" * 2**23, "int64*"), "",
    ),
    "a name of a megabyte": (
        lambda: wide(b"\x0a\x80\x80\x40" + b"a" * 2**20, "string"), "name has 1048576 characters",
    ),
    "names without end": (lambda: wide(b"\x0a\x00" * 2**20, "string*"), ""),
}  # fmt: skip


@pytest.mark.parametrize("kind", PROTOBUF)
def test_protobuf_that_costs_too_much(kind: str, tmp_path: Path) -> None:
    make, words = PROTOBUF[kind]
    found = survey(protobuf_log(tmp_path / "log", *make()))
    (topic,) = found.topics
    assert words in damage(found) + (topic.problem or "")


def test_a_large_definition_is_held_once(tmp_path: Path) -> None:
    """A thousand topics share one of 2 MiB, which is refused: 2 GB if each had its own."""
    with (tmp_path / "log").open("wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start()
        about = writer.register_schema("t.M", "protobuf", bytes(2**21))
        for i in range(1000):
            writer.add_message(writer.register_channel(f"/t{i}", "protobuf", about), 1, b"", 1)
        writer.finish()
    found = survey(tmp_path / "log")
    assert len(found.topics) == 1000
    assert all("beyond the limit definition_mib = 1" in (topic.problem or "") for topic in found.topics)


def test_names_of_a_megabyte(tmp_path: Path) -> None:
    payload = struct.pack("<I", 2**20) + b"a" * 2**20
    found = survey(cdr_log(tmp_path / "log", "string name\n", [payload] * 20))
    assert "name has 1048576 bytes" in damage(found)


BOMBS = {
    "merges": "a0: &a0 {x: 1, y: 2}\n"
    + "".join(f"a{i}: &a{i} {{<<: [{', '.join([f'*a{i - 1}'] * 9)}]}}\n" for i in range(1, 10)),
    "aliases": "a0: &a0 [1, 2]\n"
    + "".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 10)),
    "very deep": "a: " + "[" * 100_000,
    "in itself": "a: &a [*a]",
    "large": "a: [" + "1," * 2**22 + "]",
    "many": "a: [" + "1," * 3000 + "]\nb: &b [" + "1," * 20 + "]\n" + f"c: [{'*b,' * 400}]",
}


DEEP = "nested deeper than 50 levels"


@pytest.mark.parametrize("name", BOMBS)
def test_yaml_that_unfolds(name: str, tmp_path: Path) -> None:
    (tmp_path / "log").mkdir()
    (tmp_path / "log" / "metadata.yaml").write_text(f"rosbag2_bagfile_information: {{}}\n{BOMBS[name]}\n")
    words = {"large": "yaml_mib = 4", "merges": "yaml_values", "aliases": "yaml_values"}
    if name == "many":
        with limit(yaml_values=9000):
            assert "beyond the limit yaml_values = 9000" in refused(tmp_path / "log")
        return
    said = refused(tmp_path / "log").replace(
        "exceeded maximum nesting depth", DEEP
    )  # in the words of libyaml
    assert words.get(name, DEEP) in said


def _npz(path: Path) -> None:
    zeros = np.zeros(2**21)
    np.savez_compressed(path, allow_pickle=False, time=zeros, **{f"q{i}": zeros for i in range(3)})


def _hdf5(path: Path, **external: object) -> None:
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w") as file:
        file.create_dataset("time", (10**9,), "f8", chunks=(10**6,))


def _parquet(path: Path) -> None:
    pa = pytest.importorskip("pyarrow")
    import pyarrow.parquet as parquet

    zeros = pa.array(np.zeros(2**20))
    with parquet.ParquetWriter(path, pa.schema([("time", pa.float64())])) as file:
        for _ in range(8):
            file.write_table(pa.table({"time": zeros}))


def _lists(path: Path) -> None:
    pa = pytest.importorskip("pyarrow")
    import pyarrow.parquet as parquet

    zeros = pa.FixedSizeListArray.from_arrays(pa.array(np.zeros(2**22)), 2**10)
    parquet.write_table(pa.table({"time": np.zeros(2**12), "q": zeros}), path, store_schema=False)


@pytest.mark.medium
@pytest.mark.parametrize("write", [_npz, _hdf5, _parquet, _lists])
def test_tables_of_zeros(write: Callable[[Path], None], tmp_path: Path) -> None:
    path = tmp_path / f"log{'.npz' if write is _npz else ''}"
    write(path)
    assert path.stat().st_size < 2**18
    with limit(piece_mib=30):
        assert "beyond the limit growth = 100" in refused(path)


def test_rows_of_a_table_take_memory_in_proportion(tmp_path: Path) -> None:
    path, count = tmp_path / "log.npz", 600_000
    np.savez(path, time=np.resize(np.array([9.0, 1.0, 5.0]), count), q=np.ones(count))
    survey(path)  # loads what is loaded once
    tracemalloc.start()
    assert survey(path).topics[0].count == count
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < (64 + 2 * 8) * count


def write_records(path: Path, *formats: str, topics: int = 1, name: bytes = b"a") -> Path:
    """A ULog of records of one topic `a`, whose format is one of those given."""
    records = [(b"F", text.encode()) for text in formats]
    records += [(b"A", struct.pack("<BH", 0, i) + name) for i in range(topics)]
    records += [(b"D", struct.pack("<HQ", 0, t) + bytes(8)) for t in range(10)]
    body = b"".join(struct.pack("<Hc", len(data), kind) + data for kind, data in records)
    path.write_bytes(b"ULog\x01\x125\x01" + bytes(8) + body)
    return path


def _groups(path: Path, names: Iterable[str]) -> None:
    with pytest.importorskip("h5py").File(path, "w") as file:
        for name in names:
            file.create_group(name)


def _arrays(path: Path, count: int) -> None:
    np.savez(path, allow_pickle=False, **{f"q{i}": np.zeros(1) for i in range(count)})
    path.with_name("log.npz").rename(path)


STAMP = "a:uint64_t timestamp;"
DOUBLED = [f"l{i}:l{i + 1} a;l{i + 1} b;" for i in range(23)]
#: Kind of a bomb -> writes it, and the limit that it is beyond.
COUNTS: dict[str, tuple[Callable[[Path], object], str]] = {
    "formats that multiply": (
        lambda path: write_records(path, *DOUBLED, "l23:double x;", f"{STAMP}l0 x;"), "columns = 1000",
    ),
    "arrays of arrays": (
        lambda path: write_records(path, "l0:double[60000] x;", f"{STAMP}l0[60000] x;"), "columns = 1000",
    ),
    "a format in itself": (lambda path: write_records(path, f"{STAMP}a x;"), "columns = 1000"),
    "many subscriptions": (
        lambda path: write_records(path, f"{STAMP}double[9] x;", topics=101), "columns = 1000",
    ),
    "subscriptions with bytes that are skipped": (
        lambda path: write_records(path, f"{STAMP}double[9] x;", topics=101, name=b"\xff" * 300 + b"a"),
        "columns = 1000",
    ),
    "arrays in an npz": (lambda path: _arrays(path, 1001), "its arrays are beyond the limit columns"),
    "groups in an HDF5 file": (lambda path: _groups(path, map(str, range(1001))), "topics = 1000"),
    "groups in 3000 levels": (lambda path: _groups(path, ["g/" * 3000]), "nested deeper than 50 levels"),
    "rows behind an open quote": (
        lambda path: path.write_bytes(b'time,q\n0,1\n"1,2\n' + b"1,2\n" * 2**17), "limit messages = 65536",
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", COUNTS)
def test_more_of_a_thing_than_a_log_has(kind: str, tmp_path: Path) -> None:
    write, words = COUNTS[kind]
    write(tmp_path / "log")
    with limit(messages=2**16, columns=1000, topics=1000):
        assert words in refused(tmp_path / "log")


def test_a_description_of_a_dataset_that_is_too_large(tmp_path: Path) -> None:
    folder = dataset(tmp_path, "v2.1")
    with (folder / "meta" / "info.json").open("ab") as file:
        file.truncate(3 * 2**30)
    with pytest.raises(AmheError, match="info.json: its 3221225472 bytes are beyond the limit yaml_mib = 4"):
        survey(Path(f"{folder}#0"))


def test_a_count_of_episodes_that_no_number_holds(tmp_path: Path) -> None:
    folder = dataset(tmp_path, "v2.1")
    path = folder / "meta" / "info.json"
    path.write_text(path.read_text().replace('"total_episodes": ', '"total_episodes": 1e400, "were": '))
    with pytest.raises(AmheError, match=r"info\.json: .*finite") as refusal:
        survey(Path(f"{folder}#0"))
    assert "\n" not in str(refusal.value)


def test_a_list_of_episodes_that_is_too_large(tmp_path: Path) -> None:
    pa = pytest.importorskip("pyarrow")
    import pyarrow.parquet as parquet

    folder = dataset(tmp_path, "v3.0")
    (episodes,) = (folder / "meta" / "episodes").rglob("*.parquet")
    zeros = pa.array(np.zeros(2**22, np.int64))
    table = pa.table(dict.fromkeys(("episode_index", "data/chunk_index", "data/file_index"), zeros))
    with parquet.ParquetWriter(episodes, table.schema, compression="zstd") as file:
        for _ in range(4):
            file.write_table(table)
    with pytest.raises(AmheError, match="beyond the limit growth = 100"):
        survey(Path(f"{folder}#0"))


_EVERY_BYTE = """
import sys
from pathlib import Path
from amhe_cli.core.errors import AmheError
from amhe_cli.logs import survey
path = Path(sys.argv[1])
content = path.read_bytes()
for place in range(len(content) - 8 - int.from_bytes(content[-8:-4], "little"), len(content) - 8, 2):
    changed = bytearray(content)
    changed[place] ^= 16
    path.write_bytes(changed)
    try:
        survey(path)
    except AmheError:
        pass
print("survived")
"""


@pytest.mark.medium
def test_a_damaged_footer_of_a_parquet_file_does_not_end_the_process(tmp_path: Path) -> None:
    """pyarrow aborts where it is asked for a column whose statistics do not fit the schema."""
    pa = pytest.importorskip("pyarrow")
    import pyarrow.parquet as parquet

    parquet.write_table(pa.table({"time": np.arange(100.0)}), tmp_path / "log", store_schema=False)
    command = [sys.executable, "-c", _EVERY_BYTE, str(tmp_path / "log")]
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}
    ended = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    assert (ended.returncode, ended.stdout) == (0, "survived\n"), ended.stderr


def test_texts_in_a_parquet_file_are_not_unfolded(tmp_path: Path) -> None:
    """One text of 16 KiB, 65,536 times, is a small file and a GiB."""
    pa = pytest.importorskip("pyarrow")
    import pyarrow.parquet as parquet

    text = pa.DictionaryArray.from_arrays(pa.array(np.zeros(2**16, dtype=np.int32)), ["x" * 2**14])
    columns = {"time": np.arange(2.0**16), "text": text}
    parquet.write_table(pa.table(columns), tmp_path / "log", store_schema=False)
    (topic,) = survey(tmp_path / "log").topics
    assert topic.count == 2**16
    assert pa.default_memory_pool().max_memory() < 2**29


def test_a_table_opens_no_other_file(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    (tmp_path / "secret").write_bytes(np.arange(100.0).tobytes())
    with h5py.File(tmp_path / "log", "w") as file:
        file.create_dataset("time", (100,), "f8", external=[(str(tmp_path / "secret"), 0, 800)])
    assert "its 'time' lies in another file" in refused(tmp_path / "log")


PLACES: dict[str, Callable[[Path], Path]] = {
    "log": lambda path: path / "pipe",
    "log/part.db3": lambda path: path / "log",
    "log/metadata.yaml": lambda path: path / "log",
}


@pytest.mark.parametrize("place", PLACES)
def test_pipes_are_not_waited_for(place: str, tmp_path: Path) -> None:
    (tmp_path / "log").mkdir()
    information = {"relative_file_paths": ["part.db3"], "compression_mode": ""}
    (tmp_path / "log" / "metadata.yaml").write_text(json.dumps({"rosbag2_bagfile_information": information}))
    pipe = tmp_path / "pipe" if place == "log" else tmp_path / place
    pipe.unlink(missing_ok=True)
    os.mkfifo(pipe)
    assert "a pipe or a device" in refused(PLACES[place](tmp_path))


@pytest.mark.parametrize("name", ["../other/part.db3", "{}/other/part.db3", "a\0b", "..", "/"])
def test_parts_outside_of_the_folder_are_not_opened(name: str, tmp_path: Path) -> None:
    (tmp_path / "log").mkdir()
    (tmp_path / "other").mkdir()
    database_of(tmp_path / "other" / "part.db3")
    information = {"relative_file_paths": [name.format(tmp_path)], "compression_mode": ""}
    (tmp_path / "log" / "metadata.yaml").write_text(json.dumps({"rosbag2_bagfile_information": information}))
    refused(tmp_path / "log")


def test_a_device_is_no_log() -> None:
    assert "a pipe or a device" in refused(Path("/dev/zero"))


def test_limits_are_known_by_name() -> None:
    with pytest.raises(AmheError, match="no limit 'topic' .did you mean 'topics'"), limit(topic=3):
        pass
    with pytest.raises(AmheError, match="no whole number above zero"), limit(topics=0):
        pass


def test_the_command_line_sets_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from amhe_cli.cli.main import run

    path = cdr_log(tmp_path / "log", "float64 x\n", [bytes(8)] * 4, 2)
    assert run(["inspect", str(path), "--limit", "topics=1"]) == 4
    assert "2 topics are beyond the limit topics = 1 (--limit topics=4 raises it)" in capsys.readouterr().err
    assert run(["inspect", str(path), "--limit", "topic=1"]) == 2
    assert run(["inspect", str(path), "--limit", "topics=x"]) == 2
    assert run(["inspect", str(path)]) == 0


@pytest.mark.parametrize(
    ("version", "name"), [("v2.1", "meta/info.json"), ("v2.1", "data/chunk-000"), ("v3.0", "meta/episodes")]
)
def test_a_link_of_a_dataset_is_not_followed_out_of_it(version: str, name: str, tmp_path: Path) -> None:
    path = dataset(tmp_path, version)
    (path / name).rename(tmp_path / "elsewhere")
    (path / name).symlink_to(tmp_path / "elsewhere")
    with pytest.raises(AmheError, match=r"a link that leads out of .*data_set"):
        survey(Path(f"{path}#0"))


@pytest.mark.parametrize("name", ["y.csv", "b.mcap"])
def test_a_link_in_a_folder_is_not_followed_out_of_it(name: str, tmp_path: Path) -> None:
    (tmp_path / "log").mkdir()
    (tmp_path / "x.csv").write_text("time,y\n0,1\n1,2\n")
    (tmp_path / "log" / name).symlink_to("../x.csv")
    with pytest.raises(AmheError, match=rf"{name}: a link that leads out of .*log; put the file itself"):
        survey(tmp_path / "log")
    (tmp_path / "log" / name).unlink()
    (tmp_path / "log" / "x.csv").write_text("time,y\n0,1\n1,2\n")
    (tmp_path / "log" / "z.csv").symlink_to("x.csv")  # one within the folder is
    assert {topic.name for topic in survey(tmp_path / "log").topics} == {"x", "z"}
