"""The numbers of a model file against what a robot did: a table of what its logs contradict."""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from functools import partial
from math import inf
from typing import Any

import numpy as np

from amhe_cli.audit.claims import Claim, Group, claims_of, doubts_of
from amhe_cli.audit.judge import (
    ODDS,
    RATE,
    Findings,
    Said,
    averaged,
    chances,
    contradicted,
    judged,
    said,
    wrong_sheets,
)
from amhe_cli.audit.suspects import (
    HOPELESS,
    Explanation,
    Searched,
    findings_of,
    over,
    rows_of,
    sheets_of,
    without_suspects,
)
from amhe_cli.audit.weight import anywhere, weights
from amhe_cli.check.motion import states_along
from amhe_cli.core.arrays import BoolArray, FloatArray
from amhe_cli.core.belief import with_prior
from amhe_cli.core.errors import ConfigError, EstimationError, LogError
from amhe_cli.core.log import Log
from amhe_cli.core.parameters import theta_of
from amhe_cli.core.settings import AssumedSettings
from amhe_cli.core.statistics import correlation
from amhe_cli.core.yaml_file import merged
from amhe_cli.estimation.conclude import PARTS, Search
from amhe_cli.estimation.core.result import Against, Identification, Iteration, ParameterResult
from amhe_cli.estimation.explain.inputs import uncommanded
from amhe_cli.estimation.identification import IdentifyOptions, concluded, searched_for
from amhe_cli.estimation.offline.problem import Ends, KnownNoise
from amhe_cli.estimation.offline.watch import Watch
from amhe_cli.estimation.uncertainty.misfit import stalled
from amhe_cli.init.folder import Proposal
from amhe_cli.system.system import System

logger = logging.getLogger(__name__)

#: Clips of the searches where motions are matched, and their length [s]: many short ones, along which even
#: wrong numbers do not lead far away, show what is far off, and some of the usual length by how much.
_CLIPS = ((16, 0.3), (12, None))
#: Clips that show that nothing else explains the logs.
_LOOK = 4
#: The same where what is slow stands still in the short ones.
_SLOW = 5
#: What is far off is found with a step [posterior sd] that is worth less than a sheet's odds.
_WORTH = float(np.sqrt(2.0 * ODDS))
#: Another explanation ends with a step [posterior sd] that changes its odds by half a unit.
_NEAR = 1.0
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
        file, file_sd: What the file says, and what that is taken to be worth.
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
    file_sd: float
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
        unsearched: What was not searched to the end, in a sentence; '' where all was.
    """

    lines: tuple[Line, ...]
    system: System
    found: Identification
    claims: tuple[Claim, ...]
    proposal: Proposal
    unsearched: str = ""

    @property
    def beside(self) -> list[ParameterResult]:
        """What was identified beside the file's numbers: zeros of sensors, delays, what a system adds."""
        own = {claim.parameter for claim in self.claims}
        return [one for one in self.found.parameters if one.name not in own]

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
    progress: Callable[[str, int], None] = lambda doing, done: None,
) -> Audit:
    """Compare every number that decides a motion with logs.

    What ends its searches early, Ctrl-C or the options' time, leaves undecided what they would have decided.

    Args:
        proposal: Model and signals; its parameters are replaced.
        name: Name of the system.
        read: Reads the logs for a system.
        options: How to search.
        settings: Settings over the defaults.
        progress: Called after each iteration of a search, and before each check, with what is being done, and
            the number of both until then.

    Raises:
        ConfigError: The model has no number that these logs could tell.
        LogError: A log cannot be read.
        EstimationError: No clip of the logs can be used.
    """
    settings = merged(proposal.settings, settings or {})
    claims = claims_of(proposal, _assumed(settings))
    if not claims:
        raise ConfigError("the model says no number of a joint that the log measures")
    logs, doing, done = list[Log](), "", 0

    def show(iteration: Iteration, total: int) -> None:
        nonlocal done
        done += 1
        now = f"{doing}: cost {iteration.cost:.3g}"
        progress(f"checking: {iteration.method}" if iteration.stage == "conclusion" else now, done)

    watch = Watch(show, inf if options.max_time is None else options.max_time, PARTS)

    def searched(
        clips: int | None, length: float | None, enough: float | None,
        wide: Collection[Group], near: Search | None, noise: KnownNoise | None = None, ends: Ends = stalled,
    ) -> Search:  # fmt: skip
        nonlocal doing
        doing = "what else explains the logs" if noise else "what is far off" if length else "all numbers"
        guesses = [claim.guess(claim.group not in wide) for claim in claims]
        short = {"clips": {"length": [length, length]}} if length else {}
        parameters = [*guesses, *doubts_of(proposal)]
        system = replace(proposal, parameters=parameters).system(name, merged(settings, short))
        if not logs:
            logs[:] = read(system)
            for text in uncommanded(system):
                logger.warning(text)
        enough = _NEAR if noise else enough
        return searched_for(
            system, logs, None, options, quick=True, near=near, clips=clips, enough=enough, noise=noise,
            ends=ends, watch=watch,
        )  # fmt: skip

    search, wrong, again, seen = _searched(searched, claims, proposal.match)
    look = again if proposal.match == "effort" else partial(searched, _LOOK, None, None)
    first = Explanation(search, wrong, claims)
    try:
        first = first.further()
    except KeyboardInterrupt:
        watch.interrupt()
    found, judgement, at = _concluded(again, look, first, seen)
    system = at.search.problem.system
    lines = _lines(system, found, claims, judgement, logs)
    return Audit(tuple(lines), system, found, tuple(claims), proposal, judgement.unsearched)


