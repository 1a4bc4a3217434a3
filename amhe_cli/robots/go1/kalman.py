"""Kalman filters of two numbers, value and rate, shared by all axes of a vector; and one of an orientation.

All axes of a sensor are equally noisy, so that one covariance of 2 x 2 serves them all: three floats instead
of matrices. Accelerations are white (Bar-Shalom, Li, Kirubarajan: Estimation with Applications to Tracking
and Navigation, 2001, section 6.2.2). Measurements may come late by a little: they are compared with the
estimate extrapolated back to their time.

Quaternions are multiplied in plain floats here: one at a time, `core.rotations` takes 20 times as long.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import atan2, copysign, cos, hypot, sin, sqrt

import numpy as np

from amhe_cli.core.arrays import FloatArray


@dataclass(slots=True)
class ValueFilter:
    """Values and their rates; changes in place.

    Args:
        time: Time of the estimate [s].
        value: Estimated values in any unit, shape (k,).
        rate: Estimated rates [1/s], shape (k,).
        vv: Variance of a value.
        rr: Variance of a rate.
        drive: Root of the spectral density of the acceleration [1/s^2/sqrt(Hz)].
        walk: Root of the density of the random walk of values, in addition to their rates [1/sqrt(s)].
        vr: Covariance of a value with its rate.
    """

    time: float
    value: FloatArray
    rate: FloatArray
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
        self.value = self.value + dt * self.rate
        self.time = time

    def see_value(self, value: FloatArray, sd: float, time: float) -> None:
        """Correct by a value (k,), measured now or a little while ago."""
        age = max(self.time - time, 0.0)
        with_value, with_rate = self.vv - age * self.vr, self.vr - age * self.rr
        innovation = value - (self.value if age == 0.0 else self.at(time))
        self._correct(innovation, with_value, with_rate, with_value - age * with_rate + sd**2)

    def see_rate(self, rate: FloatArray, sd: float) -> None:
        """Correct by a rate (k,), measured now."""
        self._correct(rate - self.rate, self.vr, self.rr, self.rr + sd**2)

    def at(self, time: float) -> FloatArray:
        """Values at a time [s] near the estimate's."""
        return self.value + (time - self.time) * self.rate

    def _correct(self, innovation: FloatArray, with_value: float, with_rate: float, variance: float) -> None:
        """Correct by a measurement of this variance and of these covariances with value and rate."""
        to_value, to_rate = with_value / variance, with_rate / variance
        self.value = self.value + to_value * innovation
        self.rate = self.rate + to_rate * innovation
        self.vv -= to_value * with_value
        self.vr -= to_value * with_rate
        self.rr -= to_rate * with_rate


@dataclass(slots=True)
class Turn:
    """An orientation, and the small rotation by which it is wrong, in the body's own frame; changes in place.

    The rate of that rotation is the part of the angular velocity that no gyro measures: all of it where there
    is no gyro, the gyro's offset where there is one.

    Args:
        orientation: Unit quaternion w, x, y, z, shape (4,).
        error: Rotation vector [rad], zero between calls, and its rate [rad/s], each of shape (3,).
    """

    orientation: FloatArray
    error: ValueFilter

    @property
    def time(self) -> float:
        """Time of the estimate [s]."""
        return self.error.time

    def advance(self, time: float, angle: FloatArray | float = 0.0) -> None:
        """Predict to a time [s], by an angle (3,) [rad] that the gyro turned meanwhile."""
        if time > self.time:
            self.error.advance(time)
            self._fold(angle)

    def see(self, orientation: FloatArray, sd: float, time: float, rate: FloatArray | float = 0.0) -> None:
        """Correct by a unit quaternion (4,); `rate` is the gyro's [rad/s], for those that come late."""
        age = max(self.time - time, 0.0)
        innovation = _between(self.orientation, orientation)
        self.error.see_value(innovation + age * rate, sd, time)
        self._fold(0.0)

    def at(self, time: float, rate: FloatArray) -> FloatArray:
        """Unit quaternion at a time [s] near the estimate's, at this angular velocity [rad/s], shape (3,)."""
        return _turned(self.orientation, (time - self.time) * rate)

    def matrix(self) -> FloatArray:
        """Rotation matrix from body to world, shape (3, 3)."""
        w, x, y, z = self.orientation.tolist()
        return np.array(
            [
                [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
                [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
                [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
            ]
        )

    def _fold(self, angle: FloatArray | float) -> None:
        self.orientation = _turned(self.orientation, self.error.value + angle)
        self.error.value = np.zeros(3)


def _turned(orientation: FloatArray, rotation: FloatArray) -> FloatArray:
    """Turn by a rotation vector (3,) in the body's frame; of unit length again, whatever was rounded."""
    a, b, c = rotation.tolist()
    angle = sqrt(a * a + b * b + c * c)
    scale = sin(0.5 * angle) / angle if angle > 1e-12 else 0.5
    return _product(orientation.tolist(), [cos(0.5 * angle), scale * a, scale * b, scale * c])


def _between(start: FloatArray, end: FloatArray) -> FloatArray:
    """Rotation vector (3,) [rad], in the frame of `start`, that rotates it to `end`; signs do not matter."""
    w, x, y, z = start.tolist()
    cosine, *sines = _product([w, -x, -y, -z], end.tolist()).tolist()
    sine = hypot(*sines)
    scale = 2.0 * atan2(sine, abs(cosine)) / sine if sine > 1e-12 else 2.0
    return copysign(scale, cosine) * np.array(sines)


def _product(a: list[float], b: list[float]) -> FloatArray:
    """Hamilton product, scaled to unit length, shape (4,)."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    w = aw * bw - ax * bx - ay * by - az * bz
    x = aw * bx + ax * bw + ay * bz - az * by
    y = aw * by - ax * bz + ay * bw + az * bx
    z = aw * bz + ax * by - ay * bx + az * bw
    return np.array((w, x, y, z)) / sqrt(w * w + x * x + y * y + z * z)
