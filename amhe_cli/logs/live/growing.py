"""An MCAP file that a recorder still writes, and those that it begins after it."""

from __future__ import annotations

import re
from collections.abc import Collection
from pathlib import Path

from mcap.opcode import Opcode

from amhe_cli.core.errors import ConfigError
from amhe_cli.core.files import check_regular
from amhe_cli.core.limits import beyond, limits
from amhe_cli.logs.containers.mcap_file import MAGIC, PARSE_ERRORS, RECORD, McapMessages, Piece, unfolded
from amhe_cli.logs.containers.raw import Batch, Unfolder
from amhe_cli.logs.live.transport import Transport

#: Bytes that are read at one look, so that a long file does not hold up all else; a chunk may be longer.
_READ = 8 * 2**20
#: Records that hold messages, or say what they are.
_READABLE = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)


class GrowingMcap(Transport):
    """The messages that are appended to a file from now on.

    Records count once they are whole: of a chunk that is being written nothing is read. Where the recorder
    goes on in another file of the folder, as rosbag2 does, that is read from its start; so is a file that
    takes the place of the first one, or that is cut short.

    Args:
        path: A .mcap file, or a folder of them, of which the last is followed.
        topics: Topics that are wanted; None: all.

    Raises:
        ConfigError: There is no such file.
    """

    def __init__(self, path: Path, topics: Collection[str] | None) -> None:
        super().__init__(f"{path}, while it grows")
        self._folder, self._topics = (path if path.is_dir() else path.parent), topics
        path = max(self._files(), key=_number, default=path) if path.is_dir() else path
        if not path.is_file():
            check_regular(path)
            raise ConfigError(f"{path}: no .mcap file to follow")
        self._open(path, skip=path.stat().st_size)

    def receive(self) -> list[Batch]:
        """See `Transport`."""
        try:
            found = self._grown() or self._turned()
        except (OSError, ConfigError) as error:  # a disk that is gone for a while; no regular file
            self.note(f"{self._path}: {error}; waiting")
            return []
        for problem in self._messages.problems[:1]:
            self.note(f"{self._path.name}: {problem}")
        self._messages.problems.clear()
        return found

    def close(self) -> None:
        """See `Transport`."""
        self._file.close()

    def _open(self, path: Path, skip: int = 0) -> None:
        self._path, self._file, self._inode = path, path.open("rb"), path.stat().st_ino
        self._at, self._skip, self._ended = len(MAGIC), skip, False
        self._messages = McapMessages()
        self.connections = self._messages.connections

    def _grown(self) -> list[Batch]:
        """Messages of the records that have become whole since the last call."""
        found: list[Batch] = []
        begun, size = self._at, self._file.seek(0, 2)
        while not self._ended and self._at - begun < _READ and self._at + RECORD.size <= size:
            self._file.seek(self._at)
            head = self._file.read(RECORD.size)
            opcode, length = RECORD.unpack(head)
            if length > limits().piece or opcode == 0 or len(self.connections) > limits().topics:
                self._ended = True  # where the next record begins is not known
                self.note(
                    f"{self._path.name}: {beyond('piece_mib', 'a record is')}; waiting for the next file"
                )
            elif self._at + RECORD.size + length > size:
                break
            else:
                # of what is older only the declarations count
                topics = self._topics if self._at >= self._skip else ()
                self._at += RECORD.size + length
                found += self._of_record(opcode, head + self._file.read(length), topics)
        return found

    def _of_record(self, opcode: int, record: bytes, topics: Collection[str] | None) -> list[Batch]:
        self._ended = opcode in (Opcode.DATA_END, Opcode.FOOTER)
        try:
            if opcode == Opcode.CHUNK:
                record = unfolded(record, Piece(RECORD.size, len(record), True), Unfolder(len(record)))
            elif opcode not in _READABLE:
                return []
        except PARSE_ERRORS as error:
            self.note(f"{self._path.name}: a chunk is lost: {error}")
            return []
        return list(self._messages.records(record, 0, len(record), topics))

    def _turned(self) -> list[Batch]:
        """Go on in the file that took this one's place, or in the next one."""
        now = self._path.stat() if self._path.exists() else None
        anew = now is not None and (now.st_ino != self._inode or now.st_size < self._at)
        later = [file for file in self._files() if _number(file) > _number(self._path)]
        if not (anew or later):
            return []
        path = self._path if anew else min(later, key=_number)
        check_regular(path, None if anew else self._folder)
        self._file.close()
        self._open(path)
        return self._grown()

    def _files(self) -> list[Path]:
        return [file for file in self._folder.glob("*.mcap") if file.stat().st_size > len(MAGIC)]


def _number(file: Path) -> tuple[list[int], str]:
    """Orders the files of rosbag2 as it numbers them: name_0, or 0_name_date."""
    return [int(digits) for digits in re.findall(r"\d+", file.stem)], file.name
