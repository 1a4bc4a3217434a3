"""The numbers of a model file against what a robot did: a table of what its logs contradict."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from amhe_cli.audit.claims import Claim, Group, claims_of, doubts_of
from amhe_cli.audit.judge import Findings, Sheets, contradicted, judged, wrong_sheets
from amhe_cli.audit.weight import anywhere, weights
from amhe_cli.check.motion import states_along
from amhe_cli.core.arrays import BoolArray, FloatArray
from amhe_cli.core.errors import ConfigError, EstimationError, LogError
from amhe_cli.core.log import Log
from amhe_cli.core.parameters import ParameterSpace, theta_of
from amhe_cli.core.settings import AssumedSettings
from amhe_cli.core.statistics import correlation
from amhe_cli.core.yaml_file import merged
from amhe_cli.estimation.conclude import Search
from amhe_cli.estimation.core.result import Identification, Iteration
from amhe_cli.estimation.identification import IdentifyOptions, concluded, searched_for
from amhe_cli.estimation.offline.search import SearchState
from amhe_cli.estimation.uncertainty.misfit import unexplained
from amhe_cli.init.folder import Proposal
from amhe_cli.system.system import System

#: Searches until no more number stands out, at most.
_ROUNDS = 8
#: Clips of the searches where motions are matched, and their length [s]: many short ones, along which even
#: wrong numbers do not lead far away, show what is far off, and some of the usual length by how much.
_CLIPS = ((16, 0.3), (12, None))
#: The same where what is slow stands still in the short ones.
_SLOW = 5
#: Where a data sheet may be wrong by more than slopes show, in units of `Claim.wide`, and the share by which
#: the cost must fall there.
_FAR, _FALLS = (-2.0, -1.0, 1.0, 2.0), 0.1
#: Share by which the cost may rise, by chance, where more is left open.
_RISES = 1e-3
#: Correlation from which two numbers are known only together.
_TOGETHER = 0.7

Verdict = str
#: Verdicts, worst first.
VERDICTS = ("contradicted", "agrees", "cannot tell")


@dataclass(frozen=True, slots=True)
class Line:
    """One number of the table.

    Args:
        of, what, unit: Whose number it is, and which.
        parameter: Name of the parameter that sets it.
        file: What the file says.
        log, sd: What the log says of it, whatever the file says, in the same unit.
        t: How far apart they are, in sd of both.
        chance: The chance that a right number is farther away.
        verdict: One of `VERDICTS`.
        weight: Share of the forces along the motion that the difference is worth.
        cure: What to record or measure, of a number that the log does not show.
    """

    of: str
    what: str
    unit: str
    parameter: str
    file: float
    log: float
    sd: float
    t: float
    chance: float
    verdict: Verdict
    weight: float
    cure: str


@dataclass(frozen=True, eq=False)
class Audit:
    """The numbers of a file against logs.

    Args:
        lines: Contradicted ones first, by weight; then what agrees, then what the log does not show.
        system: The model with all its numbers as parameters, under the priors of the last identification.
        found: That identification.
        claims: What the file claims.
        proposal: Model and signals.
    """

    lines: tuple[Line, ...]
    system: System
    found: Identification
    claims: tuple[Claim, ...]
    proposal: Proposal

    def with_only(self, names: Collection[str]) -> System:
        """The file's model with some of its numbers as parameters, and all others as they are in the file."""
        guesses = [claim.guess(False) for claim in self.claims if claim.parameter in names]
        return replace(self.proposal, parameters=guesses).system(self.system.name)


def audit(
    proposal: Proposal,
    name: str,
    read: Callable[[System], Sequence[Log]],
    options: IdentifyOptions,
    settings: Mapping[str, Any] | None = None,
    progress: Callable[[Iteration, int], None] = lambda iteration, total: None,
) -> Audit:
    """Compare every number that decides a motion with logs.

    Args:
        proposal: Model and signals; its parameters are replaced.
        name: Name of the system.
        read: Reads the logs for a system.
        options: How to search.
        settings: Settings over the defaults.
        progress: Called after each iteration.

    Raises:
        ConfigError: The model has no number that these logs could tell.
        LogError: A log cannot be read.
        EstimationError: No clip of the logs can be used.
    """
    settings = merged({"identify": {"profile_points": 0}}, merged(proposal.settings, settings or {}))
    claims = claims_of(proposal, _assumed(settings))
    if not claims:
        raise ConfigError("the model says no number of a joint that the log measures")
    doubts, logs = doubts_of(proposal), tuple[Log, ...]()

    def searched(
        clips: int | None, length: float | None, wide: Collection[Group], near: Search | None
    ) -> Search:
        nonlocal logs
        guesses = [claim.guess(claim.group not in wide) for claim in claims]
        short = {"clips": {"length": [length, length]}} if length else {}
        system = replace(proposal, parameters=[*guesses, *doubts]).system(name, merged(settings, short))
        logs = logs or tuple(read(system))
        return searched_for(system, logs, None, options, progress, quick=True, near=near, clips=clips)

    # rollouts of all clips take their time, and data sheets are held against what some of them say
    search, wrong = None, frozenset[Group]()
    for clips, length in ((None, None),) if proposal.match == "effort" else _CLIPS:
        if search is not None and search.watch.interrupted:
            break
        try:
            search, wrong = _without_suspects(partial(searched, clips, length), claims, wrong, search)
        except KeyboardInterrupt:
            if search is None:
                raise
            search.watch.interrupted = True  # what the search before this one found is reported
        except EstimationError:
            if length is None:
                raise
            search, wrong = _without_suspects(partial(searched, _SLOW, None), claims, wrong, search)
    assert search is not None
    found, system = concluded(search, quick=True), search.problem.system
    lines = _lines(system, found, claims, wrong, logs)
    return Audit(tuple(lines), system, found, tuple(claims), proposal)


