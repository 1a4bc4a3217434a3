"""Settings from outside a system folder: `--set`, `AMHE_*` variables, `--config` files.

`gathered` collects them; `Overrides.suited` makes of them what `System.load` needs for one system.

Keys are those of `core.settings.Settings` (`clips.length`), and `parameters.NAME....` and
`signals.NAME....` as in `system.yaml`. `System.load` refuses unknown ones, listing what exists.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from amhe_cli.core.errors import ConfigError
from amhe_cli.core.yaml_file import YamlFile, merged, scalar

if TYPE_CHECKING:
    from amhe_cli.core.settings import Settings

#: Start of an environment variable that is a setting, and what stands in it for the dot of `--set`.
PREFIX, SEPARATOR = "AMHE_", "__"
#: The one robot that has settings of its own: `robot:` in `system.yaml`.
_ROBOT = "go1"


@dataclass(frozen=True, slots=True)
class Overrides:
    """Settings from outside a system folder, as nested mappings.

    Args:
        shared: Those of the environment over those of a file; they may be meant for several systems.
        chosen: Those of `--set`.
    """

    shared: Mapping[str, Any]
    chosen: Mapping[str, Any]

    @property
    def all(self) -> dict[str, Any]:
        """All of them; `--set` wins."""
        return merged(self.shared, self.chosen)

    def suited(
        self, folder: Path, own: Mapping[str, Any] | None = None
    ) -> tuple[dict[str, Any], type[Settings]]:
        """The settings for one system, and the class that checks them.

        Shared settings of a robot that the system does not have are left out. The settings of its own robot
        are imported only where there is something to check.

        Args:
            folder: The system folder.
            own: Weaker settings, such as those that a log states.

        Raises:
            ConfigError: `--set` names a setting of a robot that the system does not have.
        """
        from amhe_cli.core.settings import Settings
        from amhe_cli.system.description.folders import FILE_NAME
        from amhe_cli.system.description.schema import robot_groups

        described = YamlFile(folder / FILE_NAME, patient=True).own
        foreign = set(robot_groups({"robot": _ROBOT})) - set(robot_groups(described))
        for group in sorted(foreign & set(self.chosen)):
            raise ConfigError(
                f"--set {_first_key(group, self.chosen[group])}: a setting of the robot {_ROBOT}, which the "
                f"system {folder.resolve().name} does not have; leave it out"
            )
        shared = {group: values for group, values in self.shared.items() if group not in foreign}
        settings = merged(own or {}, merged(shared, self.chosen))
        in_file = described.get("settings")
        present = {*settings, *(in_file if isinstance(in_file, Mapping) else ())}
        if described.get("robot") == _ROBOT and present & set(robot_groups(described)):
            from amhe_cli.robots.go1.settings import PushSettings

            return settings, PushSettings
        return settings, Settings


#: No settings from outside.
NONE = Overrides({}, {})


def groups() -> set[str]:
    """Groups of settings that any system has, and what `--set` sets besides."""
    from amhe_cli.core.settings import Settings
    from amhe_cli.system.description.schema import robot_groups

    return {*Settings.model_fields, *robot_groups({"robot": _ROBOT}), "boxes", "parameters", "signals"}


def gathered(config: Path | None, environment: Mapping[str, str], options: Iterable[str]) -> Overrides:
    """Settings of a file, of the environment, which wins over the file, and of `--set`."""
    file = YamlFile(config).data if config else {}
    return Overrides(merged(file, from_environment(environment)), parse_set(options))


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


def _nested(keys: list[str], value: Any) -> dict[str, Any]:
    for key in reversed(keys):
        value = {key: value}
    return value


def _first_key(name: str, value: Any) -> str:
    """Dotted name of the first setting in a group: `control.samples`."""
    while isinstance(value, Mapping) and value:
        key, value = next(iter(value.items()))
        name = f"{name}.{key}"
    return name
