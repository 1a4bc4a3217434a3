"""From a system folder to a `System`, with every mistake of its file in one error."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mujoco

import amhe_cli
from amhe_cli.core.errors import ConfigError, one_of
from amhe_cli.core.settings import MheSettings
from amhe_cli.core.yaml_file import YamlFile, merged
from amhe_cli.system.boxes import resize_boxes
from amhe_cli.system.cautions import caution
from amhe_cli.system.channels import draft_wiring
from amhe_cli.system.model_file import compiled, read_spec
from amhe_cli.system.schema import SystemEntry, keys_at, validated
from amhe_cli.system.system import System
from amhe_cli.system.targets import id_of
from amhe_cli.system.unknowns import generalise, unknowns_of

logger = logging.getLogger(__name__)

#: The file that makes a folder a system.
FILE_NAME = "system.yaml"
#: Keys of `system.yaml` that overrides name directly; every other override is a setting.
_OWN_KEYS = ("parameters", "signals", "keyframe", "model", "boxes")


def bundled_root() -> Path:
    """Folder that holds `models` and `examples/logs`: inside a wheel, or the top of a checkout."""
    package = Path(amhe_cli.__file__).parent
    inside = package / "_bundled"
    return inside if inside.is_dir() else package.parent


def bundled_systems() -> dict[str, Path]:
    """Names and folders of the systems that come with amhe."""
    return {p.parent.name: p.parent for p in sorted((bundled_root() / "models").glob(f"*/{FILE_NAME}"))}


def find_system(name_or_dir: str) -> Path:
    """Folder of a system: a path to it, or the name of a bundled one.

    Raises:
        ConfigError: Neither exists; the text lists the bundled ones.
    """
    folder = Path(name_or_dir).expanduser()
    if (folder / FILE_NAME).is_file():
        return folder
    if folder.name == FILE_NAME and folder.is_file():
        return folder.parent
    bundled = bundled_systems()
    if name_or_dir in bundled:
        return bundled[name_or_dir]
    if folder.is_dir():
        raise ConfigError(f"{folder}: no {FILE_NAME} in this folder; `amhe init` writes one")
    raise ConfigError(f"{one_of('system', name_or_dir, bundled)} (or any folder with a {FILE_NAME})")


def load_system(folder: Path, overrides: Mapping[str, Any] | None = None, *, warn: bool = True) -> System:
    """Read, check and compile a system.

    Args:
        folder: The system folder.
        overrides: Nested settings that replace the folder's own, and `parameters` or `signals` parts of
            its file; see `overrides`.
        warn: Log what is allowed but will not do what it seems to.

    Raises:
        ConfigError: One line for each mistake, `file:line:column: what, what would be valid`.
    """
    folder = Path(folder)
    file = YamlFile(folder / FILE_NAME, _placed(overrides or {}), patient=True)
    _check_names(file, overrides or {})
    entry = validated(file)
    spec = None if entry is None else _spec(file, folder / entry.model, entry)
    if entry is None or spec is None:
        file.raise_problems()
        raise ConfigError(f"{file.path}: not a system")
    generalise(spec, entry)
    plain = _compiled(file, spec)
    draft = draft_wiring(file, entry, spec, plain)
    keyframe = _keyframe(file, entry, plain)
    unknowns_of(file, entry, plain)
    _refuse_strangers(file, entry)
    file.raise_problems()
    for name, parameter in entry.parameters.items():
        if not draft.has_commands() and any(target.set == "command_delay" for target in parameter.targets):
            file.problem(
                ("parameters", name), "a command delay changes nothing: no signal commands actuators"
            )
    file.raise_problems()
    base = _compiled(file, spec)
    space, edits = unknowns_of(file, entry, base)
    wiring = draft.wired(base)
    model = edits.apply(base, space.nominal)
    if warn:
        caution(str(file.path), base, edits)
        _warn_of_unset(str(file.path), draft.unset_joints(), keyframe)
        _warn_of_idle(overrides or {}, entry.settings.mhe)
    return System(
        name=folder.resolve().name,
        folder=folder,
        model_path=folder / entry.model,
        spec=spec,
        model=model,
        space=space,
        edits=edits,
        signals=wiring.signals,
        channels=wiring.channels,
        inputs=wiring.inputs,
        input_spec=wiring.input_spec,
        settings=entry.settings,
        keyframe=keyframe,
    )


def _refuse_strangers(file: YamlFile, entry: SystemEntry) -> None:
    """Settings by parameter are of parameters that there are."""
    mhe, identify = entry.settings.mhe, entry.settings.identify
    for group, setting, given in (
        ("mhe", "prior_weight", mhe.prior_weight),
        ("mhe", "systematic", mhe.systematic),
        ("identify", "model_error", identify.model_error),
    ):
        for name in set(given) - set(entry.parameters):
            file.problem(("settings", group, setting, name), one_of("parameter", name, entry.parameters))


def _warn_of_unset(where: str, joints: list[str], keyframe: int | None) -> None:
    if joints and keyframe is None:
        logger.warning(
            "%s: no signal gives the state of joint %s: it starts each clip at zero; give one, or a keyframe",
            where,
            ", ".join(joints),
        )


def _warn_of_idle(overrides: Mapping[str, Any], mhe: MheSettings) -> None:
    for name in mhe.idle(overrides.get("mhe") or ()):
        logger.warning("mhe.%s does nothing with the method %s", name, mhe.method)


def _placed(overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Overrides in the places of `system.yaml` that they replace.

    Raises:
        ConfigError: There is no such setting.
    """
    own = {key: value for key, value in overrides.items() if key in _OWN_KEYS}
    settings = {key: value for key, value in overrides.items() if key not in _OWN_KEYS}
    known = keys_at(SystemEntry, ("settings",)) or []
    for key in settings:
        if key not in known:
            raise ConfigError(one_of("setting", key, [*known, "parameters", "signals", "keyframe", "boxes"]))
    return merged(own, {"settings": settings}) if settings else own


def _check_names(file: YamlFile, overrides: Mapping[str, Any]) -> None:
    """Refuse overrides of parameters and signals that the file does not have."""
    for group in ("parameters", "signals"):
        known, given = file.own.get(group), overrides.get(group)
        if not isinstance(known, Mapping) or not isinstance(given, Mapping):
            continue
        for name in set(given) - set(known):
            raise ConfigError(f"setting {group}.{name}: {one_of(group[:-1], str(name), map(str, known))}")


def _spec(file: YamlFile, path: Path, entry: SystemEntry) -> mujoco.MjSpec | None:
    if not path.is_file():
        file.problem(("model",), f"no file {entry.model!r} beside this one; give an MJCF or a URDF")
        return None
    try:
        spec = read_spec(path)
    except ConfigError as error:
        file.problem(("model",), str(error))
        return None
    try:
        resize_boxes(spec, entry.boxes)
    except ConfigError as error:
        file.problem(("boxes",), str(error))
    return spec


def _compiled(file: YamlFile, spec: mujoco.MjSpec) -> mujoco.MjModel:
    try:
        return compiled(spec)
    except ConfigError as error:
        file.problem(("model",), str(error))
        file.raise_problems()
        raise


def _keyframe(file: YamlFile, entry: SystemEntry, model: mujoco.MjModel) -> int | None:
    if entry.keyframe is None:
        return None
    try:
        return id_of(model, "keyframe", entry.keyframe)
    except ConfigError as error:
        file.problem(("keyframe",), str(error))
        return None
