"""A belief as randomisation for Isaac Lab: a Python file with a configuration class of events."""

from __future__ import annotations

from collections.abc import Iterator

from amhe_cli.system.export.actuators import Form, PositionServo, actuators_text, lost
from amhe_cli.system.export.randomisation import Drawn, Event, Tool, ends

#: The versions that the file was checked against.
ISAACLAB = "2.3.2 and 3.0.0"
_FRICTION = "randomize_joint_friction"
_TEXT = '''
import isaaclab.envs.mdp as mdp
from isaaclab.managers import EventTermCfg, SceneEntityCfg
from isaaclab.utils import configclass
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


def _events(draws: Drawn) -> Iterator[Event]:
    yield from _joints(draws)
    yield from _bodies(draws)


def _joints(draws: Drawn) -> Iterator[Event]:
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
        yield Event("friction", _FRICTION, "joint", names, values)
    for row, kp, kd in draws.servos():
        names = [draws.model.joint(int(draws.model.actuator_trnid[row, 0])).name]
        values = {
            "stiffness_distribution_params": kp, "damping_distribution_params": kd, "operation": "abs",
        }  # fmt: skip
        yield Event("gains", "mdp.randomize_actuator_gains", "joint", names, values)


def _bodies(draws: Drawn) -> Iterator[Event]:
    for row in draws.rows("body_mass"):
        moments = row in draws.rows("body_inertia")
        if moments and row not in draws.rows("body_iquat"):  # else they do not follow the mass alone
            draws.used.add(("body_inertia", row))
        values: dict[str, object] = {
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
                for column in sorted(draws.columns("body_ipos", row))
            }
        }
        yield Event("com", "mdp.randomize_rigid_body_com", "body", [draws.model.body(row).name], values)


def _servo(servo: PositionServo) -> dict[str, object]:
    return {
        "joint_names_expr": [servo.joint], "stiffness": servo.stiffness, "damping": servo.damping,
        "effort_limit": servo.effort, "armature": servo.armature, "friction": servo.friction,
        "dynamic_friction": servo.friction, "viscous_friction": servo.viscous,
        "min_delay": servo.delay[0], "max_delay": servo.delay[1],
    }  # fmt: skip


_FORM = Form(
    "isaaclab.actuators", "DelayedPDActuatorCfg", "{}", _servo,
    "for `ArticulationCfg(actuators=identified_actuators(timestep))`",
)  # fmt: skip
#: Isaac Lab (`isaaclab.managers.EventTermCfg`).
ISAACLAB_TOOL = Tool(
    _events,
    (
        f"Isaac Lab {ISAACLAB}",
        "class EventCfg(IdentifiedEventsCfg): ...  # or copy the terms into your own",
        f"Functions and arguments were checked against the source of Isaac Lab {ISAACLAB}; none was run.",
    ),
    '"robot"',
    list,
    "    {} = {}",
    _TEXT,
    lambda draws: (actuators_text(draws, _FORM), lost(draws)),
)
