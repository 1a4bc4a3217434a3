"""A belief as randomisation for mjlab: a Python file whose events its environments take."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.belief import Belief
from amhe_cli.system.inertia import PSEUDO_NAMES, log_cholesky_of, pseudo_inertia, upper_factor
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

#: The version that the file was run with (`benchmarks/mjlab_events.py`).
MJLAB = "1.6.0"
_CHECKED = f"Files of this kind, with all its kinds of terms, were run with mjlab {MJLAB}."
#: Fields of a joint: what mjlab randomises them with.
_MJLAB_JOINT = {
    "dof_damping": "joint_damping",
    "dof_armature": "joint_armature",
    "dof_frictionloss": "joint_friction",
    "jnt_stiffness": "joint_stiffness",
}
#: Draws that a whole inertia's ranges are taken from, and numbers that are rounding.
_BODIES, _ROUNDING = 4000, 1e-9
_INERTIAL = ("body_mass", "body_ipos", "body_iquat", "body_inertia")


def mjlab_text(system: System, belief: Belief) -> str:
    """Python file with a function that returns the events of mjlab (`mjlab.managers.EventTermCfg`)."""
    found = drawn(system, belief)
    terms = [*_mjlab_joints(found), *_mjlab_bodies(found), *_mjlab_contacts(found), *_mjlab_actuators(found)]
    own = any(term.function == _ACTUATOR for term in terms)
    body = "\n".join(
        f'        "{term.name}": EventTermCfg(\n'
        f"            func={_called(term)},\n"
        f'            mode="startup",\n'
        f"            params={{\n"
        f'                "asset_cfg": SceneEntityCfg(entity, {selected(term, tuple)}),\n'
        + "".join(f'                "{key}": {code(value)},\n' for key, value in term.values.items())
        + "            },\n        ),"
        for term in terms
    )
    use = "env_cfg.events |= identified_events()"
    more = ", requires_model_fields" * own
    return f'''{head(system, belief, f"mjlab {MJLAB}", _CHECKED, found, use)}
{"import torch" * own}
from mjlab.envs.mdp import dr
from mjlab.managers.event_manager import EventTermCfg{more}
from mjlab.managers.scene_entity_config import SceneEntityCfg
{_ACTUATOR_TEXT * own}

def identified_events(entity: str = "robot") -> dict[str, EventTermCfg]:
    """Events that draw the identified numbers of an entity once for each environment."""
    return {{
{body}
    }}
'''


_ACTUATOR = "randomize_actuator"
_ACTUATOR_TEXT = '''

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
'''


def _called(term: Term) -> str:
    """The function of a term as the file names it: its own, or one of mjlab."""
    return term.function if term.function == _ACTUATOR else f"dr.{term.function}"


def _mjlab_joints(found: Drawn) -> Iterator[Term]:
    for name, function in _MJLAB_JOINT.items():
        for rows in found.tied(name, found.rows(name)):
            joints = [joint_of(found.model, name, row) for row in rows]
            ranges = found.range(name, rows)
            values = {"ranges": ranges, "operation": "abs", "shared_random": len(rows) > 1}
            yield Term(term_name(joints, function), function, ("joint_names", joints), values)
    for row in found.rows("qpos0"):
        joint = found.model.joint(int(np.flatnonzero(found.model.jnt_qposadr == row)[0])).name
        own = found.system.edits.own(found.model).qpos0[row]
        found.used |= {("qpos0", row), ("qpos_spring", row), ("jnt_range", found.model.joint(joint).id)}
        values = {"bias_range": ends(found.arrays["qpos0"][:, row] - own)}
        yield Term(term_name([joint], "encoder_bias"), "encoder_bias", ("joint_names", [joint]), values)


def _mjlab_bodies(found: Drawn) -> Iterator[Term]:
    for row in found.rows(*_INERTIAL):
        body = found.model.body(row).name
        selector, own = ("body_names", [body]), {name for name in _INERTIAL if row in found.rows(name)}
        if own == {"body_mass"}:
            values: dict[str, object] = {"ranges": found.range("body_mass", [row]), "operation": "abs"}
            yield Term(term_name([body], "mass"), "body_mass", selector, values)
        elif own == {"body_ipos"}:
            columns = sorted(found.columns("body_ipos", row))
            values = {"ranges": {column: found.range("body_ipos", [row], column) for column in columns}}
            yield Term(term_name([body], "com"), "body_com_offset", selector, values | {"operation": "abs"})
        elif (stretch := _stretch(found, row)) is not None:
            found.used |= {(name, row) for name in own}
            values = {
                f"{name}_range": ends(numbers)
                for name, numbers in zip(PSEUDO_NAMES, stretch.T, strict=True)
                if np.abs(numbers).max() > _ROUNDING
            }
            yield Term(term_name([body], "inertia"), "pseudo_inertia", selector, values)


def _stretch(found: Drawn, row: int) -> FloatArray | None:
    """Draws of a body's inertia as the ten numbers that turn the estimate's into it, shape (n, 10).

    mjlab's J' = U J U^T, so U = R' R^-1 of upper triangular factors R; None for a body of no extent.
    """
    own = [getattr(found.model, name)[row] for name in _INERTIAL]
    draws = [
        found.arrays[name][:_BODIES, row] if name in found.arrays else np.repeat(value[None], _BODIES, axis=0)
        for name, value in zip(_INERTIAL, map(np.asarray, own), strict=True)
    ]
    try:
        base = np.linalg.inv(upper_factor(_pseudo(*own)))
        return log_cholesky_of(
            np.array([upper_factor(_pseudo(*one)) for one in zip(*draws, strict=True)]) @ base
        )
    except np.linalg.LinAlgError:
        return None


def _pseudo(mass: float, com: FloatArray, quaternion: FloatArray, inertia: FloatArray) -> FloatArray:
    return pseudo_inertia(float(mass), com, quaternion, inertia)


def _mjlab_contacts(found: Drawn) -> Iterator[Term]:
    for name, kind in (("geom_friction", "geom"), ("pair_friction", "pair")):
        for column in (0, 1, 2, 3) if kind == "pair" else (0, 1, 2):
            if kind == "pair" and column == 1:
                continue  # the second of the two sliding directions
            rows = [row for row in found.rows(name) if column in found.columns(name, row)]
            for group in found.tied(name, rows, column):
                names = [getattr(found.model, kind)(row).name for row in group]
                ranges = found.range(name, group, column)
                values: dict[str, object] = {"ranges": ranges, "operation": "abs", "axes": [column]}
                values |= {"shared_random": len(group) > 1} | ({"isotropic": True} if kind == "pair" else {})
                yield Term(term_name(names, f"friction_{column}"), name, (f"{kind}_names", names), values)


def _mjlab_actuators(found: Drawn) -> Iterator[Term]:
    for row, kp, kd in servos(found):
        name = found.model.actuator(row).name
        values: dict[str, object] = {"kp": kp, "kd": kd}
        yield Term(term_name([name], "gains"), _ACTUATOR, ("actuator_names", [name]), values)
    for row in found.rows("actuator_forcerange"):
        name = found.model.actuator(row).name
        values = {"limit": found.range("actuator_forcerange", [row], 1)}
        yield Term(term_name([name], "effort"), _ACTUATOR, ("actuator_names", [name]), values)
