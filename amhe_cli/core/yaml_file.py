"""YAML files read safely, with the place of every mistake.

Differences from plain PyYAML, all against silent surprises: duplicate keys are refused, `1e-3` is a
number, `on` and `yes` are words, `010` is ten.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from amhe_cli.core.errors import ConfigError
from amhe_cli.core.files import check_regular
from amhe_cli.core.limits import beyond, limits

#: Keys and list indices from the top of a file to one of its values.
Place = tuple[str | int, ...]

_DEEPEST = 50
_TOO_DEEP = f"nested deeper than {_DEEPEST} levels, or within itself"


class _Loader(yaml.SafeLoader):
    """SafeLoader with the scalars of YAML 1.2's core schema."""

    yaml_implicit_resolvers: dict = {}  # noqa: RUF012 (PyYAML's own registry, filled below)
    _values = 0

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """Compose one value, within the limit of a file."""
        self._values += 1
        if self._values > limits().yaml_values:
            raise yaml.YAMLError(beyond("yaml_values", "its values are"))
        return super().compose_node(parent, index)

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        """The value of a node; a tag such as !!bool may stand before anything."""
        try:
            return super().construct_object(node, deep)
        except (ValueError, TypeError, LookupError, AttributeError):
            text = f"{str(node.value)[:40]!r} is no {node.tag.rpartition(':')[2]}"
            raise yaml.constructor.ConstructorError(None, None, text, node.start_mark) from None


def _decimal(loader: yaml.SafeLoader, node: Any) -> int:
    """An integer in decimal: `010` is ten, not eight."""
    return int(loader.construct_scalar(node))


