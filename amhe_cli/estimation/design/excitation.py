"""Excitation of plain actuators: the controls that can be driven, and sums of sines within their limits."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from amhe_cli.core.arrays import FloatArray, IntArray
from amhe_cli.core.errors import ConfigError
from amhe_cli.engine.states import home
from amhe_cli.system.model.couplings import floats
from amhe_cli.system.model.elements import commanded
from amhe_cli.system.system import System

#: Lowest and highest frequency [Hz]: slow ones show gravity and friction, fast ones inertia.
LOWEST, HIGHEST = 0.15, 2.5
#: Number of sines of one control, and the largest share of its range that they use together.
SINES, SHARE = 6, 0.9
#: Time over which the sines fade in from rest [s].
FADE = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class DrivenControls:
    """The controls that a system's signals command.

    Args:
        columns: Columns of the controls in the engine's input vector, shape (n,).
        actuators: Rows of their actuators, shape (n,).
        rest: Values of the controls at the home state, shape (n,).
        lower, upper: Limits of the controls, shape (n,).
        home: The whole input vector at the home state, shape (nu,).
    """

    columns: IntArray
    actuators: IntArray
    rest: FloatArray
    lower: FloatArray
    upper: FloatArray
    home: FloatArray


def driven_controls(system: System) -> DrivenControls:
    """The controls that a system's signals command.

    Raises:
        ConfigError: There are none, one has no limits, or one moves a free body.
    """
    model = system.model
    columns = np.array([c for i in system.inputs if i.delayed for c in i.columns], dtype=np.int64)
    if not columns.size:
        raise ConfigError(f"{system.name}: no signal commands an actuator, so there is nothing to drive")
    # controls stand first in the input vector: a column is the address of a control
    rows = [int(np.flatnonzero(model.actuator_ctrladr == column)[0]) for column in columns]
    limits = np.array([_limits(system, row) for row in rows])
    for row, limit in zip(rows, limits, strict=True):
        name = model.actuator(row).name
        if not np.isfinite(limit).all():
            raise ConfigError(
                f"{system.name}: give actuator {name!r} a ctrlrange, or its joint a range: a probe "
                f"stays within it"
            )
        if floats(model, int(model.actuator_trnid[row, 0])):
            raise ConfigError(
                f"{system.name}: actuator {name!r} moves a body that nothing holds: a robot on legs needs a "
                f"controller, which only go1_push has"
            )
    _, rest = home(model, system.keyframe, system.input_spec)
    return DrivenControls(columns, np.array(rows), rest[columns], limits[:, 0], limits[:, 1], rest)


def _limits(system: System, actuator: int) -> FloatArray:
    """Limits of a control (2,); of a position servo without any, those of its joint."""
    model = system.model
    joint = int(model.actuator_trnid[actuator, 0])
    if model.actuator_ctrllimited[actuator]:
        return model.actuator_ctrlrange[actuator]
    if commanded(model, actuator) == "position" and model.jnt_limited[joint]:
        return model.jnt_range[joint]
    return np.full(2, np.nan)


class Waves(Protocol):
    """Controls over time."""

    @property
    def name(self) -> str:
        """Short name of the motion."""
        ...

    @property
    def title(self) -> str:
        """What it is, in words."""
        ...

    def smaller(self, joint: int | None) -> Waves | None:
        """The same with less of a joint's motion, or of all joints'; None where there is nothing less."""
        ...

    def at(self, times: FloatArray) -> FloatArray:
        """Controls at times [s] (n,), shape (n, nu)."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Multisine:
    """Controls over time: sums of sines.

    Args:
        name: Short name of the motion.
        rest: Controls before it begins, shape (nu,).
        hertz: Frequencies of the sines [Hz], shape (k,).
        size: Amplitude of each sine of each control, shape (nu, k).
        phase: Phase of each sine of each control [rad], shape (nu, k) or (nu, 1).
    """

    name: str
    rest: FloatArray
    hertz: FloatArray
    size: FloatArray
    phase: FloatArray

    @property
    def title(self) -> str:
        """What it is, in words."""
        return "sines within the limits of the controls"

    def smaller(self, joint: int | None) -> Waves | None:
        """See `Waves`: the sines stay as they are."""
        return None

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
    """The plain motion that plans are compared with: all controls up and down together every four seconds."""
    room = 0.5 * np.minimum(upper - rest, rest - lower)
    return Multisine("slow sine", rest, np.array([0.25]), room[:, None], np.zeros((rest.size, 1)))
