"""Excitation that a robot can play: chirps, multisines, steps and sweeps of all commanded joints together."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from amhe_cli.core.arrays import FloatArray, IntArray
from amhe_cli.core.errors import ConfigError, one_of
from amhe_cli.engine.states import home
from amhe_cli.system.model.elements import commanded, floats
from amhe_cli.system.system import System

#: Slowest and fastest frequency of a chirp [Hz].
CHIRP = 0.1, 10.0
#: Slowest and fastest sine of a multisine [Hz], and their number: slow ones show gravity and friction, fast
#: ones inertia.
LOWEST, HIGHEST, SINES = 0.15, 5.0, 6
#: Largest share of a command's range that is used.
SHARE = 0.9
#: Shortest time over which a motion fades in from rest, and out [s].
FADE = 0.5
#: Shortest and longest time that a step is held [s].
HELD = (0.3, 1.2)
#: Speed of a sweep, as a share of the largest speed.
SWEPT = (0.1, 0.4)
#: Largest speed where none is given: of hinges [rad/s], of slides [m/s].
HINGE, SLIDE = np.pi, 0.5
#: Share of the largest speed that commands use: a servo overshoots.
_PACE = 0.8
#: Factor on the share of the leeway, until nothing is broken, and the least share.
_LESS, _LEAST = 0.7, 0.1


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


@dataclass(frozen=True, slots=True, eq=False)
class Leeway:
    """How far commands may go, all of shape (k,).

    Args:
        rest: Commands at the home state.
        lower, upper: Limits of the commands, and of the joints where the commands are their positions.
        speed: Largest speed of the commands, which are positions [rad/s or m/s]; inf of other commands.
        fastest: Largest speed of their joints [rad/s or m/s].
        joints: Rows of their joints.
    """

    rest: FloatArray
    lower: FloatArray
    upper: FloatArray
    speed: FloatArray
    fastest: FloatArray
    joints: IntArray


def leeway_of(system: System, controls: DrivenControls, speed: float | None) -> Leeway:
    """Where the commands of a system may go.

    Args:
        controls: Its controls.
        speed: Largest speed of a joint [rad/s or m/s]; None: `HINGE` and `SLIDE`.
    """
    model = system.model
    lower, upper, most = controls.lower.copy(), controls.upper.copy(), np.full(controls.rest.size, np.inf)
    fastest, joints = np.empty(controls.rest.size), model.actuator_trnid[controls.actuators, 0]
    for i, row in enumerate(controls.actuators):
        kind, joint = commanded(model, int(row)), int(model.actuator_trnid[row, 0])
        # 2: mjJNT_SLIDE
        allowed = speed or (SLIDE if model.jnt_type[joint] == 2 else HINGE)
        fastest[i] = allowed
        if kind == "position":
            most[i] = allowed
            if model.jnt_limited[joint]:
                lower[i] = max(lower[i], model.jnt_range[joint, 0])
                upper[i] = min(upper[i], model.jnt_range[joint, 1])
        elif kind == "velocity":
            lower[i], upper[i] = max(lower[i], -_PACE * allowed), min(upper[i], _PACE * allowed)
    return Leeway(np.clip(controls.rest, lower, upper), lower, upper, most, fastest, joints)


@dataclass(frozen=True, slots=True, eq=False)
class Recipe:
    """Commands over time: from rest to a centre, about which they wave, and back.

    Args:
        name: Short name of the motion.
        kind: Which of `RECIPES` it is.
        leeway: Where the commands may go.
        share: Share of the leeway and of the speed that each command uses, shape (k,).
        seed: Seed of its centre, size and phases.
    """

    name: str
    kind: str
    leeway: Leeway
    share: FloatArray
    seed: Sequence[int]

    @property
    def title(self) -> str:
        """What it is, in words."""
        shares = ", ".join(f"{100.0 * share:.0f} %" for share in self.share)
        return f"it uses {shares} of what the limits of joints, speed and force allow"

    def smaller(self, joint: int | None) -> Recipe | None:
        """The same with less of a joint's motion, or of all joints'; None where there is nothing less."""
        less = self.leeway.joints == joint
        share = np.where(less | ~less.any(), _LESS * self.share, self.share)
        return replace(self, share=share) if (share > _LEAST).all() else None

    def at(self, times: FloatArray) -> FloatArray:
        """Commands at evenly spaced times [s] (n,), which are the whole motion, shape (n, k)."""
        leeway, rng = self.leeway, np.random.default_rng(self.seed)
        away = self.share * rng.uniform() * (0.5 * (leeway.lower + leeway.upper) - leeway.rest)
        centre = leeway.rest + away
        most = SHARE * np.minimum(leeway.upper - centre, centre - leeway.lower)
        size = self.share * rng.uniform(0.4, 1.0, leeway.rest.size) * most
        speed = _PACE * self.share * leeway.speed
        lead = max(FADE, float(np.max(2.0 * np.abs(away) / speed)))
        fade = (_smooth(times / lead) * _smooth((times[-1] - times) / lead))[:, None]
        wave = _WAVES[self.kind](times, size, speed, rng)
        most = speed * (times[1] - times[0])
        slow = _slewed(leeway.rest + fade * (away + wave), most)
        left = np.where(np.isfinite(most), most, 1e300) * np.arange(times.size - 1, -1, -1.0)[:, None]
        return np.clip(slow, leeway.rest - left, leeway.rest + left)  # near enough to be at rest at the end


def recipes(kind: str, leeway: Leeway, count: int, seed: int) -> list[Recipe]:
    """Random recipes of a kind, which use all the leeway.

    Raises:
        ConfigError: There is no such kind.
    """
    if kind not in RECIPES:
        raise ConfigError(f"`recipe`: {one_of('recipe', kind, RECIPES)}")
    return [
        Recipe(f"{kind} {number + 1}", kind, leeway, np.ones(leeway.rest.size), (seed, number))
        for number in range(count)
    ]


def plain(leeway: Leeway) -> Recipe:
    """The motion that recipes are compared with: all commands up and down together every four seconds."""
    return Recipe("slow sine", "slow sine", leeway, np.ones(leeway.rest.size), (0, 0))


def _smooth(ratio: FloatArray) -> FloatArray:
    """From 0 at 0 to 1 at 1, without a jump of the speed."""
    inside = np.clip(ratio, 0.0, 1.0)
    return inside**2 * (3.0 - 2.0 * inside)


def _slewed(targets: FloatArray, most: FloatArray) -> FloatArray:
    """Targets (n, k) that change by at most so much (k,) from row to row."""
    slow = targets.copy()
    for i in range(1, len(slow)):
        slow[i] = np.clip(targets[i], slow[i - 1] - most, slow[i - 1] + most)
    return slow


def _chirp(times: FloatArray, size: FloatArray, speed: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Sines whose frequency grows exponentially; the size falls where they would be too fast."""
    lowest, highest = CHIRP[0], min(CHIRP[1], 0.1 / (times[1] - times[0]))
    growth = np.log(highest / lowest) / times[-1]
    phase = 2.0 * np.pi * lowest * np.expm1(growth * times) / growth
    rate = 2.0 * np.pi * lowest * np.exp(growth * times)[:, None]
    return np.minimum(size, speed / rate) * np.sin(phase[:, None] + rng.uniform(0.0, 2.0 * np.pi, size.size))


