"""The plant: all collisions, 2 ms steps, noisy sensors, changes on the way; and the family of other Go1s.

The family differs from ours as one robot of a kind differs from another, all of one model. The planner is
told nothing of it. Sizes are those of data sheets, of other published Go1 models and of robots that have
walked for a year; each plant has one or two of them at once.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np

from amhe_cli.core import rotations
from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.errors import ConfigError, SimulationError, one_of
from amhe_cli.core.log import Samples
from amhe_cli.engine.states import contact_forces
from amhe_cli.robots.go1.kinematics import LEGS
from amhe_cli.robots.go1.model import FLOOR_PAIR, Box, Change, home, layout, plant_model
from amhe_cli.robots.go1.state import GRAVITY, SensorNoise, State

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
        zeros: Offsets of the encoders [rad], of all joints.
        legs: Mass of the legs as a share of the model's.
        box: Size of the box as a share of the task's, in x, y and z.
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
    zeros: tuple[float, ...] = (0.0,) * 12
    legs: float = 1.0
    box: Kinds = (1.0, 1.0, 1.0)
    box_centre: Kinds = (0.0, 0.0, 0.0)


#: To one side in the right and to the other in the left legs [rad].
_ONE_DEGREE = tuple(float(side * np.deg2rad(1.0)) for side in (1, -1, 1, -1) for _ in range(3))
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
    "late": PlantShape("commands 30 ms late, encoders 1 degree off", latency=0.03, zeros=_ONE_DEGREE),
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
    raise ConfigError(f"{one_of('plant', str(plant), PLANTS)}, or the MJCF of a Go1")


def shaped_plant(box: Box, shape: PlantShape, robot: Path | None = None) -> mujoco.MjModel:
    """The plant of a shape, with a box of the task's size; see `plant_model`.

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
    legs = model.body_rootid == trunk.id
    legs[trunk.id] = False
    model.body_mass[legs] *= shape.legs
    model.body_inertia[legs] *= shape.legs
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


#: Specific force that an accelerometer measures at rest [m/s^2].
_UPHELD = np.array([0.0, 0.0, GRAVITY])


_NOISE = SensorNoise()


