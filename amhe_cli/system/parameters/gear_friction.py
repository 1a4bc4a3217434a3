"""Friction of geared joints, which MuJoCo's constant `frictionloss` does not know.

What friction of a joint can hold at most [N m] grows with the torque through its gear, and falls with speed:

    f = f_c + |k_e tau_e - k_m tau_m| + exp(-|dq / v_s|^a) (f_s + |k_es tau_e - k_ms tau_m|) + q |tau_m tau_e|

tau_m is the actuators' force at the joint, tau_e all other force on it but friction, and the last term is
there only while the two pull against each other. f_c is the joint's `frictionloss`, and viscous friction its
`damping`. Negative k take away what positive ones add. With k_e and k_m, it is harder to drive such a joint
back than to drive it. The models M1 to M6 of Duclusaud, Passault, Padois and Ly, "Extended friction models
for the physics simulation of servo actuators", arXiv 2410.08650, are special cases, up to their form of the
quadratic term.

The numbers of a joint are those of `<custom><numeric name="gear_friction/JOINT" data="..."/>` in its model:
part of it like all others, which MuJoCo only keeps.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass

import mujoco
import numpy as np

from amhe_cli.core.arrays import FloatArray, IntArray
from amhe_cli.core.errors import ConfigError
from amhe_cli.system.parameters.edits import Cells
from amhe_cli.system.parameters.numerics import Numerics

#: Numbers of a joint in their order, each with its value where nothing says otherwise.
OWN = {
    "load_friction_motor": 0.0,  # k_m
    "load_friction_external": 0.0,  # k_e
    "stribeck_friction": 0.0,  # f_s [N m]
    "stribeck_velocity": 0.1,  # v_s [rad/s]
    "stribeck_exponent": 1.0,  # a
    "stribeck_load_friction_motor": 0.0,  # k_ms
    "stribeck_load_friction_external": 0.0,  # k_es
    "load_friction_quadratic": 0.0,  # q [1/(N m)]
}
#: Targets that are numbers of both sides: k (tau_e - tau_m).
BOTH = ("load_friction", "stribeck_load_friction")
#: Time between two updates of what friction can hold [s]. A batch of simulations stops for each.
UPDATE = 0.004
#: What lies ahead differs from what is by at most this factor.
AHEAD = 2.0
#: Fields from which an engine computes it, and of which it keeps its own.
OF_GEARS = ("dof_frictionloss", "numeric_data")
GEARS = Numerics("gear_friction/", mujoco.mjtObj.mjOBJ_JOINT, OWN, ("stribeck_velocity", "stribeck_exponent"))


@dataclass(frozen=True, eq=False)
class GearFriction:
    """The gear friction of a model's joints.

    Args:
        dofs: Their degrees of freedom, shape (g,).
        at: Where the numbers of each are in the model's `numeric_data`, shape (g, 8).
    """

    dofs: IntArray
    at: IntArray

    @classmethod
    def of(cls, model: mujoco.MjModel, set_by_parameters: Collection[int] = ()) -> GearFriction | None:
        """That of the joints whose friction is not constant; None where there is no such joint.

        Args:
            set_by_parameters: Places in `numeric_data` that parameters set.
        """
        acting = GEARS.acting(model, set_by_parameters)
        if not acting:
            return None
        return cls(model.jnt_dofadr[list(acting)].astype(np.int64), np.array(list(acting.values())))

    def law(self, numbers: FloatArray, dry: FloatArray) -> Callable[..., FloatArray]:
        """What friction of n simulations can hold [N m] by tau_m, tau_e and dq, each of shape (n, g).

        It is asked for at each update: terms that are zero for all are left out.

        Args:
            numbers: The numbers of the joints, shape (n or 1, g, 8).
            dry: Their f_c, shape (n or 1, g).
        """
        k_m, k_e, f_s, v_s, power, k_ms, k_es, quadratic = np.moveaxis(numbers, -1, 0).copy()
        constant, of_load, of_slow = dry.copy(), _under_load(k_e, k_m), _under_load(k_es, k_ms)
        grows, bent, pulls = k_es.any() or k_ms.any(), (power != 1.0).any(), quadratic.any()
        slows, falls = grows or f_s.any(), -1.0 / v_s
        takes = min(dry.min(), *(part.min() for part in (k_m, k_e, f_s, k_ms, k_es, quadratic))) < 0.0

        def bound(motor: FloatArray, external: FloatArray, speed: FloatArray) -> FloatArray:
            found = of_load(external, motor)
            found += constant
            if slows:
                size = np.abs(speed)
                slow = np.exp(-((size / v_s) ** power) if bent else size * falls)
                slow *= f_s + of_slow(external, motor) if grows else f_s
                found += slow
            if pulls:
                found += quadratic * np.maximum(-motor * external, 0.0)
            return np.maximum(found, 0.0, out=found) if takes else found

        return bound


def beyond(constraint: FloatArray, holds: FloatArray) -> FloatArray:
    """What of the forces of constraints is external, not friction: all above what friction could hold."""
    held = np.maximum(constraint, -holds)
    np.minimum(held, holds, out=held)
    return np.subtract(constraint, held, out=held)


def ahead(now: FloatArray, before: FloatArray, every: int) -> FloatArray:
    """What friction can hold on the average until the next update, by the line through the last two.

    The forces are those at the start of the last step, which lies half of so many steps and a half ago. Held
    as it was, friction lags; errors of positions are five to ten times as large then.
    """
    share = 0.5 + 0.5 / every
    line = (1.0 + share) * now
    line -= share * before
    # no bound is negative and the share at most 1: above, AHEAD holds by itself
    return np.maximum(line, now / AHEAD, out=line)


def _under_load(k_e: FloatArray, k_m: FloatArray) -> Callable[[FloatArray, FloatArray], FloatArray]:
    """|k_e tau_e - k_m tau_m|, odd in the k, so that a small k of unknown sign has a slope."""
    if min(k_e.min(), k_m.min()) >= 0.0:
        return lambda external, motor: np.abs(k_e * external - k_m * motor)

    def signed(external: FloatArray, motor: FloatArray) -> FloatArray:
        sign = np.sign(k_e * np.abs(external) + k_m * np.abs(motor))
        return sign * np.abs(k_e * external - k_m * motor)

    return signed


def number_cells(model: mujoco.MjModel, joint: int, word: str) -> list[Cells]:
    """Numbers of a joint that a target sets: its own, or those of both sides.

    Raises:
        ConfigError: The joint turns or slides about more than one axis.
    """
    name = model.joint(joint).name
    words = (f"{word}_motor", f"{word}_external") if word in BOTH else (word,)
    if not (cells := GEARS.cells(model, joint, words, name)):
        raise ConfigError(f"joint {name!r} has no gear: only hinges and slides with a name have one")
    return cells
