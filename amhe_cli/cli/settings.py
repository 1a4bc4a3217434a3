"""Settings from outside a system folder: `--set`, `AMHE_*` variables, `--config` files.

All of them become one nested mapping for `System.load`, by `gathered`.

Keys are those of `core.settings.Settings` (`clips.length`), and `parameters.NAME....` and
`signals.NAME....` as in `system.yaml`. `System.load` refuses unknown ones, listing what exists.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from amhe_cli.core.errors import ConfigError
from amhe_cli.core.yaml_file import YamlFile, merged, scalar

__all__ = ["from_environment", "from_file", "gathered", "merged", "parse_set"]

#: Start of an environment variable that is a setting, and what stands in it for the dot of `--set`.
PREFIX, SEPARATOR = "AMHE_", "__"


def gathered(config: Path | None, environment: Mapping[str, str], options: Iterable[str]) -> dict[str, Any]:
    """All overrides as one nested mapping, the strongest last: file, environment, `--set`."""
    settings = from_file(config) if config else {}
    settings = merged(settings, from_environment(environment))
    return merged(settings, parse_set(options))


def parse_set(options: Iterable[str]) -> dict[str, Any]:
    """Nested mapping of options `a.b=value`; the value is YAML, a later option wins.

    Raises:
        ConfigError: An option has no key or no '=', or its value is no YAML.
    """
    result: dict[str, Any] = {}
    for option in options:
        key, sign, text = option.partition("=")
        parts = key.strip().split(".")
        if not sign or not all(parts):
            raise ConfigError(f"--set {option!r}: write KEY=VALUE, for instance clips.count=32")
        result = merged(result, _nested(parts, scalar(text)))
    return result


def from_environment(environ: Mapping[str, str]) -> dict[str, Any]:
    """Nested mapping of the variables `AMHE_GROUP__KEY=value`.

    Two underscores separate levels, because keys have single ones: AMHE_CLIPS__HELD_OUT_LENGTH=0.4 is
    `clips.held_out_length`. Variables without two underscores are options of the command line, not ours.
    """
    result: dict[str, Any] = {}
    for name, text in sorted(environ.items()):
        parts = name.removeprefix(PREFIX).split(SEPARATOR)
        if name.startswith(PREFIX) and len(parts) > 1 and all(parts):
            group = parts[0].lower()
            # the names of parameters and signals are the user's own: their case is kept
            own = group in ("parameters", "signals") and not parts[1].isupper()
            keys = [group, parts[1] if own else parts[1].lower(), *(part.lower() for part in parts[2:])]
            result = merged(result, _nested(keys, scalar(text)))
    return result


def from_file(path: Path) -> dict[str, Any]:
    """Nested mapping of a YAML file such as `clips: {length: [0.3, 0.6]}`.

    Raises:
        ConfigError: It cannot be read, or is no mapping.
    """
    return YamlFile(path).data


def _nested(keys: list[str], value: Any) -> dict[str, Any]:
    for key in reversed(keys):
        value = {key: value}
    return value
