"""What a joint may have that its model lacks: springs, weights, friction, limits, contacts, what repeats."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from itertools import permutations
from typing import Any

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.engine.states import controls
from amhe_cli.estimation.explain.candidate import (
    Cause,
    CauseMaker,
    MeasuredDof,
    number,
    positive,
    says,
    signed,
    times,
)
from amhe_cli.system.model.elements import axis_in, driven_joint, heaviest_part, holds_position

#: Numbers of a joint that may be wrong: kind -> what it is, with '#' for its size; field and column of the
#: model, and its word in `set:`; against what it is drawn.
NUMBERS = {
    "viscous": ("viscous friction of # {f} s/{u}", "dof_damping", "damping", "speed"),
    "dry": ("dry friction of # {f}", "dof_frictionloss", "friction_loss", "speed"),
    "quadratic": (
        "friction with the square of the speed of # {f} s^2/{u}^2",
        *("dof_dampingpoly", "damping_quadratic", "speed"),
    ),
    "armature": ("an inertia of # {kg}", "dof_armature", "armature", "acceleration"),
}
#: Quantiles of a force or speed between which a limit is tried at several values; and of positions at which a
#: contact is.
_LIMITED, _TRIED, _PLACES = (0.1, 0.95), 11, (0.6, 0.7, 0.8, 0.9)
#: Waves on a turn, of what repeats with the angle, and the fewest of them that the motion must pass.
_WAVES, _PASSED = np.unique(np.geomspace(3, 60, 40).round()), 1.5
#: Frequencies at which what repeats in time is looked for, and peaks of them that are tried.
_STEPS, _PEAKS = 2000, 24
#: Speeds, in shares of their rms, below which friction may rise.
_SLOW = (0.1, 0.25, 0.5)
#: Share of a free body's weight from which a constant force against it is what carries the body.
_CARRIED = 0.2
#: A range of angles [rad] in which a sine is more than a line.
_CURVED = 0.5
_GRAVITY = 9.81


def joint_causes(maker: CauseMaker) -> Iterator[Cause]:
    """Candidates on each measured degree of freedom; more of hinges and slides."""
    effort = maker.system.match == "effort"
    hinges = [j for j in maker.moved.values() if j.place >= 0]
    for j in maker.moved.values():
        yield from _numbers(maker, j)
        yield from _in_time(maker, j)
        if effort:
            words = times("its measured torque is", "times what the motion needs", -1.0)
            yield maker.on(j, "torque scale", [j.given], words, "time")
    if effort:
        yield _late_torques(maker)
    for j in hinges:
        yield from _springs(maker, j)
        yield from _friction(maker, j)
        yield from _limits(maker, j, forces=not effort)
        yield from _repeating(maker, j)
    for j, other in permutations(hinges, 2):
        yield from _coupling(maker, j, other)


def _late_torques(maker: CauseMaker) -> Cause:
    """Measured torques that come later, or earlier, than the measured motion."""
    dofs, values = maker.spread(maker.change(maker.found.forces.given)[None])

    def words(c: FloatArray, sd: FloatArray) -> str:
        late = number(1e3 * abs(c[0]), 1e3 * sd[0])
        return f"its measured torques come {late} ms {'later' if c[0] > 0.0 else 'earlier'} than its motion"

    against = "change of the torque [N m/s]", values[0, :, dofs[0]]
    return Cause("torque delay", "torques", dofs, values, words, lambda: against)


def _numbers(maker: CauseMaker, j: MeasuredDof) -> Iterator[Cause]:
    """Numbers of the model that are too small, or too large."""
    columns = {"viscous": j.v, "dry": j.way, "quadratic": j.v * np.abs(j.v), "armature": j.a}
    kg = "kg m^2" if j.u == "rad" else "kg"
    for kind, (text, field, word, against) in NUMBERS.items():
        if maker.free(field, j.dof):
            continue
        has, text = maker.now(field, j.dof), text.format(f=j.f, u=j.u, kg=kg)

        def words(c: FloatArray, sd: FloatArray, text: str = text) -> str:
            return says(text + " less than the model has" * bool(c[0] >= 0.0), 0.0)(c[:1], sd[:1])

        def repair(c: FloatArray, sd: FloatArray, field: str = field, word: str = word) -> dict[str, Any]:
            value = maker.now(field, j.dof) - float(c[0])
            return maker.became((field, j.dof, 0), value, float(sd[0]), joint=j.name, set=word)

        repairs = repair if j.place >= 0 else None
        yield maker.on(j, kind, [columns[kind]], words, against, repairs, has)


def _in_time(maker: CauseMaker, j: MeasuredDof) -> Iterator[Cause]:
    """A constant force, and what changes slowly."""
    later = maker.time - maker.time.mean()
    constant = partial(_constant, maker, j)
    made = _command_zero if _servo(maker, j) else _soft_spring
    repair = partial(made, maker, j) if j.place >= 0 else None
    yield maker.on(j, "constant", [np.ones_like(later)], constant, repair=repair)
    yield maker.on(j, "drift", [later], says(f"a force that drifts by # {j.f}/s"))


def _constant(maker: CauseMaker, j: MeasuredDof, c: FloatArray, sd: FloatArray) -> str:
    """A constant force; that it carries a free body, or that a servo's zero would look the same."""
    text, model = f"a constant force of {number(c[0], sd[0])} {j.f}", maker.model
    if servo := _servo(maker, j):
        off = number(-c[0] / servo[2], sd[0] / abs(servo[2]))
        return f"{text}, or a zero of its command that is off by {off} {j.u}"
    pull = model.opt.gravity["xyz".index(j.name[-1])] if j.place < 0 and j.u == "m" else 0.0
    if c[0] * pull >= 0.0 or maker.found.forces.by[..., j.dof].any():
        return text
    weight = model.body_subtreemass[model.dof_bodyid[j.dof]] * abs(pull)
    if abs(c[0]) < _CARRIED * weight:
        return text
    return f"{text} against its weight of {weight:.3g} {j.f}: something carries it, such as a hand"


