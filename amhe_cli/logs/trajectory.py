"""From a log to a trajectory: decode what is asked for, choose clocks, convert to SI, resample."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from amhe_cli.core import rotations
from amhe_cli.core.arrays import FloatArray, IntArray
from amhe_cli.core.errors import ConfigError, LogError
from amhe_cli.core.settings import LogSettings
from amhe_cli.core.signals import Signal
from amhe_cli.core.trajectory import Series, Trajectory
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
from amhe_cli.logs.collect import collect
from amhe_cli.logs.decode import Samples, SignalDecoder
from amhe_cli.logs.definitions import Definitions
from amhe_cli.logs.differentiate import angular_velocity, derivative
from amhe_cli.logs.folder import open_log
from amhe_cli.logs.message_types import DERIVED
from amhe_cli.logs.physics import checked, twist_looks_global
from amhe_cli.logs.raw import readable
from amhe_cli.logs.resample import longest_bridge, resample

logger = logging.getLogger(__name__)

_MOST_ROWS = 10_000_000
#: Header-less topics are moved onto the others' header clock where that is off by more than this [s].
_SAME_CLOCK = 1.0
#: A smaller offset between two topics [s], or one of less than half a period, may be their transport's.
_LATENCY = 0.02
#: A signal that is missing for a larger share of the log is worth a warning, which names so many gaps.
_LOSS = 0.05
_GAPS_SHOWN = 3


@dataclass(frozen=True, slots=True, eq=False)
class _Track:
    """One signal with its stamps: the m samples that count."""

    signal: Signal
    times: Timeline
    samples: Samples
    twist_in_child: bool

    @property
    def period(self) -> float:
        """Median period [s]; 0 for a single sample."""
        return float(np.median(np.diff(self.times.stamps_ns))) / 1e9 if self.times.stamps_ns.size > 1 else 0.0

    def moved(self, seconds: float) -> _Track:
        """The same, with stamps later by `seconds`."""
        stamps_ns = self.times.stamps_ns + round(seconds * 1e9)
        return replace(self, times=replace(self.times, stamps_ns=stamps_ns))


def read_trajectory(
    path: Path,
    signals: Sequence[Signal],
    dt: float,
    settings: LogSettings,
    *,
    start: float | None = None,
    end: float | None = None,
    msg_path: Path | None = None,
) -> Trajectory:
    """Read the given signals of one log onto one uniform clock.

    Row 0 is the first instant at which every signal has begun, in phase with the first message of the
    state topic that begins last: a log recorded at multiples of `dt` is taken over as it is. Commands are
    held until the next one, states interpolated, orientations along the arc; silences longer than
    `settings.max_gap` (or five periods of the topic) stay invalid.

    An odometry's linear velocity is turned from its child frame into the world. A TwistStamped, whose frame
    ROS leaves to the sender, is taken as it is: linear velocity in the world, angular in the body's frame.

    Args:
        path: A .mcap, .db3 or .bag file, or a rosbag2 folder.
        signals: What to read; topics that are not named are not decoded.
        dt: Step of the clock [s].
        settings: Clock and gap settings.
        start: Where to begin [s], counted from row 0.
        end: Where to stop [s], counted from row 0.
        msg_path: Folder of .msg files for types that the log does not define.

    Raises:
        ConfigError: If the path does not exist, or a signal or option makes no sense.
        LogError: If the log is unreadable, or lacks a topic, joint or quantity that is asked for.
    """
    if not signals or not dt > 0:
        raise ConfigError("reading a log takes at least one signal and a positive time step")
    with readable(path):
        log = open_log(path)
        decoders = collect(log, signals, Definitions(msg_path))
        tracks = _one_clock(path, _tracks(path, signals, decoders, settings), settings)
        grid, start_ns = _grid(path, tracks, dt, start, end)
        series: dict[str, Series] = {}
        for track in tracks:
            found = _series(path, track, grid, start_ns, settings)
            _tell_gaps(path, track.signal, found, dt)
            series |= found
    return Trajectory(dt, series, str(path), start_ns, log.metadata)


def _tracks(
    path: Path, signals: Sequence[Signal], decoders: Mapping[str, SignalDecoder], settings: LogSettings
) -> list[_Track]:
    """Check the signals' samples and choose their stamps."""
    samples = {}
    for signal in signals:
        warn = _Warner(path, signal.topic)
        samples[signal.name] = checked(decoders[signal.name].samples(), signal, warn)
    stamp = _trusted(path, signals, samples, settings.stamp)
    return [_track(path, signal, decoders[signal.name], samples[signal.name], stamp) for signal in signals]