def _searched(
    searched: Callable[..., Search], claims: Sequence[Claim], match: str
) -> tuple[Search, frozenset[Group], Searched, list[Explanation]]:
    """The first explanation: its search, its wrong sheets, how it searched, and what was seen on the way.

    Rollouts of all clips take their time, and data sheets are held against what some of them say.
    """
    search, wrong, again = None, frozenset[Group](), partial(searched, None, None, None)
    seen = list[Explanation]()
    for clips, length in ((None, None),) if match == "effort" else _CLIPS:
        if search is not None and search.watch.cut_short:
            break
        again, seen = partial(searched, clips, length, _WORTH if length else None), []
        try:
            search, wrong = without_suspects(again, claims, wrong, search, seen=seen)
        except KeyboardInterrupt:
            if search is None:
                raise
            search.watch.interrupt()  # what the search before this one found is reported
        except EstimationError:
            if length is None:
                raise
            again, seen = partial(searched, _SLOW, None, _WORTH), []
            search, wrong = without_suspects(again, claims, wrong, search, seen=seen)
    assert search is not None
    return search, wrong, again, seen


@dataclass(frozen=True, slots=True, eq=False)
class _Judgement:
    """Evidence of the best explanation, and of k claims what the logs say and the chances (k,).

    `free`: what the logs say of each with all other sheets left open, as far as slopes reach. What that
    excludes, no other explanation is searched for. `unsearched`: as of `Audit`; `left`: groups whose other
    explanations that is about, None: it is about the first explanation, and so about every number.
    """

    evidence: Findings
    said: Said
    chance: FloatArray
    free: Said
    unsearched: str = ""
    left: Collection[Group] | None = ()

    def doubtful(self, claims: Sequence[Claim], tested: Set[Group]) -> dict[Group, float]:
        """Groups not yet tested whose numbers are far off, which something else may explain -> how far."""
        far = chances(self.said.t)
        some = contradicted(far) & ~contradicted(chances(self.free.t))
        return {
            claim.group: one
            for claim, one, doubtful in zip(claims, far, some, strict=True)
            if doubtful and claim.group not in tested
        }

    def unsure(
        self, claims: Sequence[Claim], wrong: BoolArray, known: BoolArray, sheet: FloatArray
    ) -> BoolArray:
        """Which of k numbers, that are `wrong` or `known` (k,), what was not searched might decide otherwise.

        A group that is left may be right if others are not; what others are then, only slopes say.
        """
        left = np.array([claim.group in (self.left or ()) for claim in claims])
        open_to = (self.free.sd > sheet) | contradicted(chances(self.free.t))
        return (left & wrong) | (left.any() & known & open_to)


