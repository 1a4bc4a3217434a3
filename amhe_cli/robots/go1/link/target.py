"""A real Go1, or an emulated one, as a `Target`: plans go to the sender, states and poses come back in time.

Three clocks are kept apart: the robot's, that of motion capture, and ours. Each sample is placed on ours
where it was taken, not where it arrived; a plan is handed over early by the time that a command takes. The
run's own time is ours since the operator let it begin.
"""

from __future__ import annotations

import gc
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from typing import Any

import numpy as np

from amhe_cli.control.controller import Plan
from amhe_cli.control.mpopi import MpopiStep
from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.errors import AmheError
from amhe_cli.core.log import Samples
from amhe_cli.robots.go1.kinematics import HOME
from amhe_cli.robots.go1.link.link import Link
from amhe_cli.robots.go1.link.mail import SAMPLE, Followed, Phase, SenderReport, StoppedError, Targets
from amhe_cli.robots.go1.link.process import Clock, Opened, planning_first
from amhe_cli.robots.go1.model import Box
from amhe_cli.robots.go1.poses.feed import PoseFeed, TimedPose
from amhe_cli.robots.go1.poses.gate import Gate, check_axes, check_place, offset_pose, tilt_offset
from amhe_cli.robots.go1.poses.sources import Pose, PoseError
from amhe_cli.robots.go1.poses.witness import Witness
from amhe_cli.robots.go1.settings import Go1Settings, deviations
from amhe_cli.robots.go1.state import Plane, State

#: More than this share of the rollouts of so many cycles in a row may not diverge.
_DIVERGED, _CYCLES = 0.25, 5
#: Poses of trunk and box belong together when they are no further apart than this [s].
_TOGETHER = 0.012
_STEP = 0.01
#: Signals of the robot's own sensors -> their name in what the link delivers.
_OWN = {
    "joints.position": "joints",
    "joints.velocity": "joint_rates",
    "imu.angular_velocity": "gyro",
    "imu.linear_acceleration": "accelerometer",
}


