"""What a file of another shape has wrong: the mistakes that pydantic finds, in words, each at its place."""

from __future__ import annotations

import types
from collections.abc import Iterator, Mapping
from itertools import islice
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError

from amhe_cli.core.errors import one_of
from amhe_cli.core.yaml_file import Place, YamlFile, at_place

#: Lengths of the starts of mappings and lists that are looked at where there are more mistakes than the last:
#: each costs a kilobyte.
_STARTS = 200, 2_000
#: Mistakes of a whole collection, which its start may have without it.
_OF_ALL = ("missing", "value_error", "too_short")


M = TypeVar("M", bound=BaseModel)


def validated(file: YamlFile, model: type[M], examples: Mapping[str, str] | None = None) -> M:
    """The content of a file as a model; for `examples` see `mistakes`.

    Raises:
        ConfigError: It has another shape; one line for each mistake.
    """
    try:
        return model.model_validate(file.data)
    except ValidationError as error:
        for mistake in mistakes(error, model, file.data, examples or {}):
            file.problem(*mistake)
        file.raise_problems()
        raise


def mistakes(
    error: ValidationError, model: Any, data: Any, examples: Mapping[str, str]
) -> Iterator[tuple[Place, str, bool]]:
    """The place of each mistake, what is wrong there, and whether that is the key.

    Args:
        error: What validating found.
        model: The model of the content.
        data: The content.
        examples: Keys whose shape is best explained by an example -> what would be valid.
    """
    by_place: dict[Place, list[Any]] = {}
    for mistake in _listed(error, model, data):
        by_place.setdefault(tuple(_real(data, mistake["loc"])), []).append(mistake)
    for place, here in by_place.items():
        yield place, _in_words(here, place, data, model, examples), here[0]["type"] == "extra_forbidden"


def _listed(error: ValidationError, model: Any, data: Any) -> list[Any]:
    """What validating found; where that is very much, only what it finds in the start of each collection."""
    for length in _STARTS if error.error_count() > _STARTS[-1] else ():
        try:
            model.model_validate(_start(data, length))
        except ValidationError as fewer:  # what the start lacks may come later
            found = [one for one in fewer.errors(include_url=False) if one["type"] not in _OF_ALL]
            if found:
                return found
    return error.errors(include_url=False)


def _start(data: Any, length: int) -> Any:
    """The data with no more than so many entries in each mapping and list."""
    if isinstance(data, Mapping):
        return {key: _start(value, length) for key, value in islice(data.items(), length)}
    return [_start(value, length) for value in data[:length]] if isinstance(data, list) else data


def _keys_at(model: Any, place: Place) -> list[str]:
    """Keys that a mapping at `place` may have; none where any key may stand."""
    options = [model]
    for part in place:
        options = [inner for option in options for inner in _step(option, part)]
    return [name for option in options if _is_model(option) for name in _fields(option)]


def _fields(model: type[BaseModel]) -> dict[str, Any]:
    """Types of a model's fields, by their names in a file."""
    return {field.alias or name: field.annotation for name, field in model.model_fields.items()}


def _step(annotation: Any, part: str | int) -> Iterator[Any]:
    """Types of the member `part` of a type."""
    for option in _options(annotation):
        if _is_model(option) and part in _fields(option):
            yield from _options(_fields(option)[str(part)])
        elif get_origin(option) in (dict, list):
            yield from _options(get_args(option)[-1])


def _options(annotation: Any) -> Iterator[Any]:
    """Members of a union, without Annotated."""
    origin = get_origin(annotation)
    if origin is Annotated:
        yield from _options(get_args(annotation)[0])
    elif origin in (Union, types.UnionType):
        for option in get_args(annotation):
            yield from _options(option)
    else:
        yield annotation


def _is_model(annotation: Any) -> bool:
    return isinstance(annotation, type) and issubclass(annotation, BaseModel)


def _real(data: Any, place: Place) -> Iterator[str | int]:
    """`place` without the names of union members that pydantic puts between real keys."""
    walked: list[str | int] = []
    for index, part in enumerate(place):
        here = at_place(data, walked)
        last = index == len(place) - 1
        if isinstance(here, list):
            exists = isinstance(part, int) and part < len(here)
        else:
            exists = isinstance(here, Mapping) and part in here
        if exists or (last and isinstance(here, Mapping) and part != "[key]"):
            walked.append(part)
            yield part


#: What would be valid, in place of pydantic's names for its types; `{}` is the limit.
_VALID = {
    "string_type": "a word",
    "string_too_short": "a name",
    "list_type": "a list",
    "dict_type": "a mapping of names",
    "model_type": "a mapping of keys to values",
    "model_attributes_type": "a mapping of keys to values",
    "tuple_type": "a list of two numbers",
    "bool_type": "true or false",
    "bool_parsing": "true or false",
    "finite_number": "a finite number",
    "int_from_float": "a whole number",
    "greater_than": "a number above {}",
    "greater_than_equal": "a number of at least {}",
    "less_than": "a number below {}",
    "too_short": "at least {} of them",
    "too_long": "at most {} of them",
}
#: Names that pydantic has for a type's limit.
_LIMITS = ("gt", "ge", "lt", "le", "min_length", "max_length")
#: Mistakes of a shape, which an example explains best.
_SHAPES = ("dict_type", "list_type", "tuple_type", "too_short", "too_long", "missing")


def _in_words(mistakes: list[Any], place: Place, data: Any, model: Any, examples: Mapping[str, str]) -> str:
    """What is wrong, and what would be valid; a union of types has one mistake for each member."""
    kind, value = mistakes[0]["type"], at_place(data, place)
    label = _label(place)
    if kind == "extra_forbidden":
        return one_of("key", str(place[-1]), _keys_at(model, place[:-1]))
    if label in examples and value is not None and any(mistake["type"] in _SHAPES for mistake in mistakes):
        return f"{label} is {value!r}; {examples[label]} would be valid"
    if kind == "missing":
        return f"{'.'.join(map(str, place[:-1])) or 'this file'} lacks the key {str(place[-1])!r}"
    if kind == "value_error":
        message = str(mistakes[0]["ctx"]["error"])
        return message if isinstance(value, Mapping) else f"{label} {message}"
    if kind in ("float_type", "float_parsing", "int_type", "int_parsing"):
        quoted = " (without quotes)" if isinstance(value, str) else ""
        return f"{label} is {value!r}; a number{quoted} would be valid"
    valid = " or ".join(dict.fromkeys(_valid(mistake) for mistake in mistakes))
    return f"{label} is {'empty' if value in ([], {}, '') else repr(value)}; {valid} would be valid"


def _label(place: Place) -> str:
    """The user's name for the value at `place`: its key, with the index if it is in a list."""
    if not place:
        return "this file"
    return str(place[-1]) if isinstance(place[-1], str) else f"{_label(place[:-1])}[{place[-1]}]"


def _valid(mistake: Any) -> str:
    limits = [value for key, value in mistake.get("ctx", {}).items() if key in _LIMITS]
    if mistake["type"] not in _VALID:
        return str(mistake["msg"]).removeprefix("Input should be ")
    return _VALID[mistake["type"]].format(*(f"{limit:g}" for limit in limits))