def _concluded(
    searched: Searched, looked: Searched, first: Explanation, seen: Sequence[Explanation]
) -> tuple[Identification, _Judgement, Explanation]:
    """The best explanation, and its claims judged: what it contradicts has been believed once.

    What was `seen` on the way to it counts by its evidence.
    """
    others, tested, decided = list(seen), set[Group](), set[Group]()
    found = concluded(first.search, quick=True)
    watch, judgement = first.search.watch, _judgement(found, first, others, decided)
    if watch.cut_short:
        text = f"the search did not end ({watch.cause}), and its values are the best so far"
        return found, replace(judgement, unsearched=text, left=None), first
    try:
        while not _unjudged(found) and (left := judgement.doubtful(first.claims, tested)):
            group = max(left, key=left.__getitem__)  # the first that something else may explain
            wider = _wider(found)
            other, ended = first.rival(searched, looked, group, wider)
            tested.add(group)
            if ended:
                decided.add(group)  # a search that has not ended excludes nothing
            if other is not None and other.against(first, wider) > 0.0:
                others += [first, other]  # what is wrong beside it was looked for with one sheet barred
                first, other = other.widened(searched, others), None
                found = concluded(first.search, quick=True)
            others += [other] if other else []
            judgement = _judgement(found, first, others, decided)
    except KeyboardInterrupt:
        watch.interrupt()
        found = replace(found, interrupted=watch.interrupted)
        judgement = _judgement(found, first, others, decided)
    if watch.cut_short:
        left = judgement.doubtful(first.claims, tested)
        text = f"what else explains the logs was not searched for to the end ({watch.cause})"
        judgement = replace(judgement, unsearched=text, left=left)
    return found, judgement, first


def _judgement(
    found: Identification, first: Explanation, others: Sequence[Explanation], decided: Set[Group]
) -> _Judgement:
    """The test of each claim, over explanations by their evidence.

    Whether a sheet is right that searches `decided`, they say themselves, and not what is linear about them.
    Where held-out clips are missed more than fitted ones, by more than chance, fitted ones leave less than
    the next motion would: the noise is taken to be what held-out ones leave.
    """
    space = first.search.problem.system.space
    at = space.phi_of(found.belief.estimate)
    evidence = findings_of(space, at, found.unbounded, found.information, found.belief.covariance)
    wider, tests = _wider(found), []
    odds = _once({first: 0.0} | {one: one.odds(first, wider) for one in others})
    evidence = evidence.under_noise(wider)
    if not over(first.search):  # its ledger has the step that is left, and it stopped on its way
        evidence = evidence.unsure(first.to_go[0])
    for one in odds:
        findings = evidence if one is first else one.evidence.under_noise(wider).unsure(one.to_go[0])
        system = one.search.problem.system
        sheets, rows = sheets_of(system, one.claims), rows_of(system, one.claims)
        sets = wrong_sheets(findings, sheets, one.wrong)
        sets = {some: likely for some, likely in sets.items() if not (some ^ one.wrong) & decided}
        tests.append(judged(findings, sheets, sets, rows, system.space.log[rows]))
    share = np.exp(np.array([*odds.values()]) - max(odds.values()))
    chance = share @ np.array([each for _, each in tests]) / share.sum()
    system = first.search.problem.system
    sheets, rows = sheets_of(system, first.claims), rows_of(system, first.claims)
    least = np.broadcast_to(sheets.least, sheets.file.shape)[rows]
    file, right, log = sheets.file[rows], sheets.right[rows], space.log[rows]
    free = said(evidence.with_priors(sheets.sd(sheets.groups)), rows, file, right, log, least)
    logged = averaged([each for each, _ in tests], share.tolist(), file, right, log, least, evidence.at[rows])
    return _Judgement(evidence, logged, chance, free)


