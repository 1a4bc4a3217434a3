"""Kalman filters of two numbers, value and rate, shared by all axes of a vector; and one of an orientation.

All axes of a sensor are equally noisy, so that one covariance of 2 x 2 serves them all: three floats instead
of matrices. Accelerations are white (Bar-Shalom, Li, Kirubarajan: Estimation with Applications to Tracking
and Navigation, 2001, section 6.2.2). Measurements may come late by a little: they are compared with the
estimate extrapolated back to their time.

Vectors are sequences of plain floats here: for a few numbers at a time NumPy takes longer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import atan2, copysign, cos, hypot, sin, sqrt

Vector = Sequence[float]
REST = (0.0, 0.0, 0.0)


@dataclass(slots=True)
class ValueFilter:
    """Values and their rates; changes in place.

    Args:
        time: Time of the estimate [s].
        value: Estimated values in any unit, k of them.
        rate: Estimated rates [1/s], likewise.
        vv: Variance of a value.
        rr: Variance of a rate.
        drive: Root of the spectral density of the acceleration [1/s^2/sqrt(Hz)].
        walk: Root of the density of the random walk of values, in addition to their rates [1/sqrt(s)].
        vr: Covariance of a value with its rate.
    """

    time: float
    value: Vector
    rate: Vector
    vv: float
    rr: float
    drive: float
    walk: float = 0.0
    vr: float = 0.0

    def advance(self, time: float) -> None:
        """Predict to a time [s]; an earlier one changes nothing."""
        dt = time - self.time
        if dt <= 0.0:
            return
        driven = self.drive**2 * dt
        self.vv += dt * (2.0 * self.vr + dt * self.rr + dt * driven / 3.0 + self.walk**2)
        self.vr += dt * (self.rr + 0.5 * driven)
        self.rr += driven
        self.value, self.time = self.at(time), time

    def see_value(self, value: Vector, sd: float, time: float) -> None:
        """Correct by values, measured now or a little while ago."""
        age = max(self.time - time, 0.0)
        with_value, with_rate = self.vv - age * self.vr, self.vr - age * self.rr
        expected = self.value if age == 0.0 else self.at(time)
        self._correct(value, expected, with_value, with_rate, with_value - age * with_rate + sd**2)

    def see_rate(self, rate: Vector, sd: float) -> None:
        """Correct by rates, measured now."""
        self._correct(rate, self.rate, self.vr, self.rr, self.rr + sd**2)

    def at(self, time: float) -> Vector:
        """Values at a time [s] near the estimate's."""
        passed = time - self.time
        return [value + passed * rate for value, rate in zip(self.value, self.rate, strict=True)]

    def _correct(
        self, seen: Vector, expected: Vector, with_value: float, with_rate: float, variance: float
    ) -> None:
        """Correct by a measurement of this variance and of these covariances with value and rate."""
        to_value, to_rate = with_value / variance, with_rate / variance
        before, self.value, self.rate = zip(self.value, self.rate, seen, expected, strict=True), [], []
        for value, rate, measured, predicted in before:
            innovation = measured - predicted
            self.value.append(value + to_value * innovation)
            self.rate.append(rate + to_rate * innovation)
        self.vv -= to_value * with_value
        self.vr -= to_value * with_rate
        self.rr -= to_rate * with_rate


@dataclass(slots=True)
class Turn:
    """An orientation, and the small rotation by which it is wrong, in the body's own frame; changes in place.

    The rate of that rotation is the part of the angular velocity that no gyro measures: all of it where there
    is no gyro, the gyro's offset where there is one.

    Args:
        orientation: Unit quaternion w, x, y, z.
        error: Rotation vector [rad], zero between calls, and its rate [rad/s], three numbers each.
    """

    orientation: Vector
    error: ValueFilter

    @property
    def time(self) -> float:
        """Time of the estimate [s]."""
        return self.error.time

    def advance(self, time: float, angle: Vector = REST) -> None:
        """Predict to a time [s], by a rotation vector [rad] by which the gyro turned meanwhile."""
        if time > self.time:
            self.error.advance(time)
            self._fold(angle)

    def see(self, orientation: Vector, sd: float, time: float, rate: Vector = REST) -> None:
        """Correct by a unit quaternion; `rate` is the gyro's [rad/s], for those that come late."""
        age = max(self.time - time, 0.0)
        off = _between(self.orientation, orientation)
        self.error.see_value([a + age * b for a, b in zip(off, rate, strict=True)], sd, time)
        self._fold(REST)

    def at(self, time: float, rate: Vector) -> Vector:
        """Unit quaternion at a time [s] near the estimate's, at this angular velocity [rad/s]."""
        return _turned(self.orientation, [(time - self.time) * r for r in rate])

    def matrix(self) -> list[Vector]:
        """Rotation matrix from body to world, three rows."""
        w, x, y, z = self.orientation
        return [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
            [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
            [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
        ]

    def _fold(self, angle: Vector) -> None:
        turned = [a + b for a, b in zip(self.error.value, angle, strict=True)]
        self.orientation, self.error.value = _turned(self.orientation, turned), REST


def _turned(orientation: Vector, rotation: Vector) -> Vector:
    """Turn by a rotation vector in the body's frame; of unit length again, whatever was rounded."""
    a, b, c = rotation
    angle = sqrt(a * a + b * b + c * c)
    scale = sin(0.5 * angle) / angle if angle > 1e-12 else 0.5
    return _product(orientation, [cos(0.5 * angle), scale * a, scale * b, scale * c])


def _between(start: Vector, end: Vector) -> Vector:
    """Rotation vector [rad], in the frame of `start`, that rotates it to `end`; signs do not matter."""
    w, x, y, z = start
    cosine, *sines = _product([w, -x, -y, -z], end)
    sine = hypot(*sines)
    scale = 2.0 * atan2(sine, abs(cosine)) / sine if sine > 1e-12 else 2.0
    return [copysign(scale, cosine) * s for s in sines]


def _product(a: Vector, b: Vector) -> Vector:
    """Hamilton product, scaled to unit length."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    w = aw * bw - ax * bx - ay * by - az * bz
    x = aw * bx + ax * bw + ay * bz - az * by
    y = aw * by - ax * bz + ay * bw + az * bx
    z = aw * bz + ax * by - ay * bx + az * bw
    size = sqrt(w * w + x * x + y * y + z * z)
    return [w / size, x / size, y / size, z / size]
