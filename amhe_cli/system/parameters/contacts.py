"""Which geoms must touch for a parameter to have an effect."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import mujoco
import numpy as np

from amhe_cli.system.parameters.edits import Cells

#: Fields that act at contacts only.
_OF_PAIRS = ("pair_friction", "pair_solref", "pair_margin")
_CONTACT = ("geom_friction", "geom_solref", *_OF_PAIRS)
#: Fields of the inertia of a body.
_INERTIAL = ("body_mass", "body_inertia", "body_ipos", "body_iquat")


def needed_contacts(model: mujoco.MjModel, cells: Iterable[Cells]) -> list[tuple[int, int]]:
    """Pairs of geoms of which one must touch for these numbers to have an effect.

    Friction and softness of a contact need the contact. The inertia of a free body needs more than the floor
    below it: something that pushes it. Other numbers need none.
    """
    pairs: dict[tuple[int, int], None] = {}
    for c in cells:
        if c.field in _OF_PAIRS:
            pairs[int(model.pair_geom1[c.row]), int(model.pair_geom2[c.row])] = None
        elif c.field in _CONTACT:
            pairs |= dict.fromkeys((c.row, other) for other in partners(model, c.row))
        elif c.field in _INERTIAL and _is_free(model, c.row):
            geoms = np.flatnonzero(model.body_weldid[model.geom_bodyid] == model.body_weldid[c.row])
            for geom in map(int, geoms):
                explicit = [b if a == geom else a for a, b in _pairs(model) if geom in (a, b)]
                others = (*partners(model, geom), *explicit)
                pairs |= dict.fromkeys((geom, o) for o in others if not _is_fixed(model, o))
        else:
            return []
    return list(pairs)


def partners(model: mujoco.MjModel, row: int) -> Iterator[int]:
    """Geoms that may touch a geom, other than through an explicit pair."""
    pairs, weld = _pairs(model), model.body_weldid
    own = int(weld[model.geom_bodyid[row]])
    mask = (model.geom_contype[row] & model.geom_conaffinity) | (
        model.geom_conaffinity[row] & model.geom_contype
    )
    for other in map(int, np.flatnonzero(mask)):
        body = int(weld[model.geom_bodyid[other]])
        # MuJoCo keeps parent and child from colliding, unless the parent is the world
        parent, child = (int(weld[model.body_parentid[one]]) if one else -1 for one in (own, body))
        if body == own or (own and child == own) or (body and parent == body):
            continue
        if (row, other) not in pairs and (other, row) not in pairs:
            yield other


def geom_name(model: mujoco.MjModel, row: int) -> str:
    """The geom in words."""
    name = model.geom(row).name
    return f"geom {name!r}" if name else f"a geom of body {model.body(model.geom_bodyid[row]).name!r}"


def _pairs(model: mujoco.MjModel) -> list[tuple[int, int]]:
    return [(int(a), int(b)) for a, b in zip(model.pair_geom1, model.pair_geom2, strict=True)]


def _is_fixed(model: mujoco.MjModel, geom: int) -> bool:
    body = model.geom_bodyid[geom]
    return model.body_weldid[body] == 0 and model.body_mocapid[model.body_rootid[body]] < 0


def _is_free(model: mujoco.MjModel, body: int) -> bool:
    joint = int(model.body_jntadr[body])
    return joint >= 0 and int(model.jnt_type[joint]) == int(mujoco.mjtJoint.mjJNT_FREE)
