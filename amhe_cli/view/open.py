"""From logs to a page: which clips, which candidates, and what is written around them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from markupsafe import Markup

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.belief import Belief, completed
from amhe_cli.core.errors import ConfigError
from amhe_cli.core.log import Log, Window
from amhe_cli.core.shown import TimeCurve
from amhe_cli.engine.open import open_engine
from amhe_cli.estimation.offline.clips import clip_name, split_held_out, too_few, whole
from amhe_cli.system.system import System
from amhe_cli.view.ghosts import Candidate, Take, Viewing, viewing
from amhe_cli.view.page import Heading, ghost_data, parameter_rows, saved_page, strip_data
from amhe_cli.view.scene import Geom, scene_of
from amhe_cli.web import page as web
from amhe_cli.web.plots import Curve, Mark, Panel, figure, shown_unit

#: Pictures of a strip, and triangles of their meshes: a report stays small.
_PICTURES, _TRIANGLES = 5, 5_000
#: Columns of a whole log that are drawn.
_COLUMNS = 4


@dataclass(frozen=True, slots=True, eq=False)
class LogView:
    """Logs with their ghosts, as a page and as parts of a report.

    Args:
        found: Clips and ghosts.
        heading: What stands around the scene.
    """

    found: Viewing
    heading: Heading = field(repr=False)

    def page(self, **more: Any) -> str:
        """The page; `more` as in `saved_page`."""
        return saved_page(self.found, self.heading, **more)

    def answer(self, asked: Mapping[str, str]) -> dict[str, Any]:
        """Another ghost of a clip: `take`, its row, and a value for each parameter by name.

        Raises:
            ConfigError: There is no such clip, or a value is no number within its bounds.
        """
        space = self.found.scene.system.space
        try:
            take = self.found.takes[int(asked["take"])]
            theta = np.array([float(asked[name]) for name in space.names])
        except (KeyError, ValueError, IndexError):
            raise ConfigError("give the row of a clip as `take`, and a value for each parameter") from None
        if not all(p.lower <= value <= p.upper for p, value in zip(space.parameters, theta, strict=True)):
            raise ConfigError("a value is not within its bounds")
        return ghost_data(self.found, *self.found.again(take, theta))

    def worst(self, names: Sequence[str]) -> int | None:
        """Row of the clip that the first candidate misses most, of those with some names if one has it."""
        takes = self.found.takes
        held = [i for i, take in enumerate(takes) if take.held_out] or range(len(takes))
        among = [i for i in held if clip_name(takes[i].window) in names] or held
        return max(among, key=lambda i: takes[i].costs[0], default=None)

    def strip(self, row: int) -> Markup:
        """Pictures of a clip, measured and with its ghosts, for stage.js; '' where these move alike."""
        if self.found.scene.system.match == "effort":
            return Markup("")
        scene = scene_of(self.found.scene.system, most=_TRIANGLES)
        values = strip_data(self.found, self.found.takes[row], scene, _PICTURES)
        return Markup('<div class="ghosts"><script type="application/json">{}</script></div>').format(
            web.data(values)
        )

    def whole_log(self) -> Markup:
        """The first log as a whole: what moves most, measured and predicted over each clip."""
        recording, columns = self.found.recordings[0], self.found.columns
        takes = sorted((t for t in self.found.takes if t.recording == 0), key=lambda take: take.ends)
        held = [Mark(take.ends, "held out", "given") for take in takes if take.held_out]
        moved = np.array(
            [np.ptp(v[np.isfinite(v)]) if np.isfinite(v).any() else 0.0 for v in recording.track.values.T]
        )
        noise = np.array([one.noise or np.inf for one in columns])
        panels = []
        for k in sorted(np.argsort(-moved / noise, kind="stable")[:_COLUMNS].tolist()):
            factor, unit = shown_unit(columns[k].unit)
            time = recording.track.step * np.arange(len(recording.track.values), dtype=np.float64)
            measured = Curve(time, factor * recording.track.values[:, k], "measured", "measured", "dots")
            ghosts = [_over_clips(takes, i, k, name, factor) for i, name in enumerate(self.found.candidates)]
            title = " ".join(dict.fromkeys((columns[k].channel, columns[k].name)))
            panels.append(Panel(title, [*ghosts, measured], unit, marks=held))
        return figure(panels, 1)


def _over_clips(takes: Sequence[Take], i: int, k: int, name: str, factor: float) -> Curve:
    """Column k of candidate i over all clips, open between them."""
    x, y = [np.zeros(0)], [np.zeros(0)]
    for take in takes:
        if (ghost := take.ghosts[i]) is not None:
            x += [take.ends[0] + ghost.step * np.arange(len(ghost.values)), np.array([take.ends[1]])]
            y += [factor * ghost.values[:, k], np.array([np.nan])]
    shape = "dashed" if name == "before" else "line"
    return Curve(np.concatenate(x), np.concatenate(y), name, name, shape, leads=False)


def view_of(
    system: System,
    logs: Sequence[Log],
    *,
    held_out: Sequence[Log] = (),
    belief: Belief | None = None,
    first: Mapping[str, float] | None = None,
    fitted: bool = False,
    threads: int = 1,
    about: str = "",
    warnings: Sequence[str] = (),
    verdicts: Mapping[str, str] | None = None,
    bodies: Sequence[Mapping[str, Any]] = (),
    curves: Sequence[TimeCurve] = (),
    events: FloatArray | Sequence[float] = (),
    more: Sequence[Geom] = (),
) -> LogView:
    """Logs with their ghosts.

    Args:
        held_out: Further logs that were only used to validate.
        belief: What was identified, the second candidate; None: what `curves` say was believed where a clip
            starts, if they say it.
        first: Values of the first candidate by name, those with which something began; None: the system's
            nominal ones.
        fitted: `belief` comes from these logs: those clips come first that were held out of the fit.
        threads: CPU threads; the page does not depend on them.
        about: What the page's title says behind the system's name; that of `identify --model` has none.
        warnings: Further sentences that a reader needs to know.
        verdicts: Verdict of each parameter by name.
        bodies: What is known of bodies, as in result.json, in place of the coordinates of their inertias.
        curves: Further numbers over the time of the first log.
        events: Times of the first log that one may want to jump to [s], shape (e,).
        more: Geoms that do not move, drawn beside the model's own.

    Raises:
        LogError: A log has no instant at which all of the state was measured.
    """
    begun = system.space.named(system.space.nominal) if first is None else first
    start = system.space.z_of(np.array([begun[name] for name in system.space.names]))
    estimates = {curve.name: curve for curve in curves if curve.group == "parameters"}
    candidates: dict[str, Candidate] = {"before": start}
    known: dict[str, tuple[float, float, float]] = {}
    if belief is not None:
        candidates["after"] = system.space.z_of(completed(belief, system).estimate)
        ends = np.array([belief.estimate, *belief.interval]).T.tolist()
        known = dict(zip(belief.names, map(tuple, ends), strict=True))
    elif estimates.keys() >= set(system.space.names):
        candidates["at that time"] = _believed(system, estimates, start)
        known = {name: _last(curve) for name, curve in estimates.items()}
    else:
        candidates = {"predicted": start}
    parts = list(_parts(system, logs, held_out)) if fitted else [(whole(log), None) for log in logs]
    found = viewing(system, parts, candidates, open_engine(system, threads=threads), more=more)
    recording, *others = found.recordings
    found = replace(found, recordings=(replace(recording, curves=curves, events=events), *others))
    seconds = sum(log.duration for log in (*logs, *held_out))
    heading = Heading(
        about if about and system.name == "system" else ": ".join(filter(None, (system.name, about))),
        (f"{seconds:.1f} s of log", f"{len(found.takes)} clips"),
        [*warnings, *_notes(found)],
        parameter_rows(system.space, begun, known, verdicts or {}, bodies),
    )
    return LogView(found, heading)


def _last(curve: TimeCurve) -> tuple[float, float, float]:
    """The last value of a curve, and its interval."""
    value = float(curve.values[-1])
    low, high = (value, value) if curve.band is None else map(float, curve.band[:, -1])
    return value, low, high


def _believed(system: System, estimates: Mapping[str, TimeCurve], start: FloatArray) -> Candidate:
    """What was believed at a time, as z (d,): the newest estimate before it, or the values of the start."""
    curves = [estimates[name] for name in system.space.names]

    def at(time: float) -> FloatArray:
        rows = [int(np.searchsorted(curve.times, time + 1e-9, side="right")) - 1 for curve in curves]
        if min(rows) < 0:
            return start
        theta = np.array([curve.values[row] for curve, row in zip(curves, rows, strict=True)])
        return system.space.z_of(theta)

    return at


def _parts(
    system: System, logs: Sequence[Log], held_out: Sequence[Log]
) -> Iterator[tuple[Window, bool | None]]:
    """Parts of the logs as `identify` divides them."""
    if held_out:
        fit, held = [whole(log) for log in logs], [whole(log) for log in held_out]
    else:
        fit, held = split_held_out(logs, system.settings.clips)
    refitted = not held_out and too_few(logs, system.settings.clips)  # held out of a first fit only
    yield from ((window, False) for window in fit)
    yield from ((window, not refitted) for window in held)


def _notes(found: Viewing) -> Iterator[str]:
    """What is not as a reader would expect."""
    if found.scene.system.match == "effort":
        yield "Efforts are compared along the measured motion: only the plots show how the ghosts differ."
    names = [found.scene.names[i] for i in found.scene.unmeasured]
    if names:
        yield f"No signal gives the place of {', '.join(names)}: drawn grey, at home."
    if any(len(recording.gaps) for recording in found.recordings):
        yield "In gaps of the log (grey on the time line) the last measured state is drawn grey."
    if found.left_out:
        yield f"{found.left_out} more clips are not shown: the page has some from all over the logs."
    if not found.takes:
        yield "No clip can be predicted: the logs are motionless, or each clip crosses a gap."
    if lost := sum(None in take.ghosts for take in found.takes):
        yield f"In {lost} clips a prediction diverged: its ghost is missing there."
