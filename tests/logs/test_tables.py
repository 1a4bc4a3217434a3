"""Tables: CSV, Parquet, HDF5, NumPy, LeRobot data sets and ULog; and what damage does to them."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
import pytest
import yaml
from pyarrow import parquet

from amhe_cli.cli.main import run
from amhe_cli.core.errors import ConfigError, LogError
from amhe_cli.core.log import Log
from amhe_cli.core.settings import LogSettings
from amhe_cli.core.signals import Signal
from amhe_cli.init.folder import init_system
from amhe_cli.logs import episode_paths, read_signals, survey
from amhe_cli.logs.containers import text_table
from tests.logs.log_makers import write_ulog

DT = 0.01
T = DT * np.arange(200)
Q = np.stack((np.sin(3.0 * T), np.cos(2.0 * T)), axis=1)
QD = np.stack((3.0 * np.cos(3.0 * T), -2.0 * np.sin(2.0 * T)), axis=1)

STATES = Signal(
    "joints", "", ("position", "velocity"), names=("a", "b"),
    columns={"position": ("q1", "q2"), "velocity": ("dq*",)},
)  # fmt: skip


def read(path: Path, *signals: Signal) -> Log:
    return read_signals(path, signals or (STATES,), DT, LogSettings())


def text(
    header: str, delimiter: str = ",", decimal: str = ".", factor: float = 1.0, first: float = 0.0
) -> str:
    rows = np.column_stack((factor * (T + first), Q, QD))
    lines = [delimiter.join(f"{x:.15g}".replace(".", decimal) for x in row) for row in rows]
    return "\n".join(([header] if header else []) + lines) + "\n"


def header(delimiter: str = ",", time: str = "time") -> str:
    return delimiter.join((time, "q1", "q2", "dq1", "dq2"))


def one_of_each(folder: Path) -> dict[str, Callable[[], Path]]:
    """Name of a dialect -> writes the log in it."""

    def written(name: str, content: str) -> Callable[[], Path]:
        def write() -> Path:
            path = folder / f"{name.replace(' ', '_')}.csv"
            path.write_bytes(content.encode("utf-8"))
            return path

        return write

    arrays = "\n".join(
        f'RUN,{1e6 * t:.15g},"[{q[0]:.15g}, {q[1]:.15g}]","[{v[0]:.15g}, {v[1]:.15g}]"'
        for t, q, v in zip(T, Q, QD, strict=True)
    )
    plain = text(header())
    degrees = np.column_stack((T, np.rad2deg(Q), np.rad2deg(QD)))
    in_degrees = "\n".join(",".join(f"{x:.15g}" for x in row) for row in degrees)
    shuffled = plain.splitlines()
    shuffled[1:] = [shuffled[1 + i] for i in np.random.default_rng(0).permutation(T.size)]
    return {
        "commas": written("commas", plain),
        "tabs": written("tabs", text(header("\t"), "\t")),
        "semicolons": written("semicolons", text(header(";"), ";")),
        "decimal commas": written("decimal commas", text(header(";"), ";", ",")),
        "crlf and mark": written("crlf", "\ufeff" + plain.replace("\n", "\r\n")),
        "comments": written("comments", "# robot: arm\n# by hand\n" + plain),
        "commented header": written("commented header", f"# {header()}\n" + text("")),
        "microseconds, unnamed": written("us", text(header(time="timestamp"), factor=1e6)),
        "nanoseconds, unnamed": written("ns", text(header(time="stamp"), factor=1e9)),
        "epoch": written("epoch", text(header(), first=1.7e9)),
        "arrays": written("arrays", f"type,timestamp,q,dq\n{arrays}\n"),
        "words": written("words", plain.replace("\n", ",word\n")),
        "an Arduino's": written("micros", text(header(time="micros"), factor=1e6)),
        "time by its unit": written("zeit", text(header(time="Zeit [ms]"), factor=1e3)),
        "degrees": written("degrees", f"TIME,q1 [DEG],q2 (Degree),dq1 [deg/s],dq2 [dps]\n{in_degrees}\n"),
        "unsorted": written("unsorted", "\n".join(shuffled) + "\n"),
        "no newline at the end": written("no newline", plain.removesuffix("\n")),
    }


DIALECTS = sorted(one_of_each(Path()))


@pytest.mark.parametrize("dialect", DIALECTS)
def test_every_dialect_gives_the_same_numbers(dialect: str, tmp_path: Path) -> None:
    path = one_of_each(tmp_path)[dialect]()
    columns = {"arrays": {"position": ("q",), "velocity": ("dq",)}}.get(dialect, STATES.columns)
    log = read(path, Signal("joints", "", ("position", "velocity"), names=("a", "b"), columns=columns))
    assert log.steps == T.size
    # stamps of a log of 2023 keep 0.2 microseconds in float64: a speed of 9 rad/s^2 makes 2e-6 of it
    tolerance = 5e-6 if dialect == "epoch" else 1e-9
    np.testing.assert_allclose(log["joints.position"].values, Q, atol=tolerance)
    np.testing.assert_allclose(log["joints.velocity"].values, QD, atol=tolerance)


def test_npz_parquet_and_hdf5_give_the_same_numbers_as_text(tmp_path: Path) -> None:
    arrays = {"time": T, "q1": Q[:, 0], "q2": Q[:, 1], "dq": QD}
    np.savez(tmp_path / "log.npz", **arrays)
    listed = {**arrays, "dq": [list(row) for row in QD]}
    table = pa.table(listed)
    parquet.write_table(table, tmp_path / "log.parquet")
    with h5py.File(tmp_path / "log.h5", "w") as file:
        for name, array in arrays.items():
            file["run/" + name] = array
    signal = Signal(
        "joints", "", ("position", "velocity"), names=("a", "b"),
        columns={"position": ("q{1..2}",), "velocity": ("dq",)},
    )  # fmt: skip
    for suffix in ("npz", "parquet", "h5"):
        log = read(tmp_path / f"log.{suffix}", signal)
        np.testing.assert_allclose(log["joints.position"].values, Q, atol=1e-9, err_msg=suffix)
        np.testing.assert_allclose(log["joints.velocity"].values, QD, atol=1e-9, err_msg=suffix)


def test_a_folder_of_tables_is_one_log_each_with_its_own_clock(tmp_path: Path) -> None:
    (tmp_path / "state.csv").write_text(text(header()))
    commands = "\n".join(f"{1e3 * t:.15g},{u:.15g}" for t, u in zip(T[::5], Q[::5, 0], strict=True))
    (tmp_path / "control.csv").write_text(f"time [ms],target\n{commands}\n")
    command = Signal("command", "control", ("position",), columns={"position": ("target",)}, is_input=True)
    states = Signal("joints", "state", ("position",), columns={"position": ("q1", "q2")})
    log = read(tmp_path, states, command)
    np.testing.assert_allclose(log["command.position"].values[:, 0], np.repeat(Q[::5, 0], 5)[: log.steps])
    found = survey(tmp_path)
    assert [topic.name for topic in found.topics] == ["control", "state"]
    assert found.topics[1].entries == ("time", "q1", "q2", "dq1", "dq2")
    assert found.topics[0].rate == pytest.approx(20.0)
    with pytest.raises(LogError, match="no table 'stat' .did you mean 'state'"):
        read(tmp_path, Signal("joints", "stat", ("position",), columns={"position": ("q1",)}))


def test_blank_cells_are_no_samples(tmp_path: Path) -> None:
    """One table with two rates: a command every fifth row, and blanks between."""
    cells = [(f"{q:.15g}", f"{q:.15g}" if i % 5 == 0 else "") for i, q in enumerate(Q[:, 0])]
    rows = [f"{t:.15g},{q},{command}" for t, (q, command) in zip(T, cells, strict=True)]
    path = tmp_path / "log.csv"
    path.write_text("time,q1,cmd\n" + "\n".join(rows) + "\n")
    command = Signal("command", "", ("position",), columns={"position": ("cmd",)}, is_input=True)
    states = Signal("joints", "", ("position",), columns={"position": ("q1",)})
    log = read(path, states, command)
    np.testing.assert_allclose(log["command.position"].values[:, 0], np.repeat(Q[::5, 0], 5)[: log.steps])
    np.testing.assert_allclose(log["joints.position"].values[:, 0], Q[: log.steps, 0], atol=1e-9)


def test_columns_of_the_same_name_are_reported(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    rows = "".join(f"{0.01 * i:g},{i},{-i}\n" for i in range(99))
    (tmp_path / "run.csv").write_text(f"time,q [mm],q [m]\n{rows}")
    read(tmp_path / "run.csv", Signal("q", "", ("value",), columns={"value": ("q",)}))
    assert any("several columns are called 'q'" in message for message in caplog.messages)


def test_ragged_lines_and_rows_without_a_time_are_dropped_and_counted(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    lines = text(header()).splitlines()
    lines[50] = "0.49,1.0"
    lines[80] = "," + lines[80].partition(",")[2]
    path = tmp_path / "log.csv"
    path.write_text("\n".join(lines) + "\n")
    log = read(path)
    np.testing.assert_allclose(log["joints.position"].values, Q, atol=1e-3)  # the two are interpolated
    assert "1 line has another number of cells than the header and is dropped" in caplog.text
    assert "1 row without a time is dropped" in caplog.text


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("q1,q2,dq1,dq2\n1,2,0,0\n2,3,0,0\n", "none of the columns 'q1', .* is a time: call the one"),
        ("time,q1\n", "a header and no rows"),
        ("time,position\n", "a header and no rows"),
        ("hello 1\nmy friend how are you\n", "no comma, semicolon or tab in its header"),
        ("hello, 1\nmy, friend\nhow, are you\n", "without a column of numbers"),
        ("# only a comment 1\n", "without a line of numbers"),
        ("time,name\n1,x\n2,y\n3,z\n", "signal 'joints': no column 'q1'"),
    ],
)
def test_what_is_no_table_is_refused_in_one_line(content: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text(content)
    with pytest.raises(LogError, match=message) as raised:
        read(path)
    assert str(path) in str(raised.value)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("0,1,2\n0.1,1,2\n", r"no names; with pandas: pandas.read_csv.PATH, names=\[...\]"),
        ("time q1 q2\n0 1 2\n0.1 1 2\n", r"no comma, semicolon or tab .*read_csv.PATH, sep=...\)"),
        ("time|q1|q2\n0|1|2\n0.1|1|2\n", r"no comma, semicolon or tab .*read_csv.PATH, sep=...\)"),
        ("time,q1\n(s),[deg]\n0,1\n0.1,2\n", r"has no number; write units as `q1 \[deg\]`.*skiprows=\[1\]"),
        ("sep=;\ntime;q1\n0;1\n0,1;2\n", "different numbers of cells.*skiprows="),
        ("Made by hand, with care, twice\ntime,q1\n0,1\n0.1,2\n", "different numbers of cells.*skiprows="),
        (
            "date,q1,q2,dq1,dq2\n2026-11-23T04:00:00Z,1,2,3,4\n2026-11-23T04:00:01Z,2,3,4,5\n",
            r"pandas.to_datetime\(table\['date'\]\)",
        ),
    ],
)
def test_another_dialect_is_refused_with_what_pandas_makes_of_it(
    content: str, message: str, tmp_path: Path
) -> None:
    test_what_is_no_table_is_refused_in_one_line(content, message, tmp_path)


def test_columns_that_do_not_fit_are_named(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text(text(header()))
    one = Signal("joints", "", ("position",), names=("a", "b"), columns={"position": ("q1",)})
    with pytest.raises(LogError, match="its position has 1 columns .q1. for the 2 entries a, b"):
        read(path, one)
    none = Signal("joints", "", ("position",), names=("a", "b"))
    with pytest.raises(LogError, match="; there is: time, q1, .*; add to it, for instance, columns: "):
        read(path, none)


def test_patterns_count_by_numbers_not_by_letters(tmp_path: Path) -> None:
    count = 11
    values = np.arange(count) + 10.0 * T[:, None]
    names = [f"q{i}" for i in range(1, count + 1)]
    order = [names.index(name) for name in sorted(names)]
    rows = np.column_stack((T, values[:, order]))
    path = tmp_path / "log.csv"
    np.savetxt(path, rows, delimiter=",", header=",".join(["time", *sorted(names)]), comments="")
    signal = Signal("joints", "", ("position",), columns={"position": ("q*",)})
    np.testing.assert_allclose(read(path, signal)["joints.position"].values, values, atol=1e-9)


def test_a_large_table_is_read_in_blocks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "log.csv"
    path.write_text(text(header()))
    whole = read(path)
    monkeypatch.setattr(text_table, "_BLOCK", 100)
    np.testing.assert_array_equal(read(path)["joints.position"].values, whole["joints.position"].values)


def test_a_header_that_windows_wrote(tmp_path: Path) -> None:
    rows = "\n".join(f"{1000.0 * t:.15g};{x:.15g}" for t, x in zip(T, np.rad2deg(Q[:, 0]), strict=True))
    (tmp_path / "run.csv").write_bytes(f"Zeit [ms];Größe [°]\n{rows}\n".encode("latin-1"))
    log = read(tmp_path / "run.csv", Signal("s", "", ("position",), columns={"position": ("Größe",)}))
    np.testing.assert_allclose(log["s.position"].values[:, 0], Q[:, 0], atol=1e-9)


FPS, FRAMES, EPISODES = 50, 100, 4
AT = np.arange(FRAMES) / FPS
NAMES = ("shoulder_pan.pos", "elbow_flex.pos", "gripper.pos")
SIGNALS = [
    Signal("joints", "", ("position",), columns={"position": [f"observation.state.{n}" for n in NAMES[:2]]}),
    Signal("command", "", ("position",), columns={"position": ["action.elbow_flex.pos"]}, is_input=True),
]


def state(episode: int, size: float) -> np.ndarray:
    angles = [size * np.sin((1 + episode) * AT), size * np.cos(AT), 50.0 + 0.0 * AT]
    return np.stack(angles, axis=1).astype(np.float32)


def frames(episode: int, size: float) -> pa.Table:
    lists = pa.list_(pa.float32(), len(NAMES))
    values = state(episode, size)
    return pa.table(
        {
            "observation.state": pa.array(list(values), lists),
            "action": pa.array(list(values + np.float32(1.0)), lists),
            "timestamp": AT.astype(np.float32),
            "frame_index": np.arange(FRAMES),
            "episode_index": np.full(FRAMES, episode),
            "index": episode * FRAMES + np.arange(FRAMES),
            "task_index": np.zeros(FRAMES, dtype=np.int64),
            "observation.images.top": [b"\xff\xd8"] * FRAMES,
        }
    )


def dataset(folder: Path, version: str, size: float = 1.0, names: Any = None, **more: Any) -> Path:
    """A dataset after the published layout: 2.1 a file for each episode, 3.0 two episodes in a file."""
    path = folder / "data_set"
    (path / "meta").mkdir(parents=True)
    joints = {"dtype": "float32", "shape": [len(NAMES)], "names": names or list(NAMES), **more}
    features = {
        "observation.state": joints,
        "action": joints,
        "timestamp": {"dtype": "float32", "shape": [1]},
    }
    features["observation.images.top"] = {"dtype": "image", "shape": [3, 4, 4]}
    new = version == "v3.0"
    places = "chunk_index:03d}/file-{file_index" if new else "episode_chunk:03d}/episode_{episode_index"
    info = {
        "codebase_version": version, "robot_type": "so101", "total_episodes": EPISODES, "chunks_size": 1000,
        "fps": FPS, "features": features, "data_path": f"data/chunk-{{{places}:0{3 if new else 6}d}}.parquet",
    }  # fmt: skip
    (path / "meta" / "info.json").write_text(json.dumps(info))
    (path / "data" / "chunk-000").mkdir(parents=True)
    if new:
        for file in range(EPISODES // 2):
            both = pa.concat_tables([frames(2 * file, size), frames(2 * file + 1, size)])
            parquet.write_table(both, path / "data" / "chunk-000" / f"file-{file:03d}.parquet")
        listed = path / "meta" / "episodes" / "chunk-000"
        listed.mkdir(parents=True)
        numbers = np.arange(EPISODES)
        places_of = {
            "episode_index": numbers,
            "data/chunk_index": 0 * numbers,
            "data/file_index": numbers // 2,
        }
        parquet.write_table(pa.table(places_of), listed / "file-000.parquet")
    else:
        for episode in range(EPISODES):
            file = path / "data" / "chunk-000" / f"episode_{episode:06d}.parquet"
            parquet.write_table(frames(episode, size), file)
    return path


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_an_episode_is_a_log(version: str, tmp_path: Path) -> None:
    path = dataset(tmp_path, version)
    for episode in range(EPISODES):
        log = read_signals(Path(f"{path}#{episode}"), SIGNALS, 1.0 / FPS, LogSettings())
        assert log.steps == FRAMES
        np.testing.assert_allclose(log["joints.position"].values, state(episode, 1.0)[:, :2], atol=1e-6)
        wanted = state(episode, 1.0)[:, 1] + 1.0
        np.testing.assert_allclose(log["command.position"].values[:, 0], wanted, atol=1e-6)
    found = survey(Path(f"{path}#2"))
    assert found.format == f"LeRobot {version[:2]}"
    (topic,) = found.topics
    assert topic.count == FRAMES
    assert topic.entries == (
        *(f"observation.state.{name}" for name in NAMES), *(f"action.{name}" for name in NAMES), "timestamp"
    )  # fmt: skip


def test_addresses(tmp_path: Path) -> None:
    path = dataset(tmp_path, "v3.0")

    def numbers(part: str) -> list[int]:
        return [int(str(one).rpartition("#")[2]) for one in episode_paths(Path(f"{path}{part}"))]

    assert numbers("") == numbers("#:") == [0, 1, 2, 3]
    assert (numbers("#3"), numbers("#1:3"), numbers("#2:"), numbers("/#0")) == ([3], [1, 2], [2, 3], [0])
    for wrong in ("#4", "#2:2", "#2:9", "#x", "#-1"):
        with pytest.raises(ConfigError):
            episode_paths(Path(f"{path}{wrong}"))
    assert episode_paths(tmp_path) == [tmp_path]
    with pytest.raises(ConfigError, match="each episode of a dataset is a log; name one, such as .*#0"):
        survey(path)
    with pytest.raises(ConfigError, match="no such file"):
        survey(tmp_path / "none#3")


def test_what_is_missing_or_of_another_version_is_named(tmp_path: Path) -> None:
    path = dataset(tmp_path, "v2.1")
    (path / "data" / "chunk-000" / "episode_000002.parquet").unlink()
    with pytest.raises(LogError, match=r"#2: its file data/chunk-000/episode_000002.parquet is missing"):
        survey(Path(f"{path}#2"))
    info = path / "meta" / "info.json"
    info.write_text(info.read_text().replace("v2.1", "v4.0"))
    with pytest.raises(LogError, match="of version 4; versions 2 and 3 are read"):
        survey(Path(f"{path}#0"))


ARM = """<mujoco>
  <worldbody><body><joint name="{}" axis="0 0 1"/><geom size=".1" mass="1"/>
    <body pos="0 0 .3"><joint name="{}" axis="0 1 0"/><geom size=".1" mass="1"/>
      <body pos="0 0 .3"><joint name="{}" axis="0 1 0"/><geom size=".1" mass=".1"/></body>
  </body></body></worldbody>
  <actuator>
    <position name="m1" joint="{}"/><position name="m2" joint="{}"/><position name="m3" joint="{}"/>
  </actuator>