def _trusted(path: Path, signals: Sequence[Signal], samples: Mapping[str, Samples], stamp: Stamp) -> Stamp:
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
        else "data on its two sides do not belong together; use --set logs.stamp=log"
    )
    for topic, found in stepping.items():
        _Warner(path, topic)(f"{step_words(found)}: {remedy}")
    return "log" if stepping and stamp == "auto" else stamp


@dataclass(frozen=True, slots=True)
class _Warner:
    """Says what is odd about one topic."""

    path: Path
    topic: str

    def __call__(self, text: str) -> None:
        logger.warning("%s: topic %r: %s", self.path, self.topic, text)


def _track(path: Path, signal: Signal, decoder: SignalDecoder, samples: Samples, stamp: Stamp) -> _Track:
    times = timeline(samples, stamp)
    for note in times.notes:
        _Warner(path, signal.topic)(note)
    if times.kept.size == 0:
        raise LogError(f"{path}: topic {signal.topic!r}: no message has a usable {times.clock} stamp")
    if not samples.has_header and stamp == "auto":
        logger.info("%s: topic %r: no header, %s stamps are used", path, signal.topic, times.clock)
    return _Track(signal, times, samples.pick(times.kept), decoder.info.twist_in_child)


def _one_clock(path: Path, tracks: list[_Track], settings: LogSettings) -> list[_Track]:
    """Bring the topics onto one clock: what differs grossly always, what differs slightly if asked."""
    lags = {t.signal.topic: t.times.lag for t in tracks if t.times.clock == "header"}
    shifts = offsets(lags) if settings.align else {}
    middle = float(np.median(list(lags.values()))) if lags else 0.0
    _tell_offsets(path, tracks, settings.align)
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


