"""How signals meet the columns of tables: by the names and patterns that the system gives."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from fnmatch import translate

from amhe_cli.core.errors import LogError, one_of
from amhe_cli.core.signals import DERIVED, Signal
from amhe_cli.logs.containers.raw import Connection
from amhe_cli.logs.containers.table_file import ENCODING

#: Last part of a column's name, for the numbers of a quantity that has no entries of its own.
_PARTS = {"orientation": ("w", "x", "y", "z")}
_XYZ = ("x", "y", "z")


def fields_of(connection: Connection) -> dict[str, int | None]:
    """Column of a table -> how many numbers one cell holds; None for a single one."""
    return dict(json.loads(connection.definition))


def table_columns(connection: Connection) -> tuple[str, ...]:
    """Columns of a table as people write them, 'q1' or 'positions[6]'; none for other connections."""
    if connection.encoding != ENCODING:
        return ()
    return tuple(f"{name}[{count}]" if count else name for name, count in fields_of(connection).items())


def signals_on_tables(connections: Sequence[Connection], signals: Sequence[Signal]) -> list[Signal]:
    """In a log of tables, the signals with their fields and topics there; else the signals unchanged.

    A log of one table needs no topic: every signal is read from it.

    Raises:
        LogError: A column is absent, or a signal does not name the columns to read.
    """
    tables = {connection.topic: connection for connection in connections if connection.encoding == ENCODING}
    return [_on_table(tables, signal) for signal in signals] if tables else list(signals)


def _on_table(tables: Mapping[str, Connection], signal: Signal) -> Signal:
    name = signal.topic.strip("/")
    if name not in tables:
        if len(tables) > 1:
            there = f"signal {signal.name!r}: {one_of('table', name, tables)}"
            raise LogError(f"{there}; name one with topic: in the signal")
        name = next(iter(tables))
    columns = fields_of(tables[name])
    fields = {}
    for quantity in signal.quantities:
        found = _columns(signal, quantity, columns)
        if not found and (quantity in signal.columns or quantity not in DERIVED):
            raise LogError(
                f"signal {signal.name!r} names no columns of its {quantity}; add to it, for instance, "
                f"columns: {{{quantity}: [{next(iter(columns))}]}}; there is: {', '.join(columns)}"
            )
        if found:
            fields[quantity] = found
    for quantity in signal.quantities:
        source = DERIVED.get(quantity, "")
        if quantity not in fields and source not in fields and (found := _columns(signal, source, columns)):
            fields[source] = found
    return replace(signal, topic=name, type=None, fields=fields, child_frame=None)


def _columns(signal: Signal, quantity: str, columns: Mapping[str, int | None]) -> tuple[str, ...]:
    """Columns of one quantity, in the order of the signal's entries."""
    patterns = signal.columns.get(quantity)
    if patterns is None:
        return _usual(signal, quantity, columns)
    found = tuple(name for pattern in patterns for name in _expanded(signal, pattern, columns))
    width = sum(columns.get(name) or 1 for name in found)
    if signal.names and width != len(signal.names):
        raise LogError(
            f"signal {signal.name!r}: its {quantity} has {width} columns ({', '.join(found)}) for the "
            f"{len(signal.names)} entries {', '.join(signal.names)}"
        )
    return found


def _usual(signal: Signal, quantity: str, columns: Mapping[str, int | None]) -> tuple[str, ...]:
    """Columns that are named after what they hold: `topic.quantity.entry` or `signal.quantity.entry`."""
    for head in (signal.topic.strip("/"), signal.name):
        stem = f"{head}.{quantity}"
        if stem in columns:
            return (stem,)
        parts = signal.names or _PARTS.get(quantity, _XYZ)
        names = tuple(f"{stem}.{part}" for part in parts)
        if all(name in columns for name in names):
            return names
    return ()


def _expanded(signal: Signal, pattern: str, columns: Mapping[str, int | None]) -> list[str]:
    """Names that a pattern stands for: 'q{1..3}' is q1, q2, q3; 'q*' is all that match, q2 before q10."""
    if braces := re.search(r"\{(\d+)\.\.(\d+)\}", pattern):
        first, last = int(braces.group(1)), int(braces.group(2))
        inner = (f"{pattern[: braces.start()]}{i}{pattern[braces.end() :]}" for i in range(first, last + 1))
        return [name for one in inner for name in _expanded(signal, one, columns)]
    if pattern in columns or _is_element(pattern, columns):
        return [pattern]
    found = [name for name in columns if re.match(translate(pattern), name)] if "*" in pattern else []
    if not found:
        raise LogError(f"signal {signal.name!r}: {one_of('column', pattern, columns)}")
    return sorted(found, key=_natural)


def _is_element(name: str, columns: Mapping[str, int | None]) -> bool:
    """Whether a name is one number of an array column: 'positions[2]'."""
    match = re.fullmatch(r"(.+)\[(\d+)\]", name)
    return match is not None and int(match.group(2)) < (columns.get(match.group(1)) or 0)


def _natural(name: str) -> list[tuple[int, str]]:
    """Sort key by which q2 comes before q10."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name)]
