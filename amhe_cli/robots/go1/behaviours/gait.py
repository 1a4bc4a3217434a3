"""Analytic gaits of a Go1: when each foot stands, where it goes, and which joint targets carry the robot.

Everything is a pure function of time, command and force, for any number of instants at once; phase comes from
the clock, so that a late or skipped control cycle changes nothing.

Joint targets lead the joints. A servo gives the torque kp (target - q) - kd dq, so joints that are to move
at dq and hold a torque tau are commanded (tau + kd dq) / kp further than they are; tau = -J^T f answers the
forces f of the ground on the feet, weight and push. Open loop the robot then walks at the speed commanded;
without the weight's share it stands still, without the speed's it walks at half of it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from amhe_cli.core.arrays import BoolArray, FloatArray, columns, sealed
from amhe_cli.robots.go1.kinematics import FOOT_RADIUS, HIP_OFFSET, HIPS, SIDE, joint_angles, posture
from amhe_cli.robots.go1.state import GRAVITY

#: Weight of the Go1's 12.743 kg [N].
WEIGHT = 12.743 * GRAVITY
#: Its centre of mass when it stands, ahead and left in the trunk's frame [m].
CENTRE_OF_MASS = (-0.0023, 0.0009)
#: Height of the bumper's middle over the floor [m]: what is pushed, pushes back there.
PUSH_HEIGHT = 0.22
#: A standing foot always carries a little: without, none would at the instants of switching.
_LEAST_LOAD = 1e-3
#: Trot: phase of each foot's touch-down, in periods; diagonal legs go together, FR + RL before FL + RR.
TROT = (0.0, 0.5, 0.5, 0.0)


@dataclass(frozen=True, slots=True)
class Gait:
    """A gait's shape.

    Args:
        period: Duration of one stride [s].
        duty: Share of the period that a foot stands; 1 is standing still.
        swing: How high a swinging foot is lifted [m].
        height: Height of the trunk over the floor [m].
        kp: Gain of the servos that follow the targets [N m/rad].
        damping: Damping of hip, thigh and calf [N m s/rad]: servo and joint added up.
        loading: Share of the period in which a foot takes over, or hands on, its load.
        weight: Weight of the robot [N].
        centre: Its centre of mass when it stands, ahead and left in the trunk's frame [m].
        zeros: What the encoders read where a joint is at zero [rad], twelve numbers or one for all.
    """

    period: float = 0.5
    duty: float = 0.6
    swing: float = 0.07
    height: float = 0.27
    kp: float = 60.0
    damping: tuple[float, float, float] = (2.0, 3.0, 3.0)
    loading: float = 0.1
    weight: float = WEIGHT
    centre: tuple[float, float] = CENTRE_OF_MASS
    zeros: tuple[float, ...] = (0.0,)


@dataclass(frozen=True, slots=True, eq=False)
class LegTargets:
    """Targets of a gait; the leading axes are those of time and command.

    Args:
        targets: Joint targets as the encoders count, force lead included [rad], shape (..., 12).
        joints: True joint angles that put the feet where they should be [rad], shape (..., 12).
        feet: Centres of the feet in the trunk's frame [m], shape (..., 4, 3).
        forces: Forces of the ground on the feet [N], shape (..., 4, 3).
    """

    targets: FloatArray
    joints: FloatArray
    feet: FloatArray
    forces: FloatArray


def standing(gait: Gait) -> Gait:
    """The same gait with all feet on the floor."""
    return replace(gait, duty=1.0)


def phases(gait: Gait, time: ArrayLike) -> FloatArray:
    """Phase of each foot in [0, 1) since its touch-down, shape (..., 4), at times [s] (...)."""
    return np.mod(np.asarray(time, dtype=np.float64)[..., None] / gait.period - np.array(TROT), 1.0)


def contacts(gait: Gait, time: ArrayLike) -> BoolArray:
    """Feet that should stand, shape (..., 4), at times [s] (...)."""
    return phases(gait, time) < gait.duty


def switches(gait: Gait, start: float, end: float) -> bool:
    """Whether a foot lifts off or touches down in (start, end] [s], which no stance or flight fits into."""
    now, then = ((time + 1e-9) / gait.period for time in (start, end))  # plain numbers, which are quicker
    return any(((now - o) % 1.0 < gait.duty) != ((then - o) % 1.0 < gait.duty) for o in TROT)


#: Thighs' joints in the trunk's frame [m].
_THIGHS = sealed(HIPS + np.outer(SIDE, [0.0, HIP_OFFSET, 0.0]))


def neutral_feet(gait: Gait) -> FloatArray:
    """Feet straight below the thighs' joints, in the trunk's frame [m], shape (4, 3)."""
    return _THIGHS + np.array([0.0, 0.0, FOOT_RADIUS - gait.height])


def walk(
    gait: Gait, time: ArrayLike, twist: ArrayLike, push: ArrayLike = (0.0, 0.0), left: ArrayLike = 0.0
) -> LegTargets:
    """Trot, trot in place, or stand, as the gait says and the twist commands.

    Args:
        gait: Period, duty, heights and gains of the gait.
        time: Instants [s], shape (...).
        twist: Velocity of the trunk in its own frame: ahead, left [m/s], yaw rate [rad/s], shape (..., 3).
        push: Force on what is in front of the robot, ahead and left in the trunk's frame [N], shape (..., 2).
        left: How far left of neutral each foot steps [m], shape (4,) or ().
    """
    phase = phases(gait, time)
    twist, push = np.asarray(twist, dtype=np.float64), np.asarray(push, dtype=np.float64)
    steps, velocity = _steps(gait, phase, twist)
    feet = neutral_feet(gait) + steps
    feet[..., 1] += np.asarray(left, dtype=np.float64)
    forces = ground_forces(gait, feet, _loads(gait, phase), push, PUSH_HEIGHT)
    return leg_targets(gait, feet, velocity, forces)


def leg_targets(gait: Gait, feet: FloatArray, velocity: FloatArray, forces: FloatArray) -> LegTargets:
    """Joints and joint targets for feet that move so, while the ground acts so on them; all (..., 4, 3)."""
    joints = joint_angles(feet)
    at = posture(joints)
    torques = at.holding_torques(forces) + np.array(4 * gait.damping) * at.rates(velocity)
    return LegTargets(joints + gait.zeros + torques / gait.kp, joints, feet, forces)


def _steps(gait: Gait, phase: FloatArray, twist: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Feet relative to neutral [m], and their velocity [m/s], each (..., 4, 3), in the trunk's frame.

    A standing foot goes back with the floor; a flying one comes forward on a cycloid, at rest over its
    places of lift-off and touch-down.
    """
    shape = (phase + twist[..., :1]).shape
    if gait.duty >= 1.0:
        return np.zeros((*shape, 3)), np.zeros((*shape, 3))
    flying = phase >= gait.duty
    stance, flight = gait.duty * gait.period, (1.0 - gait.duty) * gait.period
    turn = np.where(flying, 2.0 * np.pi * (phase - gait.duty) / (1.0 - gait.duty), 0.0)
    ground = stance * (0.5 - phase / gait.duty)
    sine, bump = np.sin(turn), 1.0 - np.cos(turn)
    along = np.where(flying, stance * ((turn - sine) / (2.0 * np.pi) - 0.5), ground)
    along_rate = np.where(flying, stance / flight * bump, -1.0)
    lift, lift_rate = 0.5 * gait.swing * bump, gait.swing * np.pi / flight * sine
    x, y, turning = _THIGHS[:, 0], _THIGHS[:, 1], twist[..., 2:]
    ahead, left = twist[..., :1] - turning * y, twist[..., 1:2] + turning * x
    places = columns(shape, along * ahead, along * left, lift)
    return places, columns(shape, along_rate * ahead, along_rate * left, lift_rate)