def _servo(maker: CauseMaker, j: MeasuredDof) -> tuple[str, str, float] | None:
    """Signal and name of the position servo that holds a joint by commands, and its stiffness there."""
    model, place = maker.model, controls(maker.model, maker.system.input_spec)
    firmware = maker.system.edits.servos
    if place is None:
        return None
    for source in maker.system.inputs:
        rows = np.isin(model.actuator_ctrladr, np.array(source.columns) - place.start)
        for row in np.flatnonzero(rows).tolist():
            taken = firmware is not None and row in firmware.rows
            if source.delayed and driven_joint(model, row) == j.name and holds_position(model, row):
                gear = float(model.actuator_gear[row, 0])
                stiff = gear * float(model.actuator_gainprm[row, 0])
                return None if taken else (source.key.rpartition(".")[0], model.actuator(row).name, stiff)
    return None


def _command_zero(maker: CauseMaker, j: MeasuredDof, c: FloatArray, sd: FloatArray) -> dict[str, Any]:
    """A constant force of a servo: its command counts from another zero."""
    servo = _servo(maker, j)
    assert servo is not None, "the joint has one"
    signal, name, stiff = servo
    target = {"signal": signal, "set": "bias", "actuator": name}
    return {f"{name}_command_offset": signed(-float(c[0]) / stiff, float(sd[0]) / abs(stiff), target)}


def _springs(maker: CauseMaker, j: MeasuredDof) -> Iterator[Cause]:
    """A spring, and a weight that a hinge turns."""
    stiffness = maker.free("jnt_stiffness", j.joint)

    def spring(c: FloatArray, sd: FloatArray) -> str:
        return f"a spring of {number(-c[0], sd[0])} {j.f}/{j.u} about {-c[1] / c[0]:.2g} {j.u}"

    def weight(c: FloatArray, sd: FloatArray) -> str:
        size = number(np.hypot(*c), np.hypot(*sd))
        return f"a weight off its axis: {size} {j.f}, highest at {np.arctan2(c[0], c[1]):.2g} rad"

    yield maker.on(
        j, "spring", [j.q, np.ones_like(j.q)], spring, "position",
        None if stiffness else lambda c, sd: _spring(maker, j, c, sd), maker.now("jnt_stiffness", j.joint),
    )  # fmt: skip
    if j.u == "rad" and np.ptp(j.q) > _CURVED:
        yield maker.on(
            j, "sine", [np.sin(j.q), np.cos(j.q)], weight, "position", lambda c, sd: _off_axis(maker, j, c)
        )


