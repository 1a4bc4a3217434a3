"""From logs to a page: which clips, which candidates, and what is written around them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.belief import Belief, completed
from amhe_cli.core.curves import TimeCurve
from amhe_cli.core.log import Log, Window
from amhe_cli.engine.open import open_engine
from amhe_cli.estimation.offline.clips import split_held_out, whole
from amhe_cli.system.system import System
from amhe_cli.view.ghosts import Viewing, viewing
from amhe_cli.view.page import Heading, parameter_rows, saved_page
from amhe_cli.view.scene import Geom


def page_of(
    system: System,
    logs: Sequence[Log],
    *,
    held_out: Sequence[Log] = (),
    belief: Belief | None = None,
    first: Mapping[str, float] | None = None,
    fitted: bool = False,
    threads: int = 1,
    title: str = "",
    warnings: Sequence[str] = (),
    known_as: str = "after",
    curves: Sequence[TimeCurve] = (),
    events: FloatArray | Sequence[float] = (),
    more: Sequence[Geom] = (),
) -> str:
    """The page of logs with their ghosts.

    Args:
        system: The system.
        logs: The logs.
        held_out: Further logs that were only used to validate.
        belief: What was identified, the second candidate; None: there is none.
        first: Values of the first candidate by name, those with which something began; None: the system's
            nominal ones.
        fitted: `belief` comes from these logs: those clips come first that were held out of the fit.
        threads: CPU threads; the page does not depend on them.
        title: Title of the page; empty: the system's name.
        warnings: Further sentences that a reader needs to know.
        known_as: Name of the second candidate.
        curves: Further numbers over the time of the first log.
        events: Times of the first log that one may want to jump to [s], shape (e,).
        more: Geoms that do not move, drawn beside the model's own.

    Raises:
        LogError: A log has no instant at which all of the state was measured.
    """
    begun = system.space.named(system.space.nominal) if first is None else first
    start = np.array([begun[name] for name in system.space.names])
    candidates = {"predicted" if belief is None else "before": system.space.z_of(start)}
    if belief is not None:
        candidates[known_as] = _identified(system, belief)
    parts = list(_parts(system, logs, held_out)) if fitted else [(whole(log), None) for log in logs]
    found = viewing(system, parts, candidates, open_engine(system, threads=threads), more=more)
    recording, *others = found.recordings
    found = replace(found, recordings=(replace(recording, curves=curves, events=events), *others))
    seconds = sum(log.duration for log in (*logs, *held_out))
    heading = Heading(
        title or system.name,
        (f"{seconds:.1f} s of log", f"{len(found.takes)} clips"),
        [*warnings, *_notes(found)],
        parameter_rows(system.space, begun, belief),
    )
    return saved_page(found, heading)


def _identified(system: System, belief: Belief) -> FloatArray:
    return system.space.z_of(completed(belief, system).estimate)


def _parts(
    system: System, logs: Sequence[Log], held_out: Sequence[Log]
) -> Iterator[tuple[Window, bool | None]]:
    """Parts of the logs as `identify` divides them."""
    if held_out:
        fit, held = [whole(log) for log in logs], [whole(log) for log in held_out]
    else:
        fit, held = split_held_out(logs, system.settings.clips.held_out)
    yield from ((window, False) for window in fit)
    yield from ((window, True) for window in held)


def _notes(found: Viewing) -> Iterator[str]:
    """What is not as a reader would expect."""
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
