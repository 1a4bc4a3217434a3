"""What is usually missing: one candidate each, as columns of force along the motion, and in words."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.parameters import Parameter
from amhe_cli.engine.states import controls
from amhe_cli.estimation.explain.regression import memory_of
from amhe_cli.estimation.explain.unexplained import Unexplained, accelerations, direction, scale_of
from amhe_cli.system.model.elements import axis_in, commanded, dofs_of, driven_joint, inputs_of
from amhe_cli.system.system import System

#: Quantiles of a force or speed at which a limit is tried, and of positions at which a contact is.
_LIMITS, _PLACES = (0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.92), (0.6, 0.7, 0.8, 0.9)
#: Waves on a turn, of what repeats with the angle, and the fewest of them that the motion must pass.
_WAVES, _PASSED = np.unique(np.geomspace(3, 60, 40).round()), 1.5
#: Quantiles of the speed that a servo's target may not exceed.
_FAST = (0.8, 0.9, 0.95, 0.99)
_GRAVITY = 9.81
#: Arrays of numbers that are inertia.
_INERT = {"body_mass", "body_inertia", "body_ipos", "dof_armature"}
#: Frequencies that are tried of what repeats in time.
_TIMES = 50
#: Speeds, in shares of their rms, below which friction may rise.
_SLOW = (0.1, 0.25, 0.5)
#: A range of angles [rad] in which a sine is more than a line.
_CURVED = 0.5
#: A factor on a command that is one of these within this share is that of a unit.
_UNITS: Mapping[float, str] = {
    np.pi / 180.0: "its numbers are degrees",
    180.0 / np.pi: "the model expects degrees",
    1e-3: "its numbers are thousandths (mV, mA, mN m)",
    1e3: "the model expects thousandths",
}
_NEAR = 0.25

#: Kinds of which several are tried at each place, as one more number decides.
SEARCHED = (
    *("stribeck", "force limit", "speed limit", "contact", "cogging", "periodic", "coupling"),
    *("servo limit", "slew limit"),
)

#: Coefficients (m,) and their sd -> a cause in words.
Words = Callable[[FloatArray, FloatArray], str]


@dataclass(frozen=True, slots=True, eq=False)
class Cause:
    """One candidate.

    Args:
        kind: What it is, such as 'spring'.
        place: Where: a joint, a body, an actuator; several, with commas.
        dofs: Degrees of freedom whose unexplained acceleration its share is of.
        force: Its columns of force along the motion, filtered as the residual is, shape (m, n, nv).
        words: The cause in words.
        repair: From coefficients and sd the entries of `parameters` that let the model have it; None: no
            number of a model does.
        against: What its force is drawn against: name with its unit, and values (n,).
        most: The largest first coefficient that can be: of friction or inertia, what the model has.
    """

    kind: str
    place: str
    dofs: tuple[int, ...]
    force: FloatArray
    words: Words
    repair: Callable[[FloatArray, FloatArray], dict[str, Any]] | None
    against: tuple[str, FloatArray]
    most: float = np.inf


def number(value: float, sd: float) -> str:
    """'0.049 ± 0.004', with the digits that the sd warrants."""
    if not 0.0 < sd < np.inf:
        return f"{value:.3g}"
    if abs(value) < 1e-3:
        return f"{value:.2e} ± {sd:.1e}"
    digits = int(np.clip(1 - np.floor(np.log10(sd)), 0, 9)) if sd < 10.0 else 0
    return f"{value:.{digits}f} ± {sd:.{digits}f}"


def causes(system: System, found: Unexplained, commands: FloatArray) -> list[Cause]:
    """All candidates of a system and a motion.

    Args:
        system: The system.
        found: What it does not explain.
        commands: The part of the forces that comes from commands, by actuator, shape (n, actuators, nv).
    """
    return list(_Dictionary(system, found, commands).all())


class _Dictionary:
    """The candidates, and what their columns are made of."""

    def __init__(self, system: System, found: Unexplained, commands: FloatArray) -> None:
        self.system, self.found, self.motion = system, found, found.motion
        self.model = system.edits.apply(system.model, np.array(system.edits.space.nominal))
        self.dofs = dofs_of(self.model)
        self.commands = commands
        self.time = self.motion.time - self.motion.time[0]
        self.way = direction(self.motion.qvel)
        self.acceleration = self._predicted()
        self.unknown = {parameter.of_model for parameter in system.space.parameters}
        self.set = {
            (cells.field, cells.row, column): parameter
            for parameter, each in system.edits.by_parameter() for cells in each
            for column in cells.columns or (0,)
        }  # fmt: skip

    def _predicted(self) -> FloatArray:
        """Accelerations as commands, positions and speeds predict them, shape (n, nv).

        What was measured has the residual's own noise in it.
        """
        clean: list[FloatArray] = [np.ones(len(self.time))]
        for dof in self.motion.dofs:
            speed, place = self.motion.qvel[:, dof], self.dofs[dof].place
            clean += [
                self.commands[..., dof].sum(axis=1),
                self.found.forces.given[:, dof],
                speed,
                self.way[:, dof],
            ]
            if place >= 0:
                q = self.motion.qpos[:, place]
                clean += [q, np.sin(q), np.cos(q)]
        columns = np.stack(clean, axis=1)
        columns /= np.maximum(np.abs(columns).max(axis=0), 1e-12)
        fit = np.linalg.lstsq(columns, self.motion.qacc, rcond=1e-9)[0]
        return np.asarray(columns @ fit)

    def all(self) -> Iterator[Cause]:
        for dof in self.motion.dofs:
            yield from self._of_dof(dof)
            if self.dofs[dof].place >= 0:
                yield from self._of_joint(dof)
                yield from self._repeating(dof)
        for dof in self.motion.dofs:
            for other in self.motion.dofs:
                if other != dof and self.dofs[dof].place >= 0 and self.dofs[other].place >= 0:
                    yield from self._of_pair(dof, other)
        yield from self._of_actuators()
        yield from self._of_priors()

    def _free(self, field: str, row: int, column: int = 0) -> bool:
        """Whether an unknown sets a number of the model."""
        parameter = self.set.get((field, row, column))
        return parameter is not None and parameter.name in self.unknown

    def _made(
        self, kind: str, dof: int, columns: Sequence[FloatArray], words: Words, against: str = "",
        repair: Callable[[FloatArray, FloatArray], dict[str, Any]] | None = None,
    ) -> Cause:  # fmt: skip
        """A candidate on one degree of freedom."""
        values = np.zeros((len(columns), len(self.time), len(self.dofs)))
        values[..., dof] = columns
        dofs, force = self._spread(values)
        return Cause(kind, self.dofs[dof].name, dofs, force, words, repair, self._against(dof, against))

    def _against(self, dof: int, what: str) -> tuple[str, FloatArray]:
        one, rows = self.dofs[dof], self.found.rows
        unit = "rad" if one.turns else "m"
        if what == "position" and one.place >= 0:
            return f"{one.name} [{unit}]", self.motion.filtered(self.motion.qpos[:, one.place])[rows]
        if what == "acceleration":
            return f"acceleration of {one.name} [{unit}/s^2]", self.motion.filtered(self.motion.qacc[:, dof])[
                rows
            ]
        if what == "speed":
            return f"speed of {one.name} [{unit}/s]", self.motion.filtered(self.motion.qvel[:, dof])[rows]
        return "time [s]", self.time[rows]

    def _force(self, dof: int, per: str = "") -> str:
        """Unit of a force by something: 'N m/rad', 'N s/m'."""
        turns = self.dofs[dof].turns
        force, length = ("N m", "rad") if turns else ("N", "m")
        return {"": force, "q": f"{force}/{length}", "v": f"{force} s/{length}",
                "vv": f"{force} s^2/{length}^2", "a": "kg m^2" if turns else "kg"}[per]  # fmt: skip

    def _of_dof(self, dof: int) -> Iterator[Cause]:
        """What any degree of freedom may have."""
        speed, acceleration, way = self.motion.qvel[:, dof], self.acceleration[:, dof], self.way[:, dof]
        one, name = np.ones(len(speed)), self.dofs[dof].name
        joint = self.dofs[dof].place >= 0

        def more(what: str, per: str, field: str, word: str, column: int | None = None) -> tuple[Words, Any]:
            """Words, and the parameter, of a number that is too small, or too large, in the model."""

            def words(c: FloatArray, sd: FloatArray) -> str:
                less = "" if c[0] < 0.0 else " less than the model has"
                return f"{what} of {number(abs(c[0]), sd[0])} {self._force(dof, per)}{less}"

            def repair(c: FloatArray, sd: FloatArray) -> dict[str, Any]:
                now = getattr(self.model, field)[dof]
                value = float((now if column is None else now[column]) - c[0])
                if (cell := (field, dof, column or 0)) in self.set:
                    return self._wider(cell, value)
                return {f"{name}_{word}": _positive(value, float(sd[0]), {"joint": name, "set": word})}

            return words, repair if joint else None

        unit = self._force(dof)
        yield self._made(
            "constant", dof, [one], lambda c, sd: f"a constant force of {number(c[0], sd[0])} {unit}", "time",
            (lambda c, sd: self._soft_spring(dof, float(c[0]))) if joint else None,
        )  # fmt: skip
        for kind, what, per, field, word, column, values, against in (
            ("viscous", "viscous friction", "v", "dof_damping", "damping", None, speed, "speed"),
            ("dry", "dry friction", "", "dof_frictionloss", "friction_loss", None, way, "speed"),
            ("quadratic", "friction with the square of the speed", "vv", "dof_dampingpoly",
             "damping_quadratic", 0, speed * np.abs(speed), "speed"),
            ("armature", "an inertia", "a", "dof_armature", "armature", None, acceleration, "acceleration"),
        ):  # fmt: skip
            if not self._free(field, dof):
                words, repair = more(what, per, field, word, column)
                has = np.atleast_1d(getattr(self.model, field)[dof])[column or 0]
                yield replace(self._made(kind, dof, [values], words, against, repair), most=float(has))
        yield self._made(
            "drift", dof, [self.time - self.time.mean()],
            lambda c, sd: f"a force that drifts by {number(c[0], sd[0])} {unit}/s", "time",
        )  # fmt: skip
        yield self._made(
            "fading friction", dof, [way * (self.time - self.time.mean())],
            lambda c, sd: f"dry friction that changes by {number(-c[0], sd[0])} {unit}/s", "time",
        )  # fmt: skip

    def _soft_spring(self, dof: int, force: float) -> dict[str, Any]:
        """A constant force: that of a spring so long that motion hardly changes it."""
        model, name, place = self.model, self.dofs[dof].name, self.dofs[dof].place
        row, q = self.dofs[dof].joint, self.motion.qpos[:, place]
        if self._free("jnt_stiffness", row) or self._free("qpos_spring", place):
            return {}
        stiffness = float(model.jnt_stiffness[row]) or 0.01 * abs(force) / float(np.ptp(q))
        rest = float(model.qpos_spring[place]) + force / stiffness
        fixed = {"nominal": stiffness, "prior_sd": 0.0, "targets": [{"joint": name, "set": "stiffness"}]}
        return {
            f"{name}_stiffness": fixed,
            f"{name}_rest": _signed(rest, abs(rest), {"joint": name, "set": "spring_rest"}),
        }

    def _off_axis(self, dof: int, along: FloatArray) -> dict[str, Any]:
        """A centre of mass that is elsewhere, of the heaviest part of the body that a hinge moves.

        Args:
            dof: The hinge's degree of freedom.
            along: The force by sine and cosine of its angle, shape (2,).
        """
        model, row = self.model, self.dofs[dof].joint
        parts = np.flatnonzero(model.body_weldid == model.body_weldid[model.jnt_bodyid[row]])
        body = int(parts[np.argmax(model.body_mass[parts])])
        across = np.argsort(np.abs(axis_in(model, row, body)))[:2]
        weight, name = float(model.body_mass[body]) * _GRAVITY, model.body(body).name
        if not weight or not name or any(self._free("body_ipos", body, int(i)) for i in across):
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

    def _of_joint(self, dof: int) -> Iterator[Cause]:
        """What a hinge or slide may have."""
        q, v, one = (
            self.motion.qpos[:, self.dofs[dof].place],
            self.motion.qvel[:, dof],
            np.ones(len(self.time)),
        )
        name, unit = self.dofs[dof].name, "rad" if self.dofs[dof].turns else "m"
        given, force = self.found.forces.given[:, dof], self._force(dof)

        def spring(c: FloatArray, sd: FloatArray) -> str:
            return (
                f"a spring of {number(-c[0], sd[0])} {self._force(dof, 'q')} about {-c[1] / c[0]:.2g} {unit}"
            )

        def springs(c: FloatArray, sd: FloatArray) -> dict[str, Any]:
            model = self.model
            has, at = float(model.jnt_stiffness[row]), float(model.qpos_spring[self.dofs[dof].place])
            if (stiffness := has - float(c[0])) <= 0.0:
                return {}
            rest = float(has * at + c[1]) / stiffness
            off = float(abs(sd[1])) / stiffness + 0.1 * float(np.ptp(q))
            return {
                f"{name}_stiffness": _positive(stiffness, float(sd[0]), {"joint": name, "set": "stiffness"}),
                f"{name}_rest": _signed(rest, off, {"joint": name, "set": "spring_rest"}),
            }

        row = self.dofs[dof].joint
        yield self._made(
            "spring", dof, [q, one], spring, "position",
            None if self._free("jnt_stiffness", row) else springs,
        )  # fmt: skip
        if self.dofs[dof].turns and np.ptp(q) > _CURVED:
            yield self._made(
                "sine", dof, [np.sin(q), np.cos(q)],
                lambda c, sd: f"a weight off its axis: {number(np.hypot(*c), np.hypot(*sd))} {force}, "
                f"highest at {np.arctan2(c[0], c[1]):.2g} rad", "position",
                lambda c, sd: self._off_axis(dof, c),
            )  # fmt: skip
        yield from self._of_gear(dof)
        for quantile in _LIMITS:
            top, fast = np.quantile(np.abs(given), quantile), np.quantile(np.abs(v), quantile)
            if top > 0.0:
                yield self._made(
                    "force limit", dof, [np.clip(given, -top, top) - given],
                    lambda c, sd, at=top: f"its drive gives no more than about {at:.2g} {force}", "time",
                )  # fmt: skip
            yield self._made(
                "speed limit", dof, [np.sign(v) * np.maximum(np.abs(v) - fast, 0.0)],
                lambda c, sd, at=fast: f"it is held back above {at:.2g} {unit}/s", "speed",
            )  # fmt: skip
        for quantile in _PLACES:
            for side, at in ((1.0, np.quantile(q, quantile)), (-1.0, np.quantile(q, 1.0 - quantile))):
                where = f"{'above' if side > 0 else 'below'} {at:.2g} {unit}"
                yield self._made(
                    "contact", dof, [np.maximum(side * (q - at), 0.0)],
                    lambda c, sd, where=where: f"a force only {where}: something touches there", "position",
                )  # fmt: skip

    def _of_gear(self, dof: int) -> Iterator[Cause]:
        """Friction that a gear has besides a constant."""
        v, way, given = self.motion.qvel[:, dof], self.way[:, dof], self.found.forces.given[:, dof]
        name, unit, force = self.dofs[dof].name, "rad" if self.dofs[dof].turns else "m", self._force(dof)
        yield self._made(
            "load friction", dof, [np.abs(given) * way],
            lambda c, sd: f"friction that grows with the load: {number(-c[0], sd[0])} of it", "speed",
            lambda c, sd: {
                f"{name}_load_friction": {
                    "nominal": 0.1, "bounds": [0.0, 1.0], "prior_sd": 0.1,
                    "targets": [{"joint": name, "set": "load_friction"}],
                }
            } if c[0] < 0.0 else {},
        )  # fmt: skip
        usual = float(np.sqrt((v**2).mean()))
        for share in _SLOW:
            yield self._made(
                "stribeck", dof, [way * np.exp(-((v / (share * usual)) ** 2))],
                lambda c, sd, at=share * usual: f"friction larger by {number(-c[0], sd[0])} {force} below "
                f"{at:.2g} {unit}/s", "speed",
                lambda c, sd, at=share * usual: {
                    f"{name}_{word}": _positive(float(size), 0.0, {"joint": name, "set": word})
                    for word, size in (("stribeck_friction", -c[0]), ("stribeck_velocity", at))
                    if c[0] < 0.0
                },
            )  # fmt: skip

    def _repeating(self, dof: int) -> Iterator[Cause]:
        """What repeats with the angle, or in time."""
        q, force = self.motion.qpos[:, self.dofs[dof].place], self._force(dof)
        for waves in _WAVES if self.dofs[dof].turns else ():
            finest = 2.0 * np.pi / waves
            if (
                np.ptp(q) > _PASSED * finest
                and np.abs(self.motion.qvel[:, dof]).mean() / finest < self.motion.band
            ):
                yield self._made(
                    "cogging", dof, [np.sin(waves * q), np.cos(waves * q)],
                    lambda c, sd, n=waves: f"{number(np.hypot(*c), np.hypot(*sd))} {force} that repeats "
                    f"{n:.0f} times a turn (cogging)", "position",
                )  # fmt: skip
        lowest = 2.0 / max(np.ptp(self.time), 1e-9)
        for hertz in np.linspace(lowest, self.motion.band, _TIMES) if self.motion.band > lowest else ():
            wave = 2.0 * np.pi * hertz * self.motion.time
            yield self._made(
                "periodic", dof, [np.sin(wave), np.cos(wave)],
                lambda c, sd, f=hertz: f"{number(np.hypot(*c), np.hypot(*sd))} {force} at {f:.2g} Hz: "
                "something rocks or turns", "time",
            )  # fmt: skip

    def _of_pair(self, dof: int, other: int) -> Iterator[Cause]:
        """A force that comes with another joint's motion."""
        name = self.dofs[other].name
        for what, values in (
            ("position", self.motion.qpos[:, self.dofs[other].place]),
            ("speed", self.motion.qvel[:, other]),
            ("acceleration", self.acceleration[:, other]),
        ):
            made = self._made(
                "coupling", dof, [values - values.mean()],
                lambda c, sd, what=what: f"{number(c[0], sd[0])} times the {what} of {name}",
            )  # fmt: skip
            yield replace(made, against=self._against(other, what))

    def _spread(self, values: FloatArray) -> tuple[tuple[int, ...], FloatArray]:
        """CauseColumns (m, n, nv) on the degrees of freedom that were measured and that they act on."""
        acts = np.abs(values).max(axis=(0, 1)) > 0.0
        dofs = tuple(d for d in self.motion.dofs if acts[d])
        moved = np.moveaxis(self.motion.filtered(np.moveaxis(values, 1, 0)), 0, 1)
        return dofs, moved[:, self.found.rows]

    def _of_actuators(self) -> Iterator[Cause]:
        """Commands: their factor, their order, their delay; actuators that nothing commands."""
        model, by = self.model, self.found.forces.by
        names = [model.actuator(row).name or f"actuator {row}" for row in range(model.nactuator)]
        driven = {a for a in range(len(names)) if np.abs(self.commands[:, a]).max(initial=0.0) > 0.0}
        for a, name in enumerate(names):
            dofs, values = self._spread(by[None, :, a])
            if not dofs or name.startswith("amhe/"):
                continue
            against = f"force of {name}", values[0, :, dofs[0]]
            if a not in driven:
                yield Cause(
                    "idle actuator", name, dofs, -values,
                    lambda c, sd, n=name: f"{n} has no command and acts: remove it, or give its command",
                    None, against,
                )  # fmt: skip
                continue
            servo = np.abs(by[:, a] - self.commands[:, a]).max() > 0.0
            if servo and not self._gain_is_free(a):
                yield Cause(
                    "gain", name, dofs, values,
                    lambda c, sd, n=name: f"{n} gives {number(1.0 + c[0], sd[0])} of what the model says",
                    lambda c, sd, n=name: {f"{n}_gain": _scale({"actuator": n, "set": "gain"})},
                    against,
                )  # fmt: skip
            dofs, values = self._spread(self.commands[None, :, a])
            yield Cause("command", name, dofs, values, _of_factor(name), None, against)
            yield from self._of_servo(a)
        yield from self._exchanged(names, sorted(driven))
        total = self.commands.sum(axis=1)
        if total.any():
            dofs, values = self._spread(-self._change(total)[None])
            yield Cause(
                "delay", "commands", dofs, values,
                lambda c, sd: f"commands act {number(1e3 * c[0], 1e3 * sd[0])} ms later",
                lambda c, sd: {
                    "command_delay": {
                        "nominal": float(c[0]), "bounds": [0.0, 10.0 * float(c[0])], "scale": "linear",
                        "prior_sd": float(c[0]), "targets": [{"set": "command_delay"}],
                    }
                } if c[0] > 0.0 and self.system.edits.prompt else {},
                ("change of the command's force", values[0, :, dofs[0]]),
            )  # fmt: skip

    def _of_servo(self, a: int) -> Iterator[Cause]:
        """A position servo whose gains act inside a limit, or whose target moves no faster than it may."""
        model, motion, name = self.model, self.motion, self.model.actuator(a).name
        joint, place = driven_joint(model, a), controls(model, self.system.input_spec)
        if joint is None or place is None or commanded(model, a) != "position" or inputs_of(model, a):
            return
        dof, gear = int(model.joint(joint).dofadr[0]), float(model.actuator_gear[a, 0])
        if dof not in motion.dofs:
            return
        q, v = gear * motion.qpos[:, self.dofs[dof].place], gear * motion.qvel[:, dof]
        at = int(model.actuator_actadr[a])
        target = (
            motion.inputs[:, place.start + int(model.actuator_ctrladr[a])] if at < 0 else motion.act[:, at]
        )
        gain, bias = float(model.actuator_gainprm[a, 0]), model.actuator_biasprm[a]
        now, turn = self.found.forces.by[:, a, dof], bias[0] + bias[1] * q
        fast, unit = float(np.quantile(np.abs(v), 0.998)), "rad" if self.dofs[dof].turns else "m"
        force, per = self._force(dof), self._force(dof, "v")
        pull = gain * target + turn
        pulls = [
            ("servo limit", most, np.clip(pull, -most, most)) for most in np.quantile(np.abs(pull), _LIMITS)
        ]
        for most in np.quantile(np.abs(v), _FAST):
            moved = [_slewed(target[s], q[s], most * motion.period) for s in motion.stretches]
            pulls.append(("slew limit", most, gain * np.concatenate(moved) + turn))
        for kind, most, values in pulls:
            change = gear * self._change(values)  # another delay than the model's, too
            factor, slows, _ = self._replaced(dof, now, gear * values, -gear * v, -change)
            if factor <= 0.0 or (kind == "servo limit" and slows <= 0.0):
                continue
            drive = f"as {factor * gain:.2g} {force}/{unit} less {slows:.2g} {per}"
            text = {
                "servo limit": f"{name} never exceeds {fast:.2g} {unit}/s: its gains act inside a limit, "
                f"{drive} up to {factor * most:.2g} {force}",
                "slew limit": f"{name} follows its command at no more than {most:.2g} {unit}/s (a profile, "
                f"slewmax of a <pid>), {drive}",
            }[kind]
            how = factor, factor * most, slows
            made = self._made(
                kind, dof, [gear * (factor * values - slows * v) - now, -change],
                lambda c, sd, text=text: text, "speed",
                (lambda c, sd, how=how: self._limited(a, dof, *how)) if kind == "servo limit" else None,
            )  # fmt: skip
            yield replace(made, place=name)

    def _change(self, values: FloatArray) -> FloatArray:
        """Derivative of values (n, ...) by time."""
        motion = self.motion
        return np.concatenate([np.gradient(values[s], motion.period, axis=0) for s in motion.stretches])

    def _replaced(self, dof: int, now: FloatArray, *columns: FloatArray) -> FloatArray:
        """Coefficients of columns of force that would best be there in place of one force, shape (m,)."""
        found, dofs = self.found, list(self.motion.dofs)
        values = np.zeros((len(columns) + 1, len(self.time), len(self.dofs)))
        values[..., dof] = (now, *columns)
        moved = accelerations(found.forces.mass[found.rows], self._spread(values)[1], dofs)
        residual, slopes = found.residual[found.rows], found.slopes[:, found.rows]
        known = np.concatenate([moved[1:], slopes]).reshape(len(columns) + len(slopes), -1)
        prior = np.r_[np.zeros(len(columns)), np.ones(len(slopes))] * (residual**2).mean()
        prior *= memory_of(residual, found.stretches)
        wanted = known @ (residual + moved[0]).ravel()
        return np.linalg.solve(known @ known.T + np.diag(prior), wanted)[: len(columns)]

    def _limited(self, a: int, dof: int, factor: float, most: float, slows: float) -> dict[str, Any]:
        """Parameters of a servo that pulls in proportion up to a limit, and is slowed as by drag."""
        model, name, joint = self.model, self.model.actuator(a).name, self.dofs[dof].name
        if not model.actuator_forcelimited[a]:
            return {}
        wanted = [
            ("gain", "actuator_gainprm", a, 0, factor * float(model.actuator_gainprm[a, 0])),
            ("force_limit", "actuator_forcerange", a, 1, most),
            ("damping", "dof_damping", dof, 0, float(model.dof_damping[dof]) + slows),
            ("actuator_damping", "actuator_biasprm", a, 2, -0.1 * float(model.actuator_biasprm[a, 2])),
        ]
        found: dict[str, Any] = {}
        for word, *cell, value in wanted:
            where = {"joint": joint} if word == "damping" else {"actuator": name}
            entry = {f"{next(iter(where.values()))}_{word}": _positive(value, 0.0, where | {"set": word})}
            place = (str(cell[0]), int(cell[1]), int(cell[2]))
            found |= self._wider(place, value) if place in self.set else entry if value > 0.0 else {}
        return found

    def _wider(self, cell: tuple[str, int, int], value: float) -> dict[str, Any]:
        """The parameter that sets a number, with a prior about another value of it."""
        parameter, (field, row, column) = self.set[cell], cell
        now = np.atleast_1d(getattr(self.model, field)[row])[column]
        if parameter.owner or not now:
            return {}
        nominal = parameter.nominal * max(value / abs(float(now)), 0.1)
        return {parameter.of_model: _believed(parameter, nominal)}

    def _of_priors(self) -> Iterator[Cause]:
        """Values that the logs want farther off than their priors allow.

        None of an inertia: a body without one, that nothing pulls, moves as it likes.
        """
        found, space = self.found, self.system.space
        cells = {
            parameter.name: {cell[0] for cell, p in self.set.items() if p is parameter}
            for parameter in self.set.values()
        }
        dofs = list(self.motion.dofs)
        for parameter, slopes, scale in zip(
            space.parameters, found.slopes, scale_of(self.system), strict=True
        ):
            own = tuple(
                d for d, moved in zip(dofs, np.abs(slopes[found.rows]).max(axis=0), strict=True) if moved
            )
            if parameter.owner or not own or not cells.get(parameter.name, _INERT).isdisjoint(_INERT):
                continue
            force = np.zeros((1, int(found.rows.sum()), len(self.dofs)))
            mass = found.forces.mass[found.rows][:, dofs][:, :, dofs]
            force[0][:, dofs] = np.einsum("nij,nj->ni", mass, slopes[found.rows])

            def wanted(c: FloatArray, parameter: Parameter = parameter, scale: float = scale) -> float:
                """Beside it, a fit of the slope rests at the prior's own value."""
                return float(np.clip(parameter.nominal - scale * c[0], parameter.lower, parameter.upper))

            yield Cause(
                "prior", parameter.name, own, force,
                lambda c, sd, p=parameter, w=wanted: f"the log wants about {w(c):.3g}, where the prior has "
                f"{p.nominal:.3g}: is it known so well?",
                lambda c, sd, p=parameter, w=wanted: {p.name: _believed(p, w(c))},
                ("what a prior sd of it changes", force[0, :, own[0]]),
            )  # fmt: skip

    def _exchanged(self, names: Sequence[str], driven: Sequence[int]) -> Iterator[Cause]:
        """Two commands in each other's place."""
        size = np.abs(self.commands).max(axis=(0, 2))
        for i, a in enumerate(driven):
            for b in driven[i + 1 :]:
                of = [int(np.abs(self.commands[:, x]).max(axis=0).argmax()) for x in (a, b)]
                if of[0] == of[1] or not size[a] * size[b]:
                    continue
                one, two = self.commands[:, a, of[0]], self.commands[:, b, of[1]]
                ratio = self.gain(a) / self.gain(b)
                values = np.zeros((1, len(one), len(self.dofs)))
                values[0, :, of[0]], values[0, :, of[1]] = two * ratio - one, one / ratio - two
                dofs, columns = self._spread(values)
                yield Cause(
                    "exchanged", f"{names[a]}, {names[b]}", dofs, columns,
                    lambda c, sd, x=names[a], y=names[b]: f"the commands of {x} and {y} are exchanged", None,
                    ("exchanged less given [N m]", columns[0, :, dofs[0]]),
                )  # fmt: skip

    def gain(self, actuator: int) -> float:
        """Force by command of an actuator, with its sign."""
        return float(self.model.actuator_gainprm[actuator, 0]) or 1.0

    def _gain_is_free(self, actuator: int) -> bool:
        fields = ("actuator_gainprm", "actuator_biasprm", "actuator_gear")
        return any(self._free(field, actuator, column) for field in fields for column in (0, 1))


