"""Offline identification as one call, and its result."""

from __future__ import annotations

import io
import logging
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from amhe_cli import __version__
from amhe_cli.api.arguments import checked
from amhe_cli.core.arrays import sealed
from amhe_cli.core.belief import Belief, belief_of, with_prior
from amhe_cli.core.each_log import check_logs, fixing
from amhe_cli.core.errors import ConfigError, LogError
from amhe_cli.core.log import Log
from amhe_cli.core.shown import SavedView
from amhe_cli.core.statistics import positive
from amhe_cli.engine.cpu import hush_mujoco
from amhe_cli.estimation import identification
from amhe_cli.estimation.core.result import Fit, Identification, Iteration, ParameterResult
from amhe_cli.estimation.uncertainty.verdicts import DETERMINED
from amhe_cli.logs.read import truth_in_metadata
from amhe_cli.system.provenance import hashes, inputs_record, provenance
from amhe_cli.system.system import System

if TYPE_CHECKING:
    import mujoco  # noqa: TID251 -- for a type

    from amhe_cli.report.identification_page import Beside

logger = logging.getLogger(__name__)

#: Width of a table in characters.
_WIDTH = 110


@dataclass(frozen=True, eq=False)
class Result:
    """What an identification found.

    Args:
        system: The system that was identified.
        found: All numbers of the identification.
        logs, held_out: The logs that were fitted, and those that were only used for validation.
        seed: Seed of the random numbers.
        seconds: Time that the identification took [s].
        warnings: What was warned of on the way.
    """

    system: System
    found: Identification
    logs: tuple[Log, ...]
    held_out: tuple[Log, ...]
    seed: int
    seconds: float
    warnings: tuple[str, ...]

    @cached_property
    def parameters(self) -> dict[str, ParameterResult]:
        """Each parameter by its name: `estimate`, `sd`, `interval`, `verdict`, `reasons` and more."""
        return {parameter.name: parameter for parameter in self.found.parameters}

    @property
    def belief(self) -> Belief:
        """Estimate and covariance; it can be saved, sampled, and given to `identify` as a prior.

        Where logs had values of their own, it is about the value of the next log: their common mean, with
        their spread in its sd. A parameter that every log knew is not in it.
        """
        return self.found.belief.about(self.system.space.names)

    @property
    def validated(self) -> Belief:
        """The belief at the values that held-out parts of the logs judge, which did not fit them."""
        return (self.found.validated or self.found.belief).about(self.system.space.names)

    @property
    def fits(self) -> tuple[Fit, ...]:
        """Measured values against predicted ones, for some clips and each of their channels."""
        return self.found.fits

    @cached_property
    def table(self) -> str:
        """The table of parameters, known combinations and held-out errors, as text."""
        return self._rendered().export_text(clear=False).rstrip("\n")

    def model(self) -> mujoco.MjModel:
        """A MuJoCo model with the identified values; sensors that amhe needed are in it too."""
        return self.system.edits.apply(self.system.model, with_prior(self.system.space, self.belief).nominal)

    def record(self) -> dict[str, Any]:
        """The keys of an identification in result.json."""
        from amhe_cli.report.identification import identification_record

        inputs = inputs_record(self.system, self.logs, self.held_out)
        record = identification_record(self.found, truth_in_metadata(self.logs))
        return record | {"seed": self.seed, "inputs": inputs}

    def save(self, folder: str | Path, *, force: bool = False) -> Path:
        """Write belief.yaml, identified.xml (its meshes in assets/), result.json, report.html and view.html.

        Args:
            folder: Folder of the files; made if it does not exist.
            force: Write into a folder that is not empty; other files in it stay.

        Returns:
            The folder.

        Raises:
            ConfigError: The folder is not empty and `force` is not given, or it cannot be written.
        """
        from amhe_cli.report.folder import reserve

        out = reserve(Path(folder), "identify", force)
        head = {
            "schema_version": 1, "command": "identify", "version": __version__,
            "seconds": round(self.seconds, 3), "warnings": list(self.warnings),
        }  # fmt: skip
        record = head | self.record() | {"out": str(out)}
        self.write(out, record, "amhe.identify", self.logs, self.held_out, force)
        return out

    def write(
        self,
        folder: Path,
        record: Mapping[str, Any],
        command: str,
        logs: Sequence[Path | Log],
        held_out: Sequence[Path | Log],
        force: bool,
    ) -> None:
        """Write the files with a given content of result.json.

        Args:
            folder: Folder of the files.
            record: Content of result.json.
            command: The command or call that made the result.
            logs, held_out: What is hashed for the provenance.
            force: Write into a folder that is not empty.
        """
        from amhe_cli.report.identification import write_identification

        origin = provenance(command, self.seed, self.found.method, self.system, logs, held_out)
        seen = self._seen(folder.name)
        write_identification(folder, self.system, self.found, self.belief, record, origin, force, seen)

    def _seen(self, name: str) -> Beside:
        """What a view of the result adds to its report; nothing where it has no ghosts."""
        from amhe_cli.report.identification_page import Beside
        from amhe_cli.view.open import clip_name, view_of

        verdicts = {name: p.verdict for name, p in self.parameters.items()}
        try:
            view = view_of(
                self.system, self.logs, held_out=self.held_out, belief=self.belief, fitted=True,
                about=name, verdicts=verdicts,
                bodies=[asdict(one) for one in self.found.bodies],
            )  # fmt: skip
        except LogError as error:
            logger.debug("no view: %s", error)
            return Beside()
        except Exception as fault:  # it must cost no result
            logger.warning(
                "view.html could not be made (%s: %s); the rest is complete", type(fault).__name__, fault
            )
            return Beside()
        if (row := view.worst([fit.clip for fit in self.fits])) is None:
            return Beside(page=view.page(report="report.html"))
        take = view.found.takes[row]
        link = f"view.html#clip={row + 1}&t={take.ends[0] + 0.7 * (take.ends[1] - take.ends[0]):.2f}"
        page = view.page(report="report.html#measured-against-predicted")
        return Beside(view.strip(row), view.whole_log(), link, clip_name(take.window), page)

    def __repr__(self) -> str:
        verdicts = ", ".join(f"{p.name} {p.estimate:.4g} ({p.verdict})" for p in self.parameters.values())
        return f"Result({self.system.name!r}: {verdicts})"

    def __str__(self) -> str:
        return self.table

    def _repr_html_(self) -> str:
        """The table in the notebook's own colours, what it means in sentences, and the fits."""
        from amhe_cli.report.shown import result_html

        return result_html(self.found) + (self.plot()._repr_html_() if self.fits else "")

    def plot(self) -> SavedView:
        """Measured against predicted for the best, a middling and the worst clip; a notebook shows it."""
        from amhe_cli.report.identification_page import overlay_section
        from amhe_cli.report.shown import view

        return view([overlay_section(self.fits, refitted=self.found.clips.refitted)], "Result")

    def _rendered(self) -> Any:
        from amhe_cli.report.identification import print_identification
        from amhe_cli.report.tables import PlainConsole

        console = PlainConsole(record=True, file=io.StringIO(), width=_WIDTH, force_jupyter=False)
        print_identification(self.found, None, console, truth_in_metadata(self.logs))
        return console


