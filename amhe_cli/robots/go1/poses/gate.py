"""Poses are checked before they are believed: those that cannot be true are dropped, and counted."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.rotations import conjugate, difference, rotate
from amhe_cli.robots.go1.poses.frame import LEVEL, up
from amhe_cli.robots.go1.poses.source import Pose
from amhe_cli.robots.go1.settings import PoseSettings
from amhe_cli.robots.go1.state_estimator.kalman import ValueFilter

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
            body: Name of the body.
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
            track.place = ValueFilter(time, place, np.zeros(3), _NOISE**2, _FIRST_SPEED**2, _DRIVE)
        track.place.advance(time)
        track.place.see_value(place, _NOISE, time)
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
