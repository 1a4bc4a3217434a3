"""Log files: their formats, topics and layout."""

from __future__ import annotations

import bz2
import gzip
import io
import json
import lzma
import pickle
import struct
import tarfile
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer
from rosbags.highlevel import AnyReader
from rosbags.interfaces import Nodetype

from amhe_cli.core.errors import ConfigError, LogError
from amhe_cli.core.signals import Signal
from amhe_cli.logs import LogWriter, read_metadata, read_signals, survey
from amhe_cli.logs.containers.raw import Connection, batch_of
from amhe_cli.logs.messages.definitions import Definitions
from amhe_cli.logs.messages.layout import MalformedMessageError, walk
from amhe_cli.logs.messages.split import Splitter
from tests.logs.log_makers import (
    DT,
    JOINTS,
    JS,
    ROS1,
    ROS2,
    SETTINGS,
    SIGNALS,
    T0,
    Message,
    joint_state,
    motion,
    write_bag,
    write_mcap,
    write_rosbag2,
    wrong_samples,
)

N = 60


def read(path: Path) -> Any:
    return read_signals(path, SIGNALS, DT, SETTINGS)


# -- containers -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("content", "text"),
    [
        (b"", "the file is empty"),
        (b"\x89MCAP", "ends after 5 bytes"),
        (b"\x89MCAP0\r\n", "no topic"),
        (b"#ROSBAG V2.0\n", "no topic"),
        (b"PK\x03\x04 a zip archive, say", "a zip file that is damaged or cut"),
        (b"\x01\x02\x03\x00 unknown", "begins with the bytes 01 02 03 00 20 75 6e 6b, which is no log"),
        (b"SQLite format 3\0" + bytes(200), "cannot be read"),
    ],
)
def test_what_is_no_log(tmp_path: Path, content: bytes, text: str) -> None:
    path = tmp_path / "log.mcap"
    path.write_bytes(content)
    with pytest.raises(LogError, match=text):
        read(path)


@pytest.mark.parametrize(
    "options",
    [
        {"index_types": IndexType.NONE},
        {
            "use_statistics": False,
            "use_summary_offsets": False,
            "repeat_channels": False,
            "repeat_schemas": False,
        },
        {"enable_crcs": False},
        {"use_chunking": False},
        {"compression": CompressionType.LZ4},
        {"enable_data_crcs": True},
        {"chunk_size": 1},
    ],
)
def test_every_kind_of_mcap(
    tmp_path: Path, options: dict[str, Any], caplog: pytest.LogCaptureFixture
) -> None:
    path = write_mcap(tmp_path / "a", motion(ROS2, N), **options)
    trajectory = read(path)
    assert trajectory.steps == N and not any(wrong_samples(trajectory).values())
    assert not caplog.records
    assert read_metadata(path) == {"system": "made", "seed": "7"}