class Interrupted(KeyboardInterrupt):
    """Ctrl-C during `identify`, raised once the best so far is there; a loop over logs ends with it.

    Args:
        result: The best so far.
    """

    def __init__(self, result: Result) -> None:
        super().__init__("identify was interrupted; the best so far is the `result` of this exception")
        self.result = result


def identify(
    system: System,
    logs: Log | Sequence[Log],
    *,
    held_out: Log | Sequence[Log] | None = None,
    prior: Belief | str | Path | None = None,
    belief_anyway: bool = False,
    fix: Mapping[str, float] | None = None,
    only: Sequence[str] | None = None,
    method: str = "linearised",
    seed: int = 0,
    threads: int | None = None,
    engine: str = "cpu",
    max_time: float | None = None,
    checkpoint: str | Path | None = None,
    executor: Executor | None = None,
    progress: Callable[[Iteration, int], None] | None = None,
) -> Result:
    """Find the parameters under which rollouts of the model match the logs, and how well they are known.

    Args:
        system: Model, parameters, signals and settings.
        logs: The logs to fit, read for this system; those that are `held_out` validate.
        held_out: More logs that are only used to validate. Where there are none, a share of the fitted
            logs' time is held out.
        prior: A belief, or the path of a belief.yaml, to start from in place of the system's own prior.
        belief_anyway: Take a prior about another model too, and only warn of what has changed.
        fix: Parameter -> value that is taken as known; it stays in the model and is not estimated. One of
            which a log knows its own value is refused.
        only: Parameters to estimate, by names or patterns such as 'left_*'; all others are fixed at their
            prior's value. None: all that are not fixed.
        method: 'linearised', or 'cmaes'.
        seed: Seed of the random numbers.
        threads: CPU threads; None: all cores. Results do not depend on it.
        engine: What computes the rollouts: 'cpu', 'gpu', or 'auto', for each call the quicker.
        max_time: Time [s] for the search, which stops with the best so far, and for its conclusion, which
            leaves out checks that would take too long, with a warning; None: no limit.
        checkpoint: File in which the search is saved after each iteration; it is resumed if the file exists.
        executor: Computes the rollouts with its workers in place of threads of this process.
        progress: Called after each iteration with its record and the expected number of iterations; then
            before each part of the conclusion, whose `stage` is 'conclusion' and whose `method` is the part.

    Raises:
        ConfigError: An argument is wrong.
        LogError: A log was not read for this system.
        EstimationError: No clip of the logs can be used.
        Interrupted: Ctrl-C, once the search has begun: a KeyboardInterrupt whose `result` is the best so far.
    """
    hush_mujoco()
    seed, threads = checked(seed, threads, times={"max_time": max_time}, files={"checkpoint": checkpoint})
    path = None if checkpoint is None else Path(checkpoint)
    options = identification.IdentifyOptions(
        method, seed, threads, max_time, path, executor=executor, engine=engine
    )
    fitted, validation = _split(system, logs, held_out, fix or {})
    held = {"fix": fix, "only": only, "belief_anyway": belief_anyway}
    return _found(
        system, fitted, validation, prior, held, options, progress or (lambda iteration, total: None)
    )


