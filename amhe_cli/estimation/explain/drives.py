"""What drives may have that their model lacks: factors, delays, limits inside a servo; and priors."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from itertools import product
from statistics import NormalDist
from typing import Any

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.engine.states import controls
from amhe_cli.estimation.explain.candidate import (
    Cause,
    CauseMaker,
    MeasuredDof,
    believed,
    number,
    says,
    times,
)
from amhe_cli.estimation.explain.joints import limits_of
from amhe_cli.estimation.explain.regression import memory_of
from amhe_cli.estimation.explain.unexplained import scale_of
from amhe_cli.system.model.elements import commanded, driven_joint, inputs_of

#: Quantiles of the speed that a servo's target may not exceed.
_FAST = (0.8, 0.9, 0.95, 0.99)
#: Delays of commands that are tried [s]: between them, the difference that one makes grows with it.
_LATE = tuple(np.geomspace(0.003, 0.1, 8))
#: Arrays of numbers that are inertia.
_INERT = {"body_mass", "body_inertia", "body_ipos", "dof_armature"}


def drive_causes(maker: CauseMaker) -> Iterator[Cause]:
    """Commands: their factor, their delay, limits; actuators that nothing commands."""
    model, by = maker.model, maker.found.forces.by
    names = [model.actuator(row).name or f"actuator {row}" for row in range(model.nactuator)]
    driven = [a for a in range(len(names)) if np.abs(maker.commands[:, a]).max(initial=0.0) > 0.0]
    for a, name in enumerate(names):
        dofs, values = maker.spread(by[None, :, a])
        if not dofs or name.startswith("amhe/"):
            continue
        against = partial(_of, f"force of {name}", values[0, :, dofs[0]])
        if a not in driven:
            words = says(f"{name} has no command and acts: remove it, or give its command")
            yield Cause("idle actuator", name, dofs, -values, words, against)
            continue
        servo = np.abs(by[:, a] - maker.commands[:, a]).max() > 0.0
        gains = product(("actuator_gainprm", "actuator_biasprm", "actuator_gear"), (0, 1))
        if servo and not any(maker.free(field, a, column) for field, column in gains):
            words = times(f"{name} gives", "of what the model says", -1.0)
            yield Cause("gain", name, dofs, -values, words, against, lambda c, sd, n=name: _gain(n), 0.95)
        words = times(f"the command of {name} acts", "times as the model says")
        yield Cause("command", name, *maker.spread(maker.commands[None, :, a]), words, against)
        yield from _inside(maker, a)
    for late in _LATE if (total := maker.commands.sum(axis=1)).any() else ():
        dofs, values = maker.spread((total - maker.later(total, late))[None] / late)
        yield Cause(
            "delay", "commands", dofs, values,
            lambda c, sd: f"commands act {number(-1e3 * c[0], 1e3 * sd[0])} ms later",
            partial(_of, "change of the command's force", values[0, :, dofs[0]]),
            lambda c, sd: _delay(float(-c[0])) if c[0] < 0.0 and maker.system.edits.prompt else {},
            np.inf if maker.system.edits.late else 0.0,
        )  # fmt: skip


def _of(name: str, values: FloatArray) -> tuple[str, FloatArray]:
    return name, values


def _gain(name: str) -> dict[str, Any]:
    target = {"actuator": name, "set": "gain", "mode": "scale"}
    scale = {"nominal": 1.0, "bounds": [0.05, 20.0], "scale": "log", "prior_sd": 0.5}
    return {f"{name}_gain": scale | {"targets": [target]}}


def _delay(late: float) -> dict[str, Any]:
    entry = {"nominal": late, "bounds": [0.0, 10.0 * late], "scale": "linear", "prior_sd": late}
    return {"command_delay": entry | {"targets": [{"set": "command_delay"}]}}


def _inside(maker: CauseMaker, a: int) -> Iterator[Cause]:
    """A position servo whose gains act inside a limit, or whose target moves no faster than it may."""
    model, motion, name = maker.model, maker.motion, maker.model.actuator(a).name
    joint, place = driven_joint(model, a), controls(model, maker.system.input_spec)
    if joint is None or place is None or commanded(model, a) != "position" or inputs_of(model, a):
        return
    if (j := maker.moved.get(int(model.joint(joint).dofadr[0]))) is None:
        return
    gear, at = float(model.actuator_gear[a, 0]), int(model.actuator_actadr[a])
    q, v = gear * j.q, gear * j.v
    target = motion.inputs[:, place.start + int(model.actuator_ctrladr[a])] if at < 0 else motion.act[:, at]
    assert maker.found.laws is not None, "a command moves it"
    gain, bias, slope = maker.found.laws[:, a, :3].T  # of each row: logs may have gains of their own
    now, turn = maker.found.forces.by[:, a, j.dof], bias + slope * q
    fast = float(np.quantile(np.abs(v), 0.998))
    pull = gain * target + turn
    pulls = [("servo limit", most, np.clip(pull, -most, most)) for most in limits_of(pull)]
    for most in np.quantile(np.abs(v), _FAST):
        moved = [_slewed(target[s], q[s], most * motion.period) for s in motion.stretches]
        pulls.append(("slew limit", most, gain * np.concatenate(moved) + turn))
    for kind, most, values in pulls:
        change = gear * maker.change(values)  # another delay than the model's, too
        factor, slows, _ = _replaced(maker, j.dof, now, gear * values, -gear * v, -change)
        if factor <= 0.0 or (kind == "servo limit" and slows <= 0.0):
            continue
        stiff = f"{factor:.2g} times its gains" if np.ptp(gain) else f"{factor * gain[0]:.2g} {j.f}/{j.u}"
        drive = f"as {stiff} {'plus' if slows < 0.0 else 'less'} {abs(slows):.2g} {j.f} s/{j.u}"
        text, repair = {
            "servo limit": (
                f"{name} never exceeds {fast:.2g} {j.u}/s: its gains act inside a limit, "
                f"{drive} up to {factor * most:.2g} {j.f}",
                lambda c, sd, how=(factor * gain, factor * most, slows): _limited(maker, a, j, *how),
            ),
            "slew limit": (
                f"{name} follows its command at no more than {most:.2g} {j.u}/s (a profile, slewmax of a "
                f"<pid>), {drive}",
                None,
            ),
        }[kind]
        columns = [gear * (factor * values - slows * v) - now, -change]
        yield replace(maker.on(j, kind, columns, says(text), "speed", repair), place=name)


def _slewed(target: FloatArray, start: FloatArray, step: float) -> FloatArray:
    """A target (n,) that moves from `start` on by no more than a step a row."""
    found, now = np.empty_like(target), float(start[0])
    for k, wanted in enumerate(target):
        found[k] = now = now + float(np.clip(wanted - now, -step, step))
    return found


def _replaced(maker: CauseMaker, dof: int, now: FloatArray, *columns: FloatArray) -> FloatArray:
    """Coefficients of columns of force that would best be there in place of one force, shape (m,)."""
    found = maker.found
    values = np.zeros((len(columns) + 1, len(maker.time), maker.model.nv))
    values[..., dof] = (now, *columns)
    moved = found.made_by(maker.spread(values)[1])
    residual, slopes = found.residual[found.rows], found.slopes[:, found.rows]
    known = np.concatenate([moved[1:], slopes]).reshape(len(columns) + len(slopes), -1)
    idle = ~moved[1:].any(axis=(1, 2))  # such as the later force of a target that stands still
    prior = np.r_[idle, np.ones(len(slopes))] * (residual**2).mean()
    prior *= memory_of(residual, found.stretches)
    wanted = known @ (residual + moved[0]).ravel()
    return np.linalg.solve(known @ known.T + np.diag(prior), wanted)[: len(columns)]


def _limited(
    maker: CauseMaker, a: int, j: MeasuredDof, gain: FloatArray, most: float, slows: float
) -> dict[str, Any]:
    """Parameters of a servo that pulls in proportion up to a limit, and is slowed as by drag.

    Of several gains, which logs know, none is freed.
    """
    name, found = maker.model.actuator(a).name, {}
    if not maker.model.actuator_forcelimited[a]:
        return {}
    for word, field, row, column, value in (
        ("gain", "actuator_gainprm", a, 0, float(gain[0])),
        ("force_limit", "actuator_forcerange", a, 1, most),
        ("damping", "dof_damping", j.dof, 0, maker.now("dof_damping", j.dof) + slows),
        ("actuator_damping", "actuator_biasprm", a, 2, -0.1 * maker.now("actuator_biasprm", a, 2)),
    ):
        where = {"joint": j.name} if word == "damping" else {"actuator": name}
        if word == "gain" and np.ptp(gain):
            continue
        if value > 0.0 or (field, row, column) in maker.set:
            found |= maker.became((field, row, column), value, 0.0, **where, set=word)
    return found


def prior_causes(maker: CauseMaker) -> Iterator[Cause]:
    """Values that the logs want farther off than their priors allow.

    None of an inertia: a body without one, that nothing pulls, moves as it likes.
    """
    found, space, dofs = maker.found, maker.system.space, list(maker.motion.dofs)
    fields: dict[str, set[str]] = {}
    for cell, parameter in maker.set.items():
        fields.setdefault(parameter.name, set()).add(cell[0])
    scales = scale_of(maker.system)
    far = NormalDist().inv_cdf(1.0 - 0.005 / max(len(space), 1))  # of so many, by chance in one of 100
    for parameter, slopes, scale in zip(space.parameters, found.slopes[:, found.rows], scales, strict=True):
        own = tuple(d for d, moved in zip(dofs, np.abs(slopes).max(axis=0), strict=True) if moved)
        if parameter.owner or not own or not fields.get(parameter.name, _INERT).isdisjoint(_INERT):
            continue
        force = found.behind(slopes)[None]

        def wanted(c: FloatArray, parameter=parameter, scale: float = scale) -> float:  # type: ignore[no-untyped-def]
            """Beside it, a fit of the slope rests at the prior's own value."""
            return float(np.clip(parameter.nominal - scale * c[0], parameter.lower, parameter.upper))

        yield Cause(
            "prior", parameter.name, own, force,
            lambda c, sd, p=parameter, w=wanted: f"the log wants about {w(c):.3g}, where the prior has "
            f"{p.nominal:.3g}: is it known so well?",
            partial(_of, "what a prior sd of it changes", force[0, :, own[0]]),
            lambda c, sd, p=parameter, w=wanted: {p.name: believed(p, w(c))},
            least=far,
        )  # fmt: skip
