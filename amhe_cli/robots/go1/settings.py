"""Settings of a real Go1: gains, thresholds of trips, motion capture. What a trip does: docs/go1.md."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from pydantic import BaseModel, Field

from amhe_cli.control.settings import ControlSettings
from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.settings import Positive, Settings, SettingsGroup

if TYPE_CHECKING:
    from amhe_cli.system.system import System

#: Less than 1/16 is nothing to a motor.
_Damping = Annotated[float, Field(ge=0.0625, le=10)]
_Speed = Annotated[float, Field(ge=1, le=40)]
_Share = Annotated[float, Field(gt=0, le=1)]
_Finite = Annotated[float, Field(allow_inf_nan=False)]
#: x, y, z [m].
_Point = tuple[_Finite, _Finite, _Finite]
#: Place [m] and rotation vector [rad] of the body that carries the markers, in the rigid body's frame.
Offset = tuple[_Finite, _Finite, _Finite, _Finite, _Finite, _Finite]


class TripSettings(SettingsGroup):
    """Thresholds that end a run; ages are just below the 50, 100 and 200 ms within which motors must react.

    No bound is so wide that a trip could be switched off by it.
    """

    state_age: Annotated[float, Field(ge=0.02, le=0.5)] = 0.045
    """Longest time without a new state of the robot [s]; then motors are damped."""
    plan_age: Annotated[float, Field(ge=0.04, le=1)] = 0.09
    """Longest time without a new plan [s]; then the robot holds, sits down, and its motors are damped."""
    pose_age: Annotated[float, Field(ge=0.02, le=1)] = 0.19
    """Longest time without a new pose of trunk or box [s]; then as for `plan_age`."""
    packet_gap: Annotated[float, Field(ge=0.01, le=0.2)] = 0.02
    """Longest time between two packets to the robot [s]; a sender that stalled damps when it goes on."""
    report_age: Annotated[float, Field(ge=0.05, le=1)] = 0.1
    """Longest time without a report of the sender [s]; then the program damps the motors in its place."""
    tilt: Annotated[float, Field(ge=0.2, le=1.3)] = 0.9
    """Largest tilt of the trunk, by the IMU [rad]."""
    joint_speed: tuple[_Speed, _Speed, _Speed] = (25.0, 25.0, 18.0)
    """Largest speed of hip, thigh and calf [rad/s]."""
    power: Annotated[float, Field(ge=50, le=2000)] = 700.0
    """Largest sum over the motors of |torque x speed| [W] ..."""
    power_ticks: Annotated[int, Field(ge=1, le=50)] = 6
    """... in this many states, counted as by the vendor's own PowerProtect."""
    temperature: Annotated[float, Field(ge=30, le=85)] = 75.0
    """Highest temperature of a motor [deg C]; nobody publishes a limit, this one is ours."""
    charge: Annotated[float, Field(ge=5, le=100)] = 15.0
    """Least charge of the battery [%]."""
    target_jump: Annotated[float, Field(ge=0.05, le=1)] = 0.5
    """Largest step from the targets in force to a new plan [rad]; it is blended over 20 ms."""
    position_margin: Annotated[float, Field(ge=0, le=0.3)] = 0.05
    """How far a joint may be beyond the limits of commands [rad], once the robot stands."""
    bad_packets: Annotated[int, Field(ge=1, le=100)] = 20
    """This many damaged datagrams in a row end a run."""
    share: Annotated[float, Field(ge=0.6, le=0.95)] = 0.8
    """Least share of the robot's last 200 states that must arrive; a second program takes about half."""


class PoseSettings(SettingsGroup):
    """What a pose of motion capture may be; one that is not is dropped."""

    bounds: tuple[_Point, _Point] = ((-20.0, -20.0, -1.0), (20.0, 20.0, 4.0))
    """The room: least and largest x, y, z of a rigid body in motion capture's frame [m]."""
    trunk_speed: Annotated[float, Field(gt=0, le=5)] = 2.0
    """Largest speed of the trunk from one pose to the next [m/s]."""
    box_speed: Annotated[float, Field(gt=0, le=5)] = 1.5
    """Largest speed of the box [m/s]."""
    turn_speed: Annotated[float, Field(gt=0, le=20)] = 6.0
    """Largest angular velocity of both [rad/s]."""
    gate: Annotated[float, Field(ge=3, le=20)] = 6.0
    """Largest distance from what the poses before predict, in sd."""
    dropped: Annotated[int, Field(ge=3, le=50)] = 10
    """This many dropped poses of the last hundred of a body end a run: the robot holds, and sits down."""
    data_port: Annotated[int, Field(ge=1, le=65535)] = 1511
    """natnet: port from which Motive sends its frames, besides its command port; others are ignored."""
    peer: str = ""
    """udp: ADDRESS:PORT that poses are taken from; by default the first that sends one."""


