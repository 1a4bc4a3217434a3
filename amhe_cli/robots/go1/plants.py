"""A family of Go1s that differ from ours as one robot of a kind differs from another, all of one model.

The planner is told nothing of them. Sizes are those of data sheets, of other published Go1 models and of
robots that have walked for a year; each plant has one or two of them at once.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.errors import ConfigError
from amhe_cli.robots.go1.kinematics import LEGS
from amhe_cli.robots.go1.model import Box, layout, plant_model

#: A value of each kind of joint: hip, thigh and calf.
Kinds = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class PlantShape:
    """How a plant differs from our own model; the defaults change nothing.

    Args:
        title: What is different, in words.
        friction: Dry friction of the joints [N m]; None: the model's.
        damping: Damping of the joints [N m s/rad]; None: the model's.
        armature: Armature of the joints [kg m^2]; None: the model's.
        load_friction: Dry friction that the torque of the motor adds, as a share of it.
        gain: Torque of the motors as a share of what is commanded.
        load: Mass on the trunk [kg].
        centre: Where the trunk's centre of mass is, beside where the model has it [m].
        foot_friction: Friction between feet and floor; None: the model's.
        soft_feet: Feet that sink 15 mm into the floor, as in MuJoCo Menagerie.
        sole: How much larger the radius of the feet is [m].
        latency: Time from a command to its effect [s].
        zero: Offset of the encoders [rad], to one side in the right and to the other in the left legs.
        box: Size of the box as a share of the stated one, in x, y and z.
        box_centre: Where the box's centre of mass is beside its middle [m].
    """

    title: str = "as the planner has it"
    friction: Kinds | None = None
    damping: Kinds | None = None
    armature: float | None = None
    load_friction: float = 0.0
    gain: float = 1.0
    load: float = 0.0
    centre: Kinds = (0.0, 0.0, 0.0)
    foot_friction: float | None = None
    soft_feet: bool = False
    sole: float = 0.0
    latency: float = 0.0
    zero: float = 0.0
    box: Kinds = (1.0, 1.0, 1.0)
    box_centre: Kinds = (0.0, 0.0, 0.0)

    @property
    def zeros(self) -> FloatArray:
        """Offsets of the encoders [rad], shape (12,)."""
        return np.repeat(self.zero * np.array([1.0, -1.0, 1.0, -1.0]), 3)


#: Name -> plant. The first is our own.
PLANTS = {
    "ours": PlantShape(),
    "dry": PlantShape(
        "joints with much dry friction and little damping", (0.4, 0.4, 0.8), (0.6, 0.6, 0.6), 0.006
    ),
    "smooth": PlantShape("joints that hardly rub", (0.05, 0.05, 0.05), (0.3, 0.3, 0.3), 0.005),
    "geared": PlantShape("weak motors, rubbing gears", (0.3, 0.3, 0.3), load_friction=0.06, gain=0.9),
    "strong": PlantShape("strong motors, heavy rotors", armature=0.016, gain=1.1, damping=(2.0, 3.0, 3.0)),
    "loaded": PlantShape("1.5 kg on the trunk, its centre 3 cm off", load=1.5, centre=(-0.02, 0.01, 0.02)),
    "slippery": PlantShape("soft and slippery feet", foot_friction=0.5, soft_feet=True, sole=0.002),
    "late": PlantShape("commands 30 ms late, encoders 1 degree off", latency=0.03, zero=float(np.deg2rad(1))),
    "crate": PlantShape(
        "a box of another size, with its load off the middle", box=(1.1, 0.95, 1.05),
        box_centre=(0.02, 0.03, -0.03),
    ),
}  # fmt: skip


def find_plant(plant: str | Path | None) -> tuple[PlantShape, Path | None]:
    """A plant of the family by its name, or the model file of another robot.

    Args:
        plant: Name, or path of the MJCF of any Go1; None: our own.

    Raises:
        ConfigError: It is neither.
    """
    if plant is None or str(plant) in PLANTS:
        return PLANTS[str(plant or "ours")], None
    if Path(plant).is_file():
        return PLANTS["ours"], Path(plant)
    raise ConfigError(f"no plant {str(plant)!r}: give the MJCF of a Go1, or one of {', '.join(PLANTS)}")


def shaped_plant(box: Box, shape: PlantShape, robot: Path | None = None) -> mujoco.MjModel:
    """The plant of a shape, with a box as it is stated; see `plant_model`.

    What is no number of the model, latency and zeros and the friction of loads, the `Plant` does.
    """
    x, y, z = (float(edge * share) for edge, share in zip(box.size, shape.box, strict=True))
    model = plant_model(replace(box, size=(x, y, z), centre=shape.box_centre), robot)
    if shape == PLANTS["ours"]:
        return model
    dofs, servos, trunk = layout(model).joints_v, layout(model).servos, model.body("trunk")
    for field, values in (("dof_frictionloss", shape.friction), ("dof_damping", shape.damping)):
        if values is not None:
            getattr(model, field)[dofs] = np.tile(values, len(LEGS))
    if shape.armature is not None:
        model.dof_armature[dofs] = shape.armature
    model.actuator_gainprm[servos] *= shape.gain
    model.actuator_biasprm[servos] *= shape.gain
    trunk.inertia[:] *= (trunk.mass[0] + shape.load) / trunk.mass[0]
    trunk.mass[0] += shape.load
    trunk.ipos[:] += shape.centre
    _reshape_feet(model, shape)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def _reshape_feet(model: mujoco.MjModel, shape: PlantShape) -> None:
    for leg in LEGS:
        pair = model.pair(f"robot/{leg}_foot_floor")
        if shape.foot_friction is not None:
            pair.friction[:2] = shape.foot_friction
        if shape.soft_feet:
            pair.solimp[:3] = 0.015, 1.0, 0.031
        model.geom(f"robot/{leg}_foot").size[0] += shape.sole
        model.geom(f"robot/{leg}_foot").rbound[0] += shape.sole
