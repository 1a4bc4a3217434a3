"""Logs that are not what they say: a joint with the other sign, two in each other's place, another unit.

Each candidate is the log as it would be if that were put right. It is scored by what is left of the measured
accelerations at the prior's values, in units of the accelerations: a number that no unit changes. Beside the
model, each joint's drive, friction and inertia may be off, at a price.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from itertools import combinations
from typing import Any

import numpy as np

from amhe_cli.core.arrays import BoolArray, FloatArray, IntArray
from amhe_cli.core.each_log import values_on
from amhe_cli.core.log import Log, Window
from amhe_cli.engine.cpu import CpuEngine
from amhe_cli.engine.inverse import Forces
from amhe_cli.engine.states import collides, controls, filters, first_activations
from amhe_cli.estimation.explain.motion import DrivenMotion, motion_in
from amhe_cli.estimation.explain.regression import LEVEL, SIGNS, blocks_of, memory_of
from amhe_cli.estimation.explain.unexplained import along, apart_in, direction, missing, models_of
from amhe_cli.estimation.offline.clips import whole
from amhe_cli.matching.starts import tangent_of
from amhe_cli.system.model.elements import dofs_of, set_followers
from amhe_cli.system.system import System

#: Candidates that are tried: 24 joints of a hand have 350; a hundred joints have 5,252, which take hours.
_MOST = 400
#: Instants that decide, and the price of a share of all force that a joint's drive or friction is off.
_INSTANTS, _PRICE = 600, 0.1
#: Instants that show which candidates leave more than the log as it is: most of a log that is right.
_GLANCE = 150
#: Where every instant may have a contact, joints are compared by rollouts of this length [s], for so many
#: candidates at most: a legged robot has 200, which take a minute.
_AHEAD, _ROLLED = 0.05, 60
#: What is left of two logs put right that are alike, at most a factor.
LIKE = 1.1
#: Factors from numbers to SI units that are tried.
_UNITS = {"degrees": np.pi / 180.0, "thousandths": 1e-3, "radians, and are read as degrees": 180.0 / np.pi}
#: Keys of a signal that say so.
_KEYS = dict(zip(_UNITS, ("unit: deg", "unit: {effort: mV}, or mA, mNm,", "no unit"), strict=True))


@dataclass(frozen=True, slots=True, eq=False)
class Remapped:
    """A log with columns that are others, times factors: key of a series -> column -> (which one, factor)."""

    columns: Mapping[str, Mapping[int, tuple[int, float]]]

    def __call__(self, log: Log) -> Log:
        """The log, a position's velocity like the position."""
        series = dict(log.series)
        for key, columns in self.columns.items():
            names = {key, key.removesuffix(".position") + ".velocity"}
            for name in names & series.keys() if key.endswith(".position") else {key}:
                values = np.array(series[name].values)
                _set(values, series[name].values, range(values.shape[1]), columns)
                series[name] = replace(series[name], values=values)
        return replace(log, series=series)

    def joints(self, system: System) -> bool:
        """Whether positions are others, not commands alone."""
        return any(channel.source == "qpos" and channel.key in self.columns for channel in system.channels)

    def moved(self, system: System, motion: DrivenMotion) -> DrivenMotion:
        """The motion of such a log, from that of the log as it is: it is linear in the columns."""
        model, place = system.model, controls(system.model, system.input_spec) or slice(0, 0)
        kept = motion.qpos, motion.qvel, motion.qacc
        qpos, qvel, qacc = map(np.array, kept)
        for channel in system.channels if self.joints(system) else ():
            if channel.source == "qpos" and channel.key in self.columns:
                dofs = tangent_of(system, channel)
                for values, old, at in zip(
                    (qpos, qvel, qacc), kept, (channel.columns, dofs, dofs), strict=True
                ):
                    _set(values, old, at, self.columns[channel.key])
        measured = {at for channel in system.channels if channel.source == "qpos" for at in channel.columns}
        for change in (qvel, qacc):
            set_followers(model, qpos, change, measured)
        # what came through a filter stands for its command
        filtered = np.array(motion.inputs)
        for at, command, _ in filters(model):
            filtered[:, place.start + command] = motion.act[:, at]
        inputs, lasting = np.array(motion.inputs), np.array(filtered)
        for source in system.inputs:
            for values, old in ((inputs, motion.inputs), (lasting, filtered)):
                _set(values, old, source.columns, self.columns.get(source.key, {}))
        act = first_activations(model, qpos, inputs[:, place])
        for at, command, _ in filters(model):
            act[:, at] = lasting[:, place.start + command]
        return replace(motion, qpos=qpos, qvel=qvel, qacc=qacc, inputs=inputs, act=act)


