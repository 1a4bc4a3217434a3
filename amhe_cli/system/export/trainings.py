"""How mjlab and Isaac Lab take a belief: the terms that draw the model's numbers, and actuators."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.system.export.randomisation import Drawn, Event, Tool, ends
from amhe_cli.system.model.elements import driven_joint, names_of
from amhe_cli.system.parameters.inertia import PSEUDO_NAMES, log_cholesky_of, pseudo_inertia, upper_factor

#: The version that mjlab's files were run with (`benchmarks/mjlab_events.py`), and those of Isaac Lab whose
#: source they were checked against.
MJLAB, ISAACLAB = "1.6.0", "2.3.2 and 3.0.0"
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
_MJLAB_TEXT = '''
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


_ISAACLAB_TEXT = '''
import isaaclab.envs.mdp as mdp
from isaaclab.managers import EventTermCfg, SceneEntityCfg
from isaaclab.utils.configclass import configclass
from isaaclab.utils.math import sample_uniform


def randomize_joint_friction(env, env_ids, asset_cfg, dry, viscous):
    """Dry friction [N m] and viscous friction [N m s/rad] of joints, each from a range of its own.

    Isaac Lab's own term, randomize_joint_parameters, draws both from one range.
    """
    asset = env.scene[asset_cfg.name]
    rows = env.scene.num_envs if env_ids is None or isinstance(env_ids, slice) else len(env_ids)
    columns = asset.num_joints if isinstance(asset_cfg.joint_ids, slice) else len(asset_cfg.joint_ids)
    coulomb = sample_uniform(*dry, (rows, columns), asset.device)
    write = getattr(asset, "write_joint_friction_coefficient_to_sim_index", None)
    write = write or asset.write_joint_friction_coefficient_to_sim  # its name before Isaac Lab 3
    write(
        joint_friction_coeff=coulomb,
        joint_dynamic_friction_coeff=coulomb,
        joint_viscous_friction_coeff=sample_uniform(*viscous, (rows, columns), asset.device),
        joint_ids=asset_cfg.joint_ids,
        env_ids=env_ids,
    )


@configclass
class IdentifiedEventsCfg:
    """Events that draw the identified numbers of the robot once for each environment."""

$entries
'''


def _of_mjlab(draws: Drawn) -> Iterator[Event]:
    yield from _joints(draws)
    yield from _zeros(draws)
    yield from _bodies(draws)
    yield from _contacts(draws)
    for row, kp, kd in draws.gains():
        yield _actuator(draws, row, "gains", {"kp": kp, "kd": kd})
    for row in draws.rows("actuator_forcerange"):
        yield _actuator(draws, row, "effort", {"limit": draws.range("actuator_forcerange", [row], 1)})


def _actuator(draws: Drawn, row: int, what: str, values: dict[str, object]) -> Event:
    """Of an actuator by its name in the MJCF or, in `identified_actuators`, by its joint's."""
    names, joint = names_of(draws.model, "actuator"), driven_joint(draws.model, row)
    other = joint if joint not in names else None
    return Event(what, "randomize_actuator", "actuator", [draws.model.actuator(row).name], values, other)


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
            columns = draws.columns("body_ipos", row)
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


def _of_isaaclab(draws: Drawn) -> Iterator[Event]:
    values: dict[str, object]
    for row in draws.rows("dof_armature"):
        names = [draws.joint("dof_armature", row)]
        values = {
            "armature_distribution_params": draws.range("dof_armature", [row]), "operation": "abs",
        }  # fmt: skip
        yield Event("armature", "mdp.randomize_joint_parameters", "joint", names, values)
    for row in draws.rows("dof_frictionloss", "dof_damping"):
        names = [draws.joint("dof_damping", row)]
        values = {"dry": draws.range("dof_frictionloss", [row]), "viscous": draws.range("dof_damping", [row])}
        yield Event("friction", "randomize_joint_friction", "joint", names, values)
    for row, kp, kd in draws.gains():
        names = [draws.model.joint(int(draws.model.actuator_trnid[row, 0])).name]
        values = {
            "stiffness_distribution_params": kp, "damping_distribution_params": kd, "operation": "abs",
        }  # fmt: skip
        yield Event("gains", "mdp.randomize_actuator_gains", "joint", names, values)
    for row in draws.rows("body_mass"):
        moments = row in draws.rows("body_inertia")
        if moments and row not in draws.rows("body_iquat"):  # else they do not follow the mass alone
            draws.used.add(("body_inertia", row))
        values = {
            "mass_distribution_params": draws.range("body_mass", [row]), "operation": "abs",
            "recompute_inertia": moments,
        }  # fmt: skip
        yield Event("mass", "mdp.randomize_rigid_body_mass", "body", [draws.model.body(row).name], values)
    for row in draws.rows("body_ipos"):
        place = draws.model.body_ipos[row]
        draws.used.add(("body_ipos", row))
        values = {
            "com_range": {
                "xyz"[column]: ends(draws.arrays["body_ipos"][:, row, column] - place[column])
                for column in draws.columns("body_ipos", row)
            }
        }
        yield Event("com", "mdp.randomize_rigid_body_com", "body", [draws.model.body(row).name], values)


#: mjlab (`mjlab.managers.EventTermCfg`).
MJLAB_TOOL = Tool(
    _of_mjlab,
    (
        f"mjlab {MJLAB}",
        "env_cfg.events |= identified_events()",
        f"Files of this kind, with all its kinds of terms, were run with mjlab {MJLAB}.",
    ),
    "entity",
    tuple,
    '        "{}": {},',
    _MJLAB_TEXT,
    (
        "mjlab.actuator", "BuiltinPositionActuatorCfg", "()",
        "EntityArticulationInfoCfg(actuators=identified_actuators(timestep)): delete those of the spec.",
    ),
    {
        "target_names_expr": "joint", "stiffness": "stiffness", "damping": "damping",
        "effort_limit": "effort", "armature": "armature", "frictionloss": "friction",
        "viscous_damping": "viscous", "delay_min_lag": "shortest", "delay_max_lag": "longest",
        "delay_update_period": 10**9, "delay_per_env_phase": False,  # drawn at a reset, and held
    },
)  # fmt: skip
#: Isaac Lab (`isaaclab.managers.EventTermCfg`).
ISAACLAB_TOOL = Tool(
    _of_isaaclab,
    (
        f"Isaac Lab {ISAACLAB}",
        "class EventCfg(IdentifiedEventsCfg): ...  # or copy the terms into your own",
        f"Functions and arguments were checked against the source of Isaac Lab {ISAACLAB} with PhysX; none\n"
        "was run. Newton takes no viscous friction there.",
    ),
    '"robot"',
    list,
    "    {} = {}",
    _ISAACLAB_TEXT,
    (
        "isaaclab.actuators", "DelayedPDActuatorCfg", "{}",
        "ArticulationCfg(actuators=identified_actuators(timestep))",
    ),
    {
        "joint_names_expr": "joint", "stiffness": "stiffness", "damping": "damping",
        "effort_limit": "effort", "armature": "armature", "friction": "friction",
        "dynamic_friction": "friction", "viscous_friction": "viscous",
        "min_delay": "shortest", "max_delay": "longest",
    },
)  # fmt: skip
