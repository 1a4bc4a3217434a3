"""Which model predicts better what was not fitted?"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from amhe_cli import __version__
from amhe_cli.api.arguments import checked
from amhe_cli.api.identify import Result, collected_warnings, identify
from amhe_cli.core.belief import gaussian_of
from amhe_cli.core.errors import ConfigError, LogError
from amhe_cli.core.log import Log, Window
from amhe_cli.engine.open import open_engine
from amhe_cli.estimation.core.result import AtHorizon, Iteration
from amhe_cli.estimation.offline.clips import split_held_out, whole
from amhe_cli.estimation.validation.prediction import (
    HORIZONS,
    Compared,
    at_horizon,
    best_of,
    errors_of,
    simplest_of,
    starts,
    verdict,
)
from amhe_cli.report.comparison import comparison_record, comparison_table, write_comparison
from amhe_cli.report.folder import reserve
from amhe_cli.report.numbers import joined
from amhe_cli.system.provenance import provenance
from amhe_cli.system.system import System


@dataclass(frozen=True, eq=False)
class Comparison(Compared):
    """What several systems predict of the same held-out clips.

    Args:
        results: What was identified of each.
        seconds: Time that the comparison took [s].
        warnings: What was warned of on the way, by system.
    """

    results: tuple[Result, ...]
    seconds: float
    warnings: tuple[str, ...]

    @property
    def table(self) -> str:
        """Errors of each system at each horizon, and the verdicts, as text."""
        from amhe_cli.report.comparison import table_text

        return "\n".join(
            (table_text(comparison_table(self.names, self.horizons, self.best)), "", *self.verdicts)
        )

    def record(self) -> dict[str, Any]:
        """The keys of a comparison in result.json."""
        return comparison_record(self)

    def save(self, folder: str | Path, *, force: bool = False) -> Path:
        """Write result.json and report.html, and the files of each system's identification in a folder.

        Args:
            folder: Folder of the files; made if it does not exist.
            force: Write into a folder that is not empty; other files in it stay.
        """
        out = reserve(Path(folder), "compare", force)
        head = {
            "schema_version": 1, "command": "compare", "version": __version__,
            "seconds": round(self.seconds, 3), "warnings": list(self.warnings),
        }  # fmt: skip
        self.write(out, head | self.record() | {"out": str(out)}, "amhe.compare")
        return out

    def write(self, folder: Path, record: dict[str, Any], command: str) -> None:
        """Write the files with a given content of result.json."""
        for name, result in zip(self.names, self.results, strict=True):
            result.save(folder / name, force=True)
        one = self.results[0]
        origin = provenance(command, one.seed, one.found.method, one.system, one.logs, one.held_out)
        write_comparison(folder, self, record, origin)

    def __str__(self) -> str:
        return self.table


def compare(
    systems: Sequence[System],
    logs: Sequence[Sequence[Log]],
    *,
    held_out: Sequence[Sequence[Log]] | None = None,
    seed: int = 0,
    threads: int | None = None,
    engine: str = "cpu",
    max_time: float | None = None,
    simplest: bool = False,
    progress: Callable[[str], None] | None = None,
) -> Comparison:
    """Fit each system to the same logs, and score all on the same clips that were not fitted.

    Args:
        systems: Two or more systems; the clips are cut as the first one's settings say.
        logs: For each system the same logs, read for it.
        held_out: Likewise logs to score on; None: a share of the logs' time is held out.
        seed, threads, engine: As in `identify`.
        max_time: Time of the whole comparison [s], shared evenly; None: no limit.
        simplest: Prefer the system with the fewest parameters of those within one standard error of the best.
        progress: Called with a line of text now and then.

    Raises:
        ConfigError: An argument is wrong.
        LogError: A log was not read for its system, or nothing that all systems predict was held out.
    """
    begun, say = time.monotonic(), progress or (lambda text: None)
    seed, threads = checked(seed, threads, times={"max_time": max_time})
    unseen = held_out or logs
    _refuse_unequal(systems, logs, unseen)
    names = _names(systems)
    clips = systems[0].settings.clips
    parts = [whole(log) for log in unseen[0]] if held_out else split_held_out(logs[0], clips)[1]
    if not parts:
        raise LogError("`logs`: no part is held out (too short, or `clips.held_out` is 0); give `held_out`")
    alike = [replace(one, settings=one.settings.model_copy(update={"clips": clips})) for one in systems]
    share = None if max_time is None else 0.9 * max_time / len(systems)
    how = {"seed": seed, "threads": threads, "engine": engine, "max_time": share}
    results, warnings = [], []
    for name, system, own, held in zip(names, alike, logs, held_out or [None] * len(names), strict=True):
        with collected_warnings(of=name) as texts:
            show = partial(_show, say, name)
            results.append(identify(system, own, held_out=held, progress=show, **how))
        warnings += texts
    say("held-out clips")
    found = scored(alike, results, unseen, parts, seed, threads, engine)
    best = simplest_of(found, [len(one.space) for one in alike]) if simplest else best_of(found)
    return Comparison(
        names=names,
        found=tuple(result.found for result in results),
        horizons=found,
        best=best,
        verdicts=_verdicts(found, names, best, [one.found.settled for one in results]),
        results=tuple(results),
        seconds=time.monotonic() - begun,
        warnings=tuple(warnings),
    )


def _show(say: Callable[[str], None], name: str, iteration: Iteration, total: int) -> None:
    say(f"{name}: {iteration.summary(total)}")


def _refuse_unequal(
    systems: Sequence[System], logs: Sequence[Sequence[Log]], held_out: Sequence[Sequence[Log]]
) -> None:
    """Refuse what is no comparison.

    Raises:
        ConfigError: There are fewer than two systems, or their logs differ in number.
    """
    if len(systems) < 2:
        raise ConfigError("`systems`: give two or more")
    for argument, given in (("logs", logs), ("held_out", held_out)):
        if [len(own) for own in given] != [len(given[0])] * len(systems) or not given[0]:
            raise ConfigError(f"`{argument}`: give the same logs for each of the {len(systems)} systems")


def _verdicts(
    found: Sequence[AtHorizon], names: Sequence[str], best: int, settled: Sequence[bool]
) -> tuple[str, ...]:
    """What the logs say of the best system against each other one whose search has ended."""
    others = [i for i in range(len(names)) if i != best]
    ended = [verdict(found, names, best, i) for i in others if settled[i]]
    if not (short := [names[i] for i in others if not settled[i]]):
        return tuple(ended)
    more = "give it more (`identify.iterations`, `max_time`)"
    return (*ended, f"no model is called better than {joined(short)}, whose search did not end; {more}")


def _names(systems: Sequence[System]) -> tuple[str, ...]:
    """Names of the systems, numbered where some are alike."""
    names = [system.name for system in systems]
    return tuple(
        name if names.count(name) == 1 else f"{name}-{names[: i + 1].count(name)}"
        for i, name in enumerate(names)
    )


def scored(
    systems: Sequence[System],
    results: Sequence[Result],
    logs: Sequence[Sequence[Log]],
    parts: Sequence[Window],
    seed: int,
    threads: int,
    engine: str,
) -> tuple[AtHorizon, ...]:
    """Errors of all systems on the same windows in parts of the first one's logs, at each horizon."""
    engines = [open_engine(system, threads=threads, kind=engine) for system in systems]
    found, rng = [], np.random.default_rng([seed, 1])
    longest = max((part.duration for part in parts), default=0.0)
    for horizon in (*(h for h in HORIZONS if h < longest), np.inf):
        windows = [
            [_same_time(window, logs[0], own) for own in logs]
            for window in starts(systems[0], parts, horizon)
        ]
        usable = [row for row in windows if all(_usable(s, w) for s, w in zip(systems, row, strict=True))]
        if not usable:
            continue
        errors = [
            errors_of(
                system, [row[i] for row in usable], engines[i], gaussian_of(system.space, result.validated)[0]
            )
            for i, (system, result) in enumerate(zip(systems, results, strict=True))
        ]
        seconds = min(horizon, max(row[0].duration for row in usable))
        found.append(at_horizon(seconds, horizon == np.inf, errors, rng))
    if not found or not found[0].errors:
        raise LogError(
            "`logs`: nothing that all systems compare was held out; record more, or give `held_out`"
        )
    return tuple(found)


def _same_time(window: Window, logs: Sequence[Log], own: Sequence[Log]) -> Window:
    """The window of another system's log at the same time."""
    log = own[next(i for i, one in enumerate(logs) if one is window.log)]
    since = 1e-9 * (window.log.start_ns - log.start_ns) + window.start * window.log.dt
    return Window(log, round(since / log.dt), round(window.duration / log.dt))


def _usable(system: System, window: Window) -> bool:
    inside = window.start >= 0 and window.stop < window.log.steps
    return inside and bool(window.log.usable(system.keys)[window.start : window.stop + 1].all())
