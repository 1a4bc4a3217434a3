"""What to read from a log, in terms that do not depend on the simulator, and the series that are read."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Protocol

from amhe_cli.core.errors import ConfigError, one_of
from amhe_cli.core.parameters import Described

if TYPE_CHECKING:
    from amhe_cli.core.settings import Settings


import numpy as np

from amhe_cli.core.arrays import BoolArray, FloatArray, sealed

#: Quantities a signal can carry, with the unit of their values once read.
QUANTITIES: Mapping[str, str] = {
    "position": "m or rad",  # body position, world frame (3); or joint positions (n)
    "orientation": "-",  # unit quaternion w, x, y, z of the body in the world (4)
    "linear_velocity": "m/s",  # of the body's frame origin, in the world frame (3)
    "angular_velocity": "rad/s",  # in the body's own frame (3)
    "linear_acceleration": "m/s^2",  # proper acceleration in the sensor's frame (3)
    "velocity": "m/s or rad/s",  # joint velocities (n)
    "effort": "N or N m",  # joint forces or torques (n)
    "force": "N",  # (3)
    "torque": "N m",  # (3)
    "voltage": "V",  # of the supply of servos (n)
    "enabled": "0 or 1",  # whether the torque of servos is on (n)
    "value": "any",  # plain numbers (n): commands, arrays, fields of foreign types
}

#: Quantity -> the quantity that it can be differentiated from.
DERIVED: Mapping[str, str] = {
    "velocity": "position",
    "linear_velocity": "position",
    "angular_velocity": "orientation",
}


@dataclass(frozen=True, slots=True)
class Signal:
    """One topic of a log, and what to take from it.

    Args:
        name: The signal's name; its series are called `name.quantity`.
        topic: Topic in the log.
        quantities: Quantities to read, keys of QUANTITIES. A velocity that the topic does not carry is
            differentiated from the position or orientation that it does.
        type: ROS message type such as 'nav_msgs/msg/Odometry'; None takes the type in the log.
        names: For messages with named entries (JointState, JointTrajectory): the entries to read,
            as the log calls them, in column order. Empty: all, in the order of the first message.
        child_frame: Name of the body's frame. Of a TFMessage the one transform that is wanted; a log that is
            written has it in its Odometry and Imu messages.
        fields: quantity -> paths such as 'motorState[0].q', for types that are not built in.
        columns: quantity -> columns of a table (CSV, npz ...), names or patterns such as 'q*' and 'q{1..6}'.
        is_input: It drives the model; everything else is measured, and interpolated between messages.
        hold: An input is held until its next message; if not, it is interpolated too.
        offset: Seconds to add to the topic's stamps to bring them onto the log's common clock.
        smooth: Its values are those of a parabola through this time [s] on either side.
        active: Stretches, in seconds from the log's start, outside which it is not active; (): it always is.
        switch: Series and value: where that has another value, it is not active.
        factors: Quantity -> factor from the unit of the log's file to SI, where it is not 1.
        wraps: The positions in the file are angles that jump by a turn; they are unwrapped.
        reversed: Columns that have the other sign in the file.
    """

    name: str
    topic: str
    quantities: tuple[str, ...]
    type: str | None = None
    names: tuple[str, ...] = ()
    child_frame: str | None = None
    fields: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    columns: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    is_input: bool = False
    hold: bool = True
    offset: float = 0.0
    smooth: float = 0.0
    active: tuple[tuple[float, float], ...] = ()
    switch: tuple[str, float] | None = None
    factors: Mapping[str, float] = field(default_factory=dict)
    wraps: bool = False
    reversed: tuple[int, ...] = ()

    @property
    def held(self) -> bool:
        """Whether a value lasts until the next message."""
        return self.is_input and self.hold

    def key(self, quantity: str) -> str:
        """Name of the series that holds `quantity`."""
        return f"{self.name}.{quantity}"


class Measured(Described, Protocol):
    """What a log is read for: a system."""

    @property
    def signals(self) -> tuple[Signal, ...]:
        """What is read from a log."""
        ...

    @property
    def widths(self) -> Mapping[str, int]:
        """Number of columns of each series, `signal.quantity`, that meets the model."""
        ...

    @property
    def units(self) -> Mapping[str, tuple[str, ...]]:
        """Unit of series whose joints turn or slide: one for all columns, or that of each."""
        ...

    @property
    def dt(self) -> float:
        """Step of the clock [s] that logs are read onto."""
        ...

    @property
    def settings(self) -> Settings:
        """Settings, those of clocks and gaps among them."""
        ...

    def doubts(self, log: Any) -> list[str]:
        """What in a `Log` contradicts the model or itself, a line each."""
        ...


def remapped(signals: Sequence[Signal], topics: Mapping[str, str]) -> tuple[Signal, ...]:
    """The signals, some of them read from other topics.

    Args:
        signals: Signals of a system.
        topics: Name of a signal -> topic to read it from.

    Raises:
        ConfigError: There is no such signal.
    """
    names = [signal.name for signal in signals]
    for name in topics:
        if name not in names:
            raise ConfigError(f"`topics`: {one_of('signal', name, names)}")
    return tuple(replace(signal, topic=topics.get(signal.name, signal.topic)) for signal in signals)


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """One quantity of one signal on the log's clock.

    Args:
        values: SI values, shape (T, k); quaternions are w, x, y, z. Undefined where not valid.
        valid: False inside gaps and outside the topic's recording, shape (T,).
        sampled: True on the steps nearest to a real message, shape (T,): only there is a measurement
            that counts as data; every other valid step is interpolated.
        columns: Name of each column, length k.
        derived: The topic carried no such quantity; it was differentiated from one that it did carry,
            so it is no second measurement.
    """

    values: FloatArray
    valid: BoolArray
    sampled: BoolArray
    columns: tuple[str, ...]
    derived: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", sealed(self.values))
        object.__setattr__(self, "valid", sealed(self.valid, np.bool_))
        object.__setattr__(self, "sampled", sealed(self.sampled, np.bool_))


#: Unit -> factor to SI, in any case of letters.
FACTORS: Mapping[str, float] = {
    "deg": np.pi / 180.0, "degree": np.pi / 180.0, "degrees": np.pi / 180.0, "°": np.pi / 180.0,
    "deg/s": np.pi / 180.0, "deg/sec": np.pi / 180.0, "degrees/s": np.pi / 180.0, "dps": np.pi / 180.0,
    "°/s": np.pi / 180.0, "rpm": np.pi / 30.0, "mrad": 1e-3, "mm": 1e-3, "cm": 1e-2, "mm/s": 1e-3,
    "mNm": 1e-3, "Ncm": 1e-2, "mA": 1e-3, "mV": 1e-3, "turn": 2.0 * np.pi,
    **{f"1/{2**bits} turn": 2.0 * np.pi / 2**bits for bits in range(8, 21)},
}  # fmt: skip


def unwrapped(angles: FloatArray) -> FloatArray:
    """Angles (n, k) [rad] without jumps of a turn; what is not finite stays so and is passed over."""
    whole = np.array(angles)
    for column in whole.T:
        finite = np.isfinite(column)
        column[finite] = np.unwrap(column[finite])
    return whole
