"""A belief as randomisation for Isaac Lab: a Python file with a configuration class of events."""

from __future__ import annotations

from collections.abc import Iterator

from amhe_cli.core.belief import Belief
from amhe_cli.system.randomisation import (
    Drawn,
    Term,
    code,
    drawn,
    ends,
    head,
    joint_of,
    selected,
    servos,
    term_name,
)
from amhe_cli.system.system import System

#: The versions that the file was checked against.
ISAACLAB = "2.3.2 and 3.0.0"
_CHECKED = f"Functions and arguments were checked against the source of Isaac Lab {ISAACLAB}; none was run."


def isaaclab_text(system: System, belief: Belief) -> str:
    """Python file with a configuration class of Isaac Lab's events (`isaaclab.managers.EventTermCfg`)."""
    found = drawn(system, belief)
    terms = [*_isaac_joints(found), *_isaac_bodies(found)]
    own = any(term.function == _FRICTION for term in terms)
    body = "\n".join(
        f"    {term.name} = EventTermCfg(\n"
        f"        func={term.function},\n"
        f'        mode="startup",\n'
        f"        params={{\n"
        f'            "asset_cfg": SceneEntityCfg("robot", {selected(term, list)}),\n'
        + "".join(f'            "{key}": {code(value)},\n' for key, value in term.values.items())
        + "        },\n    )"
        for term in terms
    )
    use = "class EventCfg(IdentifiedEventsCfg): ...  # or copy the terms into your own"
    opening = head(system, belief, f"Isaac Lab {ISAACLAB}", _CHECKED, found, use)
    imports = "import isaaclab.envs.mdp as mdp\nfrom isaaclab.managers import EventTermCfg, SceneEntityCfg\n"
    imports += (
        "from isaaclab.utils import configclass\n" + "from isaaclab.utils.math import sample_uniform\n" * own
    )
    start = f"{opening}\n{imports}{_FRICTION_TEXT * own}\n\n@configclass\nclass IdentifiedEventsCfg:\n"
    return f"{start}{_NOTE}\n{body}\n"


_NOTE = '    """Events that draw the identified numbers of the robot once for each environment."""\n'
_FRICTION = "randomize_joint_friction"
_FRICTION_TEXT = '''

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
'''


def _isaac_joints(found: Drawn) -> Iterator[Term]:
    for row in found.rows("dof_armature"):
        joint = joint_of(found.model, "dof_armature", row)
        values: dict[str, object] = {
            "armature_distribution_params": found.range("dof_armature", [row]),
            "operation": "abs",
        }
        yield Term(
            term_name([joint], "armature"), "mdp.randomize_joint_parameters", ("joint_names", [joint]), values
        )
    for row in found.rows("dof_frictionloss", "dof_damping"):
        joint = joint_of(found.model, "dof_damping", row)
        values = {"dry": found.range("dof_frictionloss", [row]), "viscous": found.range("dof_damping", [row])}
        yield Term(term_name([joint], "friction"), _FRICTION, ("joint_names", [joint]), values)
    for row, kp, kd in servos(found):
        joint = found.model.joint(int(found.model.actuator_trnid[row, 0])).name
        values = {
            "stiffness_distribution_params": kp,
            "damping_distribution_params": kd,
            "operation": "abs",
        }
        yield Term(
            term_name([joint], "gains"), "mdp.randomize_actuator_gains", ("joint_names", [joint]), values
        )


def _isaac_bodies(found: Drawn) -> Iterator[Term]:
    for row in found.rows("body_mass"):
        body = found.model.body(row).name
        moments = row in found.rows("body_inertia")
        if moments and row not in found.rows("body_iquat"):  # else they do not follow the mass alone
            found.used.add(("body_inertia", row))
        values: dict[str, object] = {
            "mass_distribution_params": found.range("body_mass", [row]),
            "operation": "abs",
            "recompute_inertia": moments,
        }
        yield Term(term_name([body], "mass"), "mdp.randomize_rigid_body_mass", ("body_names", [body]), values)
    for row in found.rows("body_ipos"):
        body, own = found.model.body(row).name, found.model.body_ipos[row]
        found.used.add(("body_ipos", row))
        moved = {
            "xyz"[column]: ends(found.arrays["body_ipos"][:, row, column] - own[column])
            for column in sorted(found.columns("body_ipos", row))
        }
        values = {"com_range": moved}
        yield Term(term_name([body], "com"), "mdp.randomize_rigid_body_com", ("body_names", [body]), values)
