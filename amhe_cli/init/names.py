"""Matching the names in a log to the names in a model."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence

#: Words for a kind of thing, which do not say which one it is.
KINDS = {
    "joint",
    "jnt",
    "link",
    "body",
    "motor",
    "actuator",
    "act",
    "servo",
    "frame",
    "site",
    "free",
    "freejoint",
}
#: Words in the name of a topic or column that holds commands.
COMMANDS = {
    *("cmd", "cmds", "command", "commands", "commanded", "goal", "goals", "desired", "target", "targets"),
    *("setpoint", "setpoints", "reference", "ref", "control", "controls", "ctrl", "action", "actions"),
}


def words(name: str) -> list[str]:
    """Lower-case words of a name: '/leftArm/shoulder_pan-joint' has left, arm, shoulder, pan, joint."""
    spaced = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name)
    return [word for word in re.split(r"[^a-z0-9]+", spaced.lower()) if word]


def core(name: str) -> str:
    """A name without its namespace and without the words for its kind."""
    parts = words(name.rsplit("/", 1)[-1])
    return "_".join(word for word in parts if word not in KINDS) or "_".join(parts)


def is_command(topic: str, kind: str) -> bool:
    """Whether a topic carries commands, judged by its name and type."""
    return kind.endswith("JointTrajectory") or bool(COMMANDS & set(words(topic)))


def matched(own: Mapping[str, Sequence[str]], logged: Iterable[str]) -> dict[str, str]:
    """Model name -> log name.

    Equal names first, then equal cores, then one core that ends with the other; never one log name
    twice, never a choice between two.

    Args:
        own: Model name -> names that the log may use for it (its own, its joint's, ...).
        logged: Names in the log.
    """
    free = list(dict.fromkeys(logged))
    pairs: dict[str, str] = {}
    for alike in (_equal, _equal_cores, _ends_alike):
        for name, aliases in own.items():
            if name in pairs:
                continue
            candidates = [other for other in free if any(alike(alias, other) for alias in aliases)]
            if len(candidates) == 1:
                pairs[name] = candidates[0]
                free.remove(candidates[0])
    return {name: pairs[name] for name in own if name in pairs}


def names_the_same(body: str, topic_words: Sequence[str]) -> bool:
    """Whether all words of a body's name, without those for its kind, are in the name of a topic or frame."""
    wanted = words(core(body))
    return bool(wanted) and set(wanted) <= set(topic_words)


def _equal(a: str, b: str) -> bool:
    return a == b


def _equal_cores(a: str, b: str) -> bool:
    return core(a) == core(b)


def _ends_alike(a: str, b: str) -> bool:
    short, long = sorted((core(a), core(b)), key=len)
    return long.endswith(f"_{short}")