def _assumed(settings: Mapping[str, Any]) -> AssumedSettings:
    """What data sheets are worth by some settings; what is wrong with these the first system says."""
    try:
        return AssumedSettings.model_validate(settings["identify"].get("assumed", {}))
    except (AttributeError, ValueError):
        return AssumedSettings()


def _without_suspects(
    searched: Callable[[Collection[Group], Search | None], Search],
    claims: Sequence[Claim],
    wrong: frozenset[Group],
    near: Search | None,
) -> tuple[Search, frozenset[Group]]:
    """The search that believes what its own linearisation calls right, and the data sheets that it does not.

    A linearisation may err far from its minimum: where the cost rises with the sheets that it calls wrong,
    one of them at a time is tried, and where it still rises, that one is believed.
    """
    search, refused, aside = searched(wrong, near), frozenset[Group](), frozenset[Group]()
    tried = {wrong}
    try:
        for _ in range(0 if search.watch.interrupted else _ROUNDS):
            evidence, begin = _sketched(search), search
            sheets = _sheets(evidence, search.problem.system, claims)
            sets = wrong_sheets(evidence, sheets, wrong)
            if _straight(search):
                likely = next(iter(sets)) - refused - aside
            else:  # slopes that bend show where to go next, not how far: one sheet, and another linearisation
                likely = next(one for one in sets if len(one ^ wrong) <= 1 and not one & refused)
            if likely <= wrong and (far := _far_off(search, sheets, wrong | refused)):
                (more, begin) = far
                likely = wrong | {more}
            new = likely - wrong
            if likely not in tried:
                tried.add(likely)
                other = searched(likely, begin)
                if other.watch.interrupted:
                    raise KeyboardInterrupt
                if _cost(other) <= (1.0 + _RISES) * _cost(search):
                    search, wrong, refused, aside = other, likely, frozenset(), frozenset()
                    continue
            elif len(new) < 2:
                break
            if len(new) > 1:  # the strongest alone, then the others
                aside |= new - {max(new, key=lambda name: sets[wrong | {name}])}
            else:
                refused, aside = refused | new, frozenset()
    except KeyboardInterrupt:  # what was found so far is reported
        search.watch.interrupted = True
    return search, wrong


def _sheets(evidence: Findings, system: System, claims: Sequence[Claim]) -> Sheets[Group]:
    """The data sheets of the file; what it does not say is known by its prior."""
    file, right = np.array(evidence.prior)
    wide, least, groups = right.copy(), np.full(len(right), -np.inf), dict[Group, list[int]]()
    for row, claim in zip(_rows(system, claims), claims, strict=True):
        file[row], right[row], wide[row] = claim.phi(claim.value), claim.sd, claim.wide
        least[row] = claim.least
        groups.setdefault(claim.group, []).append(row)
    return Sheets(groups, file, right, wide, least)


def _cost(search: Search) -> float:
    return search.finding.record[-1].cost if search.finding.record else np.inf


def _evidence(
    space: ParameterSpace, at: FloatArray, z: FloatArray, information: FloatArray, more: FloatArray
) -> Findings:
    """Findings on the parameters' scales: z (d,) of the logs linearised `at` phi (d,), and information."""
    sd = np.array(space.prior_sd)
    prior = np.array([space.phi_of(space.nominal), sd])
    return Findings(prior[0] + sd * z, prior, information / np.outer(sd, sd), np.array(more), at)


def _straight(search: Search) -> bool:
    """Whether slopes are believed beyond where a search ended."""
    return isinstance(search.finding, SearchState) and search.finding.straight


def _sketched(search: Search) -> Findings:
    """What a search says, without the checks of its conclusion; where slopes bend, it refused their step."""
    space, posterior, z = search.problem.system.space, search.fit.posterior, search.fit.z
    more = posterior.covariance * np.outer(space.prior_sd, space.prior_sd)
    at = space.phi_of(space.theta_of(z))
    return _evidence(
        space, at, z + posterior.step * _straight(search), posterior.hessian - posterior.prior, more
    )


def _rows(system: System, claims: Iterable[Claim]) -> list[int]:
    return [system.space.names.index(claim.parameter) for claim in claims]


