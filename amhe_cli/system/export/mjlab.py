"""A belief as randomisation for mjlab: a Python file whose events its environments take."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.system.export.actuators import Form, PositionServo, actuators_text, lost
from amhe_cli.system.export.randomisation import Drawn, Event, Tool, ends
from amhe_cli.system.parameters.inertia import PSEUDO_NAMES, log_cholesky_of, pseudo_inertia, upper_factor

#: The version that the file was run with (`benchmarks/mjlab_events.py`).
MJLAB = "1.6.0"
#: Fields of a joint: what mjlab randomises them with.
_JOINT = {
    "dof_damping": "joint_damping",
    "dof_armature": "joint_armature",
    "dof_frictionloss": "joint_friction",
    "jnt_stiffness": "joint_stiffness",
}
#: Kind of what touches: the columns of its friction; of a pair's two sliding directions the first.
_FRICTION = {"geom": (0, 1, 2), "pair": (0, 2, 3)}
#: Draws that a whole inertia's ranges are taken from.
_BODIES = 4000
#: Numbers of an inertia below this are rounding.
_ROUNDING = 1e-9
_INERTIAL = ("body_mass", "body_ipos", "body_iquat", "body_inertia")
_SERVO = "randomize_actuator"
_TEXT = '''
import torch
from mjlab.envs.mdp import dr
from mjlab.managers.event_manager import EventTermCfg, requires_model_fields
from mjlab.managers.scene_entity_config import SceneEntityCfg


@requires_model_fields("actuator_gainprm", "actuator_biasprm", "actuator_forcerange")
def randomize_actuator(env, env_ids, asset_cfg, kp=None, kd=None, limit=None):
    """Gains and force limit of one servo of the MJCF.

    mjlab's own terms, dr.pd_gains and dr.effort_limits, draw for groups of actuators, not for one.
    """
    ids = env.scene[asset_cfg.name].indexing.ctrl_ids[asset_cfg.actuator_ids]
    envs = torch.arange(env.num_envs, device=env.device) if env_ids is None else env_ids.long()
    model, rows = env.sim.model, envs[:, None]

    def drawn(ends):
        return ends[0] + (ends[1] - ends[0]) * torch.rand((len(envs), 1), device=env.device)

    if kp is not None:
        gain = drawn(kp)
        model.actuator_gainprm[rows, ids, 0], model.actuator_biasprm[rows, ids, 1] = gain, -gain
        model.actuator_biasprm[rows, ids, 2] = -drawn(kd)
    if limit is not None:
        force = drawn(limit)
        model.actuator_forcerange[rows, ids, 0], model.actuator_forcerange[rows, ids, 1] = -force, force


def identified_events(entity: str = "robot") -> dict[str, EventTermCfg]:
    """Events that draw the identified numbers of an entity once for each environment."""
    return {
$entries
    }
'''


def _events(draws: Drawn) -> Iterator[Event]:
    yield from _joints(draws)
    yield from _zeros(draws)
    yield from _bodies(draws)
    yield from _contacts(draws)
    for row, kp, kd in draws.servos():
        yield Event("gains", _SERVO, "actuator", [draws.model.actuator(row).name], {"kp": kp, "kd": kd})
    for row in draws.rows("actuator_forcerange"):
        values = {"limit": draws.range("actuator_forcerange", [row], 1)}
        yield Event("effort", _SERVO, "actuator", [draws.model.actuator(row).name], values)


def _joints(draws: Drawn) -> Iterator[Event]:
    for name, function in _JOINT.items():
        for rows in draws.tied(name, draws.rows(name)):
            joints = [draws.joint(name, row) for row in rows]
            values = {
                "ranges": draws.range(name, rows), "operation": "abs", "shared_random": len(rows) > 1,
            }  # fmt: skip
            yield Event(function, f"dr.{function}", "joint", joints, values)


def _zeros(draws: Drawn) -> Iterator[Event]:
    for row in draws.rows("qpos0"):
        joint = draws.model.joint(int(np.flatnonzero(draws.model.jnt_qposadr == row)[0]))
        zero = draws.system.edits.own(draws.model).qpos0[row]
        draws.used |= {("qpos0", row), ("qpos_spring", row), ("jnt_range", joint.id)}
        values = {"bias_range": ends(draws.arrays["qpos0"][:, row] - zero)}
        yield Event("encoder_bias", "dr.encoder_bias", "joint", [joint.name], values)


def _bodies(draws: Drawn) -> Iterator[Event]:
    for row in draws.rows(*_INERTIAL):
        names, moved = [draws.model.body(row).name], {name for name in _INERTIAL if row in draws.rows(name)}
        if moved == {"body_mass"}:
            values: dict[str, object] = {"ranges": draws.range("body_mass", [row]), "operation": "abs"}
            yield Event("mass", "dr.body_mass", "body", names, values)
        elif moved == {"body_ipos"}:
            columns = sorted(draws.columns("body_ipos", row))
            ranges = {column: draws.range("body_ipos", [row], column) for column in columns}
            values = {"ranges": ranges, "operation": "abs"}
            yield Event("com", "dr.body_com_offset", "body", names, values)
        elif (stretch := _stretch(draws, row)) is not None:
            draws.used |= {(name, row) for name in moved}
            values = {
                f"{name}_range": ends(numbers)
                for name, numbers in zip(PSEUDO_NAMES, stretch.T, strict=True)
                if np.abs(numbers).max() > _ROUNDING
            }
            yield Event("inertia", "dr.pseudo_inertia", "body", names, values)


def _stretch(draws: Drawn, row: int) -> FloatArray | None:
    """Draws of a body's inertia as the ten numbers that turn the estimate's into it, shape (n, 10).

    mjlab's J' = U J U^T, so U = R' R^-1 of upper triangular factors R; None for a body of no extent.
    """
    estimate = [np.asarray(getattr(draws.model, name)[row]) for name in _INERTIAL]
    drawn = [
        draws.arrays[name][:_BODIES, row] if name in draws.arrays else np.repeat(value[None], _BODIES, axis=0)
        for name, value in zip(_INERTIAL, estimate, strict=True)
    ]
    try:
        base = np.linalg.inv(_factor(*estimate))
        return log_cholesky_of(np.array([_factor(*body) for body in zip(*drawn, strict=True)]) @ base)
    except np.linalg.LinAlgError:
        return None


def _factor(mass: Any, com: FloatArray, quaternion: FloatArray, inertia: FloatArray) -> FloatArray:
    return upper_factor(pseudo_inertia(float(mass), com, quaternion, inertia))


def _contacts(draws: Drawn) -> Iterator[Event]:
    for kind, columns in _FRICTION.items():
        name = f"{kind}_friction"
        for column in columns:
            rows = [row for row in draws.rows(name) if column in draws.columns(name, row)]
            for group in draws.tied(name, rows, column):
                names = [getattr(draws.model, kind)(row).name for row in group]
                values: dict[str, object] = {
                    "ranges": draws.range(name, group, column), "operation": "abs", "axes": [column],
                    "shared_random": len(group) > 1,
                }  # fmt: skip
                values |= {"isotropic": True} if kind == "pair" else {}
                yield Event(f"friction_{column}", f"dr.{name}", kind, names, values)


def _servo(servo: PositionServo) -> dict[str, object]:
    return {
        "target_names_expr": (servo.joint,), "stiffness": servo.stiffness, "damping": servo.damping,
        "effort_limit": servo.effort, "armature": servo.armature, "frictionloss": servo.friction,
        "viscous_damping": servo.viscous, "delay_min_lag": servo.delay[0], "delay_max_lag": servo.delay[1],
    }  # fmt: skip


_FORM = Form(
    "mjlab.actuator",
    "BuiltinPositionActuatorCfg",
    "()",
    _servo,
    "for `EntityArticulationInfoCfg(actuators=identified_actuators(timestep))`; delete those of the XML from "
    "its spec",
)
#: mjlab (`mjlab.managers.EventTermCfg`).
MJLAB_TOOL = Tool(
    _events,
    (
        f"mjlab {MJLAB}",
        "env_cfg.events |= identified_events()",
        f"Files of this kind, with all its kinds of terms, were run with mjlab {MJLAB}.",
    ),
    "entity",
    tuple,
    '        "{}": {},',
    _TEXT,
    lambda draws: (actuators_text(draws, _FORM), lost(draws)),
)
