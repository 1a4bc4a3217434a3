"""The state machine: what is sent in which phase, what leads from one phase to the next, and what ends a run.

No socket and no clock in here: time and all that is known come in, a command comes out. Each trip has its
threshold in the settings.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from amhe_cli.core.arrays import FloatArray, sealed
from amhe_cli.robots.go1.kinematics import HOME, JOINTS
from amhe_cli.robots.go1.link.mail import Inbox, Phase, Targets, allowed, beyond, eased, travel_time
from amhe_cli.robots.go1.link.packets import OVERHEATED, SERVO, MotorCommand, RobotState, pressed
from amhe_cli.robots.go1.settings import Go1Settings


def power(state: RobotState) -> float:
    """Power of all motors [W]."""
    return float(np.abs(state.torques * state.joint_rates).sum())


def tilt(quaternion: FloatArray) -> float:
    """Angle between the trunk's up and the world's [rad]."""
    w, x, y, z = quaternion.tolist()
    upright = 1.0 - 2.0 * (x * x + y * y) / max(w * w + x * x + y * y + z * z, 1e-9)
    return float(np.arccos(min(1.0, max(-1.0, upright))))


_AT_REST = sealed(np.zeros(12))
#: Trip -> the phase that follows.
TRIPS = {
    **dict.fromkeys(
        ("order", "remote", "stalled", "state_lost", "damaged", "share", "not_a_number", "tilt", "speed",
         "power", "temperature", "motor_mode", "battery", "range", "target_jump", "pose_false"), Phase.DAMP,
    ),
    **dict.fromkeys(("plan_lost", "pose_doubt", "pose_lost"), Phase.PAUSE),
}  # fmt: skip
#: Legs folded under the trunk [rad]: within the limits of commands, unlike those of a robot let down.
FOLDED = sealed(np.tile([0.0, 1.2, -2.6], 4))
#: Longest time from arming to the first plan [s].
_FIRST_PLAN = 2.0
#: Time over which targets are blended from standing into plans, and from one plan into the next [s].
_FIRST_BLEND, _BLEND = 0.3, 0.02
#: A robot that was walking puts its feet down in this time before it sits down [s].
_LANDING = 0.2
#: How a planned end begins where the robot does not stand: nothing has moved yet; it lies, or is half way up.
_ENDS = {Phase.CONNECT: Phase.OVER, Phase.HOLD: Phase.DAMP, Phase.STAND: Phase.DAMP}


@dataclass(slots=True, eq=False)
class Machine:
    """Steps through the phases, one packet at a time.

    Attributes:
        trip: Name of the first trip; '' if there was none.
        reason: Why it tripped, in words.
        commanded: The newest joint targets that a robot was sent [rad], shape (12,).
    """

    settings: Go1Settings
    phase: Phase = Phase.CONNECT
    trip: str = ""
    reason: str = ""
    commanded: FloatArray = field(default_factory=lambda: HOME)
    _since: float = 0.0
    _stepped: float = np.inf
    _gap: float = 0.0
    _from: FloatArray = field(default_factory=lambda: _AT_REST)
    _sent: FloatArray | None = None
    _playing: Targets | None = None
    _planned: FloatArray = field(default_factory=lambda: _AT_REST)
    _first_plan: float = 0.0
    _blend: tuple[float, FloatArray] = (0.0, _AT_REST)
    _jump: FloatArray = field(default_factory=lambda: _AT_REST)
    _released: bool = False
    _over_power: int = 0
    _power_tick: int = -1

    def step(self, now: float, inbox: Inbox) -> MotorCommand:
        """Compute the command of this tick.

        Args:
            now: Present time [s].
            inbox: All that is known at this tick.
        """
        self._gap, self._stepped = now - self._stepped, now
        if inbox.state is not None:
            self._count_power(inbox.state)
            self._go_on(now, inbox, inbox.state)
            phase, wanted = self.phase, self._targets(now, inbox)
            self._guard(now, inbox, inbox.state, wanted)
            if self.phase != phase:  # a trip: follow the lost plan for no further packet
                wanted = self._targets(now, inbox)
            if self._drives:
                return self._servo(now, inbox.state, wanted)
        elif inbox.stop or inbox.finish:
            self._trip("order", inbox.stop or "asked to end", Phase.OVER, now)
        self._sent = None
        if self.phase == Phase.DAMP:
            return MotorCommand(velocity=_AT_REST, kd=np.full(12, self.settings.damping))
        return MotorCommand()

    def unfit(self, now: float, inbox: Inbox) -> str:
        """Why a robot that is not driven yet would trip as soon as it is driven; '' if it would not."""
        state = inbox.state
        found = self._tripped(now, inbox, state, HOME) if state else None
        return found[1] if found else ""

    # -- from one phase to the next -------------------------------------------------------------------

    @property
    def _drives(self) -> bool:
        return Phase.HOLD <= self.phase <= Phase.SIT

    def _go_on(self, now: float, inbox: Inbox, state: RobotState) -> None:
        s, elapsed = self.settings, now - self._since
        if self.phase == Phase.CONNECT and inbox.stand:
            self._enter(Phase.HOLD, now, state.joints)
        elif self.phase == Phase.HOLD and elapsed > s.gain_time:
            self._enter(Phase.STAND, now, self._from)
        elif self.phase == Phase.STAND and elapsed > self._stand_time:
            self._enter(Phase.READY, now, HOME)
        elif self.phase == Phase.READY and (inbox.arm or self._armed("R2" in pressed(state.remote))):
            self._enter(Phase.RUN, now, HOME)
        elif self.phase == Phase.PAUSE and elapsed > s.hold_time:
            self._enter(Phase.SIT, now, self._from)
        elif self.phase == Phase.SIT and elapsed > s.sit_time:
            self._enter(Phase.DAMP, now, state.joints)
        elif self.phase == Phase.DAMP and elapsed > s.damp_time:
            self._enter(Phase.OVER, now, state.joints)
        if inbox.finish and self.phase < Phase.PAUSE:
            then = _ENDS.get(self.phase, Phase.SIT)
            self._enter(then, now, state.joints if self._sent is None else self._sent)

    def _guard(self, now: float, inbox: Inbox, state: RobotState, wanted: FloatArray) -> None:
        if self.phase == Phase.CONNECT and inbox.stop:
            self._trip("order", inbox.stop, Phase.OVER, now)
        elif Phase.CONNECT < self.phase < Phase.DAMP and (found := self._tripped(now, inbox, state, wanted)):
            self._trip(*found, now)

    def _tripped(
        self, now: float, inbox: Inbox, state: RobotState, wanted: FloatArray
    ) -> tuple[str, str, Phase] | None:
        """The most urgent trip: its name, its reason, and the phase that follows; None: all is well."""
        reasons = self._reasons(now, inbox, state, wanted)
        return next(((name, reason, TRIPS[name]) for name, reason in reasons), None)

    def _reasons(
        self, now: float, inbox: Inbox, state: RobotState, wanted: FloatArray
    ) -> Iterator[tuple[str, str]]:
        """Name and reason of each trip, most urgent first."""
        limits, keys, age = self.settings.trips, pressed(state.remote), now - inbox.state_time
        if inbox.stop:
            yield "order", inbox.stop
        if {"L2", "B"} <= keys or "select" in keys:
            yield "remote", "remote control: L2+B or select"
        if self._drives and self._gap > limits.packet_gap:
            yield "stalled", f"the sender stalled: no packet for {1e3 * self._gap:.0f} ms"
        if age > limits.state_age:
            yield "state_lost", f"no state of the robot for {1e3 * age:.0f} ms"
        if inbox.bad_packets >= limits.bad_packets:
            yield "damaged", f"{inbox.bad_packets} damaged packets one after the other"
        if inbox.share < limits.share:
            arrive = f"only {100 * inbox.share:.0f} % of the robot's states arrive"
            yield "share", f"{arrive}: another program talks to it, or the network loses packets"
        numbers = (state.joints, state.joint_rates, state.gyro, state.quaternion)
        if not np.isfinite(sum(some.sum() for some in numbers)):
            yield "not_a_number", "the robot sends what is not a number"
        if not np.isfinite(self._jump.sum() + wanted.sum()):
            yield "not_a_number", "the plan is not a number"
        if (angle := tilt(state.quaternion)) > limits.tilt:
            yield "tilt", f"the trunk leans {np.rad2deg(angle):.0f} degrees"
        ratio = np.abs(state.joint_rates) / np.tile(limits.joint_speed, 4)
        if ratio[worst := int(ratio.argmax())] > 1:
            yield "speed", f"{JOINTS[worst]} moves at {state.joint_rates[worst]:.1f} rad/s"
        if self._over_power >= limits.power_ticks:
            yield "power", f"power of {power(state):.0f} W"
        if state.temperatures[worst := int(state.temperatures.argmax())] > limits.temperature:
            yield "temperature", f"{JOINTS[worst]} is {state.temperatures[worst]:.0f} deg C hot"
        if (wrong := np.flatnonzero(state.modes != SERVO)).size:
            mode = int(state.modes[wrong[0]])
            why = ", too hot" if mode == OVERHEATED else ""
            yield "motor_mode", f"{JOINTS[wrong[0]]} is in mode {mode}{why}, not in {SERVO}"
        if state.charge < limits.charge:
            yield "battery", f"the battery is at {state.charge} %"
        # one that lies with folded calves is beyond the limits of commands: this counts once it stands
        if self.phase in (Phase.READY, Phase.RUN) and beyond(state.joints, limits.position_margin):
            yield "range", "a joint is beyond its limits"
        if abs(self._jump[worst := int(np.abs(self._jump).argmax())]) > limits.target_jump:
            yield "target_jump", f"the target of {JOINTS[worst]} jumps by {self._jump[worst]:+.2f} rad"
        if self.phase == Phase.RUN:
            yield from self._losses(now, inbox)

    def _losses(self, now: float, inbox: Inbox) -> Iterator[tuple[str, str]]:
        """Name and reason of each trip of plans and poses, which count while they are followed."""
        grace = self._since + _FIRST_PLAN if inbox.plan is None else -np.inf
        plan_age, pose_age = (now - max(time, grace) for time in (inbox.plan_time, inbox.pose_time))
        if inbox.contradiction:
            yield "pose_false", inbox.contradiction
        if plan_age > self.settings.trips.plan_age:
            yield "plan_lost", f"no plan for {1e3 * plan_age:.0f} ms"
        if inbox.doubt:
            yield "pose_doubt", inbox.doubt
        if pose_age > self.settings.trips.pose_age:
            yield "pose_lost", f"no pose of trunk or box for {1e3 * pose_age:.0f} ms"

    def _armed(self, held: bool) -> bool:
        """Whether the remote's key was pressed after the robot stood up: not held from before."""
        self._released = self._released or not held
        return self._released and held

    def _trip(self, name: str, reason: str, then: Phase, now: float) -> None:
        if not self.trip:
            self.trip, self.reason = name, reason
        if then > self.phase:
            self._enter(then, now, _AT_REST if self._sent is None else self._sent)

    def _enter(self, phase: Phase, now: float, start: FloatArray) -> None:
        self.phase, self._since, self._from = phase, now, np.array(start)

    # -- what is sent ---------------------------------------------------------------------------------

    @property
    def _fold_time(self) -> float:
        return travel_time(self._from, FOLDED, self.settings.stand_speed)

    @property
    def _stand_time(self) -> float:
        return self._fold_time + travel_time(FOLDED, HOME, self.settings.stand_speed)

    @property
    def _landing(self) -> float:
        """Time in which all feet come to the floor [s]: a walking robot has two in the air."""
        return min(_LANDING, 0.2 * self.settings.sit_time)

    def _targets(self, now: float, inbox: Inbox) -> FloatArray:
        """Joint targets of this tick, not yet clipped."""
        elapsed = now - self._since
        match self.phase:
            case Phase.STAND if elapsed < self._fold_time:
                return eased(self._from, FOLDED, elapsed / self._fold_time)
            case Phase.STAND:
                rising = self._stand_time - self._fold_time
                return eased(FOLDED, HOME, (elapsed - self._fold_time) / rising)
            case Phase.RUN if inbox.plan is not None:
                return self._played(now, inbox.plan)
            case Phase.SIT if elapsed < self._landing:
                return eased(self._from, HOME, elapsed / self._landing)
            case Phase.SIT:
                sitting = self.settings.sit_time - self._landing
                return eased(HOME, FOLDED, (elapsed - self._landing) / sitting)
        return self._from

    def _played(self, now: float, plan: Targets) -> FloatArray:
        """Joint targets of a plan, blended into from those of the plan before: a late one begins with a step.

        The first one may begin in the midst of a stride: at first all are blended into from standing.
        """
        targets, self._jump = plan.at(now), _AT_REST
        if plan is not self._playing:
            tick = now - 1.0 / self.settings.rate
            if self._playing is None:
                self._planned, self._first_plan = targets, tick
            before = self._planned
            steps = np.vstack((targets - before, np.diff(plan.rows, axis=0)))  # not finite: a trip
            self._jump = steps[np.abs(steps).argmax(axis=0), np.arange(steps.shape[1])]
            self._playing, self._blend = plan, (tick, before - targets)
        begun, offset = self._blend
        self._planned = targets + max(0.0, 1.0 - (now - begun) / _BLEND) * offset
        return eased(self._from, self._planned, (now - self._first_plan) / _FIRST_BLEND)

    def _servo(self, now: float, state: RobotState, wanted: FloatArray) -> MotorCommand:
        s = self.settings
        gain = min(1.0, (now - self._since) / s.gain_time) if self.phase == Phase.HOLD else 1.0
        self._sent = wanted
        targets = self.commanded = allowed(wanted, state.joints, s.kp, s.torque_share)
        return MotorCommand(SERVO, targets, _AT_REST, _AT_REST, np.full(12, gain * s.kp), np.tile(s.kd, 4))

    def _count_power(self, state: RobotState) -> None:
        """Count up for a state with too much power, else down, as the vendor's own protection does."""
        if state.tick == self._power_tick:
            return
        self._power_tick = state.tick
        over = power(state) > self.settings.trips.power
        self._over_power = self._over_power + 1 if over else max(0, self._over_power - 1)
