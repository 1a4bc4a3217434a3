"""The same model with details changed that nobody measured: what an estimate should not depend on."""

from __future__ import annotations

import copy

import mujoco
import numpy as np


def contact_variants(model: mujoco.MjModel) -> dict[str, mujoco.MjModel]:
    """Name -> model with another contact softness; empty for a model that cannot collide.

    The time constant of MuJoCo's soft contacts is a numerical choice as much as a material: an estimate
    that follows it absorbs errors of the contact model.
    """
    collides = model.npair > 0 or (model.geom_contype.any() and model.geom_conaffinity.any())
    if not collides:
        return {}
    return {
        "contacts twice as soft": _with_time_constant(model, 2.0),
        "contacts twice as hard": _with_time_constant(model, 0.5),
    }


def _with_time_constant(model: mujoco.MjModel, factor: float) -> mujoco.MjModel:
    """A copy with every positive solref time constant scaled, not below two time steps."""
    changed = copy.copy(model)
    for solref in (changed.geom_solref, changed.pair_solref):
        soft = solref[:, 0] > 0.0
        solref[soft, 0] = np.maximum(factor * solref[soft, 0], 2.0 * model.opt.timestep)
    return changed