class Go1Target(Opened):
    """See `live.target.Target`; use it as a context manager, then `check`, then `begin`.

    Args:
        feed: Source of poses.
        period: Control period [s].
        box: The task's box, where it is at the start.
        latency: Time that the robot itself takes to act on a command, as far as it is known [s].

    Attributes:
        begun: Whether the robot has been commanded to stand up.
    """

    truth: State | None = None
    parameters: dict[str, float] | None = None

    def __init__(
        self,
        link: Link,
        feed: PoseFeed,
        settings: Go1Settings,
        clock: Clock,
        period: float,
        box: Box,
        latency: float = 0.0,
    ) -> None:
        self._link, self._feed, self._settings, self._clock = link, feed, settings, clock
        self._period, self._latency = period, latency
        self._box = np.array([*box.position, 0.5 * box.size[2]])
        self._world = Plane(np.zeros(2), 0.0)
        self._start = 0.0
        self._time = 0.0
        self._plan, self._followed = Plan(0.0, period, np.asarray(HOME)[None]), Followed()
        names, level = (settings.trunk, settings.box), np.array([1.0, 0.0, 0.0, 0.0])
        self._newest = {name: TimedPose(name, -np.inf, np.zeros(3), level) for name in names}
        self._gate = Gate(settings.poses, *names)
        state_age = settings.trips.state_age
        self._witness = Witness(settings.poses.gate, state_age, *names, np.array(box.size))
        self._imu = level
        self._unpaired: list[TimedPose] = []
        self._robot: list[Any] = []
        self._poses: list[tuple[float, Pose, Pose]] = []
        self._playing, self._sends, self._realtime, self._doubtful = False, True, False, 0
        self._diverged: StoppedError | None = None
        self.misses = 0
        self.begun = False

    def _open(self, opening: ExitStack) -> None:
        opening.enter_context(self._feed)
        opening.enter_context(self._link)
        _, self._realtime = opening.enter_context(planning_first())  # once their processes have started

    @property
    def slow(self) -> float:
        """How many times slower than the wall clock time goes."""
        return self._clock.slow

    @property
    def dropped_poses(self) -> int:
        """Number of poses of the run that could not be true."""
        return self._gate.dropped

    @property
    def report(self) -> SenderReport:
        """The newest report of the sender."""
        return self._link.report

    @property
    def notes(self) -> list[str]:
        """What the operator should know of this computer."""
        others = {"poses": self._feed.realtime, "planner": self._realtime}
        late = [*self._link.late, *(name for name, has in others.items() if not has)]
        if not late:
            return []
        return [f"no real-time priority: {', '.join(late)}; they may be late when the computer is busy"]

    # -- before the run -------------------------------------------------------------------------------

    def check(self) -> dict[str, str]:
        """Check everything that can be checked before the robot moves; returns the findings in words.

        Raises:
            LinkError: The robot does not answer as it should.
            PoseError: Poses do not come, or contradict the robot or the task.
        """
        report = self._link.connect()
        s, seen = self._settings, self._feed.first()
        trunk, box = self._offset(seen[s.trunk]), self._offset(seen[s.box])
        robot = report.robot
        assert robot is not None, "who is connected has reported a state"
        check_axes(trunk, robot.quaternion)
        if s.world == "trunk":
            self._world = Plane.under(*trunk)
        place = self._world.place(box[0])
        check_place(place, self._box, s.place_tolerance)
        contact, tilt = report.contact, np.rad2deg(tilt_offset(trunk, robot.quaternion))
        return {
            "robot": f"{contact['states']} states, {100 * contact['share']:.0f} % arrive",
            "there and back": f"{contact['round_trip_ms']:.1f} ms",
            "battery": f"{robot.charge} %",
            "hottest motor": f"{robot.temperatures.max():.0f} deg C",
            "trunk": f"{trunk[0][2]:.3f} m high; off the IMU by {tilt[0]:+.1f}, {tilt[1]:+.1f} degrees",
            "poses": self._feed.about,
            "box": f"at ({place[0]:.2f}, {place[1]:.2f}, {place[2]:.2f}) m of the task's frame",
            **({"not by default": changed} if (changed := deviations(s)) else {}),
            **{f"note {number}": note for number, note in enumerate(self.notes, start=1)},
        }

    def begin(self, say: Callable[[str], None]) -> None:
        """Let the robot stand up and the operator arm it; then the run's time begins.

        Args:
            say: Called with each message to the operator.

        Raises:
            StoppedError, OperatorStopError: A trip, or the operator, ended the run before that.
            PoseError: Box or poses have changed since they were checked.
        """
        self.begun = True
        say("the robot stands up")
        self._link.stand()
        self._wait_for(Phase.READY)
        if self._settings.arm == "auto":
            self._link.arm()
        else:
            changed = deviations(self._settings)
            stands = f"it stands, with {changed}" if changed else "it stands"
            say(
                f"{stands}. Enter, or R2 on the remote: the run begins; any other key, or L2+B: motors damped"
            )
        self._wait_for(Phase.RUN)
        self._look_again()
        gc.freeze()  # a search for garbage in all that is loaded would take the time of several plans
        self._begin_time()

    def rehearse(self) -> None:
        """Let the run's time begin now; plans are not sent, and the robot does not move."""
        self._begin_time(sends=False)

    def _begin_time(self, sends: bool = True) -> None:
        self._start, self._sends = self._clock.now(), sends
        self._gate.begin()
        self._witness.begin()
        self._robot.clear()
        self._poses.clear()

    def _look_again(self) -> None:
        """Refuse to begin where box or poses have changed since they were checked: an operator takes time."""
        s = self._settings
        self._collect()
        age = self._clock.now() - self._oldest
        if age > s.trips.pose_age:
            raise PoseError(f"no pose of trunk or box for {1e3 * age:.0f} ms: the run does not begin")
        box, _ = self._offset(self._newest[s.box])
        check_place(self._world.place(box), self._box, s.place_tolerance)

    def _wait_for(self, phase: Phase) -> None:
        while not self._link.reached(phase):
            self._collect()
            self._clock.sleep_until(self._clock.now() + _STEP)

    # -- the run --------------------------------------------------------------------------------------

    @property
    def deadline(self) -> float | None:
        """See `Target`."""
        return self.slow * (self._start + self._time + self._period - self._lead)

    @property
    def _lead(self) -> float:
        """Time that a command takes to act [s]: plans are handed over so much earlier."""
        return 0.5e-3 * self.report.contact.get("round_trip_ms", 0.0) + self._latency

    def in_force(self, at: float) -> FloatArray:
        """See `Target`."""
        return self._plan.at(at)

    def measure(self) -> tuple[float, Samples]:
        """See `Target`.

        Raises:
            StoppedError, OperatorStopError: A trip, or the operator, ended the run.
            LinkError, PoseError: A process of the link or of the poses has died.
        """
        self._sleep_to_the_next_period()
        self._collect()
        self._check_phase()
        while not (self._playing or (self._robot and self._poses)):  # the first estimate needs both
            self._sleep_to_the_next_period()
            self._collect()
            self._check_phase()
        return self._time, self._measured()

    @property
    def stop(self) -> AmheError | None:
        """What has ended the run before its end: a trip, or the operator; None: nothing."""
        return self._diverged or (self.report.stop if self.report.trip else None)

    def play(self, plan: Plan) -> None:
        """See `Target`.

        Raises:
            StoppedError: Too many rollouts diverge: the robot is not where the planner takes it to be.
        """
        self._watch(plan.step)
        # what is in force until then comes first, so that targets are handed over without a step; from
        # standing to the first plan the sender leads, since that may begin in the midst of a stride
        before = self._plan.at(plan.start - 0.5 * self._period) if self._playing else plan.targets[0]
        start = self._start + plan.start - plan.period - self._lead
        targets = Targets(start, plan.period, np.vstack((before, plan.targets)))
        if self._sends:
            self._link.play(targets, self._oldest)
        self._plan, self._playing = plan, True

    def _watch(self, step: MpopiStep | None) -> None:
        if step is None:
            return
        self._doubtful = self._doubtful + 1 if step.diverged > _DIVERGED * step.rollouts else 0
        if self._doubtful >= _CYCLES:
            self._diverged = StoppedError(
                f"{step.diverged} of {step.rollouts} rollouts diverged, and too many in each of "
                f"{_CYCLES} cycles",
                "diverged",
            )
            raise self._diverged

    def _sleep_to_the_next_period(self) -> None:
        elapsed = self._clock.now() - self._start
        periods = max(1, int(np.ceil((elapsed - self._time) / self._period)))
        self.misses += periods - 1
        self._time += periods * self._period
        self._clock.sleep_until(self._start + self._time)

    def _check_phase(self) -> None:
        if self.report.phase > Phase.RUN:
            raise self.report.stop

    # -- what comes in --------------------------------------------------------------------------------

    def _collect(self) -> None:
        """Take in all that has arrived, can be true, and is not older than the beginning of the run."""
        until = self._link.looked
        robot = [sample for sample in self._link.samples() if sample["time"] >= self._start]
        self._robot += robot
        self._imu = self._robot[-1]["quaternion"] if self._robot else self._imu
        for pose in self._feed.poses():
            exposed = replace(pose, time=pose.time - self._settings.pose_delay)
            if pose.body in self._newest and exposed.time >= self._start and self._believes(exposed):
                self._newest[pose.body] = max(self._newest[pose.body], exposed, key=lambda one: one.time)
                self._pair(exposed)
        if self._start:
            self._witness.feel(np.array(robot, dtype=SAMPLE), until)
            if contradiction := self._witness.contradiction:
                self._link.contradict(contradiction)
            if self._gate.doubt:
                self._link.doubt(self._gate.doubt)

    def _believes(self, pose: TimedPose) -> bool:
        place, now = self._offset(pose), self._clock.now()
        believed = self._gate.believes(pose.body, pose.time, place, now, self._imu, pose.flaw)
        if believed:
            self._witness.see(pose.body, pose.time, place)
        return believed

    def _pair(self, pose: TimedPose) -> None:
        """Join the poses of trunk and box in one frame; a pose without a partner is left out."""
        self._unpaired = [other for other in self._unpaired if pose.time - other.time < _TOGETHER]
        for other in self._unpaired:
            if other.body != pose.body and abs(other.time - pose.time) < _TOGETHER:
                self._unpaired.remove(other)
                pair = {one.body: self._world.seen(*self._offset(one)) for one in (pose, other)}
                time = max(pose.time, other.time)
                self._poses.append((time, pair[self._settings.trunk], pair[self._settings.box]))
                return
        self._unpaired.append(pose)

    @property
    def _oldest(self) -> float:
        """Time of the older one of the newest poses of trunk and box [s]."""
        return min(pose.time for pose in self._newest.values())

    def _offset(self, pose: TimedPose) -> Pose:
        s = self._settings
        offset = s.trunk_offset if pose.body == s.trunk else s.box_offset
        return offset_pose((pose.position, pose.orientation), offset)

    def _measured(self) -> Samples:
        """All that was collected since the last call, on the run's own clock."""
        robot, poses = self._robot, self._poses
        self._robot, self._poses = [], []
        seen = np.array([time for time, _, _ in poses]) - self._start
        records = np.array(robot, dtype=SAMPLE)
        times = records["time"] - self._start
        samples = {key: (times, records[name]) for key, name in _OWN.items()}
        in_force = self._plan.at(self._time)
        samples["command.position"] = self._followed.take(self._time, in_force, times, records["targets"])
        for name, pairs in (("trunk", [p[1] for p in poses]), ("box", [p[2] for p in poses])):
            places, turns = [pose[0] for pose in pairs], [pose[1] for pose in pairs]
            samples[f"{name}.position"] = seen, np.array(places).reshape(len(poses), 3)
            samples[f"{name}.orientation"] = seen, np.array(turns).reshape(len(poses), 4)
        return samples
