"""What ends a run: each trip is one line of a table, with its threshold in the settings.

A trip returns its reason in words, or None. All read one `View` of what is known at a tick.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from amhe_cli.core.arrays import FloatArray, sealed
from amhe_cli.robots.go1.kinematics import JOINTS
from amhe_cli.robots.go1.link import wire
from amhe_cli.robots.go1.link.mail import Inbox, Phase
from amhe_cli.robots.go1.link.motion import beyond
from amhe_cli.robots.go1.link.state import Remote, RobotState
from amhe_cli.robots.go1.settings import TripSettings


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """All that trips depend on.

    Args:
        phase: Present phase.
        inbox: All that is known at this tick.
        state: Newest state of the robot.
        gap: Time since the packet before [s].
        state_age: Time since the newest state arrived [s].
        plan_age: Time since the newest plan was sent [s].
        pose_age: Time since the older one of the newest poses of trunk and box [s].
        over_power: States with too much power, less those without, as `Machine` counts them.
        jump: Step from the targets in force to a plan that is new in this tick, or between two of its rows,
            the larger one for each joint [rad], shape (12,).
        targets: Joint targets to send, before they are clipped [rad], shape (12,).
    """

    phase: Phase
    inbox: Inbox
    state: RobotState
    gap: float
    state_age: float
    plan_age: float
    pose_age: float
    over_power: int
    jump: FloatArray
    targets: FloatArray


#: The reason of a trip in words; '' or None if there is none.
Trip = Callable[[View, TripSettings], str | None]
_STOPS, _NO_POSE = "remote control: L2+B or select", "no pose of trunk or box"


def power(state: RobotState) -> float:
    """Power of all motors [W]."""
    return float(np.abs(state.torques * state.joint_rates).sum())


def tilt(quaternion: FloatArray) -> float:
    """Angle between the trunk's up and the world's [rad]."""
    w, x, y, z = quaternion.tolist()
    upright = 1.0 - 2.0 * (x * x + y * y) / max(w * w + x * x + y * y + z * z, 1e-9)
    return float(np.arccos(min(1.0, max(-1.0, upright))))


def _damaged(view: View, limits: TripSettings) -> str | None:
    count = view.inbox.bad_packets
    return f"{count} damaged packets one after the other" if count >= limits.bad_packets else None


def _powerful(view: View, limits: TripSettings) -> str | None:
    return f"power of {power(view.state):.0f} W" if view.over_power >= limits.power_ticks else None


def _flat(view: View, limits: TripSettings) -> str | None:
    charge = view.state.charge
    return f"the battery is at {charge} %" if charge < limits.charge else None


def _shared(view: View, limits: TripSettings) -> str | None:
    share = view.inbox.share
    if share >= limits.share:
        return None
    arrive = f"only {100 * share:.0f} % of the robot's states arrive"
    return f"{arrive}: another program talks to it, or the network loses packets"


def _not_a_number(view: View, limits: TripSettings) -> str | None:
    state = view.state
    total = state.joints.sum() + state.joint_rates.sum() + state.gyro.sum() + state.quaternion.sum()
    if not np.isfinite(total):
        return "the robot sends what is not a number"
    return None if np.isfinite(view.jump.sum() + view.targets.sum()) else "the plan is not a number"


def _tilted(view: View, limits: TripSettings) -> str | None:
    angle = tilt(view.state.quaternion)
    return f"the trunk leans {np.rad2deg(angle):.0f} degrees" if angle > limits.tilt else None


def _fast(view: View, limits: TripSettings) -> str | None:
    ratio = np.abs(view.state.joint_rates) / np.tile(limits.joint_speed, 4)
    worst = int(ratio.argmax())
    return f"{JOINTS[worst]} moves at {view.state.joint_rates[worst]:.1f} rad/s" if ratio[worst] > 1 else None


def _hot(view: View, limits: TripSettings) -> str | None:
    worst = int(view.state.temperatures.argmax())
    hottest = view.state.temperatures[worst]
    return f"{JOINTS[worst]} is {hottest:.0f} deg C hot" if hottest > limits.temperature else None


def _off(view: View, limits: TripSettings) -> str | None:
    wrong = np.flatnonzero(view.state.modes != wire.SERVO)
    if not wrong.size:
        return None
    mode = int(view.state.modes[wrong[0]])
    why = ", too hot" if mode == wire.OVERHEATED else ""
    return f"{JOINTS[wrong[0]]} is in mode {mode}{why}, not in {wire.SERVO}"


def _out_of_range(view: View, limits: TripSettings) -> str | None:
    # a robot that lies with folded calves is beyond the limits of commands: this counts only once it stands
    if view.phase not in (Phase.READY, Phase.RUN):
        return None
    return "a joint is beyond its limits" if beyond(view.state.joints, limits.position_margin) else None


def _jumping(view: View, limits: TripSettings) -> str | None:
    worst = int(np.abs(view.jump).argmax())
    far = abs(view.jump[worst]) > limits.target_jump
    return f"the target of {JOINTS[worst]} jumps by {view.jump[worst]:+.2f} rad" if far else None


def _late(what: str, age: float, longest: float) -> str | None:
    return f"{what} for {1e3 * age:.0f} ms" if age > longest else None


def _runs(view: View, reason: str | None) -> str | None:
    """A reason that counts only while the robot follows plans."""
    return reason if view.phase == Phase.RUN else None


#: Trip -> the phase that follows, most urgent first.
TRIPS: dict[str, tuple[Trip, Phase]] = {
    "order": (lambda v, _: v.inbox.stop, Phase.DAMP),
    "remote": (lambda v, _: _STOPS if Remote.of(v.state.remote).stops else None, Phase.DAMP),
    "stalled": (lambda v, s: _late("the sender stalled: no packet", v.gap, s.packet_gap), Phase.DAMP),
    "state_lost": (lambda v, s: _late("no state of the robot", v.state_age, s.state_age), Phase.DAMP),
    "damaged": (_damaged, Phase.DAMP),
    "share": (_shared, Phase.DAMP),
    "not_a_number": (_not_a_number, Phase.DAMP),
    "tilt": (_tilted, Phase.DAMP),
    "speed": (_fast, Phase.DAMP),
    "power": (_powerful, Phase.DAMP),
    "temperature": (_hot, Phase.DAMP),
    "motor_mode": (_off, Phase.DAMP),
    "battery": (_flat, Phase.DAMP),
    "range": (_out_of_range, Phase.DAMP),
    "target_jump": (_jumping, Phase.DAMP),
    "pose_false": (lambda v, _: _runs(v, v.inbox.contradiction), Phase.DAMP),
    "plan_lost": (lambda v, s: _runs(v, _late("no plan", v.plan_age, s.plan_age)), Phase.PAUSE),
    "pose_doubt": (lambda v, _: _runs(v, v.inbox.doubt), Phase.PAUSE),
    "pose_lost": (lambda v, s: _runs(v, _late(_NO_POSE, v.pose_age, s.pose_age)), Phase.PAUSE),
}

NO_JUMP = sealed(np.zeros(12))


def tripped(view: View, limits: TripSettings) -> tuple[str, str, Phase] | None:
    """The most urgent trip: its name, its reason, and the phase that follows; None: all is well."""
    for name, (trip, then) in TRIPS.items():
        reason = trip(view, limits)
        if reason:
            return name, reason, then
    return None