def _spring(maker: CauseMaker, j: MeasuredDof, c: FloatArray, sd: FloatArray) -> dict[str, Any]:
    has, at = maker.now("jnt_stiffness", j.joint), maker.now("qpos_spring", j.place)
    if (stiffness := has - float(c[0])) <= 0.0:
        return {}
    rest = float(has * at + c[1]) / stiffness
    off = float(abs(sd[1])) / stiffness + 0.1 * float(np.ptp(j.q))
    return {
        f"{j.name}_stiffness": positive(stiffness, float(sd[0]), {"joint": j.name, "set": "stiffness"}),
        f"{j.name}_rest": signed(rest, off, {"joint": j.name, "set": "spring_rest"}),
    }


def _soft_spring(maker: CauseMaker, j: MeasuredDof, c: FloatArray, _: FloatArray) -> dict[str, Any]:
    """A constant force: that of a spring so long that motion hardly changes it."""
    if maker.free("jnt_stiffness", j.joint) or maker.free("qpos_spring", j.place):
        return {}
    force = float(c[0])
    stiffness = maker.now("jnt_stiffness", j.joint) or 0.01 * abs(force) / float(np.ptp(j.q))
    rest = maker.now("qpos_spring", j.place) + force / stiffness
    fixed = {"nominal": stiffness, "prior_sd": 0.0, "targets": [{"joint": j.name, "set": "stiffness"}]}
    free = signed(rest, abs(rest), {"joint": j.name, "set": "spring_rest"})
    return {f"{j.name}_stiffness": fixed, f"{j.name}_rest": free}


def _off_axis(maker: CauseMaker, j: MeasuredDof, along: FloatArray) -> dict[str, Any]:
    """A centre of mass that is elsewhere, of the heaviest part of the body that a hinge moves.

    Args:
        j: The hinge.
        along: The force by sine and cosine of its angle, shape (2,).
    """
    model = maker.model
    body = heaviest_part(model, int(model.jnt_bodyid[j.joint]))
    across = np.argsort(np.abs(axis_in(model, j.joint, body)))[:2]
    weight, name = float(model.body_mass[body]) * _GRAVITY, model.body(body).name
    if not weight or not name or any(maker.free("body_ipos", body, int(i)) for i in across):
        return {}
    far = float(np.hypot(*along)) / weight
    now = model.body_ipos[body]
    return {
        f"{name}_center_{'xyz'[i]}": {
            "nominal": float(now[i]), "bounds": [float(now[i]) - 10.0 * far, float(now[i]) + 10.0 * far],
            "scale": "linear", "prior_sd": far,
            "targets": [{"body": name, "set": "center_of_mass", "axis": "xyz"[i]}],
        }
        for i in sorted(map(int, across))
    }  # fmt: skip


def _friction(maker: CauseMaker, j: MeasuredDof) -> Iterator[Cause]:
    """Friction that a gear has besides a constant."""

    def loaded(c: FloatArray, sd: FloatArray) -> dict[str, Any]:
        target = {"joint": j.name, "set": "load_friction"}
        entry = {"nominal": 0.1, "bounds": [0.0, 1.0], "prior_sd": 0.1, "targets": [target]}
        return {f"{j.name}_load_friction": entry} if c[0] < 0.0 else {}

    words = says("friction that grows with the load: # of it", -1.0)
    yield maker.on(j, "load friction", [np.abs(j.given) * j.way], words, "speed", loaded, 0.0)
    for slow in np.sqrt((j.v**2).mean()) * np.array(_SLOW):

        def changes(c: FloatArray, sd: FloatArray, slow: float = float(slow)) -> str:
            size, way = number(abs(c[0]), sd[0]), "larger" if c[0] < 0.0 else "smaller"
            return f"friction {way} by {size} {j.f} at rest, and as modelled well above {slow:.2g} {j.u}/s"

        def at_rest(c: FloatArray, sd: FloatArray, slow: float = float(slow)) -> dict[str, Any]:
            sizes = {"stribeck_friction": signed(float(-c[0]), float(sd[0]), {}),
                     "stribeck_velocity": positive(slow, 0.0, {})}  # fmt: skip
            return {
                f"{j.name}_{word}": entry | {"targets": [{"joint": j.name, "set": word}]}
                for word, entry in sizes.items()
            }

        # as gears have it (`stribeck_exponent` 1); negative: friction that sets in gradually
        yield maker.on(j, "stribeck", [j.way * np.exp(-np.abs(j.v / slow))], changes, "speed", at_rest)


