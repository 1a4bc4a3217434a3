"""What all worlds of an engine share: the model as the card gets it, and what one of them takes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp

from amhe_cli.core.errors import SimulationError
from amhe_cli.engine.states import first_activations
from amhe_cli.system.parameters.gear_friction import GearFriction
from amhe_cli.system.parameters.model_edits import ModelEdits
from amhe_cli.system.parameters.servos import BIAS, Servos

#: Constants that `set_const` derives from masses, inertias and armatures: each world has its own.
DERIVED = ("body_subtreemass", "body_invweight0", "dof_invweight0", "tendon_invweight0", "actuator_acc0")


@dataclass(frozen=True, eq=False)
class Blueprint:
    """What all worlds of an engine share.

    Args:
        model: The model to roll out.
        edits: How parameters are written into it.
        input_spec: mjtState bits of the input vector.
        sensors: Whether rollouts record sensors.
    """

    model: mujoco.MjModel
    edits: ModelEdits
    input_spec: int
    sensors: bool

    @cached_property
    def nominal(self) -> mujoco.MjModel:
        """The model that the card gets; mujoco-warp leaves out terms that are zero in it."""
        model = self.edits.apply(self.model, self.edits.space.nominal)
        if self.servos is not None:
            self.servos.unlimit(model)
        # mujoco-warp has no reset of bad states; kernels.watch marks them and sends them home
        model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        if not self.sensors:
            model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_SENSOR
        return model

    @property
    def own(self) -> tuple[str, ...]:
        """Fields of the model of which each world has its own."""
        derived = DERIVED if self.edits.needs_set_const else ()
        bounded = () if self.gear is None else ("dof_frictionloss",)
        driven = () if self.servos is None else (BIAS,)
        written = (
            name for name in self.edits.fields if name != "numeric_data"
        )  # no field of the card's model
        return tuple(dict.fromkeys((*written, *derived, *bounded, *driven)))

    @cached_property
    def gear(self) -> GearFriction | None:
        """The joints whose friction is not constant."""
        return self.edits.gear_friction

    @cached_property
    def servos(self) -> Servos | None:
        """The servos that are more than a gain and a limit."""
        return self.edits.servos


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


def check_supported(blueprint: Blueprint, device: str) -> None:
    """Refuse a model that mujoco-warp cannot simulate, before any work is done.

    Raises:
        SimulationError: It cannot; the text says what it lacks.
    """
    try:
        with wp.ScopedDevice(device):
            mjw.put_model(blueprint.nominal)
    except (NotImplementedError, ValueError) as error:
        lacks = str(error).rstrip(".")
        raise SimulationError(
            f"mujoco-warp cannot simulate this model: {lacks}; take the engine 'cpu'"
        ) from None
    model = blueprint.nominal
    if first_activations(model, np.ones((1, model.nq)), np.ones((1, model.nu))).any():
        raise SimulationError("filters and slews of actuators start at rest on a card; take the engine 'cpu'")


def first_room(model: mujoco.MjModel) -> Room:
    """First guess of the buffers of one world, from the contacts of the home state."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return Room(max(16, 2 * data.ncon), max(32, 2 * data.nefc))


def bytes_per_world(blueprint: Blueprint, room: Room, device: str) -> int:
    """Memory of one world [bytes]: how much two more take than one."""
    with wp.ScopedDevice(device):
        sizes = [
            _bytes(mjw.make_data(blueprint.nominal, count, room.contacts, njmax=room.rows))
            for count in (1, 3)
        ]
        own = mjw.put_model(blueprint.nominal)
    model: Mapping[str, Any] = vars(own)
    return (sizes[1] - sizes[0]) // 2 + sum(model[name].capacity for name in blueprint.own)


def _bytes(owner: Any) -> int:
    """Memory of all arrays of an object."""
    total = 0
    for value in vars(owner).values():
        if isinstance(value, wp.array):
            total += value.capacity
        elif hasattr(value, "__dict__"):
            total += _bytes(value)
    return total
