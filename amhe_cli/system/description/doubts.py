"""What in a log contradicts the model, or itself: units, and velocities that are none.

Each doubt is one line for a warning; the log is read as the system says.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import mujoco
import numpy as np

from amhe_cli.core.arrays import BoolArray, FloatArray
from amhe_cli.core.log import Log
from amhe_cli.core.signals import Series
from amhe_cli.core.yaml_file import flow
from amhe_cli.system.description.data import Input, SystemData
from amhe_cli.system.model.elements import commanded, floats
from amhe_cli.system.model.gaps import gaps

#: A state that is sampled more seldom [s] is no record of motion.
_SLOW = 0.5
#: Larger positions [rad] look like degrees.
_LARGEST = 50.0
#: Larger velocities [rad/s] look like degrees per second.
_LARGEST_RATE = 100.0
#: Positions beyond a turn and so many times a joint's range look like degrees, too.
_BEYOND = 3.0
#: A jump is a turn within this [rad].
_TURN = 0.3
#: Time [s] over which positions are compared with velocities.
_SPAN = 0.05
#: Degrees in a radian.
_DEGREES = 180.0 / np.pi
#: What is wrong, and the keys of the signal that would mend it.
_Cause = tuple[str, Mapping[str, Any]]
#: The cause where an encoder wraps.
_WRAPPING: _Cause = ("position jumps by a turn: the encoder wraps", {"wraps": True})
#: Slope of the positions over the velocities -> the cause.
_OF_VELOCITY: Mapping[float, _Cause] = {
    _DEGREES: ("the position looks like degrees", {"unit": {"position": "deg"}}),
    1.0 / _DEGREES: ("the velocity looks like degrees per second", {"unit": {"velocity": "deg/s"}}),
    np.pi / 30.0: ("the velocity looks like rpm", {"unit": {"velocity": "rpm"}}),
}
#: Speeds by the positions go with the measured ones at least so well, if these are speeds at all.
_RELATED = 0.5
#: Slope of the commands over the positions -> the cause.
_OF_COMMAND: Mapping[float, _Cause] = {
    _DEGREES: ("the command looks like degrees", {"unit": "deg"}),
    1.0 / _DEGREES: ("the position looks like degrees", {}),
}
#: A slope is taken for one of these within this share of it.
_NEAR = 0.25
#: Two series must be so well correlated for their slope to count.
_ALIKE = 0.9
#: Fewer samples are not compared.
_FEW = 100
#: No more samples than about these are compared.
_MANY = 20_000

#: A joint -> its measured positions and where they are valid, shape (T,).
_Positions = Mapping[int, tuple[FloatArray, BoolArray]]


@dataclass(frozen=True, slots=True)
class Doubt:
    """What in a signal contradicts the model, or itself.

    Args:
        signal: Name of the signal.
        text: What it is.
        remedy: Keys of the signal in `system.yaml` that would mend it.
    """

    signal: str
    text: str
    remedy: Mapping[str, Any] = field(default_factory=dict)

    def __str__(self) -> str:
        keys = flow(dict(self.remedy))[1:-1]
        return f"signal {self.signal!r}: {self.text}" + (
            f"; {keys} in system.yaml converts a file" if keys else ""
        )


def doubts_of(system: SystemData, log: Log) -> Iterator[Doubt]:
    """See `System.doubts`."""
    for signal in system.signals:
        rows = [log[key].sampled for q in signal.quantities if (key := signal.key(q)) in log.series]
        steps = np.diff(np.flatnonzero(rows[0])) if rows and not signal.is_input else np.zeros(0)
        period = log.dt * float(np.median(steps)) if steps.size else 0.0
        if period > _SLOW:
            yield Doubt(
                signal.name,
                f"a sample every {period:.3g} s: its times look like milliseconds or finer; they must be "
                f"in seconds",
            )
    for key, joints in _joint_channels(system).items():
        if key in log.series:
            yield from _of_states(system.model, log, key, joints)
    for channel in system.channels:
        if channel.key.endswith(".angular_velocity") and channel.key in log.series:
            largest = float(np.max(np.abs(log[channel.key].values), initial=0.0))
            if largest > _LARGEST_RATE:
                yield Doubt(
                    channel.key.rpartition(".")[0],
                    f"angular velocity reaches {largest:.4g} rad/s: looks like degrees",
                    {"unit": {"angular_velocity": "deg/s"}},
                )
    positions = {
        joint: (log[key].values[:, column], log[key].valid)
        for key, joints in _joint_channels(system).items()
        if key in log.series
        for column, joint in enumerate(joints)
    }
    for driving in system.inputs:
        if driving.key in log.series:
            yield from _of_commands(system, log, driving, positions)


def _joint_channels(system: SystemData) -> dict[str, list[int]]:
    """Key of each series of joint positions -> the joints of its columns."""
    model = system.model
    single = {
        int(model.jnt_qposadr[row]): row
        for row in range(model.njnt)
        if int(model.jnt_type[row]) in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
    }
    return {
        channel.key: [single[column] for column in channel.columns]
        for channel in system.channels
        if channel.source == "qpos" and all(column in single for column in channel.columns)
    }


def _of_states(model: mujoco.MjModel, log: Log, key: str, joints: list[int]) -> Iterator[Doubt]:
    """Units of joint positions, by the velocities measured with them and by the joints' ranges."""
    causes: list[tuple[_Cause, str]] = []
    far: dict[str, float] = {}
    velocity = log.series.get(f"{key.rpartition('.')[0]}.velocity")
    measured = velocity if velocity is not None and not velocity.derived else None
    rates = {} if measured is None else _rates(log.dt, log[key], measured)
    for column, row in enumerate(joints):
        values, name = log[key].values[:, column], model.joint(row).name
        if _wraps(np.abs(np.diff(values[log[key].sampled & log[key].valid]))):
            causes.append((_WRAPPING, name))
        slope = _slope(rates[column][0], rates[column][1]) if rates else None
        of_unit = _named(slope, _OF_VELOCITY)
        of_unit += _of_speed(rates, column, [model.joint(other).name for other in joints]) if rates else []
        causes += [(cause, name) for cause in of_unit]
        largest = float(np.max(np.abs(values[log[key].valid]), initial=0.0))
        hinge = int(model.jnt_type[row]) == mujoco.mjtJoint.mjJNT_HINGE
        seen = values[log[key].sampled & log[key].valid]
        if hinge and largest > _LARGEST and np.abs(seen - np.round(seen)).max() < 1e-3:
            exact = 2.0 * np.pi * slope if slope else largest + 1.0  # the speeds say how many
            turn = 2 ** max(8, int(np.ceil(np.log2(exact) - 0.3 * bool(slope))))
            text = "position is in whole numbers: looks like counts of an encoder"
            unit = f"1/{turn} turn"
            known = {"unit": {"position": unit}} if slope else {}
            causes.append(((text if slope else f"{text}, perhaps unit: {unit}", known), name))
            continue
        # a wheel turns for long, and its velocity agrees; both may be in degrees where a joint has an end
        wheel = slope is not None or (not model.jnt_limited[row] and floats(model, row))
        if not of_unit and (_beyond(model, row, largest) or (hinge and not wheel and largest > _LARGEST)):
            far[name] = largest
    if far:
        text = f"position reaches {max(far.values()):.4g} rad: looks like degrees"
        causes += [((text, {"unit": "deg"}), name) for name in far]
    yield from _of_causes(key.rpartition(".")[0], causes)


