"""Tables as logs: every way to write one and the same log gives the same numbers."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from amhe_cli.core.errors import LogError
from amhe_cli.core.log import Log
from amhe_cli.core.settings import LogSettings
from amhe_cli.core.signals import Signal
from amhe_cli.logs import read_signals, survey
from amhe_cli.logs.containers import text_table

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
    import h5py
    import pyarrow
    import pyarrow.parquet

    arrays = {"time": T, "q1": Q[:, 0], "q2": Q[:, 1], "dq": QD}
    np.savez(tmp_path / "log.npz", **arrays)
    listed = {**arrays, "dq": [list(row) for row in QD]}
    table = pyarrow.table(listed)
    pyarrow.parquet.write_table(table, tmp_path / "log.parquet")
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
        (
            "time,q1\n(s),[deg]\n0,1\n0.1,2\n",
            r"has no number; write units as `q1 \[deg\]`.*skiprows=\[1\]",
        ),
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
