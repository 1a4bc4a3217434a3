"""How signals meet the columns of tables: by the names and patterns that the system gives."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from fnmatch import translate
from itertools import count, takewhile

from amhe_cli.core.errors import LogError, one_of
from amhe_cli.core.signals import DERIVED, Signal
from amhe_cli.logs.containers.raw import Connection
from amhe_cli.logs.containers.table_file import ENCODING

#: Last part of a column's name, for the numbers of a quantity that has no entries of its own.
_PARTS = {"orientation": ("w", "x", "y", "z")}
_XYZ = ("x", "y", "z")


def fields_of(connection: Connection) -> dict[str, int | None]:
    """Column of a table -> how many numbers one cell holds, None for a single one; {} for any other topic."""
    return dict(json.loads(connection.definition)) if connection.encoding == ENCODING else {}


def table_columns(connection: Connection) -> tuple[str, ...]:
    """Columns of a table as people write them, 'q1' or 'positions[6]'; none for other connections."""
    return tuple(f"{name}[{count}]" if count else name for name, count in fields_of(connection).items())


def signals_on_tables(connections: Sequence[Connection], signals: Sequence[Signal]) -> list[Signal]:
    """The signals with their topics and fields, where the log holds tables.

    A log of one table needs no topic: every signal is read from it. In any other log, a signal without a
    topic is read from the topic of its own name.

    Raises:
        LogError: A column is absent, or a signal does not name the columns to read.
    """
    tables = {one.topic.strip("/"): one for one in connections if one.encoding == ENCODING}
    if tables:
        return [_on_table(tables, signal) for signal in signals]
    return [signal if signal.topic else replace(signal, topic=f"/{signal.name}") for signal in signals]


def table_name(topic: str) -> str:
    """Name of the table, and of its file, that holds a topic."""
    return "".join("_" if c in "/." or not c.isprintable() else c for c in topic.strip("/"))


def _on_table(tables: Mapping[str, Connection], signal: Signal) -> Signal:
    heads = (signal.topic.strip("/"), signal.name)
    names = [name for head in heads for name in (head, table_name(head)) if name in tables]
    if not names and len(tables) > 1:
        there = f"signal {signal.name!r}: {one_of('table', heads[0], tables)}"
        raise LogError(f"{there}; name one with topic: in the signal")
    table = tables[(names or list(tables))[0]]
    columns = fields_of(table)
    fields = {}
    for quantity in signal.quantities:
        found = _columns(signal, quantity, columns, own=bool(names))
        if not found and (quantity in signal.columns or quantity not in DERIVED):
            raise LogError(
                f"signal {signal.name!r} names no columns of its {quantity}; there is: {', '.join(columns)}; "
                f"add to it, for instance, columns: {{{quantity}: [{list(columns)[-1]}]}}"
            )
        if found:
            fields[quantity] = found
    for quantity in signal.quantities:
        source = DERIVED.get(quantity, "")
        if quantity not in fields and source not in fields:
            found = _columns(signal, source, columns, own=bool(names))
            fields |= {source: found} if found else {}
    return replace(signal, topic=table.topic, type=None, fields=fields, child_frame=None)


def _columns(signal: Signal, quantity: str, columns: Mapping[str, int | None], own: bool) -> tuple[str, ...]:
    """Columns of one quantity, in the order of the signal's entries.

    They are those that the signal names, else those that are named after what they hold: `position.hinge` in
    a table of the signal's `own`, `joints.position.hinge` in one that several signals share.
    """
    heads = ("", f"{signal.topic.strip('/')}.", f"{signal.name}.")
    views = [{n.removeprefix(head): c for n, c in columns.items() if n.startswith(head)} for head in heads]
    usual = ()
    for head, view in zip(heads, views, strict=True):
        if head or own:
            usual = usual or tuple(head + name for name in _usual(signal, quantity, view))
    patterns = signal.columns.get(quantity)
    if patterns is None:
        return usual
    found = [(head, view) for head, view in zip(heads, views, strict=True) if _all_there(patterns, view)]
    if not found and usual:
        return usual
    head, view = found[0] if found else ("", columns)
    names = tuple(name for pattern in patterns for name in _expanded(signal, pattern, view))
    width = sum(view.get(name) or 1 for name in names)
    if signal.names and width != len(signal.names):
        raise LogError(
            f"signal {signal.name!r}: its {quantity} has {width} columns ({', '.join(names)}) for the "
            f"{len(signal.names)} entries {', '.join(signal.names)}"
        )
    return tuple(head + name for name in names)


def _usual(signal: Signal, quantity: str, columns: Mapping[str, int | None]) -> tuple[str, ...]:
    """Columns that are named after what they hold: a quantity and its entry, or the field of a message."""
    if quantity in signal.fields:
        series = [_series(path, columns) for path in signal.fields[quantity]]
        return tuple(name for names in series for name in names) if all(series) else ()
    frame = (f"{signal.child_frame}.{quantity}",) if signal.child_frame else ()
    for stem in (*frame, quantity):
        names = tuple(f"{stem}.{part}" for part in signal.names or _PARTS.get(quantity, _XYZ))
        if all(name in columns for name in names):
            return names
        if found := _series(stem, columns):
            return found
    return ()


def _series(stem: str, columns: Mapping[str, int | None]) -> tuple[str, ...]:
    """The column of this name, or the columns stem[0], stem[1] and so on."""
    if stem in columns:
        return (stem,)
    return tuple(takewhile(columns.__contains__, (f"{stem}[{i}]" for i in count())))


def _all_there(patterns: Sequence[str], columns: Mapping[str, int | None]) -> bool:
    try:
        return all([_expanded(Signal("", "", ()), pattern, columns) for pattern in patterns])
    except LogError:
        return False


def _expanded(signal: Signal, pattern: str, columns: Mapping[str, int | None]) -> list[str]:
    """Names that a pattern stands for: 'q{1..3}' is q1, q2, q3; 'q*' is all that match, q2 before q10."""
    if braces := re.search(r"\{(\d+)\.\.(\d+)\}", pattern):
        first, last = int(braces.group(1)), int(braces.group(2))
        inner = (f"{pattern[: braces.start()]}{i}{pattern[braces.end() :]}" for i in range(first, last + 1))
        return [name for one in inner for name in _expanded(signal, one, columns)]
    if _is_element(pattern, columns):
        return [pattern]
    if series := _series(pattern, columns):
        return list(series)
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