def _multisine(
    times: FloatArray, size: FloatArray, speed: FloatArray, rng: np.random.Generator
) -> FloatArray:
    """Sums of sines, all of them smaller where they would be too fast."""
    rate = 2.0 * np.pi * np.geomspace(LOWEST, HIGHEST, SINES)
    weight = rng.dirichlet(np.ones(SINES), size=size.size)
    phase = rng.uniform(0.0, 2.0 * np.pi, (size.size, SINES))
    fastest = np.maximum(size * (weight * rate).sum(axis=1), 1e-12)
    waves = (weight * np.sin(rate * times[:, None, None] + phase)).sum(axis=-1)
    return np.minimum(1.0, speed / fastest) * size * waves


def _steps(times: FloatArray, size: FloatArray, speed: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Random targets, held for a while; all joints change together."""
    ends = np.cumsum(rng.uniform(*HELD, 2 + int(times[-1] / HELD[0])))
    levels = rng.uniform(-1.0, 1.0, (ends.size + 1, size.size)) * size
    return levels[np.searchsorted(ends, times, side="right")]


def _sweep(times: FloatArray, size: FloatArray, speed: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Slow ramps up and down: they show gravity and dry friction."""
    slow = rng.uniform(*SWEPT, size.size) * np.minimum(speed, size)  # of torques, their size a second
    period = np.clip(4.0 * size / np.maximum(slow, 1e-12), 2.0, times[-1] / 1.5)
    return size * 2.0 / np.pi * np.arcsin(np.sin(2.0 * np.pi * times[:, None] / period))


def _sine(times: FloatArray, size: FloatArray, speed: FloatArray, rng: np.random.Generator) -> FloatArray:
    """One slow sine of all commands."""
    rate = 2.0 * np.pi * 0.25
    return np.minimum(size, speed / rate) * np.sin(rate * times[:, None])


_WAVES: Mapping[str, Callable[[FloatArray, FloatArray, FloatArray, np.random.Generator], FloatArray]] = {
    "chirp": _chirp,
    "multisine": _multisine,
    "steps": _steps,
    "sweep": _sweep,
    "slow sine": _sine,
}
#: The kinds of recipes that can be requested.
RECIPES = tuple(kind for kind in _WAVES if kind != "slow sine")
