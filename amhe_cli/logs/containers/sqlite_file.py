"""rosbag2's sqlite3 storage (.db3), whole or damaged.

SQLite keeps no checksums. Its structure is checked, and rows that contradict the index of stamps are left
out, but a flipped bit inside a message's payload cannot be detected.
"""

from __future__ import annotations

import re
import sqlite3
from collections.abc import Collection, Iterator
from pathlib import Path
from urllib.parse import quote

from amhe_cli.core.limits import limits
from amhe_cli.logs.containers.raw import (
    Batch,
    Connection,
    DefinitionFormat,
    LogFile,
    batch_of,
    messages,
    normal_type,
)

_FORMATS: dict[str, DefinitionFormat] = {"ros2msg": "ros2msg", "ros2idl": "ros2idl"}
_BATCH, _BATCH_BYTES = 4096, 2**25
#: The content of larger files is not checked beforehand, which would take as long as the reading [bytes].
_CHECKED = 2**30
#: Steps of sqlite's machine: in any case, and for each byte of the file. An honest row of 20 bytes takes 30.
_STEPS, _STEPS_A_BYTE, _STRIDE = 2 * 10**7, 50, 10**5


class SqliteFile(LogFile):
    """A .db3 file; see LogFile."""

    format = "rosbag2 sqlite3"

    def __init__(self, path: Path) -> None:
        super().__init__()
        self._size = path.stat().st_size
        with path.open("rb") as file:
            head = file.read(100)
        page = int.from_bytes(head[16:18], "big")
        # sqlite would read missing bytes as zeros, and those pass as measurements.
        if len(head) < 100 or self._size < (65536 if page == 1 else page) * int.from_bytes(
            head[28:32], "big"
        ):
            raise ValueError(
                "the database is cut off: copy it again, or save what `sqlite3 FILE .recover` finds"
            )
        # A journal beside the file means that the recorder crashed; sqlite then needs to see it.
        journal = path.with_name(path.name + "-wal")
        mode = "mode=ro" if journal.exists() and journal.stat().st_size else "immutable=1"
        self._database = sqlite3.connect(f"file:{quote(str(path.absolute()))}?{mode}", uri=True)
        self._database.execute("PRAGMA cell_size_check=ON")
        self._database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, limits().piece)
        self._steps = (_STEPS + _STEPS_A_BYTE * self._size) // _STRIDE
        self._database.set_progress_handler(self._tired, _STRIDE)
        self._database.text_factory = lambda text: text.decode("utf-8", "replace")

    def batches(self, topics: Collection[str] | None) -> Iterator[Batch]:
        """Yield the messages of the named topics (None: all), in the order they were recorded."""
        self._check_tables()
        by_id = self._topics()
        suspect = self._suspect_rows()
        wanted = {number: c for number, c in by_id.items() if topics is None or c.topic in topics}
        pending: dict[int, list[tuple[int, bytes]]] = {number: [] for number in wanted}
        held = dict.fromkeys(wanted, 0)
        read = damaged = first = last = 0
        try:
            for number, topic, stamp, data in self._rows(wanted):
                if number in suspect or not isinstance(stamp, int) or not isinstance(data, bytes):
                    damaged += 1
                    continue
                rows = pending[topic]
                rows.append((stamp, data))
                held[topic] += len(data)
                first, last, read = first or stamp, stamp, read + 1
                if len(rows) == _BATCH or held[topic] > _BATCH_BYTES:
                    yield _batch(wanted[topic], rows)
                    rows.clear()
                    held[topic] = 0
        except sqlite3.DatabaseError:
            self.problems.append(
                f"recovered {messages(read)} up to t = {(last - first) / 1e9:.1f} s; the rest is lost"
            )
        if damaged:
            self.problems.append(f"{messages(damaged)} damaged and left out")
        for topic, rows in pending.items():
            if rows:
                yield _batch(wanted[topic], rows)

    def _tired(self) -> bool:
        """Whether sqlite is to give up: a few pages can be made to stand for endless rows."""
        self._steps -= 1
        return self._steps < 0

    def _check_tables(self) -> None:
        """Refuse views and computed columns: what they hold is not in the file, and has no end.

        Raises:
            ValueError: A table is none.
        """
        for (name,) in self._database.execute(
            "SELECT t.name FROM pragma_table_list AS t WHERE t.name NOT LIKE 'sqlite_%' "
            "AND (t.type != 'table' OR EXISTS (SELECT 1 FROM pragma_table_xinfo(t.name) WHERE hidden))"
        ):
            raise ValueError(f"{name!r} in this database is a view, or computes its content: no log has that")

    def _topics(self) -> dict[int, Connection]:
        definitions: dict[str, tuple[str, str, str]] = {}
        try:
            for name, encoding, text, digest in self._database.execute(
                "SELECT topic_type, encoding, encoded_message_definition, type_description_hash "
                "FROM message_definitions"
            ):
                definitions[name] = str(encoding), str(text), str(digest or "")
        except sqlite3.OperationalError:
            pass  # recorders before ROS 2 Iron wrote no definitions
        connections: dict[int, Connection] = {}
        for number, topic, kind, encoding in self._database.execute(
            "SELECT id, name, type, serialization_format FROM topics"
        ):
            language, text, digest = definitions.get(kind, ("", "", ""))
            connections[number] = Connection(
                str(topic), normal_type(str(kind)), str(encoding), text, _FORMATS.get(language, ""), digest
            )
        self.connections = list(connections.values())
        return connections

    def _rows(self, wanted: Collection[int]) -> sqlite3.Cursor:
        # Along the table, not the index: a damaged index must not reorder or hide messages.
        marks = ",".join("?" * len(wanted))
        return self._database.execute(
            f"SELECT id, topic_id, timestamp, data FROM messages NOT INDEXED WHERE topic_id IN ({marks})",
            tuple(wanted),
        )

    def _suspect_rows(self) -> set[int]:
        """Rows whose stamp contradicts the index."""
        if self._size > _CHECKED:
            return set()  # a check as long as the reading itself
        try:
            report = [line for (line,) in self._database.execute("PRAGMA integrity_check(1000)")]
        except sqlite3.DatabaseError as error:
            report = [str(error)]
        if report == ["ok"]:
            return set()
        self.problems.append(f"the database is damaged ({report[0].splitlines()[-1]})")
        return {int(row) for line in report for row in re.findall(r"row (\d+) missing from index", line)}


def _batch(connection: Connection, rows: list[tuple[int, bytes]]) -> Batch:
    times, payloads = zip(*rows, strict=True)
    return batch_of(connection, times, times, payloads)
