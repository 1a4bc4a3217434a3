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
from yaml.composer import Composer
from yaml.error import MarkedYAMLError

from amhe_cli.core.errors import ConfigError, printable
from amhe_cli.core.files import check_regular
from amhe_cli.core.limits import beyond, limits

#: Keys and list indices from the top of a file to one of its values.
Place = tuple[str | int, ...]

#: Levels that values may be nested.
_DEEPEST = 50
#: Mistakes of a file that are listed; a user mends no more at once.
_MOST_MISTAKES = 100
#: What is wrong with a file that is nested too deeply.
_TOO_DEEP = f"nested deeper than {_DEEPEST} levels, or within itself"


#: PyYAML's loader, with its parser in C where it has one; values are composed in Python, to be counted.
_BASES: Any = (Composer, yaml.CSafeLoader) if yaml.__with_libyaml__ else (yaml.SafeLoader,)


class _Loader(*_BASES):
    """SafeLoader with the scalars of YAML 1.2's core schema, within the limits of a file.

    A key that is given twice keeps its first value; `duplicates` has the others' places and what is wrong.
    """

    yaml_implicit_resolvers: dict = {}  # noqa: RUF012 (PyYAML's own registry, filled below)

    def __init__(self, text: str) -> None:
        _BASES[-1].__init__(self, text)
        Composer.__init__(self)
        self.duplicates: list[tuple[yaml.Mark, str]] = []
        # values so far, those of aliases each time; depth here; height of what the value here holds so far
        self._values, self._depth, self._height = 0, 0, 0
        self._sizes: dict[int, tuple[int, int]] = {}

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """Compose one value; refused where aliases unfold to too much, or where it is too deep."""
        event, before, beside = self.peek_event(), self._values, self._height
        mark, alias = event.start_mark, isinstance(event, yaml.AliasEvent)
        self._depth, self._height = self._depth + 1, 0
        self._check(mark)
        node = super().compose_node(parent, index)
        self._depth -= 1
        # an alias of what is not yet complete would unfold without end
        size, height = self._sizes.get(id(node), (0, _DEEPEST + 1)) if alias else (1, self._height + 1)
        self._values, self._height = self._values + size, max(beside, height)
        self._check(mark)
        if isinstance(node, yaml.ScalarNode) and not node.tag.endswith(":null"):
            node.end_mark = None  # nobody asks for it: it is a fifth of the memory
        if event.anchor is not None:  # the node lives as long as the loader, and keeps its id
            self._sizes[id(node)] = self._values - before, height
        return node

    def _check(self, mark: yaml.Mark) -> None:
        if self._values > limits().yaml_values:
            raise yaml.YAMLError(beyond("yaml_values", "its values are"))
        if self._depth + self._height > _DEEPEST:
            raise MarkedYAMLError(problem=_TOO_DEEP, problem_mark=mark)

    def compose_mapping_node(self, anchor: Any) -> yaml.MappingNode:
        """Compose a mapping without the keys that it has already."""
        node = super().compose_mapping_node(anchor)
        first: dict[str, int] = {}
        kept = []
        for key, value in node.value:
            name = str(key.value)
            if name in first and name != "<<":
                text = f"key {name!r} is here twice; its first value is in line {first[name]}"
                self.duplicates.append((key.start_mark, text))
            else:
                first.setdefault(name, key.start_mark.line + 1)
                kept.append((key, value))
        node.value = kept
        return node

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        """The value of a node; a tag such as !!bool may stand before anything."""
        try:
            return super().construct_object(node, deep)
        except (ValueError, TypeError, LookupError, AttributeError):
            text = f"{str(node.value)[:40]!r} is no {node.tag.rpartition(':')[2]}"
            raise yaml.constructor.ConstructorError(None, None, text, node.start_mark) from None


