"""The library speaks of arguments, in backquotes; on the command line they are options."""

from __future__ import annotations

import re

#: Arguments whose option has another name; all others are called alike: `held_out` is --held-out.
_OTHERS = {
    "start": "--from",
    "end": "--to",
    "topics": "--topic",
    "seconds": "--for",
    "out": "-o",
    "logs": "LOG",
    "meshes": "--no-meshes",
    "packages": "--package",
}
_ALIKE = {
    "belief", "belief_anyway", "box", "checkpoint", "cluster", "config", "count", "duration", "fault", "fix",
    "force", "held_out", "host", "limit", "max_time", "method", "mocap_port", "mode", "msg_path", "only",
    "plant", "port", "pose", "pose_host", "pose_port", "posterior", "report", "resume", "seed", "slow",
    "system", "target", "task", "threads", "to", "update_period", "urdf", "video", "window", "workers",
}  # fmt: skip
#: Groups of settings: `logs.align=true` is --set logs.align=true.
_GROUPS = {"boxes", "clips", "control", "cost", "go1", "identify", "logs", "mhe", "probe"}
_QUOTED = re.compile(r"`([a-z_0-9]+)((?:\.\w+)*)(?:=([^`]*))?`")


def in_options(text: str) -> str:
    """A text of the library with its arguments written as options; other words in backquotes stay."""
    return _QUOTED.sub(_option, text)


def _option(match: re.Match[str]) -> str:
    name, rest, value = match.groups()
    if rest:
        setting = f"{name}{rest}" if value is None else f"{name}{rest}={value}"
        return f"--set {setting}" if name in _GROUPS else match.group()
    if name not in _ALIKE and name not in _OTHERS:
        return match.group()
    option = _OTHERS.get(name) or "--" + name.replace("_", "-")
    return option if value in (None, "True", "False") else f"{option} {value}"
