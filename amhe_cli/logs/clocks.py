"""When samples were taken: one of each message's three stamps, without those that are wrong, on one clock."""

from __future__ import annotations

import logging
from array import array
from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Literal

import numpy as np

from amhe_cli.core.arrays import BoolArray, FloatArray, IntArray
from amhe_cli.core.errors import LogError
from amhe_cli.core.settings import LogSettings
from amhe_cli.core.signals import Signal
from amhe_cli.logs.containers.raw import messages
from amhe_cli.logs.messages.decode import SignalSamples

logger = logging.getLogger(__name__)

Clock = Literal["header", "publish", "log"]
#: A clock, or 'auto'; see `timeline`.
Stamp = Literal["auto", "header", "publish", "log"]

#: Header stamps this far [s] from where the recorder's clock puts them are wild, if they are few.
_WILD_HEADER = 60.0
#: Any stamp this far [s] from the middle of its log is wild, if such stamps are few.
_WILD = 86400.0
#: Clocks that differ by more [s] are worth a warning.
_DISAGREE = 1.0
#: Offsets between topics that are larger [s] are reported.
_OFFSET = 0.005
#: A smaller offset between two topics [s], or one of less than half a period, may be their transport's.
_LATENCY = 0.02
#: A header clock that steps is judged by this many messages on either side.
_STEP_MESSAGES = 50
#: It is judged by no fewer messages than these.
_STEP_ENOUGH = 10
#: It steps by at least so much [s].
_STEP_LEAST = 0.02
#: It steps by at least so many of the topic's periods.
_STEP_PERIODS = 3.0
#: It steps by at least so many sd of its jitter.
_STEP_JITTERS = 6.0


@dataclass(frozen=True, slots=True, eq=False)
class Timeline:
    """The stamps that were chosen for one topic.

    Args:
        clock: Source of the stamps: 'header', 'publish' or 'log'.
        stamps_ns: Strictly increasing stamps [ns] of the samples kept, shape (m,).
        kept: Index of these samples, shape (m,).
        lag: Median of the recorder's stamp minus these stamps [s].
        notes: What was dropped and why, in words.
    """

    clock: Clock
    stamps_ns: IntArray
    kept: IntArray
    lag: float
    notes: tuple[str, ...]

    @property
    def period(self) -> float:
        """Median period [s]; 0 for a single sample."""
        return float(np.median(np.diff(self.stamps_ns))) / 1e9 if self.stamps_ns.size > 1 else 0.0


def on_one_clock(
    path: Path, signals: Sequence[Signal], samples: Mapping[str, SignalSamples], settings: LogSettings
) -> dict[str, Timeline]:
    """Choose the stamps of each signal, and bring them onto one clock.

    Large offsets between clocks are corrected always, small ones between topics if the settings say so, and
    those that a signal states. What is dropped or moved is logged.

    Args:
        path: The log, for the messages.
        samples: Name of each signal -> its samples.
        settings: The clock to use, and whether to align topics.

    Raises:
        LogError: A topic has no usable stamp.
    """
    stamp = _trusted(path, signals, samples, settings.stamp)
    chosen = {signal.name: _chosen(path, signal, samples[signal.name], stamp) for signal in signals}
    lags = {s.topic: chosen[s.name].lag for s in signals if chosen[s.name].clock == "header"}
    middle = float(np.median(list(lags.values()))) if lags else 0.0
    _log_offsets(path, [s for s in signals if s.topic in lags], chosen, settings.align)
    for signal in signals:
        times, shift = chosen[signal.name], signal.offset
        if signal.topic in lags:
            # A topic whose stamps run ahead reaches the recorder early by its own clock: its lag is small.
            # Transport takes part of the lag, so this cannot tell a slow network from a slow clock.
            shift += lags[signal.topic] - middle if settings.align else 0.0
        elif abs(middle) > _DISAGREE:
            shift -= middle
            logger.warning(
                "%s: topic %r: its %s stamps are moved by %.6g s onto the header clock of the other topics",
                path, signal.topic, times.clock, -middle,
            )  # fmt: skip
        chosen[signal.name] = replace(times, stamps_ns=times.stamps_ns + round(shift * 1e9))
    return chosen


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
        logger.warning("%s: topic %r: %s: %s", path, topic, step_words(found), remedy)
    return "log" if stepping and stamp == "auto" else stamp


def _chosen(path: Path, signal: Signal, samples: SignalSamples, stamp: Stamp) -> Timeline:
    times = timeline(samples, stamp)
    for note in times.notes:
        logger.warning("%s: topic %r: %s", path, signal.topic, note)
    if times.kept.size == 0:
        raise LogError(f"{path}: topic {signal.topic!r}: no message has a usable {times.clock} stamp")
    if not samples.has_header and stamp == "auto":
        logger.info("%s: topic %r: no header, %s stamps are used", path, signal.topic, times.clock)
    return times


