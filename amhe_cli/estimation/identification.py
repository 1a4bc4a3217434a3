"""SPI, offline identification (the paper's section III-B): from logs and a system to an `Identification`."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

from amhe_cli.core.belief import Belief, with_prior
from amhe_cli.core.each_log import named, searched
from amhe_cli.core.errors import NOTE, ConfigError, EstimationError, LogError, and_more, one_of
from amhe_cli.core.log import Log, Window, in_order
from amhe_cli.engine.open import open_engine
from amhe_cli.estimation.conclude import PARTS, RESERVE, Search, conclude
from amhe_cli.estimation.core.agreement import SURPRISE
from amhe_cli.estimation.core.result import Identification
from amhe_cli.estimation.explain.inputs import mended
from amhe_cli.estimation.offline import cma, search
from amhe_cli.estimation.offline.checkpoint import Checkpoint
from amhe_cli.estimation.offline.clips import (
    ClipPool,
    evenly,
    split_held_out,
    too_few,
    validation_length,
    whole,
)
from amhe_cli.estimation.offline.cma import CmaState
from amhe_cli.estimation.offline.problem import Ends, KnownNoise, Problem
from amhe_cli.estimation.offline.search import SearchState
from amhe_cli.estimation.offline.watch import OnIteration, Watch
from amhe_cli.estimation.uncertainty.fit import Finding
from amhe_cli.estimation.uncertainty.misfit import still_moving
from amhe_cli.matching.motion import velocity_lag
from amhe_cli.system.parameters.inertia import inertia_of
from amhe_cli.system.system import System

logger = logging.getLogger(__name__)

METHODS = ("linearised", "cmaes")
#: Lag of velocities that matters [s].
_LATE = 0.001


@dataclass(frozen=True, slots=True)
class IdentifyOptions:
    """How to search.

    Args:
        method, seed, threads, max_time, checkpoint, executor, engine: See `amhe_cli.identify`.
        prior: A belief to start from instead of the system's own prior.
        share: See `Problem`.
    """

    method: str = "linearised"
    seed: int = 0
    threads: int = 1
    max_time: float | None = None
    checkpoint: Path | None = None
    prior: Belief | None = None
    share: float = 1.0
    executor: Executor | None = None
    engine: str = "cpu"


def identify(
    system: System,
    training: Sequence[Log],
    held_out: Sequence[Log] | None,
    options: IdentifyOptions,
    on_iteration: OnIteration = lambda iteration, total: None,
) -> Identification:
    """Find the parameters under which rollouts match the logs, and how well they are known.

    Args:
        system: Model, parameters, signals, settings.
        training: The logs to fit, in any order. Values that they know or have of their own: see
            `core.each_log`.
        held_out: Logs used only to validate; None holds out a share of the training logs.
        options: How to search.
        on_iteration: Called after each iteration with its record and the expected total, and before each part
            of the conclusion.

    Returns:
        The result; `interrupted` where Ctrl-C or the time limit cut the search short.

    Raises:
        ConfigError: There is no such method or kind of engine.
        EstimationError: No clip of the logs can be used.
    """
    return concluded(searched_for(system, training, held_out, options, on_iteration))


def searched_for(
    system: System,
    training: Sequence[Log],
    held_out: Sequence[Log] | None,
    options: IdentifyOptions,
    on_iteration: OnIteration = lambda iteration, total: None,
    *,
    quick: bool = False,
    near: Search | None = None,
    clips: int | None = None,
    enough: float | None = None,
    noise: KnownNoise | None = None,
    ends: Ends | None = None,
    watch: Watch | None = None,
) -> Search:
    """The search of `identify`, whose arguments it takes, without the conclusion.

    Of logs that are `too_few` to hold a part out, this part only validates: then all of them is fitted.

    `quick`: one of many: do not say how long it takes, nor which parameters the logs do not depend on.
    `near`: begin where a search for the same parameters under other priors has ended, and not at the prior's
    mean. `clips`: fit, and hold out, only so many. `enough`, `noise`, `ends`: as of `Problem`.
    `watch`: one that several searches share, with their time; `on_iteration` and the options' are unused.
    """
    if options.method not in METHODS:
        raise ConfigError(f"`method`: {one_of('method', options.method, METHODS)}")
    if options.prior is not None:
        system = replace(system, space=with_prior(system.space, options.prior))
    training, model = named(training), system.space
    system = replace(system, space=searched(model, training))
    training = in_order(training)
    watch = watch or Watch(on_iteration, options.max_time, PARTS)
    problem, validation = _pose(system, training, held_out, options)
    problem = replace(
        problem, enough=enough, noise=noise, ends=ends, like=near and near.problem,
        quick=quick and system.match != "effort",  # efforts along a motion are quick without
    )  # fmt: skip
    if clips is not None:
        every = tuple(problem.usable)
        problem = replace(problem, only=tuple(evenly(every, clips)), beside=every)
        validation = evenly(validation, clips)
    kept = Checkpoint(options.checkpoint, problem, options.method)
    kept.load()  # one of another problem is refused before any work
    if not quick or (
        near is None and problem.touches
    ):  # `conclude` looks for no cause where something touches
        for wrong in mended(system, problem.pool.parts, problem.rng(8))[:1]:
            logger.warning(wrong.sentence)
    if not quick:
        _warn(problem)
    watch.keep(RESERVE * problem.linearisation)
    begin = search.start(problem) if near is None else near.again(problem)
    finding = _search(problem, options.method, watch, kept, begin)
    apart = Search(problem, finding, validation, watch, model)
    more = validation and not held_out and clips is None and too_few(training, system.settings.clips)
    if watch.cut_short or not more:
        return apart
    problem = _of_all(problem, training)
    if not quick:
        logger.log(
            NOTE, "the logs are short: held-out errors are those of a fit to the rest, the values fit all"
        )
    unsaved = Checkpoint(None, problem, options.method)
    finding = _search(problem, options.method, watch, unsaved, apart.again(problem))
    return Search(problem, finding, validation, watch, model, without=apart)


def ended(stopped: Search) -> Search:
    """Continue a search for as many iterations again at most; one that has ended, or has no time, stays."""
    begin = stopped.finding
    if isinstance(begin, SearchState) and not stopped.watch.cut_short and still_moving(stopped.fit):
        begin = replace(begin, stage="polish", number=search.ROUGHLY)  # with all clips, and other draws
        before, unsaved = len(begin.record) - begin.number, Checkpoint(None, stopped.problem, METHODS[0])
        finding = _run(
            search.advance,
            lambda problem, state, before=before: before + search.total(problem, state),
            stopped.problem, begin, stopped.watch, unsaved,
        )  # fmt: skip
        stopped = replace(stopped, finding=finding)
    return stopped


def _of_all(problem: Problem, logs: Sequence[Log]) -> Problem:
    """The same problem on all of the logs."""
    pool = problem.pool
    return replace(problem, pool=ClipPool(pool.system, [whole(log) for log in logs], pool.settings))


def _warn(problem: Problem) -> None:
    """Warn of parameters that the logs do not depend on."""
    for reason in dict.fromkeys(problem.idle.values()):
        held = [name for name, why in problem.idle.items() if why == reason]
        bodies = [(name, inertia_of(name)) for name in held]
        names = [f"numbers of {body}" if body else name for name, body in bodies]
        names = list(dict.fromkeys(names))  # nobody knows the coordinates of inertias
        one = names == held[:1]
        are = "is held at its prior" if one else "are held at their priors"
        why = reason if one else reason.replace(" depends on it", " depends on them")
        logger.warning(f"{and_more(names, 3)} {are}: {why}")


def concluded(search: Search, *, quick: bool = False) -> Identification:
    """Estimate and uncertainty from a search; `quick` as of `conclude`."""
    try:
        return conclude(search, quick=quick)
    except KeyboardInterrupt:
        logger.warning("interrupted while the result was examined: its checks are not complete")
        search.watch.interrupted = True
        return conclude(search, quick=quick)


def _pose(
    system: System, training: Sequence[Log], held_out: Sequence[Log] | None, options: IdentifyOptions
) -> tuple[Problem, list[Window]]:
    """The problem, and the clips to validate on."""
    clips = system.settings.clips
    if held_out:
        fit, held = [whole(log) for log in training], [whole(log) for log in in_order(held_out)]
    else:
        fit, held = split_held_out(training, clips)
    engine = open_engine(system, threads=options.threads, executor=options.executor, kind=options.engine)
    pool = ClipPool(system, fit, clips)
    problem = Problem(system, pool, engine, options.seed, threads=options.threads, share=options.share)
    windows = ClipPool(system, held, clips).cut(validation_length(clips), clips.held_out_first_only)
    windows = evenly(windows, clips.most)
    if not (held_out or (windows and problem.usable)) and too_few(training, clips):
        problem, held, windows = _of_all(problem, training), [], []
    if not problem.usable:
        raise EstimationError(_no_clips(problem.pool))
    if held and not windows:
        logger.warning("the held-out part of the logs has no usable clip: nothing validates the result")
    _report_lag(system, training[0])
    return problem, windows


def _report_lag(system: System, log: Log) -> None:
    """Say by how much velocities lag, which matters where measured torques drive the model from them."""
    matched = system.match == "effort"
    if not matched and not any(source.key.endswith(".effort") for source in system.inputs):
        return
    try:
        lag = velocity_lag(system, log)
    except LogError:
        return  # too short for a motion
    if lag is not None and lag[0] > max(_LATE, SURPRISE * lag[1]):
        then = (
            "they are not used, since positions give the motion"
            if matched
            else "clips start at them; give their signal slope: {velocity: 0.05}, which takes them from the "
            "positions"
        )
        logger.log(
            NOTE if matched else logging.WARNING,
            f"{log.source}: measured velocities are {1e3 * lag[0]:.1f} ms behind the positions, and {then}",
        )


def _no_clips(pool: ClipPool) -> str:
    """Why no clip can be used, and what to do."""
    system = pool.system
    if not any(channel.compared for channel in system.channels):
        return (
            f"system {system.name!r} compares nothing with its logs: give a signal the noise of its sensor, "
            "for instance noise: {position: 0.002}"
        )
    log = max((part.log for part in pool.parts), key=lambda log: log.duration)
    rarest = min(pool.keys, key=lambda key: int(log[key].sampled.sum()))
    emptiest = min(pool.keys, key=lambda key: float(log.usable((key,)).mean()))
    spacing = log.duration / max(int(log[rarest].sampled.sum()), 1)
    counted = f"{pool.motionless} are motionless, {pool.across_gaps} cross gaps"
    if spacing > pool.settings.length[0]:
        cause = f"{rarest} has a sample every {spacing:.3g} s: check the unit of its times"
    elif pool.across_gaps > pool.motionless:
        share = 100.0 * float(log.usable((emptiest,)).mean())
        cause = (
            f"{emptiest} has values in {share:.0f} % of the time: check its times, or loosen `logs.max_gap`"
        )
    else:
        cause = f"record more than {log.duration:.3g} s in which the system moves, or loosen `clips.still`"
    return f"no clip of these logs can be used ({counted}): {cause}"


def _search(problem: Problem, method: str, watch: Watch, kept: Checkpoint, begin: SearchState) -> Finding:
    """Run the method, from where a checkpoint has left it."""
    if not problem.active.any():
        return replace(begin, stage="done", settled=True)  # no parameter to search
    saved = kept.load()
    if isinstance(saved, CmaState) or (saved is None and method == "cmaes"):
        return _run(cma.advance, cma.total, problem, saved or cma.start(problem), watch, kept)
    return _run(search.advance, search.total, problem, saved or begin, watch, kept)


S = TypeVar("S", SearchState, CmaState)


def _run(
    advance: Callable[[Problem, S], S],
    total: Callable[[Problem, S], int],
    problem: Problem,
    state: S,
    watch: Watch,
    kept: Checkpoint,
) -> S:
    """Advance until done, out of time, or interrupted; a finished iteration is never lost."""
    try:
        while not state.done and not watch.stopped:
            state = advance(problem, state)
            if isinstance(state, SearchState) and problem.ends and problem.ends(problem, state):
                state = replace(state, stage="done")
            kept.save(state)
            watch.saw(state.record[-1], total(problem, state))
    except KeyboardInterrupt:
        watch.interrupted = True
        logger.warning("interrupted: the result is the best so far, the search had not settled")
    return state
