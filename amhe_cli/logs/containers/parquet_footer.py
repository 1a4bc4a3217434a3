"""How much a parquet file holds, read from its footer before any of it is unfolded.

The footer is a struct FileMetaData of parquet.thrift, in Thrift's compact protocol. pyarrow would read it,
but it aborts the whole process where a column is requested whose statistics are damaged.
"""

from __future__ import annotations

from pathlib import Path

from amhe_cli.core.limits import limits

#: Kinds of values of the compact protocol.
_TRUE, _FALSE, _BYTE, _SHORT, _INT, _LONG, _DOUBLE, _BINARY, _LIST, _SET, _MAP, _STRUCT = range(1, 13)
#: Fields that lead to the metadata of a column: row groups, their columns, its metadata; in there, the number
#: of its values, and the bytes that they take once unfolded.
_COLUMN, _VALUES, _BYTES = (4, 1, 3), 5, 6
_TAIL = 8


def unfolded_size(path: Path) -> int:
    """Bytes of all columns of a parquet file once unfolded, at least eight for each value.

    Raises:
        ValueError: The footer is damaged, or too large.
    """
    with path.open("rb") as file:
        whole = file.seek(0, 2)
        file.seek(max(whole - _TAIL, 0))
        length = int.from_bytes(file.read(_TAIL)[:4], "little")
        if length > min(whole - _TAIL, limits().piece):
            raise ValueError(f"a footer of {length} bytes")
        file.seek(whole - _TAIL - length)
        footer = _Footer(file.read(length))
    try:
        footer.struct(())
    except (IndexError, RecursionError):
        raise ValueError("its footer is damaged") from None
    return footer.size


class _Footer:
    """Walks over a struct, and adds up the sizes of columns on the way; nothing else is kept.

    Attributes:
        size: Bytes of the columns so far.
    """

    def __init__(self, data: bytes) -> None:
        self._data, self._at = data, 0
        self.size = 0

    def struct(self, path: tuple[int, ...]) -> None:
        """Read a struct; `path` has the numbers of the fields that lead to it."""
        number, found = 0, {}
        while head := self._byte():
            kind = head & 15
            number = number + (head >> 4) if head >> 4 else self._signed()
            if kind not in (_TRUE, _FALSE):  # in a struct these are values already
                found[number] = self._value(kind, (*path, number))
        if path == _COLUMN:
            self.size += max(8 * found.get(_VALUES, 0), found.get(_BYTES, 0))

    def _value(self, kind: int, path: tuple[int, ...]) -> int:
        """Read a value; the number that it is, 0 for everything else."""
        if kind in (_TRUE, _FALSE, _BYTE):
            return self._byte()
        if kind in (_SHORT, _INT, _LONG):
            return self._signed()
        if kind in (_DOUBLE, _BINARY):
            size = 8 if kind == _DOUBLE else self._number()
            self._at += size
            if self._at > len(self._data):
                raise IndexError
        elif kind in (_LIST, _SET):
            head = self._byte()
            for _ in range(self._number() if head >> 4 == 15 else head >> 4):
                self._value(head & 15, path)
        elif kind == _MAP:
            size = self._number()
            kinds = self._byte() if size else 0
            for _ in range(size):
                self._value(kinds >> 4, path)
                self._value(kinds & 15, path)
        elif kind == _STRUCT:
            self.struct(path)
        else:
            raise IndexError
        return 0

    def _byte(self) -> int:
        self._at += 1
        return self._data[self._at - 1]

    def _number(self) -> int:
        value = shift = 0
        while (byte := self._byte()) > 127:
            value |= (byte & 127) << shift
            shift += 7
            if shift > 63:
                raise IndexError
        return value | byte << shift

    def _signed(self) -> int:
        value = self._number()
        return value >> 1 ^ -(value & 1)