def _log_offsets(path: Path, stamped: Sequence[Signal], chosen: Mapping[str, Timeline], align: bool) -> None:
    """Log the offsets between header clocks; warn of those that transport cannot explain, unless corrected.

    An offset that the system states counts as corrected.
    """
    lags = {signal.topic: chosen[signal.name].lag - signal.offset for signal in stamped}
    periods = {signal.topic: chosen[signal.name].period for signal in stamped}
    for (late, early, apart), words in zip(_offset_pairs(lags), offset_words(lags), strict=True):
        if align:
            logger.info("%s: %s (corrected)", path, words)
        elif apart > max(_LATENCY, 0.5 * min(periods[late], periods[early])):
            logger.warning(
                "%s: %s: if both were measured at once, correct it with `logs.align=true`", path, words
            )
        else:
            logger.info("%s: %s", path, words)


def timeline(samples: SignalSamples, forced: Stamp = "auto") -> Timeline:
    """Choose a clock for one topic and reduce its stamps to a strictly increasing sequence.

    Args:
        samples: The topic's samples, in the order they were logged.
        forced: A clock, or 'auto': header if its stamps are set and run forward, else publish, else log.
    """
    notes: list[str] = []
    order: tuple[Clock, ...] = ("header", "publish", "log") if forced == "auto" else (forced,)
    if not samples.has_header and forced == "header":
        order = ("publish", "log")
        notes.append("it has no header stamps; publish stamps are used")
    if not samples.has_header and np.array_equal(samples.publish_ns, samples.log_ns):
        order, notes = ("publish",), []  # the rows of a table have one time, whatever it is called
    best: Timeline | None = None
    for clock in order:
        stamps = {"header": samples.header_ns, "publish": samples.publish_ns, "log": samples.log_ns}[clock]
        if clock == "header" and not samples.has_header:
            continue
        found = _clean(clock, stamps, samples)
        if 10 * found.kept.size >= 9 * len(stamps) or len(stamps) - found.kept.size <= 1:
            best = found
            break
        best = found if best is None or found.kept.size > best.kept.size else best
        if forced == "auto" and len(order) > 1:
            unset = int(np.sum(stamps == 0))
            why = f"{unset} of {len(stamps)} are not set" if unset else "they do not run forward"
            notes.append(f"its {clock} stamps cannot be used ({why})")
    assert best is not None
    if notes:
        notes.append(f"{best.clock} stamps are used")
    if abs(best.lag) > _DISAGREE:
        way = "behind" if best.lag > 0 else "ahead of"
        notes.append(f"its {best.clock} stamps are {abs(best.lag):.6g} s {way} the recorder's clock")
    return Timeline(best.clock, best.stamps_ns, best.kept, best.lag, (*notes, *best.notes))


def _clean(clock: Clock, stamps: IntArray, samples: SignalSamples) -> Timeline:
    """Drop what is unset, wild, superseded, duplicate or out of order, and count it."""
    notes: list[str] = []
    kept = np.flatnonzero(stamps != 0) if clock == "header" else np.arange(len(stamps))
    if kept.size < len(stamps):
        notes.append(f"{messages(len(stamps) - kept.size)} without a {clock} stamp dropped")
    wild = _wild(stamps[kept], samples.log_ns[kept] if clock == "header" else None)
    if wild.any():
        notes.append(f"{messages(int(wild.sum()))} with a wild {clock} stamp dropped")
        kept = kept[~wild]
    lags = samples.log_ns[kept]
    lags -= stamps[kept]
    lag = float(np.median(lags, overwrite_input=True)) / 1e9 if kept.size else 0.0
    del lags  # of ten million messages, each such array is 80 MB
    acts = (stamps + samples.delay_ns)[kept]
    if np.any(samples.delay_ns[kept]):
        # A trajectory's later points count only until the next trajectory begins.
        later = np.minimum.accumulate(np.append(acts[1:], np.iinfo(np.int64).max)[::-1])[::-1]
        kept, acts = kept[acts < later], acts[acts < later]
    forward = increasing(acts)
    if not forward.all():
        repeated = int(np.sum(np.diff(np.sort(acts)) == 0))
        back = int(np.sum(~forward)) - repeated
        counts = {"with a repeated stamp": repeated, "out of order": back}
        words = ", ".join(f"{count} {what}" for what, count in counts.items() if count > 0)
        notes.append(f"messages are dropped: {words}")
        kept, acts = kept[forward], acts[forward]
    return Timeline(clock, acts, kept, lag, tuple(notes))


