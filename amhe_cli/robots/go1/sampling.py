"""The samples of each control cycle for log and estimator: sensors, poses with twists, commands."""

from __future__ import annotations

import numpy as np

from amhe_cli.core.samples import Samples, Thinner, since
from amhe_cli.robots.go1.state import State

#: Time between two samples of joints and IMU [s].
SAMPLE_PERIOD = 0.01
_OWN = ("joints.position", "joints.velocity", "imu.angular_velocity", "imu.linear_acceleration")


class Sampler:
    """Makes samples of each cycle's measurements, estimates and commands, in single precision.

    The robot's own samples are thinned: 500 Hz of twelve joints are most of a log, and an identification
    learns little from them. Nothing is older than the first command: then the clock of our reader, which
    starts at the first sample, meets every command on a step of its own.
    """

    def __init__(self) -> None:
        self._thinner = Thinner(SAMPLE_PERIOD)
        self._last: State | None = None

    def __call__(self, measured: Samples, estimate: State) -> Samples:
        """The samples of one cycle, from its measurements and its estimate; once for each, in order."""
        own = self._thinner.thinned({key: measured[key] for key in _OWN})
        seen = {key: series for key, series in measured.items() if key.startswith(("trunk.", "box."))}
        commands = {"command.position": measured["command.position"]}
        begun = -np.inf if self._last else estimate.time - 1e-6
        samples = {
            **since(own, begun),
            **self._with_twists(since(seen, begun), estimate),
            **since(commands, begun),
        }
        self._last = estimate
        # single precision: half of a log's size, and more digits than any sensor has
        return {
            key: (times, np.asarray(values, dtype=np.float32).astype(np.float64))
            for key, (times, values) in samples.items()
        }

    def _with_twists(self, seen: Samples, now: State) -> Samples:
        """Measured poses, with twists interpolated between the last cycle's estimate and this one's."""
        before = self._last or now
        samples = dict(seen)
        for name in ("trunk", "box"):
            times, _ = seen[f"{name}.position"]
            passed = max(now.time - before.time, 1e-9)
            share = np.clip((times - before.time) / passed, 0.0, 1.0)[:, None] if self._last else 1.0
            for key, field in (("linear_velocity", "velocity"), ("angular_velocity", "rate")):
                twists = [getattr(getattr(state, name), field) for state in (before, now)]
                start, end = (np.tile(twist, (times.size, 1)) for twist in twists)
                samples[f"{name}.{key}"] = times, start + share * (end - start)
        return samples
