"""Reasons of verdicts that several parameters share, said once."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from amhe_cli.estimation.core.result import ParameterResult

#: A reason of so many parameters is said below their table, not in each row.
MANY = 3

_NUMBER = re.compile(r"\d+(?:\.\d+)?(?:e-?\d+)?%?")


@dataclass(frozen=True, slots=True)
class Shared:
    """A reason of several parameters, which may differ in numbers.

    Args:
        pattern: The reason without its numbers.
        text: The reason; a number that differs is a range.
        names: The parameters.
        owners: The parameters, each with the numbers of its own in brackets.
    """

    pattern: str
    text: str
    names: tuple[str, ...]
    owners: tuple[str, ...]


def merged(reasons: Iterable[tuple[str, str]]) -> list[Shared]:
    """Names and reasons of parameters, those together that differ in numbers alone."""
    groups: dict[str, list[tuple[str, str]]] = {}
    for name, reason in reasons:
        groups.setdefault(_pattern(reason), []).append((name, reason))
    return [_shared(pattern, group) for pattern, group in groups.items()]


def common_reasons(parameters: Sequence[ParameterResult]) -> list[Shared]:
    """The reasons that `MANY` parameters have, the most frequent first."""
    found = merged((p.name, reason) for p in parameters for reason in _texts(p))
    return sorted((one for one in found if len(one.names) >= MANY), key=lambda one: -len(one.names))


def own_reasons(parameter: ParameterResult, common: Sequence[Shared]) -> tuple[list[str], list[int]]:
    """The reasons that only a parameter has, and the places, from 1, of those that it shares."""
    places = {one.pattern: place for place, one in enumerate(common, 1)}
    texts = _texts(parameter)
    alone = [text for text in texts if _pattern(text) not in places]
    return alone, sorted(places[_pattern(text)] for text in texts if text not in alone)


def _texts(parameter: ParameterResult) -> list[str]:
    return [reason.text for reason in parameter.reasons]


def _pattern(reason: str) -> str:
    """A reason without its numbers."""
    return _NUMBER.sub(lambda number: "#%" if number[0].endswith("%") else "#", reason)


def _shared(pattern: str, group: Sequence[tuple[str, str]]) -> Shared:
    columns = list(zip(*(_NUMBER.findall(reason) for _, reason in group), strict=True))
    ranges = iter(map(_range, columns))
    text = _NUMBER.sub(lambda _: next(ranges), group[0][1])
    own = list(zip(*(column for column in columns if len(set(column)) > 1), strict=True))
    names = tuple(name for name, _ in group)
    owners = (
        (f"{name} ({', '.join(numbers)})" for name, numbers in zip(names, own, strict=True)) if own else names
    )
    return Shared(pattern, text, names, tuple(owners))


def _range(column: Sequence[str]) -> str:
    """'2.9 to 7.9' of numbers that differ."""
    least, *_, most = sorted((*column, column[0]), key=lambda number: float(number.rstrip("%")))
    return most if least == most else f"{least.removesuffix('%')} to {most}"