def _of_causes(signal: str, causes: Sequence[tuple[_Cause, str]]) -> Iterator[Doubt]:
    """A doubt for each cause, with the joints that show it."""
    remedies = {text: remedy for (text, remedy), _ in causes}
    for text, remedy in remedies.items():
        joints = ", ".join(joint for cause, joint in causes if cause[0] == text)
        yield Doubt(signal, f"{text} ({joints})", remedy)


def _wraps(steps: FloatArray) -> bool:
    """Whether a position that moves little from sample to sample (n,) sometimes jumps by a whole turn."""
    turns = np.abs(steps - 2.0 * np.pi) < _TURN
    return bool(turns.any() and np.median(steps) < _TURN)


def _rates(dt: float, position: Series, velocity: Series) -> dict[int, tuple[FloatArray, FloatArray]]:
    """Mean speed of each column over short spans, by the positions and as it was measured; {}: too few."""
    rows = np.flatnonzero(position.sampled & velocity.sampled)
    times = dt * rows.astype(np.float64)
    period = float(np.median(np.diff(times))) if rows.size >= _FEW else 0.0
    span = max(1, round(_SPAN / period)) if period > 0.0 else 1
    if rows.size < max(_FEW, 2 * span + 1):
        return {}
    starts = np.arange(0, times.size - span, max(1, times.size // _MANY))
    starts = starts[times[starts + span] - times[starts] < 2.0 * span * period]  # no gap within
    elapsed = (times[starts + span] - times[starts])[:, None]
    within = starts[:, None] + np.arange(span + 1)
    speeds, place = velocity.values[rows][within], position.values[rows]
    way = np.sum(0.5 * (speeds[:, 1:] + speeds[:, :-1]) * np.diff(times[within])[..., None], axis=1)
    both = (place[starts + span] - place[starts]) / elapsed, way / elapsed
    return {k: (both[0][:, k], both[1][:, k]) for k in range(place.shape[1])}


def _of_speed(
    rates: Mapping[int, tuple[FloatArray, FloatArray]], column: int, names: Sequence[str]
) -> list[_Cause]:
    """What a measured velocity is, if not the derivative of its position."""
    speed = rates[column][1]
    alike = [
        float(np.corrcoef(own, speed)[0, 1]) if own.size >= _FEW and own.std() * speed.std() > 0.0 else np.nan
        for own, _ in rates.values()
    ]
    if not alike[column] < _RELATED:  # NaN: it stands still
        return []
    if alike[column] < -_ALIKE:
        return [("the velocity has the other sign than the position", {})]
    other = int(np.nanargmax(alike))
    if alike[other] > _ALIKE:
        return [(f"the velocity is that of {names[other]}'s position", {})]
    return [
        (f"the velocity is not the derivative of the position: their correlation is {alike[column]:.2f}", {})
    ]


def _slope(first: FloatArray, second: FloatArray) -> float | None:
    """Ratio of the standard deviations of two series that go alike; None where they do not."""
    if first.size < _FEW or not (first.std() > 0.0 and second.std() > 0.0):
        return None
    alike = float(np.corrcoef(first, second)[0, 1])
    return float(first.std() / second.std()) if alike > _ALIKE else None


def _named(slope: float | None, causes: Mapping[float, _Cause]) -> list[_Cause]:
    """What a slope looks like; nothing where there is none."""
    return [] if slope is None else [c for ratio, c in causes.items() if abs(slope / ratio - 1.0) < _NEAR]


def _of_commands(system: SystemData, log: Log, driving: Input, positions: _Positions) -> Iterator[Doubt]:
    """Units of the targets of position servos, by the joints that should follow them."""
    series, signal = log[driving.key], driving.key.rpartition(".")[0]
    servos = {column: _servo_joint(system, place) for column, place in enumerate(driving.columns)}
    driven = {
        column: joint
        for column, joint in servos.items()
        if joint is not None and joint in positions and series.values[:, column].std() > 1e-3
    }
    rows = series.valid.copy()
    for joint in driven.values():
        rows &= positions[joint][1]
    kept = np.flatnonzero(rows)[:: max(1, int(rows.sum()) // _MANY)]
    if kept.size < _FEW or not driven:
        return
    model, joints = system.model, list(driven.values())
    commands = series.values[kept][:, list(driven)]
    measured = np.stack([positions[joint][0][kept] for joint in joints], axis=1)
    names = [model.joint(joint).name for joint in joints]
    causes: list[tuple[_Cause, str]] = []
    for column, (joint, name) in enumerate(zip(joints, names, strict=True)):
        of_unit = _named(_slope(commands[:, column], measured[:, column]), _OF_COMMAND)
        if not of_unit and _beyond(model, joint, float(np.abs(commands[:, column]).max())):
            of_unit = [_OF_COMMAND[_DEGREES]]
        causes += [(cause, name) for cause in of_unit]
    yield from _of_causes(signal, causes)


def _beyond(model: mujoco.MjModel, joint: int, largest: float) -> bool:
    """Whether an angle is far beyond the range of a joint that has one."""
    hinge = int(model.jnt_type[joint]) == mujoco.mjtJoint.mjJNT_HINGE
    reach = float(np.abs(model.jnt_range[joint]).max()) if model.jnt_limited[joint] else np.inf
    return hinge and largest > max(_BEYOND * reach, 2.0 * np.pi)


def _servo_joint(system: SystemData, place: int) -> int | None:
    """The joint of the position servo that a number of the engine's input commands."""
    model, control = system.model, int(mujoco.mjtState.mjSTATE_CTRL)
    if not system.input_spec & control:
        return None
    address = place - mujoco.mj_stateSize(model, system.input_spec & (control - 1))
    rows = np.flatnonzero(model.actuator_ctrladr == address)
    if not rows.size or int(model.actuator_trntype[rows[0]]) != mujoco.mjtTrn.mjTRN_JOINT:
        return None
    joint = int(model.actuator_trnid[rows[0], 0])
    links = {gap.drive: gap.link for gap in gaps(model)}
    return links.get(joint, joint) if commanded(model, int(rows[0])) == "position" else None
