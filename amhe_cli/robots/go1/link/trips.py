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
from amhe_cli.robots.go1.link.mail import Phase
from amhe_cli.robots.go1.link.motion import beyond
from amhe_cli.robots.go1.link.state import Remote, RobotState
from amhe_cli.robots.go1.settings import TripSettings


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """All that trips depend on.

    Args:
        phase: Present phase.
        gap: Time since the packet before [s].
        state: Newest state of the robot.
        state_age: Time since it arrived [s].
        plan_age: Time since the newest plan was sent [s].
        pose_age: Time since the older one of the newest poses of trunk and box [s].
        over_power: States with too much power, less those without, as `Machine` counts them.
        bad_packets: Number of consecutive damaged datagrams.
        share: Share of the robot's last states that reached us.
        jump: Step from the targets in force to a plan that is new in this tick, or between two of its rows,
            the larger one for each joint [rad], shape (12,).
        targets: Joint targets to send, before they are clipped [rad], shape (12,).
        doubt: Why poses cannot be believed any more; '' if they can.
        contradiction: What contradicts the poses; '' if nothing does.
        order: Why the program or the operator has ordered a stop; '' if none has.
    """

    phase: Phase
    gap: float
    state: RobotState
    state_age: float
    plan_age: float
    pose_age: float
    over_power: int
    bad_packets: int
    share: float
    jump: FloatArray
    targets: FloatArray
    doubt: str
    contradiction: str
    order: str


Trip = Callable[[View, TripSettings], str | None]


def power(state: RobotState) -> float:
    """Power of all motors [W]."""
    return float(np.abs(state.torques * state.joint_rates).sum())


def tilt(quaternion: FloatArray) -> float:
    """Angle between the trunk's up and the world's [rad]."""
    w, x, y, z = quaternion.tolist()
    upright = 1.0 - 2.0 * (x * x + y * y) / max(w * w + x * x + y * y + z * z, 1e-9)
    return float(np.arccos(min(1.0, max(-1.0, upright))))


def _ordered(view: View, limits: TripSettings) -> str | None:
    return view.order or None


def _remote(view: View, limits: TripSettings) -> str | None:
    return "remote control: L2+B or select" if Remote.of(view.state.remote).stops else None


def _stalled(view: View, limits: TripSettings) -> str | None:
    late = view.gap > limits.packet_gap
    return f"the sender stalled: no packet for {1e3 * view.gap:.0f} ms" if late else None


def _state_lost(view: View, limits: TripSettings) -> str | None:
    late = view.state_age > limits.state_age
    return f"no state of the robot for {1e3 * view.state_age:.0f} ms" if late else None


def _damaged(view: View, limits: TripSettings) -> str | None:
    many = view.bad_packets >= limits.bad_packets
    return f"{view.bad_packets} damaged packets one after the other" if many else None


def _shared(view: View, limits: TripSettings) -> str | None:
    if view.share >= limits.share:
        return None
    arrive = f"only {100 * view.share:.0f} % of the robot's states arrive"
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


def _powerful(view: View, limits: TripSettings) -> str | None:
    long = view.over_power >= limits.power_ticks
    return f"power of {power(view.state):.0f} W" if long else None


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


def _flat(view: View, limits: TripSettings) -> str | None:
    low = view.state.charge < limits.charge
    return f"the battery is at {view.state.charge} %" if low else None


def _out_of_range(view: View, limits: TripSettings) -> str | None:
    # a robot that lies with folded calves is beyond the limits of commands: this counts only once it stands
    if view.phase not in (Phase.READY, Phase.RUN):
        return None
    return "a joint is beyond its limits" if beyond(view.state.joints, limits.position_margin) else None


def _jumping(view: View, limits: TripSettings) -> str | None:
    worst = int(np.abs(view.jump).argmax())
    far = abs(view.jump[worst]) > limits.target_jump
    return f"the target of {JOINTS[worst]} jumps by {view.jump[worst]:+.2f} rad" if far else None


def _plan_lost(view: View, limits: TripSettings) -> str | None:
    late = view.phase == Phase.RUN and view.plan_age > limits.plan_age
    return f"no plan for {1e3 * view.plan_age:.0f} ms" if late else None


def _pose_lost(view: View, limits: TripSettings) -> str | None:
    late = view.phase == Phase.RUN and view.pose_age > limits.pose_age
    return f"no pose of trunk or box for {1e3 * view.pose_age:.0f} ms" if late else None


def _contradicted(view: View, limits: TripSettings) -> str | None:
    return view.contradiction or None if view.phase == Phase.RUN else None


def _doubtful(view: View, limits: TripSettings) -> str | None:
    return view.doubt or None if view.phase == Phase.RUN else None


#: Trip -> the phase that follows, most urgent first.
TRIPS: dict[str, tuple[Trip, Phase]] = {
    "order": (_ordered, Phase.DAMP),
    "remote": (_remote, Phase.DAMP),
    "stalled": (_stalled, Phase.DAMP),
    "state_lost": (_state_lost, Phase.DAMP),
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
    "pose_false": (_contradicted, Phase.DAMP),
    "plan_lost": (_plan_lost, Phase.PAUSE),
    "pose_doubt": (_doubtful, Phase.PAUSE),
    "pose_lost": (_pose_lost, Phase.PAUSE),
}

NO_JUMP = sealed(np.zeros(12))


def tripped(view: View, limits: TripSettings) -> tuple[str, str, Phase] | None:
    """The most urgent trip: its name, its reason, and the phase that follows; None: all is well."""
    for name, (trip, then) in TRIPS.items():
        reason = trip(view, limits)
        if reason is not None:
            return name, reason, then
    return None
