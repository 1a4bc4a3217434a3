"""JSON messages as rows of numbers."""

from __future__ import annotations

import json
from collections.abc import Mapping
from datetime import UTC, datetime
from math import nan
from typing import Any

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


def _number(value: Any) -> float:
    """A number in JSON; null is one that was not measured."""
    return nan if value is None else float(value)
