"""Results by what was changed: one value of one setting, all others at the operating point."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from amhe_cli.study.summary import Group, Groups


@dataclass(frozen=True, slots=True, eq=False)
class Ablation:
    """One setting over its values, in one task and mode.

    Args:
        path: Path of the setting.
        task, mode: Task and mode in which it was tried.
        values: Values of the setting, in order.
        groups: One group of runs for each value.
        default: Index of the operating point among them; None: it was not run.
    """

    path: str
    task: str
    mode: str
    values: tuple[Any, ...]
    groups: tuple[Group, ...]
    default: int | None


def ablations(groups: Groups, defaults: Mapping[str, Any]) -> list[Ablation]:
    """All ablations that were run.

    Args:
        groups: Groups of the study.
        defaults: Each setting's default, by its path.
    """
    base, found = dict(groups.base), dict[tuple[str, str, str], list[tuple[Any, Group]]]()
    for group in groups:
        other = dict(group.setting)
        changed = [path for path in base.keys() | other.keys() if base.get(path) != other.get(path)]
        if len(changed) == 1 and group.n:
            (path,) = changed
            value = other.get(path, defaults.get(path))
            found.setdefault((path, group.task, group.mode), []).append((value, group))
    made = []
    for (path, task, mode), tried in sorted(found.items()):
        at_base = groups.get(task, mode)
        if at_base and at_base.n:
            tried.append((base.get(path, defaults.get(path)), at_base))
        if all(isinstance(value, (int, float)) for value, _ in tried):
            tried.sort(key=lambda pair: pair[0])
        values, members = zip(*tried, strict=True)
        default = members.index(at_base) if at_base in members else None
        made.append(Ablation(path, task, mode, values, members, default))
    return made