def _loads(gait: Gait, phase: FloatArray) -> FloatArray:
    """Share of its full load that each foot may carry, 0 to 1, shape (..., 4); it changes gradually."""
    if gait.duty >= 1.0:
        return np.ones_like(phase)
    rise, fall = phase / gait.loading, (gait.duty - phase) / gait.loading
    load = np.minimum(np.maximum(np.minimum(rise, fall), _LEAST_LOAD), 1.0)
    return np.where(phase < gait.duty, load, 0.0)


def box_friction(belief: Mapping[str, float]) -> float:
    """Force with which the box rubs on the floor when it slides, mu m g, by believed parameters [N]."""
    return belief["box_mass"] * belief["floor_friction"] * GRAVITY


def stance_weights(feet: FloatArray, load: FloatArray, centre: FloatArray) -> FloatArray:
    """Shares of the weight with which the feet balance about a point, as even as can be.

    Minimises the sum of share^2 / load subject to the equations of rest: the shares sum to one, and their
    centre is the point. Two feet cannot meet all of them: the total comes first, balance as near as it
    gets. Shares are never negative: feet do not stick.

    Args:
        feet: Places of the feet [m], shape (..., 4, 2 or 3).
        load: How much each foot may carry, 0 in the air to 1, at least one above 0; shape (..., 4).
        centre: Point that the weight acts through [m], shape (..., 2).

    Returns:
        Shares, shape (..., 4).
    """
    half_length = 0.2  # half the length of a Go1 [m]: scales moments to the size of forces
    x, y = np.moveaxis((feet[..., :2] - centre[..., None, :]) / half_length, -1, 0)
    along, across = load * x, load * y
    # multipliers solve normal @ multipliers = (1, 0, 0): up to a factor, the cofactors of its first row
    b, c, xy = along.sum(-1), across.sum(-1), (along * y).sum(-1)
    xx, yy = (along * x).sum(-1) + 1e-3, (across * y).sum(-1) + 1e-3
    one, by_x, by_y = xx * yy - xy * xy, c * xy - b * yy, b * xy - c * xx
    shares = np.maximum(load * one[..., None] + along * by_x[..., None] + across * by_y[..., None], 0.0)
    return shares / shares.sum(axis=-1, keepdims=True)


def ground_forces(
    gait: Gait, feet: FloatArray, load: FloatArray, push: FloatArray, height: ArrayLike
) -> FloatArray:
    """Forces of the ground on the feet that carry the robot while it pushes.

    A push at some height tips the robot away from it: the feet on the far side take more.

    Args:
        gait: Weight and centre of mass.
        feet: Places in the trunk's frame [m], shape (..., 4, 3).
        load: How much each foot may carry, as in `stance_weights`.
        push: Force on the object that is pushed, ahead and left [N], shape (..., 2).
        height: Height of the push over the floor [m], shape (...).

    Returns:
        Forces [N], shape (..., 4, 3).
    """
    shares = stance_weights(feet, load, gait.centre - push * (np.asarray(height)[..., None] / gait.weight))
    ahead, left = push[..., :1], push[..., 1:]
    return columns(shares.shape, shares * ahead, shares * left, shares * gait.weight)
