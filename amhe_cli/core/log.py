"""A log that was read: immutable series in SI units on one uniform clock; and samples from any source.

Logs, simulated plants, a robot's link and live topics make samples; ring buffer, estimators and recorders
take them.
"""

from __future__ import annotations

import hashlib
import logging
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from amhe_cli.core.arrays import BoolArray, FloatArray
from amhe_cli.core.errors import LogError
from amhe_cli.core.from_arrays import series_of
from amhe_cli.core.shown import Displayed
from amhe_cli.core.signals import Measured, Series

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, eq=False)
class Log(Displayed):
    """All signals of one log on one clock: row t of every series is the instant t * dt.

    An input in row t acts from instant t to instant t + 1 (zero-order hold).

    Args:
        dt: Step of the clock [s]: the time step of the model that will be compared with it.
        series: `signal.quantity` -> Series, for instance 'box.orientation', all of T rows.
        source: Name of the log in messages and results; of a file, its path.
        start_ns: Stamp of row 0 [ns].
        metadata: Metadata of the log (its `amhe` metadata record): system, truth, seed.
        file: File or folder that the log was read from; None: it was made in memory.
        known: Values of parameters [SI] that are known for this log, and not searched in it.
        own: Parameters of which this log has a value of its own -> whose it is: logs that name the same
            owner share one value; '' stands for the log itself.
        trend: Parameters that change in time from log to log along a straight line -> where this log is on
            it, 0 at the start of the line and 1 at its end.
        held_out: The log is only used to validate.
        reading: Arguments of `read_log` that it was read with, as plain values; {}: it was made in memory.
        units: Unit of series whose joints turn or slide: one for all columns, or that of each.
    """

    dt: float
    series: Mapping[str, Series]
    source: str
    start_ns: int = 0
    metadata: Mapping[str, str] = field(default_factory=dict)
    file: Path | None = None
    known: Mapping[str, float] = field(default_factory=dict)
    own: Mapping[str, str] = field(default_factory=dict)
    trend: Mapping[str, float] = field(default_factory=dict)
    held_out: bool = False
    reading: Mapping[str, Any] = field(default_factory=dict)
    units: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ("series", "metadata", "known", "own", "trend", "reading", "units"):
            object.__setattr__(self, name, MappingProxyType(dict(getattr(self, name))))

    def __repr__(self) -> str:
        columns = ", ".join(f"{key} ({series.values.shape[1]})" for key, series in self.series.items())
        return f"Log({self.source!r}, {self.duration:.4g} s at {self.dt:g} s: {columns})"

    def __reduce__(self) -> tuple[object, ...]:
        """Pickle as plain values: windows go to an estimator's process, and mapping proxies cannot."""
        plain = (
            dict(v) if isinstance(v := getattr(self, f), MappingProxyType) else v for f in self.__slots__
        )
        return Log, tuple(plain)

    @classmethod
    def from_arrays(
        cls, arrays: Mapping[str, Mapping[str, ArrayLike]], system: Measured, *, name: str = "arrays"
    ) -> Log:
        """Make a log from arrays, such as numpy arrays or columns of pandas.

        All signals are brought onto the model's clock, as those of a log file are: commands are held until
        the next one, states are interpolated, and silences longer than the setting `logs.max_gap` stay gaps.
        Velocities that are not given are differentiated.

        Args:
            arrays: Signal -> `time` [s], shape (n,), and quantities in SI units, shape (n, k), or (n,) for a
                single column. Columns stand in the order of the joints or actuators of the system's signal;
                orientations are quaternions w, x, y, z. Each signal has times of its own, on one clock. A
                value that is NaN was not measured.
            system: The system, whose signals these are.
            name: Name of the log in messages and results.

        Raises:
            LogError: A signal or quantity is missing or unknown, or an array has the wrong shape; times are
                not finite or not increasing; or the signals do not overlap in time.
        """
        series, start_ns = series_of(arrays, system, name)
        log = cls(system.dt, series, name, start_ns, units=system.units)
        warn_of(log, system)
        return log

    def with_(
        self,
        *,
        known: Mapping[str, float] | None = None,
        own: Iterable[str] | Mapping[str, str] | None = None,
        trend: Mapping[str, float] | None = None,
        held_out: bool | None = None,
    ) -> Log:
        """A copy of the log with some of these replaced; what is not given stays.

        Args:
            known: Parameter -> its value [SI] in this log, where that is known.
            own: Parameters of which this log has a value of its own, around a common mean. With a mapping
                from parameters to owners, such as `{"friction": "robot A"}`, the logs of one owner share
                one value.
            trend: Parameter -> where this log is, from 0 to 1, on the straight line along which it changes.
            held_out: Use the log only to validate.
        """
        if own is not None and not isinstance(own, Mapping):
            own = dict.fromkeys(own, "")
        given = {"known": known, "own": own, "trend": trend, "held_out": held_out}
        return replace(self, **{name: value for name, value in given.items() if value is not None})

    @property
    def steps(self) -> int:
        """Number of rows T."""
        return next(iter(self.series.values())).valid.size if self.series else 0

    @property
    def duration(self) -> float:
        """Time from the first row to the last [s]."""
        return max(self.steps - 1, 0) * self.dt

    def __getitem__(self, key: str) -> Series:
        try:
            return self.series[key]
        except KeyError:
            keys = ", ".join(self.series)
            raise LogError(f"{self.source}: no signal {key!r}; there is: {keys}") from None

    def digest(self) -> str:
        """Hash (SHA-256) of all that was measured."""
        content = hashlib.sha256(f"{self.dt} {self.start_ns}".encode())
        if stated := [sorted(given.items()) for given in (self.known, self.own, self.trend) if given]:
            content.update(repr(stated).encode())
        for key, series in sorted(self.series.items()):
            content.update(key.encode())
            for array in (series.values, series.valid, series.sampled):
                content.update(array.tobytes())
        return content.hexdigest()

    def usable(self, keys: tuple[str, ...]) -> BoolArray:
        """Rows where every one of the named series is valid, shape (T,)."""
        mask = np.ones(self.steps, dtype=bool)
        for key in keys:
            mask &= self[key].valid
        return mask