class Go1Settings(SettingsGroup):
    """The real robot."""

    rate: Annotated[float, Field(ge=100, le=1000)] = 500.0
    """Rate of packets to the robot [Hz]."""
    crc: Literal["plain", "encrypted"] = "plain"
    """Form of the checksums of commands and states: EDU robots take the plain one."""
    kp: Annotated[float, Field(gt=0, le=100)] = 60.0
    """Gain of position control [N m/rad]: that of the planner's model."""
    kd: tuple[_Damping, _Damping, _Damping] = (2.0, 3.0, 3.0)
    """Damping of hip, thigh and calf [N m s/rad]: the planner's 1, and that of its model's own joints."""
    torque_share: _Share = 0.7
    """Largest share of the torque limit that position control may demand; targets are clipped accordingly."""
    damping: Annotated[float, Field(ge=0.5, le=10)] = 3.0
    """Damping gain kd of damped motors [N m s/rad]."""
    gain_time: Positive = 2.0
    """Time in which gains rise from zero, before standing up [s]."""
    stand_speed: Annotated[float, Field(gt=0, le=3)] = 0.5
    """Highest speed of a joint while standing up [rad/s]."""
    sit_time: Annotated[float, Field(gt=0, le=10)] = 2.5
    """Time in which the robot sits down [s]."""
    hold_time: Annotated[float, Field(ge=0, le=1)] = 0.1
    """Time of standing still between a lost plan or pose and sitting down [s]; two feet may be in the air."""
    damp_time: Annotated[float, Field(ge=0.3)] = 1.5
    """Least time for which motors are damped before the sender ends [s]."""
    connect_time: Positive = 3.0
    """Longest wait for the robot, and for motion capture [s]."""
    arm: Literal["operator", "auto"] = "operator"
    """Who lets the run begin; auto is for the emulator, and refused where the robot is not on loopback."""
    trunk: str = "go1"
    """Name of the trunk's rigid body."""
    box: str = "box"
    """Name of the box's rigid body."""
    trunk_offset: Offset = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    """Trunk frame in the rigid body's frame: position [m], rotation vector [rad]."""
    box_offset: Offset = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    """Centre of the box in its rigid body's frame: position [m], rotation vector [rad]."""
    world: Literal["trunk", "mocap"] = "trunk"
    """The task's frame: under the trunk along its heading before it stands up, or motion capture's own."""
    place_tolerance: Annotated[float, Field(gt=0, le=0.5)] = 0.15
    """Largest distance of the box from where the task puts it, before anything moves [m]."""
    pose_delay: Annotated[float, Field(ge=0)] = 0.0
    """Age of poses when they arrive, in addition to the age that the source itself gives [s]."""
    slow: Annotated[float, Field(ge=1, le=100)] = 1.0
    """How many times slower than the clock an emulated robot runs; refused for a real one."""
    poses: PoseSettings = PoseSettings()
    trips: TripSettings = TripSettings()


class Go1ControlSettings(ControlSettings):
    """MPOPI, with the noise of the Go1's joints."""

    sigma_hip: Positive = 0.006
    """Noise of the hips' knots [rad]."""
    sigma_thigh: Positive = 0.012
    """Noise of the thighs' knots [rad]."""
    sigma_calf: Positive = 0.012
    """Noise of the calves' knots [rad]."""
    reflex: bool = True
    """Adaptive: correct the belief by the trunk's speed before a window shows a change."""

    @property
    def joint_sigma(self) -> FloatArray:
        """Start sd of each joint's knots [rad], shape (12,)."""
        return np.tile([self.sigma_hip, self.sigma_thigh, self.sigma_calf], 4)


class PushSettings(Settings):
    """All settings of `go1_push`: those of every system, and those of the controller and the robot."""

    control: Go1ControlSettings = Go1ControlSettings()
    go1: Go1Settings = Go1Settings()


def settings_of(system: System) -> PushSettings:
    """The settings of a system that was loaded with `PushSettings`."""
    assert isinstance(system.settings, PushSettings)
    return system.settings


def deviations(settings: Go1Settings) -> str:
    """Settings that differ from their defaults: 'go1.kp 20 (60), go1.trips.tilt 1.2 (0.9)'; '' if none."""
    return ", ".join(_deviations(settings, Go1Settings(), "go1"))


def _deviations(given: BaseModel, usual: BaseModel, name: str) -> Iterator[str]:
    for (field, value), (_, default) in zip(given, usual, strict=True):
        if isinstance(value, BaseModel):
            yield from _deviations(value, default, f"{name}.{field}")
        elif value != default:
            yield f"{name}.{field} {_plain(value)} ({_plain(default)})"


def _plain(value: object) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(map(_plain, value))}]"
    return f"{value:g}" if isinstance(value, float) else str(value)