def _tell_offsets(path: Path, tracks: Sequence[_Track], align: bool) -> None:
    """Say how far the header clocks are apart; warn of what no transport explains, unless it is corrected.

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
                "%s: %s: if both were measured at once, correct it with --set logs.align=true", path, words
            )
        else:
            logger.info("%s: %s", path, words)


def _grid(
    path: Path, tracks: Sequence[_Track], dt: float, start: float | None, end: float | None
) -> tuple[FloatArray, int]:
    """Instants of the rows [s] from the first one, shape (T,), and the stamp of the first one [ns]."""
    states = [track for track in tracks if not track.signal.is_input] or list(tracks)
    begun = max(int(track.times.stamps_ns[0]) for track in tracks)
    anchor = max(int(track.times.stamps_ns[0]) for track in states)
    last = max(int(track.times.stamps_ns[-1]) for track in states)
    step = dt * 1e9
    # Relative to the anchor: a stamp in float64 would be off by hundreds of nanoseconds.
    begin = float(np.ceil((begun - anchor) / step - 1e-6)) * step
    rows = int(np.floor((last - anchor - begin) / step + 1e-6)) + 1
    if rows < 1:
        raise LogError(f"{path}: {_no_overlap(tracks)}")
    low = 0 if start is None else int(np.ceil(start / dt - 1e-6))
    high = rows if end is None else min(rows, int(np.floor(end / dt + 1e-6)) + 1)
    if low < 0 or high <= low:
        raise ConfigError(
            f"{path}: the log lasts {(rows - 1) * dt:.3f} s: no part of it lies between "
            f"--from {start or 0:g} and --to {'its end' if end is None else f'{end:g}'}"
        )
    if high - low > _MOST_ROWS:
        raise LogError(
            f"{path}: {(high - low) * dt:.0f} s at steps of {dt:g} s are {high - low} rows, more than "
            f"{_MOST_ROWS}; cut it with --from and --to, or look for a wrong stamp with `amhe inspect`"
        )
    start_ns = anchor + round(begin + low * step)
    return np.arange(high - low, dtype=np.float64) * dt, start_ns


def _no_overlap(tracks: Sequence[_Track]) -> str:
    origin = min(int(track.times.stamps_ns[0]) for track in tracks)
    spans = ", ".join(
        f"{t.signal.topic} {(t.times.stamps_ns[0] - origin) / 1e9:.3f} to "
        f"{(t.times.stamps_ns[-1] - origin) / 1e9:.3f} s ({t.times.clock} stamps)"
        for t in tracks
    )
    return f"the topics do not overlap in time: {spans}"


def _series(
    path: Path, track: _Track, grid: FloatArray, start_ns: int, settings: LogSettings
) -> dict[str, Series]:
    signal = track.signal
    times = (track.times.stamps_ns - start_ns) / 1e9
    bridge = longest_bridge(times, settings.max_gap, signal.is_input)
    series: dict[str, Series] = {}
    for quantity in signal.quantities:
        values, columns, derived = _values(path, track, quantity, times, bridge)
        series[signal.key(quantity)] = resample(
            times,
            values,
            columns,
            grid,
            bridge=bridge,
            hold=signal.is_input,
            rotation=quantity == "orientation",
            derived=derived,
        )
    return series


def _tell_gaps(path: Path, signal: Signal, series: Mapping[str, Series], dt: float) -> None:
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
        "%s: topic %r: no data of signal %r %s%s, in all %s of %s s: clips across a gap are dropped",
        path, signal.topic, signal.name, ", ".join(shown), rest,
        f"{dt * missing.sum():.2f}", f"{dt * missing.size:.2f}",
    )  # fmt: skip


def _values(
    path: Path, track: _Track, quantity: str, times: FloatArray, bridge: float
) -> tuple[FloatArray, tuple[str, ...], bool]:
    """Bring one quantity into our convention; differentiate it where the topic lacks it.

    Returns:
        Samples (m, k), names of the columns, whether they were differentiated.
    """
    known: Mapping[str, FloatArray] = track.samples.values
    if quantity in known and np.isfinite(known[quantity]).any():
        values = known[quantity]
        if quantity == "linear_velocity" and track.twist_in_child:
            values = rotations.rotate(known["orientation"], values)
            if twist_looks_global(times, known, values):
                logger.warning(
                    "%s: topic %r: its twist fits its positions better as a velocity in the world frame, but "
                    "ROS defines it in the child frame, and so it was read",
                    path,
                    track.signal.topic,
                )
        return values, track.samples.columns[quantity], False
    source = DERIVED.get(quantity, "")
    if source not in known or not np.isfinite(known[source]).any():
        raise LogError(f"{path}: topic {track.signal.topic!r} carries no {quantity}")
    logger.info("%s: topic %r: %s is differentiated from %s", path, track.signal.topic, quantity, source)
    columns = ("x", "y", "z") if source == "orientation" else track.samples.columns[source]
    return _differentiated(times, known[source], source, bridge), columns, True


def _differentiated(times: FloatArray, values: FloatArray, source: str, bridge: float) -> FloatArray:
    if source == "orientation":
        slopes = np.full((times.size, 3), np.nan)
        present = np.isfinite(values).all(axis=1)
        slopes[present] = angular_velocity(times[present], values[present], bridge)
        return slopes
    slopes = np.full(values.shape, np.nan)
    finite = np.isfinite(values)
    for columns in _columns_alike(finite):
        present = finite[:, columns[0]]
        slopes[np.ix_(present, columns)] = derivative(times[present], values[present][:, columns], bridge)
    return slopes


def _columns_alike(finite: np.ndarray) -> list[IntArray]:
    _, kind = np.unique(finite, axis=1, return_inverse=True)
    return [np.flatnonzero(kind.ravel() == k) for k in range(int(kind.max(initial=-1)) + 1)]