def in_order(logs: Sequence[Log]) -> list[Log]:
    """The logs by time, name and what they hold, however they were given; those of one name are numbered."""
    shared, given = Counter(log.source for log in logs), Counter[str]()
    named: list[tuple[int, str, str, Log]] = []
    for log in logs:
        given[log.source] += 1
        digest, name = "", log.source
        if shared[log.source] > 1:
            digest, name = log.digest(), f"{log.source} #{given[log.source]}"
        named.append((log.start_ns, log.source, digest, replace(log, source=name)))
    return [log for *_, log in sorted(named, key=lambda one: one[:3])]


def warn_of(log: Log, system: Measured) -> None:
    """Warn of what in a log contradicts the system's model or itself."""
    for doubt in system.doubts(log):
        logger.warning("%s: %s", log.source, doubt)


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """A stretch of a log: instants start .. start + length, without copying it.

    Rolling it out takes `length` inputs, from the state at `start`, and predicts the `length` instants
    after it. SPI calls its windows clips.
    """

    log: Log
    start: int
    length: int

    @property
    def stop(self) -> int:
        """Index of the last instant."""
        return self.start + self.length

    @property
    def duration(self) -> float:
        """Time from the first instant to the last [s]."""
        return self.length * self.log.dt

    def alone(self, before: int) -> Window:
        """The same window of a log that has nothing after it, and at most so many rows before it."""
        rows = slice(max(0, self.start - before), self.stop + 1)
        series = {
            key: replace(
                one, values=one.values[rows], valid=one.valid[rows], sampled=one.sampled[rows]
            ) for key, one in self.log.series.items()
        }  # fmt: skip
        begun = self.log.start_ns + round(1e9 * rows.start * self.log.dt)
        log = replace(self.log, series=series, start_ns=begun)
        return Window(log, self.start - rows.start, self.length)


#: 'signal.quantity', such as 'box.position' -> times [s], shape (n,), and SI values, shape (n, k), with their
#: columns in the order of the signal's names. The quantities of one signal share their times.
Samples: TypeAlias = Mapping[str, tuple[FloatArray, FloatArray]]


def sampled(log: Log) -> Samples:
    """The measured rows of a log, without those that were interpolated; times count from its row 0 [s]."""
    times = log.dt * np.arange(log.steps, dtype=np.float64)
    return {key: (times[series.sampled], series.values[series.sampled]) for key, series in log.series.items()}


def merged(parts: Sequence[Samples]) -> Samples:
    """All samples of several parts, each quantity in the order of time."""
    if len(parts) == 1:
        return parts[0]
    keys = dict.fromkeys(key for part in parts for key in part)
    return {key: _joined([part[key] for part in parts if key in part]) for key in keys}


def since(samples: Samples, time: float) -> Samples:
    """The samples that were taken at a time [s] or later."""
    return {key: (times[times >= time], values[times >= time]) for key, (times, values) in samples.items()}


class Thinner:
    """Keeps the first sample of each period, whatever jitters or is lost.

    It takes samples in the order of time.

    Args:
        period: Time between two samples that are kept [s].
    """

    def __init__(self, period: float) -> None:
        self._period = period
        self._reached: dict[str, float] = {}

    def thinned(self, samples: Samples) -> Samples:
        """The next samples, without those that are left out."""
        return {key: self._kept(key, *series) for key, series in samples.items()}

    def _kept(self, key: str, times: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        number = np.floor(times / self._period + 1e-6)
        reached = np.maximum.accumulate(np.append(self._reached.get(key, -np.inf), number))
        self._reached[key] = float(reached[-1])
        rows = np.flatnonzero(number > reached[:-1])
        return times[rows], values[rows]


def _joined(series: list[tuple[FloatArray, FloatArray]]) -> tuple[FloatArray, FloatArray]:
    times, values = (np.concatenate(arrays) for arrays in zip(*series, strict=True))
    order = np.argsort(times, kind="stable")
    return times[order], values[order]
