"""Give a model what it lacks: each cause that was named is tried, and kept where held-out clips agree."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import reduce
from typing import Any

from amhe_cli.api.arguments import checked
from amhe_cli.api.compare import scored
from amhe_cli.api.identify import Interrupted, Result, identify
from amhe_cli.core.errors import AmheError, ConfigError
from amhe_cli.core.files import plain
from amhe_cli.core.log import Log
from amhe_cli.core.yaml_file import merged
from amhe_cli.estimation.core.result import AtHorizon, Iteration, MissingRow, ParameterResult, Reason, Repair
from amhe_cli.estimation.offline.clips import split_held_out, whole
from amhe_cli.estimation.validation.prediction import improves, verdict
from amhe_cli.system.system import System

logger = logging.getLogger(__name__)


def repair(
    system: System,
    logs: Log | Sequence[Log],
    cause: str | None = None,
    *,
    only: Sequence[str] | None = None,
    checkpoint: str | None = None,
    progress: Callable[[Iteration, int], None] | None = None,
    **how: Any,
) -> Result:
    """Identify; then give the model what it lacks, one cause after the other, as long as that helps.

    The parameters that let the model have a cause are added, and all is identified again. They stay where the
    error of held-out clips falls by more than chance, by the rule of `compare`. At the end those go again
    without which the later ones predict as well. `found.repairs` has what was tried, and the result's folder
    a copy of the system with what was kept. The system itself does not change.
    What is wrong with a log is no cause that a model can have: nothing is tried until it is put right.

    Args:
        system: A system with a folder.
        logs: See `identify`.
        cause: Try this cause only, such as 'spring@arm'; None: all that are named.
        only, checkpoint, progress: See `identify`; the checkpoint is that of the model as given. A
            `max_time` is that of each identification.
        how: All other arguments of `identify`.

    Raises:
        ConfigError: The system has no folder, or see `identify`.
    """
    if system.folder is None:
        raise ConfigError("`repair`: give a system folder; one of a model alone has no file to add lines to")
    begun = time.monotonic()
    best = first = identify(system, logs, only=only, checkpoint=checkpoint, progress=progress, **how)
    kept, tried, refused = dict[str, dict[str, Any]](), list[Repair](), set[str]()

    def attempt(causes: dict[str, dict[str, Any]], name: str) -> tuple[Result | None, Repair]:
        entries = reduce(merged, causes.values(), {})  # a later cause may move what an earlier one added
        more = {"only": only and [*only, *entries], "progress": progress, **how}
        outcome, found, errors = _tried(system, logs, entries, best, name in causes, more)
        return found, Repair(name, "", {}, False, outcome, errors)

    try:
        while row := _next(best, cause, refused | kept.keys()):
            entries = _readable(row.repair)
            found, one = attempt({**kept, row.name: entries}, row.name)
            helps = found is not None and improves(one.horizons, 1, 0)
            tried.append(replace(one, text=row.text, parameters=entries, kept=helps))
            refused = set() if helps else refused | {row.name}
            if helps and found is not None:
                best, kept[row.name] = found, entries
        for name in [*kept][:-1]:  # a later cause may have taken the place of an earlier one
            rest = {one: entries for one, entries in kept.items() if one != name}
            found, one = attempt(rest, f"without {name}")
            needed = found is None or improves(one.horizons, 0, 1)
            tried.append(replace(one, text="beside the later causes", kept=not needed))
            if found is not None and not needed:
                best, kept = found, rest
                tried = [replace(two, kept=two.kept and two.name != name) for two in tried]
    except Interrupted:
        stopped = replace(best, found=replace(best.found, repairs=tuple(tried), interrupted=True))
        raise Interrupted(stopped) from None
    if cause and not tried:
        rows = best.found.missing.rows if best.found.missing else ()
        named = ", ".join(one.name for one in rows if one.repair) or "nothing that a parameter could mend"
        logger.warning(f"`repair`: the logs do not name {cause}; they name {named}")
    parameters = _on_repairs(best, first, kept)
    found = replace(best.found, parameters=parameters, repairs=tuple(tried))
    return replace(best, found=found, seconds=time.monotonic() - begun)


def _on_repairs(
    result: Result, before: Result, kept: Mapping[str, dict[str, Any]]
) -> tuple[ParameterResult, ...]:
    """The parameters, none of which is identified outright where it hangs on what was found to be missing.

    Another cause may explain the logs as well with other values: a weak gain looks like little friction and a
    light load. A value that did not move by its sd hangs on none of them.
    """
    text = f"the repair {', '.join(kept)}"
    then, found = {one.name: one.estimate for one in before.parameters.values()}, []
    for one in result.found.parameters:
        still = one.name in then and abs(one.estimate - then[one.name]) < one.sd
        if kept and one.verdict == "identified" and not still:
            reason = Reason("repair", (one.name,), 1.0, f"given {text}: another cause may act alike")
            one = replace(one, verdict="conditional", given=text, reasons=(reason, *one.reasons))
        found.append(one)
    return tuple(found)


def _next(result: Result, cause: str | None, done: set[str]) -> MissingRow | None:
    """The first cause that is yet to be tried."""
    rows = result.found.missing.rows if result.found.missing else ()
    if any(row.in_log for row in rows):
        logger.warning("`repair`: nothing is tried while the log itself is wrong; put it right first")
        return None
    wanted = (row for row in rows if row.repair and row.name not in done and cause in (None, row.name))
    return next(wanted, None)


def _tried(
    system: System,
    logs: Log | Sequence[Log],
    entries: dict[str, Any],
    best: Result,
    added: bool,
    how: dict[str, Any],
) -> tuple[str, Result | None, tuple[AtHorizon, ...]]:
    """Identify with more parameters; what held-out clips say of it, the result, and the errors of both."""
    seed, threads = checked(how.get("seed", 0), how.get("threads"))
    assert system.folder is not None
    try:
        given = merged(system.given, {"parameters": entries})
        other = System.load(system.folder, given, schema=type(system.settings), warn=False)
        fixed = {one: value for one, value in system.fixed.items() if one not in {**other.fixed, **entries}}
        found = identify(other.fixing(fixed), logs, **how)
        fitted, clips = best.logs, system.settings.clips
        if best.held_out:
            fitted, parts = best.held_out, [whole(log) for log in best.held_out]
        else:
            parts = split_held_out(fitted, clips)[1]
        both = (best, found)
        errors = scored(
            [one.system for one in both], both, [fitted] * 2, parts, seed, threads, how.get("engine", "cpu")
        )
    except AmheError as error:
        return f"could not be tried: {error}", None, ()
    first = 1 if improves(errors, 1, 0) else 0
    names = ("the model without it", "the model with it")
    return verdict(errors, names if added else names[::-1], first, 1 - first), found, errors


def _readable(entries: Mapping[str, Any]) -> dict[str, Any]:
    """Plain values with numbers of four digits, as they are tried and written."""
    text = json.dumps(plain(dict(entries)))
    return dict(json.loads(text, parse_float=lambda number: float(f"{float(number):.4g}")))
