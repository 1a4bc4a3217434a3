"""What all worlds of an engine share: the model as the card gets it, and which of its numbers jobs set."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from amhe_cli.engine.states import first_activations
from amhe_cli.system.parameters.gear_friction import OF_GEARS, GearFriction
from amhe_cli.system.parameters.model_edits import ModelEdits
from amhe_cli.system.parameters.servos import BIAS, Servos

#: Constants that `set_const` derives from masses, inertias and armatures: each world has its own.
DERIVED = ("body_subtreemass", "body_invweight0", "dof_invweight0", "tendon_invweight0", "actuator_acc0")


@dataclass(frozen=True, eq=False)
class Blueprint:
    """What all worlds of an engine share.

    Args:
        model: The model that the card gets; mujoco-warp leaves out terms that are zero in it.
        set_by_jobs: Fields of the model of which each job brings its candidates' own.
        derives: Whether `set_const` has to follow them.
        gear: The joints whose friction is not constant.
        servos: The servos that are more than a gain and a limit.
        input_spec: mjtState bits of the input vector.
        sensors: Whether rollouts record sensors.
    """

    model: mujoco.MjModel
    set_by_jobs: tuple[str, ...]
    derives: bool
    gear: GearFriction | None
    servos: Servos | None
    input_spec: int
    sensors: bool

    @classmethod
    def of(cls, model: mujoco.MjModel, edits: ModelEdits, input_spec: int, sensors: bool) -> Blueprint:
        """That of an engine's model and edits."""
        nominal = edits.apply(model, edits.space.nominal)
        if edits.servos is not None:
            nominal = edits.servos.unlimited(nominal)
        # mujoco-warp has no reset of bad states; kernels.watch marks them and sends them home
        nominal.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        if not sensors:
            nominal.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_SENSOR
        gear, servos = edits.gear_friction, edits.servos
        more = OF_GEARS if gear is not None else ("numeric_data",) if servos is not None else ()
        fields = tuple(dict.fromkeys((*edits.fields, *more)))
        return cls(nominal, fields, edits.needs_set_const, gear, servos, input_spec, sensors)

    @property
    def own(self) -> tuple[str, ...]:
        """Fields of the card's model of which each world has its own."""
        written = [name for name in self.set_by_jobs if name != "numeric_data"]  # no field of the card's
        derived, driven = DERIVED * self.derives, (BIAS,) * (self.servos is not None)
        return tuple(dict.fromkeys((*written, *derived, *driven)))

    def starts_at_rest(self) -> bool:
        """Whether all activations start at zero, as they do on a card."""
        model = self.model
        return not first_activations(model, np.ones((1, model.nq)), np.ones((1, model.nu))).any()


@dataclass(frozen=True, slots=True)
class Room:
    """Buffers of one world.

    Args:
        contacts: Contacts, on the average over the worlds.
        rows: Constraint rows.
    """

    contacts: int
    rows: int

    def larger(self) -> Room:
        """Twice the room."""
        return Room(2 * self.contacts, 2 * self.rows)


def first_room(model: mujoco.MjModel) -> Room:
    """First guess of the buffers of one world, from the contacts of the home state."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return Room(max(16, 2 * data.ncon), max(32, 2 * data.nefc))