def limits_of(values: FloatArray) -> FloatArray:
    """Values at which a limit of some (n,) is tried."""
    low, high = np.quantile(np.abs(values), _LIMITED)
    return np.geomspace(max(low, 1e-3 * high), high, _TRIED) if high > 0.0 else np.zeros(_TRIED)


def _limits(maker: CauseMaker, j: MeasuredDof, forces: bool) -> Iterator[Cause]:
    """Ends of force and speed, and places where something touches."""
    for top, fast in zip(limits_of(j.given), limits_of(j.v), strict=True):
        if forces and top > 0.0:
            words = says(f"its drive gives no more than about {top:.2g} {j.f}")
            yield maker.on(j, "force limit", [j.given - np.clip(j.given, -top, top)], words, most=0.0)
        beyond = np.sign(j.v) * np.maximum(np.abs(j.v) - fast, 0.0)
        yield maker.on(
            j, "speed limit", [beyond], says(f"it is held back above {fast:.2g} {j.u}/s"), "speed", most=0.0
        )
    for quantile in _PLACES:
        for side, word in ((1.0, "above"), (-1.0, "below")):
            at = np.quantile(side * j.q, quantile)
            words = says(f"a force only {word} {side * at:.2g} {j.u}: something touches there")
            yield maker.on(
                j, "contact", [side * np.maximum(side * j.q - at, 0.0)], words, "position", most=0.0
            )


def _repeating(maker: CauseMaker, j: MeasuredDof) -> Iterator[Cause]:
    """What repeats with the angle, or in time."""
    band, usual = maker.motion.band, np.abs(j.v).mean()

    def wave(kind: str, phase: FloatArray, text: str, against: str) -> Cause:
        return maker.on(j, kind, [np.sin(phase), np.cos(phase)], says(f"# {j.f} {text}", 0.0), against)

    for waves in _WAVES if j.u == "rad" else ():
        finest = 2.0 * np.pi / waves
        if np.ptp(j.q) > _PASSED * finest and usual / finest < band:
            text = f"that repeats {waves:.0f} times a turn (cogging)"
            yield wave("cogging", waves * j.q, text, "position")
    for hertz in _peaks(maker, j):
        phase = 2.0 * np.pi * hertz * maker.motion.time
        yield wave("periodic", phase, f"at {hertz:.2g} Hz: something rocks or turns", "time")


def _peaks(maker: CauseMaker, j: MeasuredDof) -> FloatArray:
    """Frequencies [Hz] at which what is unexplained has most; a log of its length separates them."""
    lowest = 2.0 / max(np.ptp(maker.time), 1e-9)
    hertz = np.arange(lowest, maker.motion.band, lowest / 8.0)[:_STEPS]
    if hertz.size < 3:
        return hertz
    time, left = maker.motion.time[maker.found.rows], maker.left[:, maker.motion.dofs.index(j.dof)]
    power = np.abs(np.exp(-2j * np.pi * hertz[:, None] * time) @ left)
    inner = power[1:-1]
    higher = 1 + np.flatnonzero((inner >= power[:-2]) & (inner >= power[2:]))
    return hertz[higher[np.argsort(-power[higher])[:_PEAKS]]]


def _coupling(maker: CauseMaker, j: MeasuredDof, other: MeasuredDof) -> Iterator[Cause]:
    """A force that comes with another joint's motion: between the two, or from one that is driven.

    A joint that nothing drives moves as others make it. A force from it that it does not feel itself is no
    force, and would explain all that they do.
    """
    moved = {"position": (other.q, j.q), "speed": (other.v, j.v), "acceleration": (other.a, j.a)}
    for what, (values, own) in moved.items():
        rest = [np.ones_like(values)] if what == "position" else []
        against = partial(maker.drawn, other, what)
        if j.dof < other.dof:
            both = np.zeros((1 + 2 * len(rest), len(values), maker.model.nv))
            both[0, :, j.dof], both[0, :, other.dof] = values, own
            both[1:, :, [j.dof, other.dof]] = np.eye(2)[: len(both) - 1, None]
            words = says(f"a force between them, # times the {what} of the other")
            yield Cause("coupling", f"{j.name}, {other.name}", *maker.spread(both), words, against)
        if what != "acceleration" and maker.commands[..., other.dof].any():
            made = maker.on(j, "coupling", [values, *rest], says(f"# times the {what} of {other.name}"))
            yield replace(made, against=against)
