"""The signals of one log: their samples with their times, and the rows that these give on a uniform clock."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from amhe_cli.core import rotations
from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.corrections import cleaned
from amhe_cli.core.errors import ConfigError, LogError
from amhe_cli.core.from_arrays import on_grid
from amhe_cli.core.resample import common_rows, too_many
from amhe_cli.core.settings import LogSettings
from amhe_cli.core.signals import DERIVED, Series, Signal, unwrapped
from amhe_cli.logs.clocks import Timeline, on_one_clock
from amhe_cli.logs.collect import collect, twist_looks_global
from amhe_cli.logs.containers.folder import StoredLog
from amhe_cli.logs.messages.decode import SignalSamples
from amhe_cli.logs.messages.definitions import Definitions
from amhe_cli.logs.tables import signals_on_tables

logger = logging.getLogger(__name__)

#: A signal that is missing for a larger share of the log is worth a warning.
_LOSS = 0.05
#: Gaps that the warning names.
_GAPS_SHOWN = 3


@dataclass(frozen=True, slots=True, eq=False)
class SignalTrack:
    """One signal of a log.

    Args:
        signal: The signal of the system.
        times: Stamps of the m samples that count.
        samples: Values of these samples.
    """

    signal: Signal
    times: Timeline
    samples: SignalSamples

    def carried(self, quantity: str) -> FloatArray | None:
        """Values of a quantity, shape (m, k), velocities in the world; None where the topic lacks it."""
        values = self.samples.values.get(quantity)
        if values is None or not np.isfinite(values).any():
            return None
        if quantity == "linear_velocity" and self.samples.twist_in_child:
            return rotations.rotate(self.samples.values["orientation"], values)
        return values

    def converted(self, quantity: str) -> FloatArray | None:
        """The carried values in SI, angles unwrapped, where the signal says that the file has others."""
        values = self.carried(quantity)
        if values is not None and quantity in self.signal.factors:
            values = values * self.signal.factors[quantity]
        if values is not None and self.signal.reversed:
            values = np.array(values)
            values[:, list(self.signal.reversed)] *= -1.0
        if values is not None and self.signal.wraps and quantity == "position":
            values = unwrapped(values)
        return values


def read_tracks(
    log: StoredLog, signals: Sequence[Signal], definitions: Definitions, settings: LogSettings
) -> list[SignalTrack]:
    """Read signals of a log onto one clock.

    Raises:
        LogError: The log lacks a topic, joint or quantity, or a topic has no usable stamp.
    """
    signals = signals_on_tables(log.connections, signals)
    samples = collect(log, signals, definitions)
    times = on_one_clock(log.path, signals, samples, settings)
    tracks = [SignalTrack(s, times[s.name], samples[s.name].pick(times[s.name].kept)) for s in signals]
    return [_cleaned(log.path, track, settings) for track in tracks]


def _cleaned(path: Path, track: SignalTrack, settings: LogSettings) -> SignalTrack:
    """The track without spikes and repeats, which are warned of."""
    seconds = (track.times.stamps_ns - track.times.stamps_ns[0]) / 1e9
    values = dict(track.samples.values)
    wanted = dict.fromkeys(q if q in values else DERIVED.get(q, q) for q in track.signal.quantities)
    for quantity in (q for q in wanted if q in values):
        values[quantity], notes = cleaned(track.signal, quantity, values[quantity], seconds, settings)
        for note in notes:
            logger.warning("%s: topic %r: %s", path, track.signal.topic, note)
    return replace(track, samples=replace(track.samples, values=values))


def grid_of(
    path: Path, tracks: Sequence[SignalTrack], dt: float, start: float | None, end: float | None
) -> tuple[FloatArray, int]:
    """Instants of the rows [s] from the first one, shape (T,), and the stamp of the first one [ns]."""
    step = dt * 1e9
    anchor, begin, rows = common_rows([(t.times.stamps_ns, t.signal.is_input) for t in tracks], step)
    if rows < 1:
        raise LogError(f"{path}: {_no_overlap(tracks)}")
    low = 0 if start is None else int(np.ceil(start / dt - 1e-6))
    high = rows if end is None else min(rows, int(np.floor(end / dt + 1e-6)) + 1)
    if low < 0 or high <= low:
        raise ConfigError(
            f"{path}: the log lasts {(rows - 1) * dt:.3f} s: no part of it lies between "
            f"`start` {start or 0:g} and `end` {'its end' if end is None else f'{end:g}'}"
        )
    if why := too_many(high - low, max(track.times.stamps_ns.size for track in tracks), dt):
        raise LogError(
            f"{path}: {why}; cut it with `start` and `end`, or look for a wrong stamp with `amhe inspect`"
        )
    start_ns = anchor + round(begin + low * step)
    return np.arange(high - low, dtype=np.float64) * dt, start_ns


def _no_overlap(tracks: Sequence[SignalTrack]) -> str:
    origin = min(int(track.times.stamps_ns[0]) for track in tracks)
    spans = ", ".join(
        f"{t.signal.topic} {(t.times.stamps_ns[0] - origin) / 1e9:.3f} to "
        f"{(t.times.stamps_ns[-1] - origin) / 1e9:.3f} s ({t.times.clock} stamps)"
        for t in tracks
    )
    return f"the topics do not overlap in time: {spans}"


def series_of(
    path: Path, track: SignalTrack, grid: FloatArray, start_ns: int, max_gap: float
) -> dict[str, Series]:
    """Series of each quantity of a signal at the instants of a grid.

    Args:
        path: The log, for the messages.
        track: The signal.
        grid: Instants [s], shape (T,).
        start_ns: Stamp of instant 0 [ns].
        max_gap: Longest silence that is bridged [s].

    Raises:
        LogError: The topic carries nothing that a quantity could be computed from.
    """
    signal, samples = track.signal, dict[str, FloatArray]()
    where = f"{path}: topic {signal.topic!r}"
    times = (track.times.stamps_ns - start_ns) / 1e9
    for quantity in signal.quantities:
        source = quantity
        if (values := track.converted(quantity)) is None:
            source = DERIVED.get(quantity, "")
            values = samples.get(source, track.converted(source))
            if values is None:
                raise LogError(f"{where} carries no {quantity}")
            logger.info("%s: %s is differentiated from %s", where, quantity, source)
        elif quantity == "linear_velocity" and twist_looks_global(times, track.samples, values):
            logger.warning(
                "%s: its twist fits its positions better as a velocity in the world frame, but ROS defines "
                "it in the child frame, and so it was read",
                where,
            )
        values.setflags(write=False)  # nobody else has them: the log need not copy them
        samples[source] = values
    return on_grid(grid, times, signal, samples, track.samples.columns, max_gap)


def warn_of_gaps(path: Path, signal: Signal, series: Mapping[str, Series], dt: float) -> None:
    """Warn where a signal is missing for more than a small part of the log."""
    missing = ~np.all([one.valid for one in series.values()], axis=0)
    if missing.mean() <= _LOSS:
        return
    edges = np.flatnonzero(np.diff(missing, prepend=False, append=False))
    gaps = sorted(edges.reshape(-1, 2).tolist(), key=lambda gap: gap[0] - gap[1])
    shown = [
        f"from {dt * begin:.2f} to {dt * end:.2f} s ({dt * (end - begin):.2f} s)"
        for begin, end in sorted(gaps[:_GAPS_SHOWN])
    ]
    rest = f" and in {len(gaps) - len(shown)} shorter gaps" if len(gaps) > len(shown) else ""
    logger.warning(
        "%s: topic %r: no data of signal %r %s%s, in all %s of %s s: no clip crosses it",
        path, signal.topic, signal.name, ", ".join(shown), rest,
        f"{dt * missing.sum():.2f}", f"{dt * missing.size:.2f}",
    )  # fmt: skip
