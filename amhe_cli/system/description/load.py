"""What a `System` is made of, from a system folder or from a model and arguments; all mistakes at once."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import yaml
from pydantic import BaseModel

from amhe_cli.core.errors import NOTE, ConfigError, one_of
from amhe_cli.core.settings import Settings
from amhe_cli.core.yaml_file import Place, YamlFile, merged
from amhe_cli.system.description.cautions import caution
from amhe_cli.system.description.data import SystemData
from amhe_cli.system.description.efforts import matching_efforts, unpowered, unpowered_text, windowed
from amhe_cli.system.description.folders import FILE_NAME, find_system
from amhe_cli.system.description.parameters import generalise, unknowns_of
from amhe_cli.system.description.schema import Description, SystemEntry, robot_groups, validated
from amhe_cli.system.description.wiring import draft_wiring
from amhe_cli.system.model.elements import id_of, matching_rows
from amhe_cli.system.model.files import compiled, read_spec, resize_boxes, spec_of
from amhe_cli.system.model.urdf import UrdfOptions, is_urdf

logger = logging.getLogger(__name__)

#: Keys of `system.yaml` that overrides name directly; every other override is a setting.
_OWN_KEYS = ("parameters", "signals", "keyframe", "model", "boxes", "match", "unknowns")


def load(
    name_or_folder: str | Path, settings: Mapping[str, Any] | None, schema: type[Settings], *, warn: bool
) -> SystemData:
    """See `System.load`."""
    folder, overrides = find_system(name_or_folder), settings or {}
    file = YamlFile(folder / FILE_NAME, _placed(overrides), patient=True)
    _check_names(file, overrides, schema)
    file.data = _without(file.data, overrides)
    entry = validated(file, schema)
    spec = None if entry is None else _spec(file, folder / entry.model, entry)
    if entry is None or spec is None:
        file.raise_problems()
        raise ConfigError(f"{file.path}: not a system")
    text = file.path.read_text(encoding="utf-8")
    loaded = _built(file, str(file.path), entry, spec, text, warn)
    mhe = loaded.settings.mhe
    for name in mhe.idle(overrides.get("mhe") or ()) if warn else ():
        logger.warning("mhe.%s does nothing with the method %s", name, mhe.method)
    given = file.data.get("settings") or {}
    groups = [name for name in robot_groups(file.own) if name in given and name not in schema.model_fields]
    if warn and groups:
        logger.warning(
            "%s: settings of the robot %s (%s) were not checked: no class that has them was given as schema",
            file.path,
            file.own["robot"],
            ", ".join(groups),
        )
    return replace(loaded, name=folder.resolve().name, folder=folder, given=overrides)


def described(
    model: mujoco.MjSpec | str | Path,
    description: Mapping[str, Any],
    name: str | None,
    urdf: UrdfOptions,
    *,
    warn: bool,
) -> SystemData:
    """See `System.from_model`; `description` has the keys of a `system.yaml`, without its model."""
    spec = spec_of(model, urdf)
    default_name = Path(model).stem if isinstance(model, str | Path) else spec.modelname
    signals = {key: _with_topic(key, signal) for key, signal in description["signals"].items()}
    arguments = Arguments({**description, "model": name or default_name, "signals": signals})
    entry = validated(arguments)
    arguments.raise_problems()
    assert entry is not None, "no mistake was noted"
    text = entry.model_dump_json(indent=2, exclude_defaults=True) + "\n"  # JSON is YAML too
    return _built(arguments, entry.model, entry, spec, text, warn)


def matched(data: SystemData, match: str) -> SystemData:
    """See `System.matching`."""
    assert data.original is not None, "specs are only left out for other processes"
    given = _without(merged(yaml.safe_load(data.text), _placed(data.given)), data.given)
    own = {key: value for key, value in given.items() if key not in ("boxes", "model", "match")}
    arguments = Arguments({**own, "model": data.name, "match": match})
    entry = validated(arguments, type(data.settings))
    arguments.raise_problems()
    assert entry is not None, "no mistake was noted"
    made = _built(arguments, data.name, entry, data.original.copy(), data.text, False)
    return replace(made, folder=data.folder, given={**data.given, "match": match})


class Arguments:
    """Arguments that describe a system, and the mistakes found in them; see `schema.Description`.

    Args:
        data: The arguments by name; models of pydantic become mappings of what was set in them.
    """

    def __init__(self, data: Mapping[str, Any]) -> None:
        self.data: dict[str, Any] = _plain(data)
        self._problems: dict[str, None] = {}

    def problem(self, place: Place, text: str, at_key: bool = False) -> None:
        """Note a mistake, with the path of its key such as `parameters.mass.targets[0]`."""
        path = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in place)
        self._problems[f"{path.removeprefix('.')}: {text}"] = None

    def raise_problems(self) -> None:
        """Raise one ConfigError that lists every noted mistake, a line each."""
        if self._problems:
            raise ConfigError("\n".join(self._problems))


def _plain(value: Any) -> Any:
    if isinstance(value, BaseModel):
        return value.model_dump(exclude_unset=True)
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, list | tuple) else value


def _with_topic(name: str, signal: Any) -> Any:
    """Arrays have no topics: where none is given, and no columns of a table, it is the signal's name."""
    given = _plain(signal)
    named = not isinstance(given, Mapping) or "columns" in given
    return given if named else {"topic": f"/{name}", **given}


