"""Excitations of plain actuators: sums of sines within the controls' limits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amhe_cli.core.arrays import FloatArray

#: Lowest and highest frequency [Hz]: from slow (gravity, friction) to fast (inertia).
LOWEST, HIGHEST = 0.15, 2.5
#: Sines of one control, and the largest share of its range that they use together.
SINES, SHARE = 6, 0.9
#: Time over which they fade in from rest [s].
FADE = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Multisine:
    """Controls over time.

    Args:
        name: What it is.
        rest: Controls before it begins, shape (nu,).
        hertz: Frequencies, shape (k,).
        size: Amplitude of each sine of each control, shape (nu, k).
        phase: The same of phases [rad].
    """

    name: str
    rest: FloatArray
    hertz: FloatArray
    size: FloatArray
    phase: FloatArray

    def at(self, times: FloatArray) -> FloatArray:
        """Controls at times [s] (n,), shape (n, nu)."""
        angle = 2.0 * np.pi * self.hertz * times[:, None, None] + self.phase
        swing = (self.size * np.sin(angle)).sum(axis=-1)
        return self.rest + np.clip(times / FADE, 0.0, 1.0)[:, None] * swing


def candidates(
    rest: FloatArray, lower: FloatArray, upper: FloatArray, count: int, rng: np.random.Generator
) -> list[Multisine]:
    """Random multisines about the rest that stay within the limits, all (nu,) in the controls' units."""
    hertz = np.geomspace(LOWEST, HIGHEST, SINES)
    room = SHARE * np.minimum(upper - rest, rest - lower)
    found = []
    for number in range(count):
        weight = rng.dirichlet(np.ones(SINES), size=rest.size)  # sums to one: the limits hold at any phase
        size = room[:, None] * rng.uniform(0.3, 1.0) * weight
        phase = rng.uniform(0.0, 2.0 * np.pi, size=(rest.size, SINES))
        found.append(Multisine(f"multisine {number + 1}", rest, hertz, size, phase))
    return found


def slow_sine(rest: FloatArray, lower: FloatArray, upper: FloatArray) -> Multisine:
    """What a plan is held against: all controls up and down together once in four seconds."""
    room = 0.5 * np.minimum(upper - rest, rest - lower)
    return Multisine("slow sine", rest, np.array([0.25]), room[:, None], np.zeros((rest.size, 1)))