def _split(
    system: System, logs: Log | Sequence[Log], held_out: Log | Sequence[Log] | None, fix: Mapping[str, float]
) -> tuple[tuple[Log, ...], tuple[Log, ...]]:
    """The logs to fit, and those that only validate; refused where one is both."""
    given = _logs(system, logs, "logs")
    fitted = tuple(log for log in given if not log.held_out)
    validation = tuple(log for log in given if log.held_out)
    validation += () if held_out is None else _logs(system, held_out, "held_out")
    if not fitted:
        raise ConfigError("`logs`: there is none; give a log or several")
    for log in validation:
        if any(log is other or _same_data(log, other) for other in fitted):
            raise ConfigError(f"`held_out`: {log.source} is fitted too; validation needs a log of its own")
    for name in fix:
        if knowing := next((log for log in (*fitted, *validation) if name in log.known), None):
            raise ConfigError(f"`fix`: {knowing.source} knows its own value of {name}; leave one of them out")
    return fitted, validation


def _found(
    system: System,
    fitted: tuple[Log, ...],
    validation: tuple[Log, ...],
    prior: Belief | str | Path | None,
    held: Mapping[str, Any],
    options: identification.IdentifyOptions,
    progress: Callable[[Iteration, int], None],
) -> Result:
    """The result of checked arguments; where efforts and motion are matched, efforts come first."""
    logs = fitted, validation
    chosen, start, fitted, validation = _starting(system, *logs, prior, **held)
    effort = None
    if chosen.match == "both":
        plain = identification.IdentifyOptions(seed=options.seed, threads=options.threads)
        effort = _found(system.matching("effort"), *logs, prior, held, plain, progress)
        start, options = _half(effort), replace(options, share=0.5)
    check_logs(fitted, validation, chosen.space, chosen.fixed)
    begun = time.monotonic()
    with collected_warnings() as warnings:
        if start is not None and effort is None:
            _warn_of_same_logs(start, fitted)
        found = identification.identify(chosen, fitted, validation, replace(options, prior=start), progress)
    if effort is not None:
        found = replace(found, parameters=tuple(_lines(effort, found, start)))
    seconds = time.monotonic() - begun
    result = Result(chosen, found, fitted, validation, options.seed, seconds, tuple(warnings))
    if found.interrupted:
        raise Interrupted(result)
    return result


def _starting(
    system: System,
    fitted: tuple[Log, ...],
    validation: tuple[Log, ...],
    prior: Belief | str | Path | None,
    *,
    fix: Mapping[str, float] | None,
    only: Sequence[str] | None,
    belief_anyway: bool,
) -> tuple[System, Belief | None, tuple[Log, ...], tuple[Log, ...]]:
    """The system with what is fixed, where its search starts, and logs that fit to it."""
    chosen, start = system.starting_from(prior, fix=fix, only=only, belief_anyway=belief_anyway)
    fixed = {name: value for name, value in chosen.fixed.items() if name not in system.fixed}
    if by_log := {name for log in (*fitted, *validation) for name in log.known} & fixed.keys():
        # the model itself can only have values that are the same for all logs
        rest = {name: value for name, value in fixed.items() if name not in by_log}
        chosen, start = system.starting_from(prior, fix=rest, belief_anyway=belief_anyway)
    if fixed:
        lacking = {name for name in by_log if any(name not in log.known for log in fitted)}
        stated = {name: fixed[name] for name in lacking}
        fitted, validation = (fixing(some, fixed, stated) for some in (fitted, validation))
    return chosen, start, fitted, validation