def _built(
    source: Description, name: str, entry: SystemEntry, spec: mujoco.MjSpec, text: str, warn: bool
) -> SystemData:
    """Compile a system, which has no folder, from its description.

    Args:
        source: Keeps the mistakes that are found.
        name: Name of the system, and of the description in warnings.
        entry: The description, validated.
        spec: The model as it was given; sensors are added to it.
        text: See `SystemData`.
        warn: Log what is allowed but will not do what it seems to.
    """
    original = spec.copy()
    generalise(spec, entry)
    draft = draft_wiring(source, entry, spec, _compiled(source, spec))
    base = _compiled(source, spec)
    wiring = draft.wired(base)
    commands, off = draft.commanded(wiring), unpowered(wiring, base)
    width = mujoco.mj_stateSize(base, wiring.input_spec) if commands else 1
    base.actuator_gainprm[off], base.actuator_biasprm[off] = 0.0, 0.0
    base.jnt_actfrclimited[base.actuator_trnid[off, 0]] = False  # that is theirs
    if entry.match == "effort":
        wiring = matching_efforts(source, entry.signals, wiring, base)
    calibrated = draft.calibrated(entry.signals, wiring, base)
    space, edits, calibration = unknowns_of(source, entry, base, calibrated, commands, width)
    keyframe = _keyframe(source, entry, base)
    _refuse_strangers(source, entry, base)
    source.raise_problems()
    for late, parameter in entry.parameters.items():
        if not commands and any(target.set == "command_delay" for target in parameter.targets):
            why = "a command delay changes nothing: no signal commands actuators"
            source.problem(("parameters", late), why)
    source.raise_problems()
    if warn:
        caution(name, base, edits)
        if keyframe is None and (joints := draft.unset_joints()):
            why = "it starts each clip at zero; give one, or a keyframe"
            logger.warning(f"{name}: no signal gives the state of joint {', '.join(joints)}: {why}")
        if off:
            logger.log(NOTE, unpowered_text([base.actuator(row).name or f"number {row}" for row in off]))
    return SystemData(
        name=name,
        folder=None,
        text=text,
        original=original,
        spec=spec,
        model=edits.apply(base, space.nominal),
        space=space,
        edits=edits,
        signals=wiring.signals,
        channels=wiring.channels,
        inputs=wiring.inputs,
        input_spec=wiring.input_spec,
        settings=windowed(entry.settings) if entry.match == "effort" else entry.settings,
        keyframe=keyframe,
        calibration=calibration,
        match=entry.match,
    )


def _refuse_strangers(file: Description, entry: SystemEntry, model: mujoco.MjModel) -> None:
    """Refuse settings of parameters and joints that do not exist."""
    for pattern in entry.settings.identify.geared:
        try:
            matching_rows(model, "joint", pattern)
        except ConfigError as error:
            file.problem(("settings", "identify", "geared"), str(error))
    mhe, identify = entry.settings.mhe, entry.settings.identify
    for group, setting, given in (
        ("mhe", "prior_weight", mhe.prior_weight),
        ("mhe", "systematic", mhe.systematic),
        ("identify", "model_error", identify.model_error),
    ):
        for name in set(given) - set(entry.parameters):
            file.problem(("settings", group, setting, name), one_of("parameter", name, entry.parameters))


def _placed(overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Overrides in the places of `system.yaml` that they replace."""
    top_level = {key: value for key, value in overrides.items() if key in _OWN_KEYS}
    settings = {key: value for key, value in overrides.items() if key not in _OWN_KEYS}
    return merged(top_level, {"settings": settings}) if settings else top_level


def _without(given: dict[str, Any], overrides: Mapping[str, Any]) -> dict[str, Any]:
    """A description without the parameters that an override sets to nothing."""
    own = overrides.get("parameters")
    if not isinstance(own, Mapping) or None not in own.values():
        return given
    left = {name: entry for name, entry in given["parameters"].items() if own.get(name, entry) is not None}
    return given | {"parameters": left}


def _check_names(file: YamlFile, overrides: Mapping[str, Any], schema: type[Settings]) -> None:
    """Refuse overrides of settings that do not exist, and of parameters and signals that the file lacks."""
    known = list(dict.fromkeys((*schema.model_fields, *robot_groups(file.own))))
    for key in overrides:
        if key not in (*_OWN_KEYS, *known):
            raise ConfigError(one_of("setting", key, [*known, "parameters", "signals", "keyframe", "boxes"]))
    for group in ("parameters", "signals"):
        known, given = file.own.get(group), overrides.get(group)
        if not isinstance(known, Mapping) or not isinstance(given, Mapping):
            continue
        for name in set(given) - set(known):
            if "targets" not in (given[name] or {}):  # else it is a whole new parameter
                raise ConfigError(f"setting {group}.{name}: {one_of(group[:-1], str(name), map(str, known))}")


def _spec(file: YamlFile, path: Path, entry: SystemEntry) -> mujoco.MjSpec | None:
    if not path.is_file():
        file.problem(("model",), f"no file {entry.model!r} beside this one; give an MJCF or a URDF")
        return None
    try:
        spec = read_spec(path)
    except ConfigError as error:
        elsewhere = " (options of `amhe init`, which copies a model with its meshes)" if is_urdf(path) else ""
        file.problem(("model",), f"{error}{elsewhere}")
        return None
    try:
        resize_boxes(spec, entry.boxes)
    except ConfigError as error:
        file.problem(("boxes",), str(error))
    return spec


def _compiled(file: Description, spec: mujoco.MjSpec) -> mujoco.MjModel:
    try:
        return compiled(spec)
    except ConfigError as error:
        file.problem(("model",), str(error))
        file.raise_problems()
        raise


def _keyframe(file: Description, entry: SystemEntry, model: mujoco.MjModel) -> int | None:
    if entry.keyframe is None:
        return None
    try:
        return id_of(model, "keyframe", entry.keyframe)
    except ConfigError as error:
        file.problem(("keyframe",), str(error))
        return None
