"""Signals of one log with their stamps: which clock counts, bringing all onto one, and the rows it gives."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from amhe_cli.core import rotations
from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.errors import ConfigError, LogError
from amhe_cli.core.resample import common_rows, too_many
from amhe_cli.core.settings import LogSettings
from amhe_cli.core.signals import Signal
from amhe_cli.core.units import unwrapped
from amhe_cli.logs.clocks import (
    Stamp,
    Timeline,
    header_steps,
    offset_pairs,
    offset_words,
    offsets,
    step_words,
    timeline,
)
from amhe_cli.logs.messages.decode import SignalDecoder, SignalSamples
from amhe_cli.logs.physics import checked

logger = logging.getLogger(__name__)

#: Header-less topics are moved onto the others' header clock where that is off by more than this [s].
_SAME_CLOCK = 1.0
#: A smaller offset between two topics [s], or one of less than half a period, may be their transport's.
_LATENCY = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class SignalTrack:
    """One signal of a log.

    Args:
        signal: The signal of the system.
        times: Stamps of the m samples that count.
        samples: Values of these samples.
        twist_in_child: Twists are in the child frame's axes, as in an odometry.
    """

    signal: Signal
    times: Timeline
    samples: SignalSamples
    twist_in_child: bool

    @property
    def period(self) -> float:
        """Median period [s]; 0 for a single sample."""
        return float(np.median(np.diff(self.times.stamps_ns))) / 1e9 if self.times.stamps_ns.size > 1 else 0.0

    def carried(self, quantity: str) -> FloatArray | None:
        """Values of a quantity, shape (m, k), velocities in the world; None where the topic lacks it."""
        values = self.samples.values.get(quantity)
        if values is None or not np.isfinite(values).any():
            return None
        if quantity == "linear_velocity" and self.twist_in_child:
            return rotations.rotate(self.samples.values["orientation"], values)
        return values

    def converted(self, quantity: str) -> FloatArray | None:
        """The carried values in SI, angles unwrapped, where the signal says that the file has others."""
        values = self.carried(quantity)
        if values is not None and quantity in self.signal.factors:
            values = values * self.signal.factors[quantity]
        if values is not None and self.signal.wraps and quantity == "position":
            values = unwrapped(values)
        return values

    def moved(self, seconds: float) -> SignalTrack:
        """The same track, with stamps later by `seconds`."""
        stamps_ns = self.times.stamps_ns + round(seconds * 1e9)
        return replace(self, times=replace(self.times, stamps_ns=stamps_ns))


def tracks_of(
    path: Path, signals: Sequence[Signal], decoders: Mapping[str, SignalDecoder], settings: LogSettings
) -> list[SignalTrack]:
    """Check the signals' samples and choose their stamps."""
    samples = {}
    for signal in signals:
        warn = _Warner(path, signal.topic)
        samples[signal.name] = checked(decoders[signal.name].samples(), signal, warn)
    stamp = _trusted(path, signals, samples, settings.stamp)
    return [_track(path, signal, decoders[signal.name], samples[signal.name], stamp) for signal in signals]


def _trusted(
    path: Path, signals: Sequence[Signal], samples: Mapping[str, SignalSamples], stamp: Stamp
) -> Stamp:
    """The clock to use: the recorder's for all topics if one's header clock was set while it ran.

    The topics' headers have no common clock then, whichever side of the step is right.
    """
    if stamp not in ("auto", "header"):
        return stamp
    steps = {signal.topic: header_steps(samples[signal.name]) for signal in signals}
    stepping = {topic: found for topic, found in steps.items() if found}
    remedy = (
        "the recorder's stamps are used for all topics"
        if stamp == "auto"
        else "data on its two sides do not belong together; use `logs.stamp=log`"
    )
    for topic, found in stepping.items():
        _Warner(path, topic)(f"{step_words(found)}: {remedy}")
    return "log" if stepping and stamp == "auto" else stamp


@dataclass(frozen=True, slots=True)
class _Warner:
    """Warns of anomalies of one topic."""

    path: Path
    topic: str

    def __call__(self, text: str) -> None:
        logger.warning("%s: topic %r: %s", self.path, self.topic, text)


def _track(
    path: Path, signal: Signal, decoder: SignalDecoder, samples: SignalSamples, stamp: Stamp
) -> SignalTrack:
    times = timeline(samples, stamp)
    for note in times.notes:
        _Warner(path, signal.topic)(note)
    if times.kept.size == 0:
        raise LogError(f"{path}: topic {signal.topic!r}: no message has a usable {times.clock} stamp")
    if not samples.has_header and stamp == "auto":
        logger.info("%s: topic %r: no header, %s stamps are used", path, signal.topic, times.clock)
    return SignalTrack(signal, times, samples.pick(times.kept), decoder.info.twist_in_child)


def on_one_clock(path: Path, tracks: list[SignalTrack], settings: LogSettings) -> list[SignalTrack]:
    """Bring the topics onto one clock: large offsets always, small ones if the settings say so."""
    lags = {t.signal.topic: t.times.lag for t in tracks if t.times.clock == "header"}
    shifts = offsets(lags) if settings.align else {}
    middle = float(np.median(list(lags.values()))) if lags else 0.0
    _log_offsets(path, tracks, settings.align)
    moved = []
    for track in tracks:
        topic = track.signal.topic
        shift = track.signal.offset - shifts.get(topic, 0.0)
        if topic not in lags and abs(middle) > _SAME_CLOCK:
            shift -= middle
            logger.warning(
                "%s: topic %r: its %s stamps are moved by %.6g s onto the header clock of the other topics",
                path, topic, track.times.clock, -middle,
            )  # fmt: skip
        moved.append(track.moved(shift))
    return moved


def _log_offsets(path: Path, tracks: Sequence[SignalTrack], align: bool) -> None:
    """Log the offsets between header clocks; warn of those that transport cannot explain, unless corrected.

    An offset that the system states counts as corrected.
    """
    stamped = [track for track in tracks if track.times.clock == "header"]
    lags = {t.signal.topic: t.times.lag - t.signal.offset for t in stamped}
    periods = {t.signal.topic: t.period for t in stamped}
    for (late, early, apart), words in zip(offset_pairs(lags), offset_words(lags), strict=True):
        if align:
            logger.info("%s: %s (corrected)", path, words)
        elif apart > max(_LATENCY, 0.5 * min(periods[late], periods[early])):
            logger.warning(
                "%s: %s: if both were measured at once, correct it with `logs.align=true`", path, words
            )
        else:
            logger.info("%s: %s", path, words)


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