def _once(odds: Mapping[Explanation, float]) -> dict[Explanation, float]:
    """Of explanations -> logarithm of their odds, the first and those that count: each set of sheets once.

    Its evidence is that of the best values that were found for it; of the first's set, that of the first.
    """
    first, counted = next(iter(odds)), dict[frozenset[Group], Explanation]()
    for one in sorted(odds, key=odds.__getitem__):
        if odds[one] >= HOPELESS:
            counted[one.wrong] = one
    return {first: odds[first]} | {one: odds[one] for one in counted.values() if one.wrong != first.wrong}


def _assumed(settings: Mapping[str, Any]) -> AssumedSettings:
    """What data sheets are worth by some settings; what is wrong with these the first system says."""
    try:
        return AssumedSettings.model_validate(settings.get("identify", {}).get("assumed", {}))
    except (AttributeError, ValueError):
        return AssumedSettings()


def _lines(
    system: System,
    found: Identification,
    claims: Sequence[Claim],
    judgement: _Judgement,
    logs: Sequence[Log],
) -> list[Line]:
    """The table."""
    logged, log = judgement.said, system.space.log[rows_of(system, claims)]
    sheet, factor = np.array([[c.sd, c.factor] for c in claims]).T
    unjudged = judgement.unsearched if judgement.left is None else _unjudged(found)
    # sets that say nothing of a number may differ by much, and so may their mean
    wrong = contradicted(judgement.chance) & (chances(logged.t) < RATE) & (not unjudged)
    with np.errstate(over="ignore", invalid="ignore"):  # of what it does not show, a log may say anything
        value = factor * theta_of(log, logged.mean)
        sd = logged.sd * np.where(log, value, factor)
    doubtful = contradicted(chances(logged.t))  # something else may be wrong in its place
    known = (logged.sd <= sheet) & ~doubtful & (not unjudged)
    unsure = judgement.unsure(claims, wrong, known, sheet)
    verdicts = verdicts_of(wrong & ~unsure, known & ~unsure)
    later = np.where(unsure, judgement.unsearched, "")
    weight = _weights(system, found, claims, wrong, logs)
    lines = [
        Line(
            c.number.of, c.number.what, c.number.unit, c.parameter, c.value, c.worth, float(value[i]),
            float(sd[i]), float(logged.t[i]), float(judgement.chance[i]), verdicts[i], weight[i],
            unjudged or str(later[i]) or _cure(system, found, judgement.evidence, c)
            if verdicts[i] == VERDICTS[2] else "",
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
    model = system.edits.apply(system.model, with_prior(system.space, found.belief).nominal)
    numbers = [claim.number for claim, bad in zip(claims, wrong, strict=True) if bad]
    others = [number.written(model, number.values(system.model)) for number in numbers]
    try:
        states = states_along(system, max(logs, key=lambda one: one.duration))
    except LogError:
        states = anywhere(model)
    worth = iter(weights(model, others, states))
    return [next(worth) if bad else 0.0 for bad in wrong]


def _unjudged(found: Identification) -> str:
    """Why no number is judged, where a search has ended; '' where numbers are."""
    return "no value explains these logs, and none can be judged by them" if unexplained(found) else ""


def unexplained(found: Identification) -> tuple[Against, ...]:
    """Why no number can be judged; held-out clips that are missed more make every sd wider instead."""
    return tuple(one for one in found.unexplained if one.kind != "held out")


def _wider(found: Identification) -> float:
    """How many times as much held-out clips are missed as fitted ones."""
    return max(found.held_out.misses.values(), default=1.0) if found.held_out else 1.0


def _cure(system: System, found: Identification, evidence: Findings, claim: Claim) -> str:
    """What would decide about a number."""
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