</mujoco>"""


@pytest.mark.parametrize("own", [("shoulder_pan", "elbow_flex", "gripper"), ("a", "b", "c")])
def test_init_takes_the_state_and_the_action(own: tuple[str, ...], tmp_path: Path) -> None:
    """By name, and in order where no name is known."""
    path = dataset(tmp_path, "v2.1")
    model = tmp_path / "arm.xml"
    model.write_text(ARM.format(*own, *own))
    init_system(model, episode_paths(path), tmp_path / "system")
    system = yaml.safe_load((tmp_path / "system" / "system.yaml").read_text())
    joints, command = system["signals"]["joints"], system["signals"]["command"]
    assert joints["columns"] == {"position": [f"observation.state.{name}" for name in NAMES]}
    assert joints["joints"] == list(own)
    assert command["columns"] == {"position": [f"action.{name}" for name in NAMES]}


def test_commands_take_episodes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = dataset(tmp_path, "v3.0")
    assert run(["inspect", f"{path}#1:3", "--json"]) == 0
    logs = json.loads(capsys.readouterr().out)["logs"]
    assert [one["path"].rpartition("#")[2] for one in logs] == ["1", "2"]
    assert run(["inspect", f"{path}#9"]) == 2
    assert "the dataset has the episodes 0 to 3" in capsys.readouterr().err
    assert run(["mhe-replay", str(path)]) == 2
    assert f"name one, such as {path}#0" in " ".join(capsys.readouterr().err.split())


ULOG_Q = np.stack((np.cos(T), np.sin(T)), axis=1).astype(np.float32)


def ulog_written(folder: Path, dropout: int = 0) -> Path:
    """One topic with an array, and two instances of another, each with a clock of its own."""
    stamps = (20_000_000 + np.round(1e6 * T)).astype(np.uint64)
    arm = {"timestamp": stamps, "timestamp_sample": stamps - np.uint64(500), "q": ULOG_Q}
    slow = {"timestamp": stamps[::4], "x": ULOG_Q[::4, 1], "count": np.arange(50, dtype=np.int32)}
    other = slow | {"x": -ULOG_Q[::4, 1]}
    topics = {("arm", 0): arm, ("gyro", 0): slow, ("gyro", 1): other}
    return write_ulog(folder / "log.ulg", topics, dropout)


def test_topics_are_tables_with_arrays_and_microseconds(tmp_path: Path) -> None:
    path = ulog_written(tmp_path)
    signals = [
        Signal("joints", "arm", ("position",), columns={"position": ("q",)}),
        Signal("one", "arm", ("position",), columns={"position": ("q[1]",)}),
        Signal("gyro", "gyro_1", ("value",), columns={"value": ("x",)}),
    ]
    log = read_signals(path, signals, DT, LogSettings())
    assert log.start_ns == 20_000_000_000
    np.testing.assert_array_equal(log["joints.position"].values[: T.size], ULOG_Q[: log.steps])
    np.testing.assert_array_equal(log["one.position"].values[:, 0], ULOG_Q[: log.steps, 1])
    np.testing.assert_allclose(log["gyro.value"].values[::4, 0], -ULOG_Q[: log.steps : 4, 1], rtol=1e-14)


def test_inspection_lists_them(tmp_path: Path) -> None:
    found = survey(ulog_written(tmp_path, dropout=250))
    assert found.format == "ULog (3 tables)"
    assert [topic.name for topic in found.topics] == ["arm", "gyro", "gyro_1"]
    assert found.topics[0].entries == ("timestamp", "timestamp_sample", "q[2]")
    assert found.topics[1].rate == pytest.approx(25.0)
    assert found.problems == ("the recorder dropped messages 1 times, 0.25 s in all",)


def test_what_was_said_before_the_recording_is_no_part_of_its_duration(tmp_path: Path) -> None:
    stamps = (20_000_000 + np.round(1e6 * T)).astype(np.uint64)
    early = {"timestamp": np.array([1_000_000], dtype=np.uint64), "x": ULOG_Q[:1, 1]}
    arm = {"timestamp": stamps, "q": ULOG_Q}
    found = survey(write_ulog(tmp_path / "log.ulg", {("arm", 0): arm, ("boot", 0): early}))
    assert found.duration == pytest.approx(T[-1])
    halves = {"timestamp": np.where(T < 1.0, stamps, stamps + np.uint64(60_000_000)), "q": ULOG_Q}
    found = survey(write_ulog(tmp_path / "halves.ulg", {("arm", 0): halves}))
    assert found.duration == pytest.approx(60.0 + T[-1])


def test_without_the_extra_one_line_says_how_to_get_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pyulog", None)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(LogError, match=r"a ULog of PX4.*pip install 'amhe\[ulog\]'"):
        survey(ulog_written(tmp_path))


def test_zeros_at_its_end_are_left_out_and_between_its_messages_refused(tmp_path: Path) -> None:
    """pyulog takes a second for each megabyte of them."""
    whole, padded, torn = ulog_written(tmp_path), tmp_path / "padded.ulg", tmp_path / "torn.ulg"
    content = whole.read_bytes()
    padded.write_bytes(content + bytes(8 * 2**20))
    torn.write_bytes(content + bytes(2**20) + content[-100:])
    began = time.process_time()
    assert [t.entries for t in survey(padded).topics] == [t.entries for t in survey(whole).topics]
    with pytest.raises(LogError, match="a megabyte of zeros between its messages"):
        survey(torn)
    assert time.process_time() - began < 2.0