def _slewed(target: FloatArray, start: FloatArray, step: float) -> FloatArray:
    """A target (n,) that moves from `start` on by no more than a step a row."""
    found, now = np.empty_like(target), float(start[0])
    for k, wanted in enumerate(target):
        found[k] = now = now + float(np.clip(wanted - now, -step, step))
    return found


def _believed(parameter: Parameter, value: float) -> dict[str, Any]:
    """Keys of a parameter that give it a prior about another value, and wider."""
    if parameter.log:
        low, high = min(parameter.lower, value / 10.0), max(parameter.upper, value * 10.0)
        return {"nominal": max(value, low), "bounds": [low, high], "prior_sd": max(parameter.prior_sd, 0.5)}
    sd = max(parameter.prior_sd, abs(value - parameter.nominal))
    low, high = min(parameter.lower, value - 3.0 * sd), max(parameter.upper, value + 3.0 * sd)
    low = max(low, 0.0) if parameter.lower >= 0.0 else low
    return {"nominal": value, "bounds": [low, high], "prior_sd": sd}


def _of_factor(name: str) -> Words:
    """What a factor on a command means."""

    def words(c: FloatArray, sd: FloatArray) -> str:
        factor = 1.0 + c[0]
        if abs(factor + 1.0) < _NEAR:
            return f"the command of {name} has the other sign"
        for unit, meaning in _UNITS.items():
            if abs(factor / unit - 1.0) < _NEAR or abs(factor - unit) < 2.0 * sd[0] < 0.1:
                return f"the command of {name} acts {factor:.3g} times as given: {meaning}"
        return f"the command of {name} acts {number(factor, sd[0])} times as the model says"

    return words


def _positive(value: float, sd: float, target: dict[str, Any]) -> dict[str, Any]:
    """A parameter of a number that cannot be negative."""
    start = max(value, 0.5 * sd, 1e-9)
    return {
        "nominal": start, "bounds": [0.01 * start, 100.0 * start], "scale": "log", "prior_sd": 1.0,
        "targets": [target],
    }  # fmt: skip


def _scale(target: dict[str, Any]) -> dict[str, Any]:
    """A parameter that is a factor."""
    return {
        "nominal": 1.0, "bounds": [0.05, 20.0], "scale": "log", "prior_sd": 0.5,
        "targets": [target | {"mode": "scale"}],
    }  # fmt: skip


def _signed(value: float, sd: float, target: dict[str, Any]) -> dict[str, Any]:
    """A parameter of any sign."""
    reach = 3.0 * abs(value) + 10.0 * sd
    return {
        "nominal": value, "bounds": [-reach, reach], "prior_sd": max(abs(value), 3.0 * sd),
        "targets": [target],
    }  # fmt: skip
