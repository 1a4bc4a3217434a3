"""Which data sheets are wrong? Searches with some of them left open, and what else explains the logs.

A linear model of the logs says which sheets may be wrong, and the search goes on with these left open. It
ends in one explanation, and there may be others where its slopes do not reach: a third of the mass, or of the
lever. So each sheet that would be called wrong is believed once, with all others left open: the profile
likelihood of the sheet. Where that explains the logs about as well, the fewest sheets that it needs are
looked for from there, and both explanations count by their evidence.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from amhe_cli.audit.claims import Claim, Group
from amhe_cli.audit.judge import ODDS, Findings, Sheets, wrong_sheets
from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.parameters import ParameterSpace
from amhe_cli.estimation.conclude import Search
from amhe_cli.estimation.core.information import clip_objectives
from amhe_cli.estimation.identification import ended
from amhe_cli.estimation.offline.clips import places
from amhe_cli.estimation.offline.problem import Ends, KnownNoise, Problem
from amhe_cli.estimation.offline.search import SearchState, total
from amhe_cli.estimation.uncertainty.fit import FinalFit, scored
from amhe_cli.estimation.uncertainty.misfit import stalled, still_moving, unexplained
from amhe_cli.system.system import System

#: Searches until no more number stands out, at most.
_ROUNDS = 8
#: Where a data sheet may be wrong by more than slopes show, in units of `Claim.wide`, and the share by which
#: the cost must fall there.
_FAR, _FALLS = (-2.0, -1.0, 1.0, 2.0), 0.1
#: A search that has to end, to judge by it, may have so many times its iterations more.
_MORE = 3
#: Logarithm of the odds of an explanation below which it changes no verdict.
HOPELESS = -10.0

#: A search with some data sheets left open, from where another one ended; `noise`, `ends`: as of `Problem`.
Searched = Callable[..., Search]


@dataclass(frozen=True, eq=False)
class Explanation:
    """Values that explain the logs, and the data sheets that are wrong then.

    Args:
        search: The search that found them.
        wrong: The sheets that it left open.
        claims: What the file says.
    """

    search: Search
    wrong: frozenset[Group]
    claims: Sequence[Claim]
    _misfits: dict[tuple[FinalFit, Problem | None], float] = field(default_factory=dict, init=False)

    @cached_property
    def evidence(self) -> Findings:
        """What the logs say, as they look from there."""
        return sketched(self.search)

    @cached_property
    def to_go(self) -> tuple[FloatArray, float]:
        """How far a search that stopped on its way may go, and by how much its cost may fall.

        Both are what it went, (d,) on the parameters' scales, and fell in the later half of its iterations:
        so much is left where half of the iterations leave half of the way.
        """
        fit, space = self.search.fit, self.search.problem.system.space
        record = [one for one in fit.finding.record if one.stage == "polish"]
        if not (record and still_moving(fit)):
            return np.zeros_like(fit.z), 0.0
        half, last = record[(len(record) - 1) // 2], record[-1]
        fell = half.cost - last.cost if np.isfinite(half.cost) else np.inf
        return space.phi_of(space.theta_of(fit.z)) - space.phi_of(np.array(half.theta)), max(fell, 0.0)

    def gain(self, first: Explanation, wider: float) -> float:
        """Log likelihood that the rest of its search may gain, under the noise that the first has left."""
        if not (fell := self.to_go[1]):
            return 0.0
        fit, noise = self.search.fit, wider**2 * first.search.fit.finding.record[-1].cost
        return 0.5 * float(fit.slopes.cost.clips.counts.sum()) / max(fit.times) * fell / max(noise, 1e-300)

    def odds(self, first: Explanation, wider: float = 1.0) -> float:
        """As `against`; of a search that has not ended, the odds that it may end with, at most 0."""
        now = self.against(first, wider)
        return max(now, min(now + self.gain(first, wider), 0.0))

    def further(self, enough: Callable[[Explanation], bool] = lambda one: False) -> Explanation:
        """Where its search goes on until it has ended, or explains enough; a few times as long at most."""
        one = self
        for _ in range(_MORE):
            search = one.search if over(one.search) or enough(one) else _ended(ended(one.search))
            if search is one.search:
                break
            one = replace(one, search=search)
        return one

    def hopeless(self, first: Explanation, wider: float) -> bool:
        """Whether its values change no verdict, whatever sheets were wrong."""
        return self.against(first, wider, least=True) + self.gain(first, wider) < HOPELESS

    @cached_property
    def sheets(self) -> Sheets[Group]:
        """The data sheets."""
        return sheets_of(self.search.problem.system, self.claims)

    def against(self, first: Explanation, wider: float = 1.0, least: bool = False) -> float:
        """Logarithm of the odds to the first explanation, by Laplace's approximation of their evidence.

        `wider`: noise of so many times the sd that the first has left.
        `least`: the most that they can be by this one's clips and values, whatever sheets were wrong.
        """
        both, by = [], (first.search.fit, self.search.problem if least else None)
        for one, sheets in ((self, frozenset() if least else self.wrong), (first, first.wrong)):
            space, z = one.search.problem.system.space, one.search.finding.z
            sd, off = one.sheets.sd(sheets), space.phi_of(space.theta_of(z)) - one.sheets.file
            if by not in one._misfits:
                one._misfits[by] = _misfit(by[0], one.search, by[1])
            cost = one._misfits[by] / wider**2
            if not (least and one is self):
                cost += float(((off / sd) ** 2).sum()) + 2.0 * ODDS * len(sheets)
            spread = np.eye(len(sd)) + sd[:, None] * (first.evidence.information / wider**2) * sd
            both.append(-0.5 * (cost + float(np.linalg.slogdet(spread)[1])))
        return both[0] - both[1]

    def rival(
        self, searched: Searched, looked: Searched, right: Group, wider: float
    ) -> tuple[Explanation | None, bool]:
        """What else explains the logs if one sheet is right, or None; whether the search for it has ended.

        `looked` searches few of the clips; `wider`: see `against`.
        """
        at, believed = np.array(self.search.finding.z), frozenset({right})
        rows = list(self.sheets.groups[right])
        space = self.search.problem.system.space
        at[rows] = ((self.sheets.file - space.phi_of(space.nominal)) / space.prior_sd)[rows]
        near = replace(self.search, finding=replace(self.search.finding, z=space.clip(at), straight=False))
        free, noise = frozenset(self.sheets.groups) - believed, noise_of(self.search.fit, wider)
        other = Explanation(
            _ended(looked(free, near, noise, self._excludes(free, wider, True))), free, self.claims
        )
        other = other.further(lambda one: not one.hopeless(self, wider))
        if other.hopeless(self, wider):
            return None, over(other.search)

        def under_noise(wide: Collection[Group], near: Search | None) -> Search:
            return searched(wide, near, noise, self._excludes(frozenset(wide), wider, False))

        few = next(iter(wrong_sheets(other.evidence, other.sheets, right=believed)))
        search, wrong = without_suspects(under_noise, self.claims, few, other.search, believed)
        other = Explanation(_ended(search), wrong, self.claims)
        other = other.further(lambda one: one.against(self, wider) > 0.0)
        return other, over(other.search)

    def _excludes(self, wrong: frozenset[Group], wider: float, least: bool) -> Ends:
        """Of one search, whether it stalls, or stays hopeless if each step gains as much as the last.

        `wrong`: the sheets that it leaves open. Other arguments as of `against`.
        """
        before = list[float]()

        def ends(problem: Problem, state: SearchState) -> bool:
            if state.first is None:
                return False  # it has not seen all clips
            one = Explanation(replace(self.search, problem=problem, finding=state), wrong, self.claims)
            before.append(one.against(self, wider, least=least))
            left = (1 + _MORE) * problem.settings.identify.iterations - len(state.record)
            gained = before[-1] - before[-2] if len(before) > 1 else np.inf
            return stalled(problem, state) or before[-1] + left * max(gained, 0.0) < HOPELESS

        return ends

    def widened(self, searched: Searched, seen: list[Explanation]) -> Explanation:
        """The explanation from here, with any sheet open; `seen`: gets what else was searched on the way."""
        search, wrong = without_suspects(searched, self.claims, self.wrong, self.search, seen=seen)
        return Explanation(_ended(search), wrong, self.claims).further()


def noise_of(fit: FinalFit, wider: float) -> KnownNoise:
    """What a fit has left, of an sd larger by a factor: other explanations are searched for under it."""
    keys = [observed.channel.key for observed in fit.slopes.cost.clips.observed]
    scale = {key: wider * fit.finding.scale.get(key, 1.0) for key in keys}
    return KnownNoise(scale, dict(zip(keys, fit.times, strict=True)))


def over(search: Search) -> bool:
    """Whether a search has ended, and not only used up its iterations."""
    at = search.finding
    return not isinstance(at, SearchState) or at.settled or at.number < total(search.problem, at)


def _misfit(fit: FinalFit, of: Search, few: Problem | None) -> float:
    """-2 log likelihood of the values that a search found, but for a constant, under the noise of a fit.

    `few`: a problem with the clips that count, in place of the fit's own. First states are those of the
    search where it has fitted the same clips.
    """
    problem, own, began = few or fit.problem, of.problem, getattr(of.finding, "first", None)
    space, weight = problem.system.space, np.ones(len(problem.clips)) if few else fit.weight
    cost = problem.cost(problem.clips, fit.finding.scale)
    if few:  # not what its own search takes for noise
        cost = cost.scaled(fit.finding.scale)
    z = space.z_of(own.system.space.theta_of(of.finding.z))
    if began is not None and places(own.clips) == places(problem.clips):
        first = began.mean[None]
        residuals = cost.residuals(z[None], first if first.shape[2] else None)
        each = clip_objectives(cost, residuals, first, fit.times)[0]
    else:
        shape = (fit.space.prior_sd / space.prior_sd)[:, None] * fit.shape
        each = scored(problem, cost, z, shape).misfit(fit.times)
    return float(np.where(weight > 0.0, each, 0.0) @ weight)


def _ended(search: Search) -> Search:
    """A search that was not cut short; what cuts one short, Ctrl-C or the time, ends the audit's searches.

    Raises:
        KeyboardInterrupt: It was.
    """
    if search.watch.cut_short:
        raise KeyboardInterrupt
    return search


def without_suspects(
    searched: Searched,
    claims: Sequence[Claim],
    wrong: frozenset[Group],
    near: Search | None,
    right: frozenset[Group] = frozenset(),
    seen: list[Explanation] | None = None,
) -> tuple[Search, frozenset[Group]]:
    """The search that believes what its own linearisation calls right, and the data sheets that it does not.

    The sheets `right` are believed, whatever it calls them. `seen`: gets what else was searched on the way.

    A linearisation may err far from its minimum: where the evidence falls with the sheets that it calls
    wrong, one of them at a time is tried, and where it still falls, that one is believed.
    """
    search, refused, aside = searched(wrong, near), frozenset[Group](), frozenset[Group]()
    tried = {wrong}
    try:
        for _ in range(0 if search.watch.cut_short else _ROUNDS):
            evidence, begin = sketched(search), search
            sheets = sheets_of(search.problem.system, claims)
            sets = wrong_sheets(evidence, sheets, wrong, right)
            if _straight(search):
                likely = next(iter(sets)) - refused - aside
            else:  # slopes that bend show where to go next, not how far: one sheet, and another linearisation
                likely = next(one for one in sets if len(one ^ wrong) <= 1 and not one & refused)
            if likely <= wrong and (far := _far_off(search, sheets, wrong | refused | right)):
                (more, begin) = far
                likely = wrong | {more}
            new = likely - wrong
            if likely not in tried:
                tried.add(likely)
                other = _ended(searched(likely, begin))
                here, there = Explanation(search, wrong, claims), Explanation(other, likely, claims)
                better = here.against(there) < 0.0  # under the noise of the new one: misfit is no noise
                if seen is not None:
                    seen.append(here if better else there)
                if better:
                    search, wrong, refused, aside = other, likely, frozenset(), frozenset()
                    continue
            elif len(new) < 2:
                break
            if len(new) > 1:  # the strongest alone, then the others
                aside |= new - {max(new, key=lambda name: sets[wrong | {name}])}
            else:
                refused, aside = refused | new, frozenset()
    except KeyboardInterrupt:  # what was found so far is reported
        search.watch.interrupt()
    return search, wrong


def sheets_of(system: System, claims: Sequence[Claim]) -> Sheets[Group]:
    """The data sheets of the file; what it does not say is known by its prior."""
    file, right = system.space.phi_of(system.space.nominal), np.array(system.space.prior_sd)
    wide, least, groups = right.copy(), np.full(len(right), -np.inf), dict[Group, list[int]]()
    for row, claim in zip(rows_of(system, claims), claims, strict=True):
        file[row], right[row], wide[row] = claim.phi(claim.value), claim.sd, claim.wide
        least[row] = claim.least
        groups.setdefault(claim.group, []).append(row)
    return Sheets(groups, file, right, wide, least)


def findings_of(
    space: ParameterSpace, at: FloatArray, z: FloatArray, information: FloatArray, more: FloatArray
) -> Findings:
    """Findings on the parameters' scales: z (d,) of the logs linearised `at` phi (d,), and information."""
    sd = np.array(space.prior_sd)
    prior = np.array([space.phi_of(space.nominal), sd])
    return Findings(prior[0] + sd * z, prior, information / np.outer(sd, sd), np.array(more), at)


def _straight(search: Search) -> bool:
    """Whether slopes are believed beyond where a search ended."""
    return isinstance(search.finding, SearchState) and search.finding.straight


def sketched(search: Search) -> Findings:
    """What a search says, without the checks of its conclusion; where slopes bend, it refused their step."""
    space, posterior, z = search.problem.system.space, search.fit.posterior, search.fit.z
    more = posterior.covariance * np.outer(space.prior_sd, space.prior_sd)
    at = space.phi_of(space.theta_of(z))
    return findings_of(
        space, at, z + posterior.step * _straight(search), posterior.hessian - posterior.prior, more
    )


def rows_of(system: System, claims: Iterable[Claim]) -> list[int]:
    """Rows of claims among the unknowns."""
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
