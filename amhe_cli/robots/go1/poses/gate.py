"""Poses in the frame of the task, and whether they can be true: what cannot is dropped, and counted."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.rotations import conjugate, difference, exp, multiply, rotate
from amhe_cli.robots.go1.kalman import REST, ValueFilter
from amhe_cli.robots.go1.poses.sources import Pose, PoseError
from amhe_cli.robots.go1.settings import Offset, PoseSettings

#: IMU and cameras may differ by so much about the trunk's up [rad].
LEVEL = float(np.deg2rad(15.0))
#: Height of a lying or standing trunk over the floor [m]: what is outside is not in metres, or not the trunk.
_HEIGHTS = (0.03, 0.6)


def offset_pose(pose: Pose, offset: Offset) -> Pose:
    """The pose of a body from that of its rigid body; offset: place [m] and rotation vector [rad] in it."""
    position, orientation = pose
    place, turn = np.array(offset[:3]), np.array(offset[3:])
    return position + rotate(orientation, place), multiply(orientation, exp(turn))


def rigid_body(true: Pose, offset: Offset) -> Pose:
    """The pose that a rigid body has, whose offset leads to the true pose."""
    turn = multiply(true[1], conjugate(exp(np.array(offset[3:]))))
    return true[0] - rotate(turn, np.array(offset[:3])), turn


def up(orientation: FloatArray) -> FloatArray:
    """The world's up in a body's frame, shape (3,)."""
    return rotate(conjugate(orientation), np.array([0.0, 0.0, 1.0]))


def check_axes(trunk: Pose, imu: FloatArray) -> None:
    """Refuse a frame that is not in metres with z upward, by comparison with the IMU.

    Args:
        imu: Orientation by the IMU, shape (4,); its heading does not matter.

    Raises:
        PoseError: They contradict each other.
    """
    position, orientation = trunk
    height = float(position[2])
    between = float(np.arccos(np.clip(up(orientation) @ up(imu), -1.0, 1.0)))
    if between > LEVEL and abs(float(up(orientation)[2])) < 0.5:
        raise PoseError(
            f"by motion capture the trunk leans {np.rad2deg(between):.0f} degrees more than by its IMU: is "
            "its up axis z? (Motive: Settings > Streaming > Up Axis: Z)"
        )
    if between > LEVEL:
        raise PoseError(
            f"motion capture and IMU disagree by {np.rad2deg(between):.0f} degrees about the trunk's tilt: "
            "align the rigid body with the trunk, or set go1.trunk_offset"
        )
    if not _HEIGHTS[0] < height < _HEIGHTS[1]:
        raise PoseError(
            f"by motion capture the trunk is {height:.3g} m over the floor: stream metres, z upward, with "
            "the origin on the floor, and the pivot in the trunk's centre"
        )


def check_place(box: FloatArray, wanted: FloatArray, tolerance: float) -> None:
    """Refuse a box that is not where the task puts it.

    Args:
        box: Centre of the box in the task's frame [m], shape (3,).
        wanted: Centre at which it should be, shape (3,).
        tolerance: Largest distance [m].

    Raises:
        PoseError: It is elsewhere.
    """
    if np.hypot(*(box[:2] + wanted[:2])) < tolerance and wanted[0] > tolerance:
        raise PoseError(
            "the box seems to be behind the robot: have the two rigid bodies each other's name? "
            "(`go1.trunk=NAME` `go1.box=NAME`)"
        )
    away = np.hypot(*(box[:2] - wanted[:2]))
    if away > tolerance or abs(box[2] - wanted[2]) > tolerance:
        at, to = (", ".join(f"{value:.2f}" for value in place) for place in (box, wanted))
        raise PoseError(
            f"the box is at ({at}) m from the robot, the task wants it at ({to}): move one of them, or "
            "set go1.box_offset (or go1.place_tolerance)"
        )


def tilt_offset(trunk: Pose, imu: FloatArray) -> FloatArray:
    """Rotation vector [rad] that would make motion capture agree with the IMU about up, shape (3,)."""
    seen, sensed = up(trunk[1]), up(imu)
    axis, sine = np.cross(sensed, seen), float(np.linalg.norm(np.cross(sensed, seen)))
    angle = float(np.arctan2(sine, seen @ sensed))
    return axis / sine * angle if sine > 1e-9 else np.zeros(3)


#: Noise of positions [m], first sd of the velocity [m/s], and the root of the density of accelerations
#: [m/s^2/sqrt(Hz)]: those of a robot that walks, and of a box that is hit.
_NOISE, _FIRST_SPEED, _DRIVE = 0.002, 0.3, 1.0
#: Noise of orientations allows this angle besides the turning [rad]; a stamp may be early by this, and come
#: after a newer one by that [s].
_ANGLE, _EARLY, _LATE = 0.1, 0.05, 0.1
#: Number of poses of which the share of dropped ones is taken.
_SPAN = 100
#: Cameras and IMU may disagree about the trunk's tilt for so long [s].
_LEANING = 0.2
#: The box is nearer to the robot than this [m], and before it.
_REACH = 2.0


@dataclass(slots=True)
class _Track:
    """What is known of a body by the poses that were believed."""

    speed: float
    place: ValueFilter | None = None
    turn: FloatArray = field(default_factory=lambda: np.array([1.0, 0.0, 0.0, 0.0]))
    last: float = -np.inf
    dropped: deque[bool] = field(default_factory=lambda: deque(maxlen=_SPAN))


class Gate:
    """Judges one pose of trunk or box after the other, in the frame of motion capture.

    Args:
        settings: What a pose may be.
        trunk, box: Names of the bodies.

    Attributes:
        doubt: Why poses are not believed any more, and the robot should stop; '' if they are.
        dropped: Number of poses that were dropped.
    """

    def __init__(self, settings: PoseSettings, trunk: str, box: str) -> None:
        self._settings, self._trunk = settings, trunk
        self._tracks = {trunk: _Track(settings.trunk_speed), box: _Track(settings.box_speed)}
        self._leans_since: float | None = None
        self.doubt = ""
        self.dropped = 0

    def begin(self) -> None:
        """Count from now on: the run begins."""
        for track in self._tracks.values():
            track.dropped.clear()
        self._leans_since, self.doubt, self.dropped = None, "", 0

    def believes(self, body: str, time: float, pose: Pose, now: float, imu: FloatArray, flaw: str) -> bool:
        """Whether a pose is believed; it then counts for the next ones.

        Args:
            time: Time of the exposure [s].
            pose: Pose of the body.
            now: Present time [s].
            imu: Orientation of the trunk by the IMU, shape (4,); only its tilt counts.
            flaw: What is wrong with it already; '' if nothing is.
        """
        track = self._tracks[body]
        flaw = flaw or self._flaw(body, track, time, pose, now)
        track.dropped.append(bool(flaw))
        if flaw:
            self.dropped += 1
            count = sum(track.dropped)
            if count >= self._settings.dropped:
                self.doubt = f"{count} of the last {_SPAN} poses of {body!r} cannot be true: {flaw}"
            return False
        self._follow(track, time, pose)
        if body == self._trunk:
            self._compare(time, pose, imu)
        return True

    def _flaw(self, body: str, track: _Track, time: float, pose: Pose, now: float) -> str:
        place, turn = pose
        low, high = np.array(self._settings.bounds)
        if not (np.isfinite(turn).all() and (place >= low).all() and (place <= high).all()):  # NaN is outside
            return "it is outside of the room (`go1.poses.bounds`)"
        if time < track.last - _LATE:  # whatever it shows, nobody can say that it is too far for its time
            return f"it is {track.last - time:.3g} s older than the one before"
        if time > now + _EARLY:
            return f"its stamp is {time - now:.3g} s ahead"
        if track.place is not None:
            step, since = float(np.linalg.norm(place - track.place.value)), abs(time - track.last)
            margin = self._settings.gate * _NOISE
            if step > track.speed * since + margin:
                return f"it steps by {step:.2g} m in {1e3 * since:.0f} ms"
            angle = float(np.linalg.norm(difference(turn, track.turn)))
            if angle > self._settings.turn_speed * since + _ANGLE:
                return f"it turns by {np.rad2deg(angle):.0f} degrees in {1e3 * since:.0f} ms"
            off, sd = _innovation(track.place, time, place)
            if off > self._settings.gate * sd:
                return f"it is {off:.2g} m off what the ones before it predict"
        return "" if body == self._trunk else self._place_flaw(place)

    def _place_flaw(self, box: FloatArray) -> str:
        """What is wrong with where the box is, as the robot sees it."""
        trunk = self._tracks[self._trunk]
        if trunk.place is None:
            return ""
        ahead, left, _ = rotate(conjugate(trunk.turn), box - trunk.place.value).tolist()
        if ahead < 0.0:
            return "the box would be behind the robot"
        away = float(np.hypot(ahead, left))
        return f"the box would be {away:.1f} m from the robot" if away > _REACH else ""

    def _follow(self, track: _Track, time: float, pose: Pose) -> None:
        place, track.turn = pose
        if track.place is None:
            track.place = ValueFilter(time, place.tolist(), REST, _NOISE**2, _FIRST_SPEED**2, _DRIVE)
        track.place.advance(time)
        track.place.see_value(place.tolist(), _NOISE, time)
        track.last = time

    def _compare(self, time: float, pose: Pose, imu: FloatArray) -> None:
        """Doubt a trunk whose tilt is not that of the IMU."""
        between = float(np.arccos(np.clip(up(pose[1]) @ up(imu), -1.0, 1.0)))
        if between <= LEVEL:
            self._leans_since = None
        elif self._leans_since is None:
            self._leans_since = time
        elif time - self._leans_since >= _LEANING:
            self.doubt = (
                f"motion capture and IMU disagree by {np.rad2deg(between):.0f} degrees about the trunk's tilt"
            )


def _innovation(place: ValueFilter, time: float, seen: FloatArray) -> tuple[float, float]:
    """Distance of a position (3,) from the predicted one, and its sd along an axis [m]."""
    dt = abs(time - place.time)
    variance = place.vv + dt * (2.0 * abs(place.vr) + dt * (place.rr + place.drive**2 * dt / 3.0)) + _NOISE**2
    return float(np.linalg.norm(seen - place.at(time))), float(np.sqrt(variance))
