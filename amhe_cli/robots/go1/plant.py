"""The plant of simulated runs: full collisions, 2 ms steps, noisy sensors, changes on the way."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence

import mujoco
import numpy as np

from amhe_cli.core import rotations
from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.errors import SimulationError
from amhe_cli.core.samples import Samples
from amhe_cli.engine.contacts import contact_forces
from amhe_cli.robots.go1.model import FLOOR_PAIR, Change, home, layout
from amhe_cli.robots.go1.plants import PLANTS, PlantShape
from amhe_cli.robots.go1.state import GRAVITY, SensorNoise, State, state_of

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
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        changes: Sequence[Change],
        rng: np.random.Generator,
        noise: SensorNoise = _NOISE,
        start: FloatArray | None = None,
        shape: PlantShape = PLANTS["ours"],
    ) -> None:
        self.model, self._data, self._at = model, mujoco.MjData(model), layout(model)
        self._pending, self._rng, self._noise = list(changes), rng, noise
        self._pose_every = max(1, round(noise.pose_period / model.opt.timestep))
        self._uniform_inertia = self._inertia_per_mass()
        self._data.qpos[:] = home(model) if start is None else start
        self._shape, self._friction = shape, np.array(model.dof_frictionloss[self._at.joints_v])
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
        return state_of(self._at, self.time, self._data.qpos, self._data.qvel)

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
        }

    def advance(self, targets: FloatArray, duration: float) -> Samples:
        """Follow joint targets (12,) [rad] for some time [s]; what the sensors measured meanwhile.

        Raises:
            SimulationError: The simulation diverged.
        """
        robot, poses = [], []
        self._waiting.append((self.time + self._shape.latency, targets - self._shape.zeros))
        for _ in range(round(duration / self.model.opt.timestep)):
            velocity = np.array(self._data.qvel[self._at.trunk_v][:3])
            self._step()
            robot.append(self._robot_sample(velocity))
            if self._steps % self._pose_every == 0:
                poses.append(self._pose_sample())
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
            data.qpos[at.joints] + self._shape.zeros + self._draw(self._noise.joint, 12),
            data.qvel[at.joints_v] + self._draw(self._noise.joint_rate, 12),
            data.qvel[at.trunk_v][3:] + self._draw(self._noise.gyro, 3),
            force + self._draw(self._noise.accelerometer, 3),
        )

    def _pose_sample(self) -> tuple[object, ...]:
        qpos = self._data.qpos
        return (self.time, *self._seen(qpos[self._at.trunk]), *self._seen(qpos[self._at.box]))

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
