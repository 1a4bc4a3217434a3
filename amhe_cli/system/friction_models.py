"""The friction models M1 to M6 of arXiv 2410.08650, each as further parameters of one system."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
import yaml

from amhe_cli.core.errors import ConfigError
from amhe_cli.system.model.elements import matching_rows
from amhe_cli.system.parameters.gear_friction import GEARS
from amhe_cli.system.system import System

_STRIBECK = ("stribeck_friction", "stribeck_velocity")
_APART = ("load_friction_motor", "load_friction_external", *_STRIBECK)
_DIRECTED = (*_APART, "stribeck_load_friction_motor", "stribeck_load_friction_external")
#: What each model adds to constant and viscous friction, and what that is.
MODELS: Mapping[str, tuple[tuple[str, ...], str]] = {
    "M1": ((), "constant friction"),
    "M2": (_STRIBECK, "larger at rest"),
    "M3": (("load_friction",), "grows with load"),
    "M4": (("load_friction", *_STRIBECK, "stribeck_load_friction"), "grows with load, larger at rest"),
    "M5": (_DIRECTED, "as M4, by motor and load apart"),
    "M6": ((*_DIRECTED, "load_friction_quadratic"), "as M5, and quadratic"),
}
#: Prior sd of what is multiplied onto a torque.
_SHARE = 0.1
#: Speed at which friction has fallen [rad/s], and the prior sd of its logarithm.
_SPEED, _SPEED_SD = 0.2, 1.0


def friction_models(system: System) -> dict[str, System]:
    """The system with each of the friction models, by name, in place of its own parameters of gears.

    Joints that share a parameter of dry friction share the further numbers too.

    Raises:
        ConfigError: The system has no folder, or no geared joint.
    """
    if system.folder is None:
        raise ConfigError(
            "`friction`: give a system folder; one of a model alone has no file to add lines to"
        )
    own, in_file = of_gears(system), yaml.safe_load(system.text)["parameters"]
    left = {n: entry for n, entry in (system.given.get("parameters") or {}).items() if n not in own}
    left |= {n: None for n in own if n in in_file}
    found = {}
    for name in MODELS:
        given = dict(system.given) | {"parameters": left | friction_entries(system, name)}
        found[name] = replace(System.load(system.folder, given, warn=False), name=name)
    return found


def of_gears(system: System) -> list[str]:
    """Names of the system's own parameters of its gears' friction."""
    places = {place for at in GEARS.rows(system.model).values() for place in at}
    written = ((p.name, c) for p, each in system.edits.by_parameter() for c in each)
    return list(dict.fromkeys(name for name, c in written if c.field == "numeric_data" and c.row in places))


def friction_entries(system: System, name: str) -> dict[str, Any]:
    """Parameters of one of the models, as `system.yaml` has them.

    Raises:
        ConfigError: See `friction_models`.
    """
    entries: dict[str, Any] = {}
    for prefix, joints in _groups(system).items():
        for word in MODELS[name][0]:
            targets = [{"joint": joint, "set": word} for joint in joints]
            entries[f"{prefix}{word}"] = _entry(system.model, word, joints) | {"targets": targets}
    return entries


def _entry(model: mujoco.MjModel, word: str, joints: list[str]) -> dict[str, Any]:
    """What is known beforehand of a number of these joints."""
    dofs = [int(model.joint(joint).dofadr[0]) for joint in joints]
    dry = float(np.mean(model.dof_frictionloss[dofs]))
    if word == "stribeck_velocity":
        return {"nominal": _SPEED, "prior_sd": _SPEED_SD}
    if word == "stribeck_friction":
        size = float(f"{0.5 * dry or 0.01:.2g}")
        return {"nominal": size, "bounds": [-size, 20.0 * size], "prior_sd": size}
    nominal = _SHARE if word.startswith("load_friction") and "quadratic" not in word else 0.0
    return {"nominal": nominal, "bounds": [nominal - 0.5, nominal + 1.0], "prior_sd": _SHARE}


def _groups(system: System) -> dict[str, list[str]]:
    """Geared joints that share one parameter of dry friction, by what their parameters' names begin with."""
    model, patterns = system.model, system.settings.identify.geared
    driven = model.actuator_trnid[model.actuator_trntype <= 1, 0]
    rows = {row for pattern in patterns for row in matching_rows(model, "joint", pattern)} or set(driven)
    shared = {
        cells.row: parameter.name
        for parameter, written in system.edits.by_parameter()
        for cells in written
        if cells.field == "dof_frictionloss"
    }
    groups: dict[str, list[str]] = {}
    for row in sorted(rows):
        joint = str(model.joint(row).name)
        groups.setdefault(shared.get(int(model.jnt_dofadr[row]), joint), []).append(joint)
    if not groups:
        raise ConfigError(
            "`friction`: no joint has an actuator; name those with a gear: identify: {geared: []}"
        )
    return {"" if len(groups) == 1 else f"{joints[0]}_": joints for joints in groups.values()}
