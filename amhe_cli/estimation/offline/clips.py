"""Which stretches of the logs are rolled out: SPI's clips of random start and length."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from amhe_cli.core.arrays import BoolArray
from amhe_cli.core.log import Log, Window
from amhe_cli.core.settings import ClipSettings
from amhe_cli.core.statistics import white_noise_sd
from amhe_cli.system.system import System

#: From this many logs on, whole logs are held out instead of a part of each.
WHOLE_LOGS = 4


@dataclass(frozen=True, slots=True, eq=False)
class Stretch:
    """Instants start .. stop of a log that may be used for one purpose."""

    log: Log
    start: int
    stop: int


def split_held_out(logs: Sequence[Log], share: float) -> tuple[list[Stretch], list[Stretch]]:
    """Divide logs into stretches to fit and stretches to validate on.

    With many logs every n-th is held out whole; with few, the last part of each.
    """
    if share <= 0.0:
        return [whole(log) for log in logs], []
    if len(logs) >= WHOLE_LOGS:
        every = max(2, round(1.0 / share))
        held = [i % every == every - 1 for i in range(len(logs))]
        return (
            [whole(log) for log, out in zip(logs, held, strict=True) if not out],
            [whole(log) for log, out in zip(logs, held, strict=True) if out],
        )
    cuts = [round((1.0 - share) * (log.steps - 1)) for log in logs]
    return (
        [Stretch(log, 0, cut) for log, cut in zip(logs, cuts, strict=True)],
        [Stretch(log, cut, log.steps - 1) for log, cut in zip(logs, cuts, strict=True)],
    )


def whole(log: Log) -> Stretch:
    """All of a log."""
    return Stretch(log, 0, log.steps - 1)


@dataclass
class ClipPool:
    """Source of clips from some stretches; counts those that it had to drop.

    Args:
        system: Says which series a clip needs.
        stretches: Where clips may lie.
        settings: Lengths, and what counts as motionless.
    """

    system: System
    stretches: Sequence[Stretch]
    settings: ClipSettings
    motionless: int = 0
    across_gaps: int = 0
    _usable: dict[int, BoolArray] = field(default_factory=dict)
    _noise: dict[str, float] = field(default_factory=dict)

    def draw(self, rng: np.random.Generator, count: int) -> list[Window]:
        """At most `count` clips: start and length uniform, motionless and gap-crossing ones re-drawn."""
        steps = np.array([s.stop - s.start for s in self.stretches], dtype=float)
        if steps.sum() <= 0.0:
            return []
        clips: list[Window] = []
        for _ in range(10 * count):
            if len(clips) == count:
                break
            stretch = self.stretches[rng.choice(len(steps), p=steps / steps.sum())]
            length = self._steps(rng.uniform(*self.settings.length), stretch)
            start = int(rng.integers(stretch.start, stretch.stop - length + 1))
            clip = Window(stretch.log, start, length)
            if self._fit(clip):
                clips.append(clip)
        return clips

    def tiles(self, seconds: float, first_only: bool = False) -> list[Window]:
        """Clips of one length side by side, each instant used once; dropped ones are counted."""
        clips: list[Window] = []
        for stretch in self.stretches:
            length = self._steps(seconds, stretch)
            stop = min(stretch.stop, stretch.start + length) if first_only else stretch.stop
            for start in range(stretch.start, stop - length + 1, length) if length else ():
                clip = Window(stretch.log, start, length)
                if self._fit(clip):
                    clips.append(clip)
        return clips

    def _steps(self, seconds: float, stretch: Stretch) -> int:
        return min(max(1, round(seconds / stretch.log.dt)), stretch.stop - stretch.start)

    def _fit(self, clip: Window) -> bool:
        """Whether a clip can be used, counting it if not."""
        if not self._usable_rows(clip.log)[clip.start : clip.stop + 1].all():
            self.across_gaps += 1
            return False
        if self._is_still(clip):
            self.motionless += 1
            return False
        return True

    def _usable_rows(self, log: Log) -> BoolArray:
        if id(log) not in self._usable:
            keys = [c.key for c in self.system.channels] + [i.key for i in self.system.inputs]
            self._usable[id(log)] = log.usable(tuple(keys))
        return self._usable[id(log)]

    def _is_still(self, clip: Window) -> bool:
        """No compared position moves by more than a few noise sd."""
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
        if key not in self._noise:
            series = log[key]
            self._noise[key] = white_noise_sd(series.values[series.sampled & series.valid])
        return self._noise[key]
