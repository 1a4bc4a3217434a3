"""What a log is worth before any fit: where its motion is, and what is wrong with its recording."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from amhe_cli.check.findings import BEYOND, WRONG, Doubt, Finding
from amhe_cli.check.model import touching
from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.errors import LogError
from amhe_cli.core.log import Log
from amhe_cli.engine.inverse import forces_along
from amhe_cli.engine.states import home
from amhe_cli.matching.motion import motion_of
from amhe_cli.matching.windows import driving
from amhe_cli.system.model.elements import dofs_of, followers
from amhe_cli.system.model.gaps import gaps
from amhe_cli.system.system import System

#: A joint whose range is within this many noise sd stands still, as for clips.
_STILL = 9.0
#: States of a log that stand for all.
_STATES = 400
#: Share of the time from which contacts, drives at their limits and gaps are worth a word.
_OFTEN = 0.05
#: Share of a limit of force that is all of it.
_ALL = 0.999
#: Share of half of the sampling rate that the band of a motion may reach.
_SEEN = 0.5


@dataclass(frozen=True, slots=True)
class JointMotion:
    """The motion of one joint over some logs.

    Args:
        joint, unit: Its name; rad or m.
        low, high: Lowest and highest position [rad or m].
        share: Share of the joint's range; None where it has none.
        speed: Largest speed [rad/s or m/s], but for 1 % of the time.
        band: Highest frequency at which the motion is larger than the noise [Hz]; None where the logs are too
            short to tell.
        noise: Noise sd of its sensor [rad or m].
        rate: Samples per second [Hz], in the slowest log.
    """

    joint: str
    unit: str
    low: float
    high: float
    share: float | None
    speed: float
    band: float | None
    noise: float
    rate: float


@dataclass(frozen=True, slots=True, eq=False)
class States:
    """States of a motion: positions (T, nq), velocities and accelerations (T, nv), inputs (T, nu)."""

    qpos: FloatArray
    qvel: FloatArray
    qacc: FloatArray
    inputs: FloatArray
    input_spec: int


def states_along(system: System, log: Log) -> States:
    """Some states of a log, and what drove the model there.

    Raises:
        LogError: It is too short, or does not measure all of the state.
    """
    motion = motion_of(system, log)
    some = np.linspace(0, len(motion.rows) - 1, min(_STATES, len(motion.rows))).astype(int)
    inputs = np.tile(home(system.model, system.keyframe, system.input_spec)[1], (some.size, 1))
    for source in system.inputs:
        inputs[:, list(source.columns)] = driving(source, log)[motion.rows[some]]
    return States(motion.qpos[some], motion.qvel[some], motion.qacc[some], inputs, system.input_spec)


def motions(system: System, logs: Sequence[Log]) -> tuple[JointMotion, ...]:
    """The motion of each hinge and slide that the logs measure."""
    found, model = [], system.model
    bands = np.max([_bands(system, log) for log in logs], axis=0)
    for channel in system.channels:
        if channel.source != "qpos" or channel.kind == "rotation":
            continue
        for i, column in enumerate(channel.columns):
            series = [log[channel.key] for log in logs]
            values = np.concatenate([one.values[one.valid & one.sampled, i] for one in series])
            number = int(np.searchsorted(model.jnt_qposadr, column, side="right")) - 1
            if not values.size or model.jnt_type[number] < int(mujoco.mjtJoint.mjJNT_SLIDE):
                continue  # not measured, or a body that is free, or a ball
            speeds = [np.abs(np.diff(one.values[one.valid, i])) / system.dt for one in series]
            joint, slides = model.joint(number), model.jnt_type[number] == mujoco.mjtJoint.mjJNT_SLIDE
            span = float(np.ptp(joint.range)) if model.jnt_limited[number] else 0.0
            low, high, band = float(values.min()), float(values.max()), float(bands[joint.dofadr[0]])
            found.append(
                JointMotion(
                    joint.name, "m" if slides else "rad", low, high, (high - low) / span if span else None,
                    float(np.quantile(np.concatenate(speeds), 0.99)), band or None, channel.noise or 0.0,
                    min(one.sampled.sum() / max(one.valid.sum(), 1) for one in series) / system.dt,
                )
            )  # fmt: skip
    return tuple(found)


def _bands(system: System, log: Log) -> FloatArray:
    try:
        return motion_of(system, log).band
    except LogError:
        return np.zeros(system.model.nv)


def log_findings(system: System, logs: Sequence[Log], moved: Sequence[JointMotion]) -> list[Finding]:
    """What is wrong with a recording: what stands still, gaps, drives that give all, contacts.

    Where several logs have the same doubt, that of the worst stands for all.

    Args:
        system: The system that the logs were read for.
        moved: Their motion.
    """
    found = list(_doubts(system, logs, moved))
    worst = {doubt[:2]: doubt for doubt in sorted(found, key=lambda doubt: doubt[3])}
    return [Finding.of(doubt) for doubt in found if worst[doubt[:2]] is doubt]


def _doubts(system: System, logs: Sequence[Log], moved: Sequence[JointMotion]) -> Iterator[Doubt]:
    for one in moved:
        if one.high - one.low <= _STILL * one.noise:
            yield "still", one.joint, "it stands still in these logs", 1.0
        if one.band is not None and one.band > 0.5 * _SEEN * one.rate:
            moves = f"it moves at up to {one.band:.2g} Hz, and has {one.rate:.3g} samples a second"
            yield "slow", one.joint, moves, 2.0 * one.band / (_SEEN * one.rate)
        if one.share is not None and one.share > 1.0 + BEYOND:
            yield "range", one.joint, f"it moves through {one.share:.2g} times its range", one.share
    for joint in _unmeasured(system) if moved else ():
        yield "unmeasured", joint, "no signal measures it", WRONG
    for log in logs:
        for key in system.keys:
            if (lost := float(1.0 - log[key].valid.mean())) > _OFTEN:
                yield "gaps", key, f"no value in {100.0 * lost:.0f} % of {log.source}", 1.0 + lost
        if not (system.model.jnt_type == mujoco.mjtJoint.mjJNT_FREE).any():
            yield from _along(system, log)


def _unmeasured(system: System) -> list[str]:
    """Hinges and slides that no signal measures, where signals measure joints alone."""
    model, channels = system.model, system.channels
    if any(channel.source not in ("qpos", "qvel") for channel in channels):
        return []
    measured = {column for channel in channels if channel.source == "qpos" for column in channel.columns}
    ends = {end for gap in gaps(model) for end in (gap.drive, gap.link)}
    behind = {*followers(model), *(model.joint(end).name for end in ends)}
    return [
        dof.name
        for dof in dofs_of(model)
        if dof.place >= 0 and dof.place not in measured and dof.name not in behind
    ]


def _along(system: System, log: Log) -> Iterator[Doubt]:
    """Drives at their limits of force, and contacts, of a robot that stands on nothing."""
    try:
        states = states_along(system, log)
    except LogError:
        return
    model, data, often = system.model, mujoco.MjData(system.model), Counter[tuple[str, str]]()
    given = forces_along(model, states.qpos, states.qvel, states.qacc, states.inputs, states.input_spec).by
    for row in map(int, np.flatnonzero(model.actuator_forcelimited)):
        limit = np.abs(model.actuator_forcerange[row]).max() * abs(float(model.actuator_gear[row, 0]))
        full = limit > 0.0 and np.abs(given[:, row]).max(axis=1) >= _ALL * limit
        often["saturated", model.actuator(row).name] = int(np.sum(full))
    for qpos in states.qpos:
        data.qpos[:] = qpos
        mujoco.mj_fwdPosition(model, data)
        pairs = {touching(model, one) for one in data.contact[: data.ncon] if one.dist < 0.0}
        often.update(("contact", pair) for pair in pairs)
    says = {"saturated": "it gives all its force", "contact": "they touch"}
    for (kind, where), count in often.items():
        if (share := count / len(states.qpos)) > _OFTEN:
            yield kind, where, f"{says[kind]} {100.0 * share:.0f} % of the time in {log.source}", 1.0 + share