class Plant:
    """A running simulation that the controller sees through its sensors only.

    Args:
        model: A model made by `plant_model`.
        changes: Changes of box or floor on the way; each happens once.
        rng: Random generator of the sensors' noise.
        noise: Noise of the sensors.
        start: Initial qpos, shape (nq,); None: `home`.
        shape: What of another plant is no number of the model: latency, zeros, friction under load.
        beside: Further true parameters, by name, which no change moves.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        changes: Sequence[Change],
        rng: np.random.Generator,
        noise: SensorNoise = _NOISE,
        start: FloatArray | None = None,
        shape: PlantShape = PLANTS["ours"],
        beside: Mapping[str, float] | None = None,
    ) -> None:
        self.model, self._data, self._at = model, mujoco.MjData(model), layout(model)
        self._pending, self._rng, self._noise = list(changes), rng, noise
        self._pose_every = max(1, round(noise.pose_period / model.opt.timestep))
        self._uniform_inertia = self._inertia_per_mass()
        self._data.qpos[:] = home(model) if start is None else start
        self._beside, self._shape = dict(beside or {}), shape
        self._friction = np.array(model.dof_frictionloss[self._at.joints_v])
        self._waiting: deque[tuple[float, FloatArray]] = deque()
        self._data.ctrl[self._at.servos] = self._data.qpos[self._at.joints]
        mujoco.mj_forward(model, self._data)
        self._steps = 0

    @property
    def time(self) -> float:
        """Time since the start [s]."""
        return self._steps * self.model.opt.timestep

    @property
    def task_time(self) -> float:
        """Time by which changes are due [s]."""
        return self.time

    @property
    def state(self) -> State:
        """The true state: for evaluation and logs, not for the controller."""
        return self._at.state_of(self.time, self._data.qpos, self._data.qvel)

    @property
    def qpos(self) -> FloatArray:
        """All coordinates qpos, for pictures, shape (nq,)."""
        return np.array(self._data.qpos)

    @property
    def contacts(self) -> FloatArray:
        """Forces between touching bodies, for pictures; see `contact_forces`."""
        return contact_forces(self.model, self._data)

    @property
    def parameters(self) -> dict[str, float]:
        """True parameters at this instant, by the names of `go1_push`."""
        return {
            "box_mass": float(self.model.body("box").mass[0]),
            "box_inertia_scale": self._inertia_per_mass() / self._uniform_inertia,
            "floor_friction": float(self.model.pair(FLOOR_PAIR).friction[0]),
            **self._beside,
        }

    def advance(self, targets: FloatArray, duration: float) -> Samples:
        """Follow joint targets (12,) [rad] for some time [s]; what the sensors measured meanwhile.

        Raises:
            SimulationError: The simulation diverged.
        """
        robot, poses = [], []
        self._waiting.append((self.time + self._shape.latency, targets - np.array(self._shape.zeros)))
        for _ in range(round(duration / self.model.opt.timestep)):
            velocity = np.array(self._data.qvel[self._at.trunk_v][:3])
            self._step()
            robot.append(self._robot_sample(velocity))
            if self._steps % self._pose_every == 0:
                at, qpos = self._at, self._data.qpos
                poses.append((self.time, *self._seen(qpos[at.trunk]), *self._seen(qpos[at.box])))
        return {**_samples(_OWN, robot), **_samples(_SEEN, poses)}

    def _step(self) -> None:
        while self._waiting and self._waiting[0][0] <= self.time + 1e-9:
            self._data.ctrl[self._at.servos] = self._waiting.popleft()[1]
        if self._shape.load_friction:
            load = np.abs(self._data.actuator_force[self._at.servos])
            self.model.dof_frictionloss[self._at.joints_v] = self._friction + self._shape.load_friction * load
        mujoco.mj_step(self.model, self._data)
        self._steps += 1
        # MuJoCo resets a diverged simulation and goes on: only the warning shows it.
        if any(self._data.warning[kind].number for kind in _FATAL) or not np.isfinite(self._data.qpos).all():
            raise SimulationError(f"the plant diverged at {self.time:.3f} s: its state is not a number")
        box_x = float(self._data.qpos[self._at.box][0])
        for change in [change for change in self._pending if change.due(self.task_time, box_x)]:
            change.apply(self.model)
            self._pending.remove(change)

    def _inertia_per_mass(self) -> float:
        box = self.model.body("box")
        return float(box.inertia[0] / box.mass[0])

    def _robot_sample(self, earlier_velocity: FloatArray) -> tuple[object, ...]:
        at, data = self._at, self._data
        quaternion = data.qpos[at.trunk][3:]
        acceleration = (data.qvel[at.trunk_v][:3] - earlier_velocity) / self.model.opt.timestep
        force = rotations.rotate(rotations.conjugate(quaternion), acceleration + _UPHELD)
        return (
            self.time,
            data.qpos[at.joints] + np.array(self._shape.zeros) + self._draw(self._noise.joint, 12),
            data.qvel[at.joints_v] + self._draw(self._noise.joint_rate, 12),
            data.qvel[at.trunk_v][3:] + self._draw(self._noise.gyro, 3),
            force + self._draw(self._noise.accelerometer, 3),
        )

    def _seen(self, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
        turn = rotations.exp(self._draw(self._noise.orientation, 3))
        return pose[:3] + self._draw(self._noise.position, 3), rotations.multiply(pose[3:], turn)

    def _draw(self, sd: float, size: int) -> FloatArray:
        return sd * self._rng.standard_normal(size)


def _samples(widths: Mapping[str, int], rows: list[tuple[object, ...]]) -> Samples:
    """Rows of a time and a value for each key, as samples of these keys."""
    times, *columns = zip(*rows, strict=True) if rows else [()] * (1 + len(widths))
    return {
        key: (np.array(times, dtype=np.float64), np.array(column).reshape(-1, width))
        for (key, width), column in zip(widths.items(), columns, strict=True)
    }


_FATAL = (
    mujoco.mjtWarning.mjWARN_BADQPOS,
    mujoco.mjtWarning.mjWARN_BADQVEL,
    mujoco.mjtWarning.mjWARN_BADQACC,
)
#: Samples of the robot's own sensors, and of the cameras: how many numbers each has.
_OWN = {"joints.position": 12, "joints.velocity": 12, "imu.angular_velocity": 3, "imu.linear_acceleration": 3}
_SEEN = {"trunk.position": 3, "trunk.orientation": 4, "box.position": 3, "box.orientation": 4}