def test_a_crashed_recorder(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    trajectory = read(write_mcap(tmp_path / "a", motion(ROS2, N), finish=False))
    assert trajectory.steps > N // 2 and not any(wrong_samples(trajectory).values())
    assert "the file was not closed (recorder crashed or copy incomplete)" in caplog.text
    assert "recovered" in caplog.text


def test_foreign_topics_are_passed_over_and_named_when_asked_for(tmp_path: Path) -> None:
    path = tmp_path / "a"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2")
        schema = writer.register_schema("Foreign", "jsonschema", b"{}")
        strange = [
            writer.register_channel("/json", "json", schema),
            writer.register_channel(
                "/flat", "flatbuffer", writer.register_schema("P", "flatbuffer", b"\xff\x00")
            ),
            writer.register_channel("/none", "cdr", 0),
        ]
        for channel in strange:
            writer.add_message(channel, T0, b"{}", T0)
        text = ROS2.generate_msgdef(JS, ros_version=2)[0].encode()
        channel = writer.register_channel("/js", "cdr", writer.register_schema(JS, "ros2msg", text))
        for i in range(10):
            stamp = T0 + i * 10_000_000
            data = ROS2.serialize_cdr(joint_state(ROS2, stamp, JOINTS, (1, 2, 3)), JS)
            writer.add_message(channel, stamp, bytes(data), stamp)
        writer.finish()
    trajectory = read_signals(path, [Signal("j", "/js", ("position",))], DT, SETTINGS)
    assert trajectory.steps == 10
    for topic, text in (
        ("/json", "no position|not built in"),
        ("/flat", "encoded as 'flatbuffer'"),
        ("/none", "no definition"),
    ):
        with pytest.raises(LogError, match=text):
            read_signals(path, [Signal("j", topic, ("position",))], DT, SETTINGS)
    problems = {topic.name: topic.problem for topic in survey(path).topics}
    assert problems["/js"] is None and "flatbuffer" in (problems["/flat"] or "")


def test_a_ros1_mcap(tmp_path: Path) -> None:
    path = tmp_path / "a"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros1")
        channels = {}
        for message in motion(ROS1, N):
            if message.topic not in channels:
                text = ROS1.generate_msgdef(message.type)[0].encode()
                name = message.type.replace("/msg/", "/")
                schema = writer.register_schema(name, "ros1msg", text)
                channels[message.topic] = writer.register_channel(message.topic, "ros1", schema)
            data = bytes(ROS1.serialize_ros1(message.content, message.type))
            writer.add_message(channels[message.topic], message.stamp_ns, data, message.stamp_ns)
        writer.finish()
    assert not any(wrong_samples(read(path)).values())


def test_a_folder_without_metadata(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    for storage in ("sqlite3", "mcap"):
        folder = write_rosbag2(tmp_path / storage, motion(ROS2, N), storage)
        (folder / "metadata.yaml").unlink()
        assert read(folder).steps == N
        assert "has no metadata.yaml" in caplog.text
        caplog.clear()
    (tmp_path / "empty").mkdir()
    with pytest.raises(LogError, match="is no log"):
        read(tmp_path / "empty")


def test_a_split_recording_with_a_part_missing(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    messages = motion(ROS2, N)
    folder = tmp_path / "split"
    folder.mkdir()
    write_mcap(folder / "split_0.mcap", messages[:N])
    write_mcap(folder / "split_1.mcap", messages[N:])
    names = ["split_0.mcap", "split_1.mcap", "split_2.mcap"]
    lines = "\n".join(f"  - {name}" for name in names)
    text = f"rosbag2_bagfile_information:\n  version: 5\n  relative_file_paths:\n{lines}\n"
    (folder / "metadata.yaml").write_text(text)
    trajectory = read(folder)
    assert trajectory.steps == N and not any(wrong_samples(trajectory).values())
    assert "split_2.mcap is missing" in caplog.text
    assert read_metadata(folder) == {"system": "made", "seed": "7"}
    (folder / "split_0.mcap").write_bytes(b"")
    assert read(folder).steps == N // 2
    (folder / "metadata.yaml").write_text("rosbag2_bagfile_information: 7")
    with pytest.raises(LogError, match=r"not a rosbag2 metadata\.yaml"):
        read(folder)


def test_an_active_bag_is_read_and_reindexing_named(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    content = bytearray(write_bag(tmp_path / "a.bag", motion(ROS1, N)).read_bytes())
    at = content.index(b"index_pos=") + 10
    (index,) = struct.unpack_from("<Q", content, at)
    content[at : at + 8] = bytes(8)
    path = tmp_path / "a.bag.active"
    path.write_bytes(content[:index])
    trajectory = read(path)
    assert trajectory.steps == N and not any(wrong_samples(trajectory).values())
    assert "rosbag reindex" in caplog.text


# -- survey -----------------------------------------------------------------------------------------------


def test_survey_says_what_is_there(tmp_path: Path) -> None:
    messages = [m for m in motion(ROS2, N) if not 20 <= (m.stamp_ns - T0) // 10_000_000 < 40]
    found = survey(write_mcap(tmp_path / "a", messages, log_delay_ns=2_000_000))
    assert (found.format, found.metadata["seed"], found.problems) == ("MCAP", "7", ())
    assert found.duration == pytest.approx((N - 1) * DT)
    joints, body = found.topics
    assert (joints.name, joints.count, joints.entries) == ("/joint_states", N - 20, JOINTS)
    assert joints.rate == pytest.approx(100.0)
    assert (joints.longest_gap, joints.gap_at) == pytest.approx((0.21, 0.19))
    assert joints.quantities == ("position", "velocity"), "its effort arrays are empty"
    assert (joints.header, joints.clock, joints.problem) == ("good", "header", None)
    assert joints.first_ns == {"header": T0, "publish": T0 + 2_000_000, "log": T0 + 2_000_000}
    assert body.entries == ("body",)


def test_survey_of_odd_topics(tmp_path: Path) -> None:
    stamps = [T0 + i * 10_000_000 for i in range(20)]
    messages = [Message("/unset", JS, s, joint_state(ROS2, 0, ("a",), [1.0])) for s in stamps]
    messages += [Message("/once", JS, stamps[0], joint_state(ROS2, stamps[0], ("a",), [1.0]))]
    once, unset = survey(write_mcap(tmp_path / "a", messages)).topics
    assert (unset.header, unset.clock) == ("unset", "publish")
    assert (once.count, once.rate, once.longest_gap) == (1, 0.0, 0.0)
    with pytest.raises(ConfigError):
        survey(tmp_path / "nothing")


# -- writer -----------------------------------------------------------------------------------------------


def write_one(path: Path, fail: bool = False) -> None:
    with LogWriter(path, {"system": "pendulum"}) as log:
        for i in range(20):
            stamp = T0 + i * 10_000_000
            log.odometry("/odom", stamp, (1, 2, 3), (np.sqrt(0.5), 0, 0, np.sqrt(0.5)), (1, 0, 0), (0, 0, 5))
            log.transform("/tf", stamp, {"box": ((1, 2, 3), (1, 0, 0, 0))})
            if fail and i == 10:
                raise RuntimeError("a fault of the run")
        log.attach("config.yaml", "application/yaml", b"a: 1\n")


def test_other_tools_read_it(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    write_one(path)
    signals = [
        Signal("o", "/odom", ("linear_velocity",)),
        Signal("t", "/tf", ("position",), child_frame="box"),
    ]
    ours = read_signals(path, signals, DT, SETTINGS)
    assert ours["o.linear_velocity"].values[0] == pytest.approx((1, 0, 0))
    assert ours["t.position"].values[0].tolist() == [1, 2, 3]
    assert list(tmp_path.iterdir()) == [path]
    with AnyReader([path]) as reader:
        odometry = next(c for c in reader.connections if c.topic == "/odom")
        message: Any = reader.deserialize(next(reader.messages([odometry]))[2], odometry.msgtype)
    assert message.twist.twist.linear.y == pytest.approx(-1.0), "ROS has the twist in the child frame"
    with path.open("rb") as file:
        mcap = make_reader(file, validate_crcs=True)
        assert mcap.get_header().profile == "ros2"
        assert [a.data for a in mcap.iter_attachments()] == [b"a: 1\n"]
        assert {m.name for m in mcap.iter_metadata()} == {"amhe"}


def test_a_failing_run_leaves_a_whole_log(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    path.write_bytes(b"an older log")
    with pytest.raises(RuntimeError, match="a fault"):
        write_one(path, fail=True)
    assert {topic.count for topic in survey(path).topics} == {11}
    assert not survey(path).problems
    assert list(tmp_path.iterdir()) == [path]


def test_a_type_of_our_own_and_one_type_a_topic(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "a", {}) as log:
        log.define("amhe_msgs/msg/Estimate", "std_msgs/Header header\nstring name\nfloat64 mean")
        log.write("/e", "amhe_msgs/msg/Estimate", T0, {"name": "mass", "mean": 1.5})
        with pytest.raises(ValueError, match="carries amhe_msgs/msg/Estimate"):
            log.joint_state("/e", T0, ())
    signal = Signal("e", "/e", ("value",), fields={"value": ("mean",)})
    assert read_signals(tmp_path / "a", [signal], DT, SETTINGS)["e.value"].values == [[1.5]]


# -- real logs --------------------------------------------------------------------------------------------


TABLE = b"time,q\n0.0,1.0\n0.1,2.0\n0.2,3.0\n"


def zipped(name: str) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr(name, TABLE)
    return file.getvalue()


def tarred() -> bytes:
    file = io.BytesIO()
    with tarfile.open(fileobj=file, mode="w") as archive:
        about = tarfile.TarInfo("run.csv")
        about.size = len(TABLE)
        archive.addfile(about, io.BytesIO(TABLE))
    return file.getvalue()


FILES = {
    "gzip": (gzip.compress(TABLE), "gunzip -k run.csv"),
    "bzip2": (bz2.compress(TABLE), "bunzip2 -k run.csv"),
    "xz": (lzma.compress(TABLE), "unxz -k run.csv"),
    "zip": (zipped("run.csv"), "unzip run.csv"),
    "Excel": (zipped("xl/workbook.xml"), "save the sheet as CSV"),
    "tar": (tarred(), "tar -xf run.csv"),
    "UTF-16": ("time,q".encode("utf-16"), "save it as UTF-8: iconv -f UTF-16"),
    "video": (b"\x00\x00\x00\x20ftypisom\x00\x00\x02\x00", "give the log that was recorded with it"),
    "picture": (b"\x89PNG\r\n\x1a\n", "give the log that was recorded with it"),
    "pickle": (pickle.dumps({"q": [1.0]}), "np.savez"),
    "rerun": (b"RRF2\x00\x12\x01\x00", "dataframe API"),
    "ArduPilot": (b"\xa3\x95\x80\x80\x59FMT\x00BBnNZ", "mavlogdump.py --format csv --types IMU run.csv"),
    "MATLAB": (b"MATLAB 5.0 MAT-file, Platform: GLNXA64", "writetable"),
    "LCM": (b"\xed\xa1\xda\x01" + bytes(30), "convert it to MCAP"),
    "Git LFS": (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n", "git lfs pull"),
    "web page": (b"<!DOCTYPE html>\n<html></html>", "fetch the file again"),
    "MuJoCo model": (b"\n<mujoco model='arm'>\n</mujoco>", "amhe init run.csv LOG"),
    "URDF model": (b"<robot name='arm'>\n</robot>", "amhe init run.csv LOG"),
    "JSON": (json.dumps([{"time": 0.0, "q": 1.0}]).encode(), "as CSV"),
}


@pytest.mark.parametrize("kind", sorted(FILES))
def test_it_is_named_by_content(kind: str, tmp_path: Path) -> None:
    content, advice = FILES[kind]
    path = tmp_path / "run.csv"
    path.write_bytes(content)
    with pytest.raises(LogError) as caught:
        survey(path)
    text = str(caught.value)
    assert str(path) in text and kind in text and advice in text and "\n" not in text


@pytest.mark.parametrize("header", ["MZ", "RRF_hip", "BZh", "MATLAB", "[deg]"])
def test_a_table_is_not_taken_for_one(header: str, tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    rows = "".join(f"{np.sin(0.1 * i)},{0.1 * i}\n" for i in range(20))
    path.write_text(f"{header},time\n{rows}")
    assert survey(path).topics[0].count == 20


FLOATS, STRINGS = ("float32", "float64"), ("string", "wstring")


def random_value(store: Any, description: Any, rng: np.random.Generator) -> Any:
    kind, detail = description
    if kind == Nodetype.NAME:
        return random_message(store, detail, rng)
    if kind == Nodetype.BASE:
        return random_number(detail[0], rng)
    element, size = detail
    count = size if kind == Nodetype.ARRAY else int(rng.integers(0, min(size or 4, 4) + 1))
    values = [random_value(store, element, rng) for _ in range(count)]
    if element[0] == Nodetype.BASE and element[1][0] not in STRINGS:
        name = {"bool": "bool", "byte": "uint8", "char": "uint8", "octet": "uint8"}.get(element[1][0])
        return np.array(values, dtype=name or element[1][0])
    return values


def random_number(base: str, rng: np.random.Generator) -> Any:
    if base in STRINGS:
        return "ab cde"[: rng.integers(0, 6)]
    if base in FLOATS:
        return float(np.dtype(base).type(rng.normal()))
    return bool(rng.integers(2)) if base == "bool" else int(rng.integers(0, 100))


def random_message(store: Any, name: str, rng: np.random.Generator) -> Any:
    fields = store.get_msgdef(name).fields
    return store.types[name](**{field: random_value(store, kind, rng) for field, kind in fields})


def at(message: Any, path: str) -> Any:
    for part in path.split("."):
        field, *indices = part.replace("]", "").split("[")
        message = getattr(message, field)
        for index in indices:
            message = message[int(index)]
    return message


@pytest.mark.medium
@pytest.mark.parametrize("encoding", ["cdr", "ros1"])
def test_every_bundled_type_is_read_as_rosbags_reads_it(encoding: str) -> None:
    store = ROS2 if encoding == "cdr" else ROS1
    rng = np.random.default_rng(1)
    checked = 0
    for name in [*store.types] * 3:
        if name == "std_msgs/msg/Header" and encoding == "ros1":
            continue
        message = random_message(store, name, rng)
        write = store.serialize_cdr if encoding == "cdr" else store.serialize_ros1
        read = store.deserialize_cdr if encoding == "cdr" else store.deserialize_ros1
        data = bytes(write(message, name))
        types = Definitions().of(Connection("/t", name, encoding, "", ""))
        oracle = read(data, name)
        layout = walk(np.frombuffer(data, np.uint8), name, types, encoding)
        for path, leaf in layout.leaves.items():
            found = np.frombuffer(data, leaf.dtype, 1 if leaf.count is None else leaf.count, leaf.offset)
            expected = np.atleast_1d(at(oracle, path))
            np.testing.assert_array_equal(found, expected.astype(found.dtype), err_msg=f"{name} {path}")
            checked += 1
        for path, text in layout.strings.items():
            assert text == at(oracle, path)
    assert checked > 3000


def test_big_endian_cdr() -> None:
    name = "sensor_msgs/msg/JointState"
    message = random_message(ROS2, name, np.random.default_rng(3))
    message.name, message.position = ["a", "bc"], np.array([1.5, -2.0])
    data = bytes(ROS2.serialize_cdr(message, name, little_endian=False))
    layout = walk(
        np.frombuffer(data, np.uint8), name, Definitions().of(Connection("/t", name, "cdr", "", "")), "cdr"
    )
    assert layout.names("name") == ("a", "bc")
    leaf = layout.leaves["position"]
    assert np.frombuffer(data, leaf.dtype, 2, leaf.offset).tolist() == [1.5, -2.0]


@pytest.mark.parametrize(
    "damage", [lambda d: d[:-1], lambda d: d + b"12345678", lambda d: b"\0\7" + d[2:], lambda d: d[:3]]
)
def test_malformed_messages_are_distinguished(damage: Any) -> None:
    name = "sensor_msgs/msg/Imu"
    data = damage(bytes(ROS2.serialize_cdr(random_message(ROS2, name, np.random.default_rng(0)), name)))
    types = Definitions().of(Connection("/t", name, "cdr", "", ""))
    with pytest.raises(MalformedMessageError):
        walk(np.frombuffer(data, np.uint8), name, types, "cdr")


def test_batches_of_mixed_layouts_are_sorted_and_damage_is_counted() -> None:
    name = "sensor_msgs/msg/JointState"
    rng = np.random.default_rng(5)
    payloads = [bytes(ROS2.serialize_cdr(random_message(ROS2, name, rng), name)) for _ in range(200)]
    payloads[50] = payloads[50][:-2]
    payloads[60] = b""
    connection = Connection("/t", name, "cdr", "", "")
    splitter = Splitter(connection, Definitions())
    groups = list(splitter.split(batch_of(connection, range(200), range(200), payloads)))
    members = np.sort(np.concatenate([group.members for group in groups]))
    assert members.tolist() == [i for i in range(200) if i not in (50, 60)]
    assert splitter.damaged == 2
    for group in groups:
        for row, member in zip(group.rows, group.members, strict=True):
            assert row.tobytes() == payloads[member]
            leaf = group.layout.leaves["position"]
            found = np.frombuffer(payloads[member], leaf.dtype, leaf.count or 0, leaf.offset)
            oracle = ROS2.deserialize_cdr(payloads[member], name)
            np.testing.assert_array_equal(found, oracle.position)
