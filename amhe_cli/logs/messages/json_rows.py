"""JSON messages as rows of numbers, so that they are read like any other message; and back.

Numbers of a message lie side by side as float64, in the order of its text. Messages with the same keys, array
lengths and names share a layout. Times are brought to the names of ROS: stamp.sec and stamp.nanosec.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from datetime import UTC, datetime
from math import isfinite, nan
from typing import Any

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.logs.containers.raw import Batch, Connection, batch_of
from amhe_cli.logs.containers.table_file import clock_of
from amhe_cli.logs.containers.text_dialect import Column
from amhe_cli.logs.messages.descriptors import TIMES, MalformedMessageError
from amhe_cli.logs.messages.layout import KEPT, Layout, Leaf

#: A message nests no deeper, and holds no more numbers.
_DEEPEST, _MOST_NUMBERS = 30, 100_000


class JsonRows:
    """Turns JSON messages of one connection into rows; keeps the layouts that it has seen."""

    def __init__(self) -> None:
        self._layouts: dict[tuple, Layout] = {}

    def row(self, message: bytes) -> tuple[Layout, FloatArray]:
        """Layout and numbers, shape (n,), of one message.

        Raises:
            MalformedMessageError: The message is not a JSON object, or it is too deep or too large.
        """
        found = _Found()
        try:
            content = json.loads(message)
            if not isinstance(content, dict):
                raise MalformedMessageError("it is no JSON object")
            found.mapping("", _with_arrays(content), 0)
        except (ValueError, TypeError, OverflowError, RecursionError) as error:
            raise MalformedMessageError(f"it is no JSON message ({error})") from None
        shape = (tuple(found.shape), tuple(found.strings.items()))
        if shape not in self._layouts:
            self._layouts[shape] = found.layout()
        return self._layouts[shape], np.array(found.numbers)


class _Found:
    """What one message holds, in the order of its text."""

    def __init__(self) -> None:
        self.numbers: list[float] = []
        self.shape: list[tuple[str, int | None]] = []
        self.counts: dict[str, int] = {}
        self.strings: dict[str, str] = {}

    def mapping(self, path: str, content: Mapping[str, Any], depth: int) -> None:
        if depth > _DEEPEST or len(self.numbers) > _MOST_NUMBERS:
            raise MalformedMessageError("it nests too deep, or holds too many numbers")
        for key, value in content.items():
            name = "stamp" if key == "timestamp" else TIMES.get(key, key)
            self.value(f"{path}.{name}" if path else name, value, depth + 1)

    def value(self, path: str, value: Any, depth: int) -> None:
        if isinstance(value, Mapping):
            self.mapping(path, value, depth)
        elif isinstance(value, list):
            self._list(path, value, depth)
        elif isinstance(value, str):
            self._text(path, value)
        elif path.split(".")[-1] == "stamp":
            if value is not None:
                self.mapping(path, _parts_of_time(float(value)), depth)
        else:
            self.shape.append((path, None))
            self.numbers.append(_number(value))

    def layout(self) -> Layout:
        leaves, offset = {}, 0
        for path, count in self.shape:
            leaves[path] = Leaf(offset, np.dtype("<f8"), count)
            offset += 8 * (1 if count is None else count)
        nothing = np.empty(0, dtype=np.int64)
        return Layout(leaves, self.counts, self.strings, nothing, nothing.astype(np.uint8))

    def _list(self, path: str, values: list[Any], depth: int) -> None:
        if all(value is None or isinstance(value, (int, float)) for value in values):
            self.shape.append((path, len(values)))
            self.numbers += map(_number, values)
            return
        self.counts[path] = len(values)
        for i, value in enumerate(values):
            self.value(f"{path}[{i}]", value, depth + 1)

    def _text(self, path: str, text: str) -> None:
        own = path.split(".")[-1].split("[")[0]
        if own in KEPT:
            self.strings[path] = text
        elif own in ("stamp", "time"):
            try:
                moment = datetime.fromisoformat(text)
                moment = moment if moment.tzinfo else moment.replace(tzinfo=UTC)
            except ValueError:
                return
            self.mapping(path, {"sec": int(moment.timestamp()), "nanosec": 1000 * moment.microsecond}, 0)


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
    fields = list(json.loads(batch.connection.definition))
    names = [Column(name, "number" if count is None else "array") for name, count in fields]
    clock = clock_of(names)
    number, properties, template = {"type": "number"}, {}, []
    for name, count in fields:
        several = {"type": "array", "items": number, "minItems": count, "maxItems": count}
        properties[name] = number if count is None else several
        cells = "%s" if count is None else f"[{','.join(['%s'] * count)}]"
        template.append(f"{json.dumps(name).replace('%', '%%')}:{cells}")
    width = sum(count or 1 for _, count in fields)
    rows = batch.buffer.view(np.float64).reshape(-1, width)
    if clock is not None:
        place = sum(count or 1 for _, count in fields[:clock])
        rows = np.delete(rows, place, axis=1)
        del properties[fields[clock][0]], template[clock]
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


def _parts_of_time(number: float) -> dict[str, int]:
    """A time as one number, in seconds, or by its size in milli-, micro- or nanoseconds since 1970."""
    unit = next((unit for least, unit in ((1e17, 1e9), (1e14, 1e6), (1e11, 1e3)) if abs(number) > least), 1.0)
    seconds, rest = divmod(number, unit)
    return {"sec": int(seconds), "nanosec": round(rest * 1e9 / unit)}


def _with_arrays(content: Mapping[str, Any]) -> Mapping[str, Any]:
    """A list of joints with their numbers (foxglove.JointStates) as arrays by name (JointState)."""
    joints = content.get("joints")
    if not isinstance(joints, list) or not all(isinstance(j, Mapping) and "name" in j for j in joints):
        return content
    keys = [key for key in ("position", "velocity", "effort") if all(key in joint for joint in joints)]
    arrays = {key: [joint[key] for joint in joints] for key in ("name", *keys)}
    return {key: value for key, value in content.items() if key != "joints"} | arrays