def _far_off(search: Search, sheets: Sheets[Group], known: Collection[Group]) -> tuple[Group, Search] | None:
    """The group that is wrong by so much that no slope shows it, and the search to begin from there.

    A servo whose file is fifty times too stiff feels the same if it is ten per cent softer. Where no value
    near the file's explains the logs, each group is moved far away by itself; none is said where that does
    not help.
    """
    problem, space, at = search.problem, search.problem.system.space, search.finding.z
    if not unexplained(search.fit):
        return None
    step, numbers = sheets.wide / space.prior_sd, np.arange(len(at))
    moved = [
        (group, space.clip(at + far * step * np.isin(numbers, rows)))
        for group, rows in sheets.groups.items()
        if group not in known
        for far in _FAR
    ]
    if not moved:
        return None
    costs = problem.cost(problem.clips, search.finding.scale).costs(np.stack((at, *(z for _, z in moved))))
    best = int(np.argmin(costs[1:]))
    if not costs[1 + best] < (1.0 - _FALLS) * costs[0]:
        return None
    group, z = moved[best]
    return group, replace(search, finding=replace(search.finding, z=z, straight=False))


def _lines(
    system: System,
    found: Identification,
    claims: Sequence[Claim],
    doubted: frozenset[Group],
    logs: Sequence[Log],
) -> list[Line]:
    """The table, of a search that did not believe some data sheets."""
    at = system.space.phi_of(found.belief.estimate)
    evidence = _evidence(system.space, at, found.unbounded, found.information, found.belief.covariance)
    rows, sheets = _rows(system, claims), _sheets(evidence, system, claims)
    log, sheet, factor = system.space.log[rows], sheets.right[rows], np.array([c.factor for c in claims])
    logged, chance = judged(evidence, sheets, wrong_sheets(evidence, sheets, doubted), rows, log)
    unjudged = _unjudged(found)
    wrong = contradicted(chance) & (not unjudged)
    value = factor * theta_of(log, logged.mean)
    sd = logged.sd * np.where(log, value, factor)
    verdicts = verdicts_of(wrong, (logged.sd <= sheet) & (not unjudged))
    weight = _weights(system, found, claims, wrong, logs)
    lines = [
        Line(
            c.number.of, c.number.what, c.number.unit, c.parameter, c.value, float(value[i]), float(sd[i]),
            float(logged.t[i]), float(chance[i]), verdicts[i], weight[i],
            unjudged or _cure(system, found, evidence, c) if verdicts[i] == VERDICTS[2] else "",
        )
        for i, c in enumerate(claims)
    ]  # fmt: skip
    return in_order(lines)


def verdicts_of(wrong: BoolArray, determined: BoolArray) -> list[Verdict]:
    """The verdict of each number that the logs contradict, or determine."""
    return np.where(wrong, VERDICTS[0], np.where(determined, VERDICTS[1], VERDICTS[2])).tolist()


def in_order(lines: Iterable[Line]) -> list[Line]:
    """Lines as a table shows them: the worst verdict first, then part by part, what matters most first."""
    lines = sorted(lines, key=lambda line: (VERDICTS.index(line.verdict), -line.weight, -abs(line.t)))
    parts = list(dict.fromkeys((line.verdict, line.of) for line in lines))
    return sorted(lines, key=lambda line: parts.index((line.verdict, line.of)))


def _weights(
    system: System, found: Identification, claims: Sequence[Claim], wrong: BoolArray, logs: Sequence[Log]
) -> list[float]:
    """What each contradicted number is worth: forces along the motion if it alone were as in the file."""
    model = system.edits.apply(system.model, system.space.with_prior(found.belief).nominal)
    numbers = [claim.number for claim, bad in zip(claims, wrong, strict=True) if bad]
    others = [number.written(model, number.values(system.model)) for number in numbers]
    try:
        states = states_along(system, max(logs, key=lambda one: one.duration))
    except LogError:
        states = anywhere(model)
    worth = iter(weights(model, others, states))
    return [next(worth) if bad else 0.0 for bad in wrong]


def _unjudged(found: Identification) -> str:
    """Why no number is judged; '' where numbers are."""
    if found.interrupted:
        return "the search was interrupted, and its values are the best so far"
    return "no value explains these logs, and none can be judged by them" if found.unexplained else ""


def _cure(system: System, found: Identification, evidence: Findings, claim: Claim) -> str:
    """What would tell a number."""
    row = system.space.names.index(claim.parameter)
    idle = any(reason.kind == "idle" for reason in found.parameters[row].reasons)
    if claim.number.kind == "force_limit" and idle:
        return "no motion reaches it: command faster steps"
    if idle:
        return "nothing that is measured depends on it: weigh it, or move the joints before it"
    together = np.abs(correlation(evidence.known())[row])
    together[row] = 0.0
    if together.max() > _TOGETHER:
        return f"known only together with {system.space.names[int(together.argmax())]}: measure either"
    return _MORE[claim.number.element]


#: Kind of element -> what tells its numbers.
_MORE = {
    "body": "swing it alone, slowly and fast, in several postures",
    "joint": "move it alone, slowly both ways and fast with sharp turns",
    "actuator": "log its torques, or hang a known load on it",
}
