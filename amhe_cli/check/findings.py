"""A finding: one doubt about a model or a log, with its size and what would cure it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Finding:
    """One doubt.

    Args:
        kind: What kind of doubt it is, one word for each, for programs.
        where: The body, joint, actuator or log that it is about.
        what: The doubt, in words with numbers.
        size: How far it is beyond what is plausible, a factor of 1 or more.
        cure: What would remove it.
    """

    kind: str
    where: str
    what: str
    size: float
    cure: str


def worst_first(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """The findings by their size, those of one kind together where they are alike."""
    groups: dict[tuple[str, str], list[Finding]] = {}
    for one in findings:
        groups.setdefault((one.kind, one.what), []).append(one)
    joined = [
        Finding(one.kind, _joined([other.where for other in alike]), one.what, one.size, one.cure)
        for alike in groups.values()
        for one in [max(alike, key=lambda other: other.size)]
    ]
    return tuple(sorted(joined, key=lambda one: -one.size))


def _joined(names: list[str]) -> str:
    return ", ".join(names[:6]) + (f" and {len(names) - 6} more" if len(names) > 6 else "")