#: Pattern of a number that is no integer, by YAML 1.2's core schema.
_FLOAT = r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)"
for _tag, _pattern, _first in (
    ("bool", "true|True|TRUE|false|False|FALSE", "tTfF"),
    ("int", "[-+]?[0-9]+", "-+0123456789"),
    ("float", _FLOAT, "-+.0123456789"),
    ("null", "~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("merge", "<<", "<"),
):
    _Loader.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", re.compile(f"^(?:{_pattern})$"), list(_first))
# in decimal: `010` is ten, not eight
_Loader.add_constructor("tag:yaml.org,2002:int", lambda loader, node: int(loader.construct_scalar(node)))


class _Dumper(yaml.SafeDumper):
    """SafeDumper that also quotes what the loader would read as a number, such as a hash 056015197467."""

    yaml_implicit_resolvers: dict = {  # noqa: RUF012 (PyYAML's own registry)
        first: [
            *yaml.SafeDumper.yaml_implicit_resolvers.get(first, ()),
            *_Loader.yaml_implicit_resolvers.get(first, ()),
        ]
        for first in {*yaml.SafeDumper.yaml_implicit_resolvers, *_Loader.yaml_implicit_resolvers}
    }


def dumped(value: Any, *, width: int = 110, flow: bool = False) -> str:
    """A value as YAML that reads back as it was.

    Args:
        value: Plain values, lists and dictionaries.
        width: Characters of a line.
        flow: Everything in brackets.
    """
    return yaml.dump(
        value, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=width, default_flow_style=flow
    )


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
        self._more = False  # whether there are more mistakes than are listed
        loader, self._node = self._composed()
        for mark, text in loader.duplicates[:_MOST_MISTAKES]:
            self._note(mark, text)
        self._more = len(loader.duplicates) > _MOST_MISTAKES
        if not patient:
            self.raise_problems()
        self.own: dict[str, Any] = {} if self._node is None else self._constructed(loader, self._node)
        if not isinstance(self.own, dict):
            raise ConfigError(f"{path}:1:1: this file must be a mapping of keys to values")
        self.data = merged(self.own, self._overrides)

    def problem(self, place: Place, text: str, at_key: bool = False) -> None:
        """Note a mistake at the value, or key, that `place` names; `raise_problems` reports them."""
        if len(self._problems) >= _MOST_MISTAKES:
            self._more = True
            return
        if self._is_override(place):
            name = ".".join(map(str, place)).removeprefix("settings.")
            self._problems[f"setting {name}: {text}"] = (-1, 0)
            return
        self._note(self._mark(place, at_key), text)

    def _note(self, mark: yaml.Mark, text: str) -> None:
        self._problems[f"{self._at(mark)}: {text}"] = (mark.line, mark.column)

    def _at(self, mark: yaml.Mark) -> str:
        return f"{self.path}:{mark.line + 1}:{mark.column + 1}"

    def raise_problems(self) -> None:
        """Raise one ConfigError with a line for each mistake, in the file's order; of many, the first."""
        if self._problems:
            lines = sorted(self._problems, key=lambda text: self._problems[text])
            raise ConfigError("\n".join(lines + self._more * [f"{self.path}: there are more mistakes"]))

    def _composed(self) -> tuple[_Loader, yaml.Node | None]:
        check_regular(self.path)
        try:
            if self.path.stat().st_size > limits().yaml_mib * 2**20:
                raise ConfigError(f"{self.path}: {beyond('yaml_mib', 'its size is')}")
            loader = _Loader(self.path.read_text(encoding="utf-8"))
            return loader, loader.get_single_node()
        except OSError as error:
            raise ConfigError(f"{self.path}: {error.strerror or error}") from None
        except UnicodeDecodeError:
            raise ConfigError(f"{self.path}: not a text file (UTF-8)") from None
        except yaml.YAMLError as error:
            mark = getattr(error, "problem_mark", None)
            where = self._at(mark) if mark else self.path
            raise ConfigError(f"{where}: not valid YAML: {_message_of(error)}") from None

    def _constructed(self, loader: _Loader, node: yaml.Node) -> Any:
        try:
            return loader.construct_document(node)
        except (yaml.YAMLError, ValueError, TypeError) as error:
            mark = getattr(error, "problem_mark", None) or node.start_mark
            raise ConfigError(f"{self._at(mark)}: not valid YAML: {_message_of(error)}") from None

    def _mark(self, place: Place, at_key: bool) -> yaml.Mark:
        """Start of the deepest part of `place` that the file has."""
        node, mark = self._node, yaml.Mark(str(self.path), 0, 0, 0, None, 0)
        for part in place:
            if isinstance(node, yaml.MappingNode):
                pairs = [(k, v) for k, v in node.value if str(k.value) == str(part)]
                if not pairs:
                    break
                key, node = pairs[-1]
                at_its_key = at_key or isinstance(node, yaml.CollectionNode)
                mark = key.start_mark if at_its_key else node.start_mark
            elif isinstance(node, yaml.SequenceNode) and isinstance(part, int) and part < len(node.value):
                node = node.value[part]
                mark = node.start_mark
            else:
                break
        return mark

    def with_entries(self, group: str, entries: Sequence[tuple[str, Any, str]]) -> str:
        """The file's text with more entries at the start of a group, all else as it is.

        A mapping that the group has already is merged with the new one where it stands.

        Args:
            group: Key of a mapping at the top; made at the end where the file has none.
            entries: Name, value, and a comment of one line above them ('': none).
        """
        text = self.path.read_text(encoding="utf-8")
        pairs = self._node.value if isinstance(self._node, yaml.MappingNode) else []
        key, node = next((pair for pair in pairs if pair[0].value == group), (None, None))
        flowing = isinstance(node, yaml.MappingNode) and bool(node.flow_style)
        inside = node.value if isinstance(node, yaml.MappingNode) else []
        first = inside[0][0].start_mark if inside else None
        indent = " " * (first.column if first and not flowing else 2)
        here = {one.value: value for one, value in inside}
        more = {name: (value, comment) for name, value, comment in reversed(entries)}
        for name in sorted(here.keys() & more, key=lambda name: -here[name].start_mark.index):
            value, comment = more.pop(name)
            start, end, deeper = here[name].start_mark.index, here[name].end_mark.index, f"\n{2 * indent}"
            own = text[start:end].splitlines(keepends=True)
            while own and own[-1].strip()[:1] in ("", "#"):  # it is about what follows
                del own[-1]
            end = start + len("".join(own).rstrip())
            said = f"{deeper}# {printable(comment)}" * bool(comment)
            changed = f"{said}{deeper}{flow(merged(self.own[group][name] or {}, value))}"
            text = text[:start].rstrip() + changed + text[end:]
        new = "".join(
            f"{indent}# {printable(comment)}\n" * bool(comment)
            + f"{indent}{flow(name)}: {flow(value)}{',' * flowing}\n"
            for name, (value, comment) in reversed(more.items())
        )
        if not new:
            return text
        lines = text.splitlines(keepends=True)
        if key is None or node is None:
            return "".join(lines).rstrip("\n") + f"\n\n{group}:\n{new}"
        if first and not flowing:  # before comments about the first entry
            lines.insert(key.start_mark.line + 1, new)
            return "".join(lines)
        at = node.start_mark  # a bracket, or where a value would be
        column = at.column + flowing
        before, after = lines[at.line][:column], lines[at.line][column:]
        lines[at.line] = f"{before}\n{new + indent if flowing else new.removesuffix(chr(10))}{after}"
        return "".join(lines)

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


def flow(value: Any) -> str:
    """A value on one line of YAML."""
    plain = dict(value) if isinstance(value, Mapping) else value
    text = dumped(plain, width=10**9, flow=True)
    return text.removesuffix("\n").removesuffix("\n...").strip()


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