def _set(
    values: FloatArray, old: FloatArray, at: Sequence[int], columns: Mapping[int, tuple[int, float]]
) -> None:
    """Columns of some old ones, which are `at` these places, times factors, in place."""
    for i, (other, factor) in columns.items():
        values[:, at[i]] = factor * old[:, at[other]]


@dataclass(frozen=True, slots=True, eq=False)
class Mended:
    """A log as it would be if something were put right.

    Args:
        kind, place, text: What would be put right, and where, in words.
        mend: The log with it put right.
        remedy: Key of the signal that would.
        instead: The log with other factors, which must leave more: any would do where little is explained.
        share, left: Share of the unexplained acceleration that goes with it, and what is left.
    """

    kind: str
    place: str
    text: str
    mend: Remapped
    remedy: str = ""
    instead: tuple[Remapped, ...] = ()
    share: float = 0.0
    left: float = 0.0

    @property
    def what(self) -> str:
        """It, with what speaks for it."""
        share = f"{100.0 * self.share:.0f} %"
        return f"{self.text}: put right, {share} of the motion that the prior does not explain goes"

    @property
    def sentence(self) -> str:
        """It, with what speaks for it and what to do."""
        return f"{self.what}; nothing was changed ({self.remedy} in its signal would)"


def mended(system: System, parts: Sequence[Window], rng: np.random.Generator) -> list[Mended]:
    """What, put right, leaves less of the accelerations than the logs as they are; most first.

    Args:
        parts: Parts of its logs; the longest decides.
        rng: Generator of the signs of blocks.
    """
    part = max(parts, key=lambda one: one.length)
    candidates = [] if system.match == "effort" else list(_candidates(system))
    tried = len(candidates)
    glance = _Look.at(system, part, _GLANCE) if 0 < tried <= _MOST else None
    if glance is None or (glance.rows is None and tried > _ROLLED):
        return []
    look = glance if glance.rows is None else _Look.at(system, part)  # rollouts take their time
    if look is None or (start := look.left()) is None:
        return []
    if look is not glance and (as_is := glance.left()) is not None:
        candidates = [
            one for one in candidates if (left := glance.left(one.mend)) is None or left.sum() < as_is.sum()
        ]
    blocks = blocks_of([slice(0, len(start))], memory_of(start[:, None], [slice(0, len(start))]))
    edges = [block.start for block in blocks]  # they follow each other without a gap

    def left_by(mend: Remapped) -> FloatArray | None:
        """What is left of each block; None where that is no better than that nothing accelerates."""
        left = look.left(mend)
        return None if left is None or left.mean() > 1.0 else np.add.reduceat(left, edges)

    start = np.add.reduceat(start, edges)
    found, gains = [], []
    for one in candidates:
        if (left := left_by(one.mend)) is None:
            continue
        gain = start - left
        gains.append(gain / max(np.sqrt((gain**2).sum()), 1e-300))  # Student's t, but for a factor
        found.append(replace(one, share=1.0 - float(left.sum() / start.sum()), left=float(left.sum())))
    if not gains:
        return []
    # what a glance has set aside was tried, too: a lower level takes as many more signs to be seen
    signs = rng.choice([-1.0, 1.0], (SIGNS * tried // len(gains), len(start)))
    chance = np.quantile(np.max(signs @ np.array(gains).T, axis=1), 1.0 - LEVEL * len(gains) / tried)

    def alone(one: Mended) -> bool:
        """Whether other factors, and the log as it is, leave more: any would do where little is explained."""
        others = [start, *map(left_by, one.instead)] if one.instead else []
        return all(other.sum() > LIKE * one.left for other in others if other is not None)

    good = [one for one, gain in zip(found, gains, strict=True) if gain.sum() > chance and one.share > 0.0]
    return sorted(filter(alone, good), key=lambda one: -one.share)


def _candidates(system: System) -> Iterator[Mended]:
    """Signs, units and order of joints and commands that are columns of a signal."""
    model = system.model
    dofs = {dof.place: dof for dof in dofs_of(model) if dof.place >= 0}
    columns = [
        (channel.key, i, dofs[place].name, "joint", dofs[place].turns)
        for channel in system.channels if channel.source == "qpos" and channel.kind == "linear"
        for i, place in enumerate(channel.columns) if place in dofs
    ]  # fmt: skip
    place = controls(model, system.input_spec) or slice(0, 0)
    for source in system.inputs:
        for i, at in enumerate(source.columns):
            rows = np.flatnonzero(np.array(model.actuator_ctrladr) == at - place.start)
            if source.delayed and rows.size:
                name = f"command of {model.actuator(int(rows[0])).name}"
                columns.append((source.key, i, name, "command", True))
    converted = {s.key(q) for s in system.signals for q, factor in s.factors.items() if factor != 1.0}
    for key, i, name, what, turns in columns:
        sign = "joint sign" if what == "joint" else "command"
        turned = f"reversed: [{name.split()[-1]}]"
        yield Mended(sign, name, f"the log's {name} has the other sign", _scaled(key, {i: -1.0}), turned)
        for unit, factor in _UNITS.items() if turns else ():
            if factor > 1.0 and key not in converted:
                continue
            mend, *others = (_scaled(key, {i: each}) for each in (factor, factor**0.5, factor**2))
            text = f"the log's {name} is in {unit}"
            yield Mended("unit", name, text, mend, _KEYS[unit], tuple(others))
    angles = [(key, i) for key, i, *_, turns in columns if turns and key not in converted]
    for unit, factor in _UNITS.items() if len(angles) > 1 else ():
        if factor < 1.0:  # a motion made larger leaves less to explain
            yield from _all_in(unit, factor, angles)
    for (key, i, one, what, *kind), (other, j, two, _, *too) in combinations(columns, 2):
        if key == other and kind == too:
            word = "swapped joints" if what == "joint" else "exchanged"
            text = f"the log's {one} and {two} are in each other's place"
            mend = Remapped({key: {i: (j, 1.0), j: (i, 1.0)}})
            yield Mended(word, f"{one}, {two}", text, mend, "their names exchanged")


def _all_in(unit: str, factor: float, columns: Sequence[tuple[str, int]]) -> Iterator[Mended]:
    """All columns of a signal, or of all of them, in another unit."""
    keys = dict.fromkeys(key for key, _ in columns)

    def times(factor: float, some: Sequence[str]) -> Remapped:
        return Remapped({key: {i: (i, factor) for of, i in columns if of == key} for key in some})

    for some in dict.fromkeys([*((key,) for key in keys), tuple(keys)]):
        places = ", ".join(key.rpartition(".")[0] for key in some)
        text, mend = f"every column of the log's {places} is in {unit}", times(factor, some)
        yield Mended(
            "unit", places, text, mend, _KEYS[unit], (times(factor**0.5, some), times(factor**2, some))
        )


def _scaled(key: str, factors: Mapping[int, float]) -> Remapped:
    return Remapped({key: {i: (i, factor) for i, factor in factors.items()}})


@dataclass(frozen=True, slots=True, eq=False)
class _Look:
    """A part of a log at the prior's values, where other logs of its columns are compared with it.

    Args:
        system, model: The system, and its model as the log has it.
        forces, rows: Forces along it, and the rows that count; None where something may touch in all of them.
        values: The numbers of the model as the log has them, as engines take them, shape (1, d).
    """

    system: System
    model: Any
    motion: DrivenMotion
    forces: Forces
    rows: BoolArray | None
    values: FloatArray

    @classmethod
    def at(cls, system: System, part: Window, most: int = _INSTANTS) -> _Look | None:
        """The part as it is, at about so many instants at most; None where it shows no motion."""
        theta = np.array(system.space.nominal)
        if (motion := motion_in(system, [part], theta, most)) is None:
            return None
        (model,) = models_of(system, [part.log], theta)
        forces, rows = along(system, [model], motion), _counting(model, motion)
        if rows is None:  # what it touches holds other joints, or moves the base
            driven = (forces.by != 0.0).any(axis=(0, 1))
            motion = replace(motion, dofs=tuple(dof for dof in motion.dofs if driven[dof]))
        values = values_on(part.log, system.edits.space, system.space, theta[None])
        return cls(system, model, motion, forces, rows, values)

    def left(self, mend: Remapped | None = None) -> FloatArray | None:
        """What is left of the accelerations at each instant, in units of them and with the price, shape (n,).

        None where no joint is driven, or in the mended log alone every instant may have a contact.
        """
        system, motion, found, rows = self.system, self.motion, self.forces, self.rows
        if mend is not None:
            motion = mend.moved(system, motion)
            found = along(system, [self.model], motion)
            if mend.joints(system) and rows is not None:
                rows = _counting(self.model, motion)
        dofs = list(motion.dofs)
        if not dofs or (rows is None and self.rows is not None):
            return None
        residual = self._rolled_out(motion)[:, dofs] if rows is None else missing(motion, found)
        rows = np.ones(len(residual), dtype=bool) if rows is None else rows
        size = np.sqrt((motion.filtered(motion.qacc)[rows][:, dofs] ** 2).mean(axis=0)) + 1e-12
        given, owner = own_forces(system, motion, found.given)
        own = np.linalg.inv(found.mass[rows][:, dofs][:, :, dofs])
        own = own[:, :, owner]  # each acts on its joint alone
        columns = np.moveaxis(own, 2, 0) * motion.filtered(given)[rows].T[..., None] / size  # (m, n, k)
        columns /= np.sqrt((columns**2).sum(axis=2).mean(axis=1))[:, None, None] + 1e-12
        e, flat = residual[rows] / size, columns.reshape(len(columns), -1)
        price = _PRICE * len(e) * np.eye(len(flat))
        fit = np.linalg.solve(flat @ flat.T + price, flat @ e.ravel())
        total = np.zeros(len(residual))
        total[rows] = ((e - np.tensordot(fit, columns, 1)) ** 2).sum(axis=1) + _PRICE * (fit**2).sum()
        return total / len(dofs)

    def _rolled_out(self, motion: DrivenMotion) -> FloatArray:
        """Mean acceleration that short rollouts from each instant miss, filtered, shape (n, nv).

        Unlike forces along the motion they know what the floor gives, and forget in a moment how deep a
        measured state is in it.
        """
        shortest = min(s.stop - s.start for s in motion.stretches)
        system, ahead = self.system, max(1, min(round(_AHEAD / motion.period), shortest - 1))
        first = np.concatenate(
            [np.minimum(np.arange(s.start, s.stop), s.stop - 1 - ahead) for s in motion.stretches]
        )
        engine = CpuEngine(system.model, system.edits, system.input_spec, 1, False)
        inputs = motion.inputs[first[:, None] + np.arange(ahead)]
        inputs = np.repeat(inputs, round(motion.period / system.dt), axis=1)
        values, lengths = np.repeat(self.values, len(first), axis=0), np.full(len(first), inputs.shape[1])
        rolled = engine.rollout(values, motion.qpos[first], motion.qvel[first], inputs, lengths)
        missed = np.where(rolled.completed[:, None], motion.qvel[first + ahead] - rolled.qvel[:, -1], 0.0)
        return motion.filtered(missed / (ahead * motion.period))


def _counting(model: Any, motion: DrivenMotion) -> BoolArray | None:
    """Rows that no contact reaches; all where only ranges are left, None where something may touch."""
    rows = apart_in(model, motion)
    if rows.sum() >= _INSTANTS // 10:
        return rows
    return None if collides(model) else np.ones_like(rows)  # ranges in another unit


def own_forces(system: System, motion: DrivenMotion, given: FloatArray) -> tuple[FloatArray, IntArray]:
    """What each joint's drive, friction, inertia or a spring gives, shape (n, m), and which of them it is."""
    places, way, columns, owner = dofs_of(system.model), direction(motion.qvel), [], []
    for number, dof in enumerate(motion.dofs):
        own = [given[:, dof], motion.qvel[:, dof], way[:, dof], motion.qacc[:, dof]]
        if (place := places[dof].place) >= 0:
            own.append(motion.qpos[:, place] - motion.qpos[:, place].mean())
        columns += own
        owner += len(own) * [number]
    return np.stack(columns, axis=1), np.array(owner)


def first_look(
    system: System, log: Log, columns: Sequence[str] = (), rng: np.random.Generator | None = None
) -> Iterator[str]:
    """Sentences about a log that was read for a system; what contradicts itself is said on reading it.

    Args:
        log: Its log.
        columns: Columns of the log's table; empty for other formats.
        rng: Generator of the signs of blocks; None: the same in each call.
    """
    yield from uncommanded(system)
    yield from remarks(system, log, columns)
    yield from (wrong.sentence for wrong in foremost(system, log, rng))


def foremost(system: System, log: Log, rng: np.random.Generator | None = None) -> Sequence[Mended]:
    """What is first to be put right in a log, if anything is; `rng` as in `first_look`."""
    return mended(system, [whole(log)], rng or np.random.default_rng(0))[:1]


def uncommanded(system: System) -> Iterator[str]:
    """A sentence about actuators that act in rollouts, although no signal has their commands."""
    model = system.model
    place = controls(model, system.input_spec) or slice(0, 0)
    given = {at - place.start for source in system.inputs for at in source.columns}
    idle = [
        model.actuator(row).name or f"actuator {row}"
        for row in range(model.nactuator)
        if int(model.actuator_ctrladr[row]) not in given and system.match != "effort"
    ]
    if idle:
        yield f"{', '.join(idle)}: no command in the log; held at 0, it acts"


def remarks(system: System, log: Log, columns: Sequence[str] = ()) -> Iterator[str]:
    """What a log has that its system does not read, and what stands still in it."""
    read = [name for signal in system.signals for names in signal.columns.values() for name in names]
    read = [name.split("[")[0].split("{")[0] + "*" * ("{" in name) for name in read]  # patterns, roughly
    left = [name for name in columns if not any(fnmatchcase(name.split("[")[0], one) for one in read)]
    left = [name for name in left if read and not name.lower().startswith(("time", "stamp")) and name != "t"]
    if left:
        yield f"columns that no signal reads: {', '.join(left[:12])}{' ...' * (len(left) > 12)}"
    for key, series in log.series.items():
        names = next((s.names for s in system.signals if key.startswith(f"{s.name}.")), ())
        values = series.values[series.valid]
        still = np.flatnonzero(np.ptp(values, axis=0) == 0.0) if len(values) else []
        for column in still if not series.derived else ():
            name = names[column] if column < len(names) else f"number {column}"
            yield f"{key} of {name} never changes: it is {values[0, column]:.4g} throughout"
