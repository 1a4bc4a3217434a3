"""Forces between touching bodies, for pictures."""

from __future__ import annotations

import mujoco
import numpy as np

from amhe_cli.core.arrays import FloatArray


def contact_forces(model: mujoco.MjModel, data: mujoco.MjData) -> FloatArray:
    """Sum of the contact forces between each two touching bodies, shape (m, 6).

    Args:
        model: The model.
        data: Its state after `mj_forward` or a step.

    Returns:
        Where the force acts [m], the mean of the contacts weighted by their normal forces, and the force on
        the second body of the two [N], both in the world. The world itself is always the first.
    """
    sums: dict[tuple[int, int], FloatArray] = {}
    wrench = np.empty(6)
    for i in range(data.ncon):
        contact = data.contact[i]
        if min(contact.geom) < 0:  # of a flexible body
            continue
        mujoco.mj_contactForce(model, data, i, wrench)
        first, second = (int(model.geom_bodyid[g]) for g in contact.geom)
        force = contact.frame.reshape(3, 3).T @ wrench[:3]  # on the second; the normal points to it
        pair, sign = ((first, second), 1.0) if first <= second else ((second, first), -1.0)
        row = sums.setdefault(pair, np.zeros(7))
        row += np.concatenate((wrench[0] * contact.pos, sign * force, wrench[:1]))
    return np.array([[*(row[:3] / row[6]), *row[3:6]] for row in sums.values() if row[6] > 0.0]).reshape(
        -1, 6
    )