def header_steps(samples: SignalSamples) -> list[tuple[float, float]]:
    """Steps of a topic's header clock: seconds after its first message, and size [s].

    A step is lasting and in the header stamps only. A late message, a recorder that stalled and a clock that
    drifts or runs at another rate do not count.

    Args:
        samples: The topic's samples, in the order they were logged.
    """
    present = np.flatnonzero(samples.header_ns != 0)
    if not samples.has_header or present.size < 2 * _STEP_ENOUGH:
        return []
    # As float64 differences: a damaged stamp may be so far off that int64 would overflow.
    header = samples.header_ns[present].astype(np.float64) / 1e9
    log = (samples.log_ns[present] - samples.log_ns[present[0]]) / 1e9
    lead = header - header[0] - log
    period = float(np.median(np.diff(log)))
    leaps = np.diff(lead)
    # Where the recorder paused and the header went on as ever, it is the recorder that was late.
    own = np.abs(np.diff(header) - period) > 0.5 * np.abs(leaps)
    found: list[tuple[float, float]] = []
    for i in np.flatnonzero((np.abs(leaps) > max(_STEP_LEAST, _STEP_PERIODS * period)) & own).tolist():
        before, after = lead[max(i + 1 - _STEP_MESSAGES, 0) : i + 1], lead[i + 1 : i + 1 + _STEP_MESSAGES]
        if min(before.size, after.size) < _STEP_ENOUGH:
            continue
        size = float(np.median(after) - np.median(before))
        same = abs(size - leaps[i]) < 0.5 * abs(leaps[i])
        if same and abs(size) > max(_STEP_LEAST, _STEP_JITTERS * max(_spread(before), _spread(after))):
            found.append((float(log[i + 1]), size))
    return found


def _spread(values: FloatArray) -> float:
    """Standard deviation, by the median distance: a few outliers do not count."""
    return 1.4826 * float(np.median(np.abs(values - np.median(values))))


def step_words(steps: Sequence[tuple[float, float]]) -> str:
    """The steps of one topic's header clock in words; of several, the largest."""
    when, size = max(steps, key=lambda step: abs(step[1]))
    more = f" (the largest of {len(steps)} jumps)" if len(steps) > 1 else ""
    return f"its header clock jumps by {size:+.3f} s, {when:.2f} s after its first message{more}"


def _wild(stamps: IntArray, reference: IntArray | None) -> BoolArray:
    """Stamps that a few messages have far from all others (epoch 0, years off), shape (n,)."""
    wild = np.zeros(len(stamps), dtype=bool)
    if len(stamps) < 3:
        return wild
    # Differences of float64: a flipped bit may put a stamp so far off that int64 would overflow.
    for origin, limit in ((0, _WILD), (reference, _WILD_HEADER)):
        if origin is None:
            continue
        distance = stamps.astype(np.float64)
        distance -= origin
        distance -= np.median(distance)
        far = np.abs(distance, out=distance) > limit * 1e9
        if 10 * far.sum() <= len(stamps) or far.sum() == 1:
            wild |= far
    return wild


def increasing(stamps: IntArray) -> BoolArray:
    """The largest set of stamps that is strictly increasing in the order given, as a mask (n,).

    A single stamp that jumps ahead therefore costs one message, and not all messages after it.
    """
    keep = np.append(stamps[1:] != stamps[:-1], True)  # of repeated ones the last
    if not keep.all():
        keep[keep] = increasing(stamps[keep])
        return keep
    # What lies between all before it and all behind it is in any such set.
    keep[1:] &= np.maximum.accumulate(stamps[:-1]) < stamps[1:]
    keep[:-1] &= stamps[:-1] < np.minimum.accumulate(stamps[:0:-1])[::-1]
    edges = np.flatnonzero(np.diff(keep, prepend=True, append=True))
    for first, end in zip(edges[::2], edges[1::2], strict=True):
        keep[first:end] = _longest_run(stamps[first:end])
    return keep


def _longest_run(stamps: IntArray) -> BoolArray:
    """The longest strictly increasing part of some stamps, as a mask."""
    tails = array("q")  # the smallest stamp that ends a run of each length
    ends = array("q")  # its index
    before = array("q")
    for i, stamp in enumerate(stamps.data):
        length = bisect_left(tails, stamp)
        before.append(ends[length - 1] if length else -1)
        if length == len(tails):
            tails.append(stamp)
            ends.append(i)
        else:
            tails[length], ends[length] = stamp, i
    keep, i = np.zeros(stamps.size, dtype=bool), ends[-1]
    while i >= 0:
        keep[i], i = True, before[i]
    return keep


def _offset_pairs(lags: Mapping[str, float]) -> list[tuple[str, str, float]]:
    """Topics with neighbouring lags that differ: (stamped later, stamped earlier, by how much [s])."""
    ordered = sorted(lags, key=lambda topic: lags[topic])
    pairs = [(first, second, lags[second] - lags[first]) for first, second in pairwise(ordered)]
    return [pair for pair in pairs if pair[2] > _OFFSET]


def offset_words(lags: Mapping[str, float]) -> list[str]:
    """The differences between the topics' clocks, with the sign in words."""
    return [
        f"topic {late!r} is stamped {1e3 * apart:.0f} ms later than {early!r} "
        "(judged by when the recorder got them)"
        for late, early, apart in _offset_pairs(lags)
    ]
