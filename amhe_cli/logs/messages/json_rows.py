"""JSON messages as rows of numbers, and back."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from datetime import UTC, datetime
from math import isfinite, nan
from typing import Any

import numpy as np

from amhe_cli.logs.containers.raw import Batch, Connection, batch_of
from amhe_cli.logs.containers.table_file import clock_among
from amhe_cli.logs.messages.layout import KEPT, MalformedMessageError
from amhe_cli.logs.messages.rows import TIMES, Row


def json_row(message: bytes) -> Row:
    """Parse one message.

    Raises:
        MalformedMessageError: The message is not a JSON object, or it is too deep or too large.
    """
    row = _JsonRow()
    try:
        content = json.loads(message)
        if not isinstance(content, dict):
            raise MalformedMessageError("it is no JSON object")
        row.mapping("", content, 0)
    except (ValueError, TypeError, OverflowError, RecursionError) as error:
        raise MalformedMessageError(f"it is no JSON message ({error})") from None
    return row


class _JsonRow(Row):
    """A row of a JSON message."""

    def mapping(self, path: str, content: Mapping[str, Any], depth: int) -> None:
        """Note all values of an object."""
        self.check(depth)
        for key, value in content.items():
            name = "stamp" if key == "timestamp" else TIMES.get(key, key)
            self._value(f"{path}.{name}" if path else name, value, depth + 1)

    def _value(self, path: str, value: Any, depth: int) -> None:
        if isinstance(value, Mapping):
            self.mapping(path, value, depth)
        elif isinstance(value, list):
            self._list(path, value, depth)
        elif isinstance(value, str):
            self._text(path, value)
        elif path.split(".")[-1] != "stamp":
            self.number(path, _number(value))
        elif value is not None:
            self.time(path, value)

    def _list(self, path: str, values: list[Any], depth: int) -> None:
        if all(value is None or isinstance(value, (int, float)) for value in values):
            self.array(path, [_number(value) for value in values])
            return
        self.counts[path] = len(values)
        for i, value in enumerate(values):
            self._value(f"{path}[{i}]", value, depth + 1)

    def _text(self, path: str, text: str) -> None:
        """Note a name, or a time that is written out."""
        last = path.split(".")[-1].split("[")[0]
        if last in KEPT:
            self.strings[path] = text
        if last not in ("stamp", "time"):
            return
        try:
            moment = datetime.fromisoformat(text)
            moment = moment if moment.tzinfo else moment.replace(tzinfo=UTC)
        except ValueError:
            return
        self.number(f"{path}.sec", int(moment.timestamp()))
        self.number(f"{path}.nanosec", 1000 * moment.microsecond)


def schema_columns(schema: str) -> dict[str, int | None]:
    """Fields of a JSON schema that are numbers, None, or arrays of a fixed count of numbers, that count."""
    try:
        properties = json.loads(schema)["properties"]
        return {
            name: None if entry["type"] != "array" else int(entry["maxItems"])
            for name, entry in properties.items()
            if entry["type"] in ("number", "integer")
            or (entry["type"] == "array" and entry["items"]["type"] == "number" and entry["maxItems"] > 0)
        }
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
        return {}


def rows_as_json(batch: Batch) -> Batch:
    """Rows of a table as JSON messages of the same stamps, their times left out; a blank cell is null."""
    fields = json.loads(batch.connection.definition)
    clock = clock_among(dict(fields))
    properties, template, columns, place = {}, [], list[int](), 0
    for name, count in fields:
        size = count or 1
        if name != clock:
            number = {"type": "number"}
            several = {"type": "array", "items": number, "minItems": count, "maxItems": count}
            properties[name] = number if count is None else several
            cells = "%s" if count is None else f"[{','.join(['%s'] * size)}]"
            template.append(f"{json.dumps(name).replace('%', '%%')}:{cells}")
            columns += range(place, place + size)
        place += size
    rows = batch.buffer.view(np.float64).reshape(-1, place)[:, columns]
    text = "{" + ",".join(template) + "}"
    payloads = [(text % tuple(map(_cell, row))).encode() for row in rows.tolist()]
    schema = json.dumps({"type": "object", "properties": properties})
    topic = f"/{batch.connection.topic.strip('/')}"
    own = Connection(topic, batch.connection.type, "json", schema, "")
    return replace(batch_of(own, [], [], payloads), log_ns=batch.log_ns, publish_ns=batch.publish_ns)


def _cell(number: float) -> str:
    return repr(number) if isfinite(number) else "null"


def _number(value: Any) -> float:
    """A number in JSON; null is one that was not measured."""
    return nan if value is None else float(value)