def _half(effort: Result) -> Belief:
    """The prior of the efforts' result, and half of what that learned from the logs.

    Efforts and motion are two looks at the same logs, whose errors nobody knows to be independent. If each
    look counts half, what both say is as sure as one of them says, and nothing is surer than the logs make it
    (covariance intersection: Julier and Uhlmann 1997, "A non-divergent estimation algorithm in the presence
    of unknown correlations").
    """
    space, belief = effort.system.space, effort.belief
    away, before = space.z_of(belief.estimate), space.prior_precision
    after = np.linalg.inv(belief.covariance / np.outer(space.prior_sd, space.prior_sd))
    covariance = sealed(np.linalg.inv(before + 0.5 * positive(after - before)))
    return belief_of(effort.system, sealed(covariance @ (0.5 * after @ away)), covariance)


def _lines(effort: Result, found: Identification, start: Belief | None) -> Iterator[ParameterResult]:
    """Each parameter's line against the system's own prior, and not against what efforts said."""
    assert start is not None, "efforts came first"
    for p, sd in zip(found.parameters, np.sqrt(np.diag(start.covariance)), strict=True):
        known = effort.parameters[p.name]
        row = effort.system.space.names.index(p.name)
        line = replace(
            p,
            prior=known.prior,
            prior_sd=known.prior_sd,
            shrinkage=1.0 - (1.0 - p.shrinkage) * float(sd / effort.system.space.prior_sd[row]),
        )
        if p.verdict in ("weak", "prior"):  # the motion says little: what do efforts say?
            still = known.verdict not in ("identified", "conditional") or line.shrinkage >= DETERMINED
            verdict = known.verdict if still else "weak"
            if found.unexplained and verdict in ("identified", "conditional"):
                verdict = "model-sensitive"
            given = known.given if verdict == "conditional" else ""
            line = replace(line, verdict=verdict, given=given, reasons=(*p.reasons, *known.reasons))
        yield line


def _logs(system: System, given: Log | Sequence[Log], argument: str) -> tuple[Log, ...]:
    logs = (given,) if isinstance(given, Log) else tuple(given)
    for log in logs:
        if not isinstance(log, Log):
            raise ConfigError(f"`{argument}`: give logs, made by read_log or Log.from_arrays, not {log!r}")
        missing = [key for key in system.widths if key not in log.series]
        if missing or log.dt != system.dt:
            steps = f"has steps of {log.dt:g} s, the model of {system.dt:g} s"
            what = f"has no {missing[0]}" if missing else steps
            raise LogError(f"{log.source}: was not read for the system {system.name!r}: it {what}")
    return logs


def _warn_of_same_logs(belief: Belief, fitted: Sequence[Log]) -> None:
    """Warn of logs that the belief knows already: what they say would count twice."""
    before = set(belief.logs.values())
    if again := [name for name, digest in (hashes(fitted) if before else {}).items() if digest in before]:
        logger.warning(
            f"the belief was made from {', '.join(again)} already: what the same part of a log says counts "
            f"twice, and the intervals are too narrow; leave out one of the two"
        )


def _same_data(one: Log, other: Log) -> bool:
    """Whether two logs are of one file, and overlap in time."""
    if one.file is None or other.file is None or one.file.resolve() != other.file.resolve():
        return False
    ends = (log.start_ns + 1e9 * log.duration for log in (one, other))
    return max(one.start_ns, other.start_ns) < min(ends)


@contextmanager
def collected_warnings(of: str = "") -> Iterator[list[str]]:
    """The library's warnings, each once, while the block runs.

    Args:
        of: What they are about; whoever else hears them is told.
    """
    texts: dict[str, None] = {}
    found: list[str] = []

    class Collector(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            if of:
                record.msg, record.args = f"{of}: {record.getMessage()}", ()
            texts[record.getMessage()] = None

    logger, listener = logging.getLogger("amhe_cli"), Collector(logging.WARNING)
    logger.handlers.insert(0, listener)  # the first to hear of them
    try:
        yield found
    finally:
        logger.removeHandler(listener)
        found += texts