_FLOAT = r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)"
for _tag, _pattern, _first in (
    ("bool", "true|True|TRUE|false|False|FALSE", "tTfF"),
    ("int", "[-+]?[0-9]+", "-+0123456789"),
    ("float", _FLOAT, "-+.0123456789"),
    ("null", "~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("merge", "<<", "<"),
):
    _Loader.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", re.compile(f"^(?:{_pattern})$"), list(_first))
_Loader.add_constructor("tag:yaml.org,2002:int", _decimal)


def scalar(text: str) -> Any:
    """The value of one YAML expression, such as an option's `0.5`, `[0.3, 2]` or `true`.

    Raises:
        ConfigError: It is not valid YAML.
    """
    try:
        return yaml.load(text, _Loader)
    except yaml.YAMLError as error:
        raise ConfigError(f"{text!r} is not a value: {_message_of(error)}") from None


class YamlFile:
    """A YAML mapping, where each of its values stands, and the mistakes found in it.

    Args:
        path: The file.
        overrides: Values that replace or add to the file's own, as nested mappings.
        patient: A key given twice is a problem like others, noted for `raise_problems`; the first of its
            values is kept, so that all the rest can be looked through too.

    Raises:
        ConfigError: The file cannot be read, is no YAML, holds a key twice or is no mapping.
    """

    def __init__(self, path: Path, overrides: Mapping[str, Any] | None = None, patient: bool = False) -> None:
        self.path = path
        self._overrides = overrides or {}
        self._problems: dict[str, tuple[int, int]] = {}
        self._node = self._composed()
        if not patient:
            self.raise_problems()
        self.own: dict[str, Any] = {} if self._node is None else self._constructed(self._node)
        if not isinstance(self.own, dict):
            raise ConfigError(f"{path}:1:1: this file must be a mapping of keys to values")
        self.data = merged(self.own, self._overrides)

    def problem(self, place: Place, text: str, at_key: bool = False) -> None:
        """Note a mistake at the value, or key, that `place` names; `raise_problems` reports all of them."""
        if self._is_override(place):
            name = ".".join(map(str, place)).removeprefix("settings.")
            self._problems[f"setting {name}: {text}"] = (0, 0)
            return
        mark = self._mark(place, at_key)
        line, column = mark.line + 1, mark.column + 1
        self._problems[f"{self.path}:{line}:{column}: {text}"] = (line, column)

    def raise_problems(self) -> None:
        """Raise one ConfigError that lists every noted mistake, a line each, in the file's order."""
        if self._problems:
            raise ConfigError("\n".join(sorted(self._problems, key=lambda text: self._problems[text])))

    def _composed(self) -> yaml.Node | None:
        check_regular(self.path)
        try:
            if self.path.stat().st_size > limits().yaml_mib * 2**20:
                raise ConfigError(f"{self.path}: {beyond('yaml_mib', 'its size is')}")
            node = yaml.compose(self.path.read_text(encoding="utf-8"), _Loader)
        except OSError as error:
            raise ConfigError(f"{self.path}: {error.strerror or error}") from None
        except UnicodeDecodeError:
            raise ConfigError(f"{self.path}: not a text file (UTF-8)") from None
        except yaml.YAMLError as error:
            mark = getattr(error, "problem_mark", None)
            where = f":{mark.line + 1}:{mark.column + 1}" if mark else ""
            raise ConfigError(f"{self.path}{where}: not valid YAML: {_message_of(error)}") from None
        except RecursionError:
            raise ConfigError(f"{self.path}: {_TOO_DEEP}") from None
        if node is not None:
            self._check_size(node)
            self._drop_duplicates(node)
        return node

    def _constructed(self, node: yaml.Node) -> Any:
        loader = _Loader("")
        try:
            return loader.construct_document(node)
        except (yaml.YAMLError, ValueError, TypeError) as error:
            mark = getattr(error, "problem_mark", None) or node.start_mark
            where = f"{self.path}:{mark.line + 1}:{mark.column + 1}"
            raise ConfigError(f"{where}: not valid YAML: {_message_of(error)}") from None
        finally:
            loader.dispose()

    def _check_size(self, root: yaml.Node) -> None:
        """Refuse what aliases and merges unfold to too much; a node that many name counts each time."""
        sizes: dict[int, int] = {}
        waiting: list[tuple[yaml.Node, int]] = [(root, 0)]
        while waiting:
            node, depth = waiting.pop()
            parts = node.value if isinstance(node, yaml.CollectionNode) else []
            below = [one for part in parts for one in (part if isinstance(part, tuple) else (part,))]
            missing = [one for one in below if id(one) not in sizes]
            if missing and depth < _DEEPEST:
                waiting += [(node, depth), *((one, depth + 1) for one in missing)]
                continue
            if missing:
                mark = node.start_mark
                raise ConfigError(f"{self.path}:{mark.line + 1}:{mark.column + 1}: {_TOO_DEEP}")
            sizes[id(node)] = 1 + sum(sizes[id(one)] for one in below)
        if sizes[id(root)] > limits().yaml_values:
            raise ConfigError(f"{self.path}: {beyond('yaml_values', 'what its aliases unfold to is')}")

    def _drop_duplicates(self, root: yaml.Node) -> None:
        waiting, seen = [root], set()
        while waiting:
            node = waiting.pop()
            if id(node) in seen:  # an alias of a node met before
                continue
            seen.add(id(node))
            if isinstance(node, yaml.SequenceNode):
                waiting.extend(node.value)
            if not isinstance(node, yaml.MappingNode):
                continue
            first: dict[str, int] = {}
            kept = []
            for key, value in node.value:
                mark, name = key.start_mark, str(key.value)
                if name in first and name != "<<":
                    text = f"key {name!r} is here twice; its first value is in line {first[name]}"
                    place = (mark.line + 1, mark.column + 1)
                    self._problems[f"{self.path}:{place[0]}:{place[1]}: {text}"] = place
                    continue
                first.setdefault(name, mark.line + 1)
                kept.append((key, value))
                waiting.append(value)
            node.value = kept

    def _mark(self, place: Place, at_key: bool) -> yaml.Mark:
        """Start of the deepest part of `place` that the file has."""
        node, mark = self._node, yaml.Mark(str(self.path), 0, 0, 0, None, 0)
        for part in place:
            if isinstance(node, yaml.MappingNode):
                found = [(k, v) for k, v in node.value if str(k.value) == str(part)]
                if not found:
                    break
                key, node = found[-1]
                at_its_key = at_key or isinstance(node, yaml.CollectionNode)
                mark = key.start_mark if at_its_key else node.start_mark
            elif isinstance(node, yaml.SequenceNode) and isinstance(part, int) and part < len(node.value):
                node = node.value[part]
                mark = node.start_mark
            else:
                break
        return mark

    def _is_override(self, place: Place) -> bool:
        """The value at `place` was given from outside, or is missing in a group that was."""
        part: Any = self._overrides
        for depth, key in enumerate(place):
            if not isinstance(part, Mapping):
                return True
            if key not in part:
                return depth > 0 and at_place(self.own, place[:depth]) is None
            part = part[key]
        return bool(place)


def merged(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """`base` with the values of `over`, mapping by mapping; neither is changed."""
    result = dict(base)
    for key, value in over.items():
        old = result.get(key)
        if isinstance(old, Mapping) and isinstance(value, Mapping):
            value = merged(old, value)
        result[key] = value
    return result


def nested(values: Mapping[str, Any]) -> dict[str, Any]:
    """Values by dotted paths such as 'clips.count' as nested mappings."""
    result: dict[str, Any] = {}
    for path, value in values.items():
        for key in reversed(path.split(".")):
            value = {key: value}
        result = merged(result, value)
    return result


def at_place(data: Any, place: Sequence[str | int]) -> Any:
    """The value at `place`, None where there is none."""
    for part in place:
        try:
            data = data[part]
        except (KeyError, IndexError, TypeError):
            return None
    return data


def _message_of(error: Exception) -> str:
    """The message of a PyYAML error, on one line."""
    problem = getattr(error, "problem", None)
    context = getattr(error, "context", None)
    text = ", ".join(part for part in (context, problem) if part) or str(error)
    return " ".join(text.split())
