"""Clips: the windows of the logs that identification rolls out (SPI, section III-B of the paper)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from amhe_cli.core.arrays import BoolArray
from amhe_cli.core.each_log import same_values
from amhe_cli.core.log import Log, Window
from amhe_cli.core.settings import ClipSettings
from amhe_cli.core.statistics import white_noise_sd
from amhe_cli.system.system import System

#: From this many logs on, whole logs are held out instead of a part of each.
WHOLE_LOGS = 4


def whole(log: Log) -> Window:
    """All of a log."""
    return Window(log, 0, log.steps - 1)


def split_held_out(logs: Sequence[Log], clips: ClipSettings) -> tuple[list[Window], list[Window]]:
    """Divide logs into parts to fit and parts to validate on.

    With many logs every n-th is held out whole; with few, or fewer than n, and where logs have values of
    their own, which no other log knows, the last part of each.

    Args:
        clips: Share of their time that is held out, and the length of clips.
    """
    share = clips.held_out
    if share <= 0.0:
        return [whole(log) for log in logs], []
    every = max(2, round(1.0 / share))
    if len(logs) >= max(WHOLE_LOGS, every) and not any(log.own for log in logs):
        held = [i % every == every - 1 for i in range(len(logs))]
        return (
            [whole(log) for log, out in zip(logs, held, strict=True) if not out],
            [whole(log) for log, out in zip(logs, held, strict=True) if out],
        )
    cuts = [round((1.0 - share) * (log.steps - 1)) for log in logs]
    return (
        [Window(log, 0, cut) for log, cut in zip(logs, cuts, strict=True)],
        [Window(log, cut, log.steps - 1 - cut) for log, cut in zip(logs, cuts, strict=True)],
    )


def too_few(logs: Sequence[Log], clips: ClipSettings) -> bool:
    """Whether the held-out parts of the logs are few clips, so that an estimate needs these, too.

    What is held out of a log of a few seconds may be the only motion of its kind.
    """
    held = clips.held_out * sum(log.duration for log in logs)
    return 0.0 < held < clips.held_out_least * validation_length(clips)


def validation_length(clips: ClipSettings) -> float:
    """Length of the clips to validate on [s]."""
    return clips.held_out_length or 0.5 * sum(clips.length)


def evenly(clips: Sequence[Window], most: int) -> list[Window]:
    """At most so many of the clips, spread evenly over them."""
    rows = np.linspace(0, len(clips) - 1, min(most, len(clips))).round().astype(int)
    return [clips[i] for i in rows]


def places(clips: Sequence[Window]) -> list[tuple[str, int, int]]:
    """Log, start and length of each clip: each search cuts clips of its own from the same logs."""
    return [(clip.log.source, clip.start, clip.length) for clip in clips]


def of_each_kind(clips: Sequence[Window], few: int) -> list[Window]:
    """The first few clips of logs that measured the same, and on which parameters have the same values."""
    kinds: dict[object, list[Window]] = {}
    for clip in clips:
        measured = tuple(sorted(key for key, series in clip.log.series.items() if not series.derived))
        kinds.setdefault((measured, same_values(clip.log)), []).append(clip)
    return [clip for alike in kinds.values() for clip in alike[:few]]


@dataclass
class ClipPool:
    """Source of clips from some parts of logs; counts the clips side by side that it had to drop.

    Args:
        system: The system, which defines the series that a clip needs.
        parts: Parts of logs in which clips may lie.
        settings: Lengths of clips, and when a clip is motionless.
        motionless, across_gaps: Number of clips that `cut` has dropped for either reason.
    """

    system: System
    parts: Sequence[Window]
    settings: ClipSettings
    motionless: int = 0
    across_gaps: int = 0
    _usable: dict[int, BoolArray] = field(default_factory=dict)
    _noise: dict[tuple[int, str], float] = field(default_factory=dict)

    @property
    def _places(self) -> list[Window]:
        """Where clips may lie: the parts, or of a log in short pieces, such as throws, the pieces."""
        return [piece for part in self.parts for piece in self._pieces(part)]

    def _pieces(self, part: Window) -> list[Window]:
        """A part, or its stretches without a gap where none of them has room for two usual clips."""
        usable = self._usable_rows(part.log)[part.start : part.stop + 1]
        ends = np.flatnonzero(np.diff(usable, prepend=False, append=False)).reshape(-1, 2)
        least, most = (round(seconds / part.log.dt) for seconds in self.settings.length)
        pieces = [Window(part.log, part.start + int(a), int(b - a) - 1) for a, b in ends if b - a > least]
        if len(ends) < 2 or not pieces or max(piece.length for piece in pieces) >= least + most:
            return [part]
        return pieces

    def _usable_rows(self, log: Log) -> BoolArray:
        """Rows of a log where all that a clip needs is measured, shape (T,)."""
        if id(log) not in self._usable:
            self._usable[id(log)] = log.usable(self.keys)
        return self._usable[id(log)]

    @property
    def keys(self) -> tuple[str, ...]:
        """Series that every clip needs: what the channels measure, and the inputs."""
        return self.system.keys

    def draw(self, rng: np.random.Generator, count: int) -> list[Window]:
        """At most `count` clips of random start and length; unusable ones are drawn again."""
        places = self._places
        steps = np.array([place.length for place in places], dtype=float)
        if steps.sum() <= 0.0:
            return []
        clips: list[Window] = []
        for _ in range(10 * count):
            if len(clips) == count:
                break
            part = places[rng.choice(len(steps), p=steps / steps.sum())]
            length = _steps(rng.uniform(*self.settings.length), part)
            start = int(rng.integers(part.start, part.stop - length + 1))
            clip = Window(part.log, start, length)
            if not self._crosses_gap(clip) and not self._is_still(clip):
                clips.append(clip)
        return clips

    def cut(self, seconds: float, first_only: bool = False) -> list[Window]:
        """Clips of one length [s] side by side, each instant used once.

        Args:
            seconds: Length of a clip [s].
            first_only: Only the first clip of each part.
        """
        clips: list[Window] = []
        for part in self.parts if first_only else self._places:
            length = _steps(seconds, part)
            stop = min(part.stop, part.start + length) if first_only else part.stop
            for start in range(part.start, stop - length + 1, length) if length else ():
                clip = Window(part.log, start, length)
                if self._crosses_gap(clip):
                    self.across_gaps += 1
                elif self._is_still(clip):
                    self.motionless += 1
                else:
                    clips.append(clip)
        return clips

    def _crosses_gap(self, clip: Window) -> bool:
        return not self._usable_rows(clip.log)[clip.start : clip.stop + 1].all()

    def _is_still(self, clip: Window) -> bool:
        """Whether no compared position moves by more than a few noise sd."""
        for channel in self.system.channels:
            if not channel.compared or channel.source == "qvel":
                continue
            values = clip.log[channel.key].values[clip.start : clip.stop + 1]
            noise = max(channel.noise or 0.0, self._noise_of(channel.key, clip.log))
            # the range of n noise samples alone is some 4 to 6 sd
            if np.ptp(values, axis=0).max() > (self.settings.still + 6.0) * noise:
                return False
        return True

    def _noise_of(self, key: str, log: Log) -> float:
        place = id(log), key  # each log has sensors of its own
        if place not in self._noise:
            series = log[key]
            self._noise[place] = white_noise_sd(series.values[series.sampled & series.valid])
        return self._noise[place]


def _steps(seconds: float, part: Window) -> int:
    """Steps of a clip of some length [s], no more than the part has."""
    return min(max(1, round(seconds / part.log.dt)), part.length)


def clip_name(window: Window) -> str:
    """Name of a clip: 'push.mcap 0.80-1.60 s'."""
    dt = window.log.dt
    return f"{Path(window.log.source).name} {window.start * dt:.2f}-{window.stop * dt:.2f} s"
