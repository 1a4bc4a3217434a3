"""Verdicts: what stands between a value and 'identified', read from the ledger.

identified       with all terms in, DETERMINED of the prior's sd is gone, and would be if given numbers and
                 contradictions were DOUBT times as large; and it moves by no more than its own sd where
                 priors of other unknowns are DOUBT sd off
conditional      the logs determine it, if a number that somebody else gave is right
model-sensitive  the model misses the logs, or the value would be identified if the logs agreed with
                 themselves and the response were straight
weak             none of these
prior            the logs hardly narrow it down
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.parameters import ParameterSpace
from amhe_cli.core.statistics import correlation
from amhe_cli.estimation.core.agreement import SURPRISE
from amhe_cli.estimation.core.result import Against, ParameterResult, Reason
from amhe_cli.estimation.uncertainty.ledger import Ledger, Source, interval, size
from amhe_cli.estimation.uncertainty.minimum import Rival

#: Share of a prior's sd that is next to nothing, whether the logs take it away or move the value by it.
NOTHING = 0.3
#: Share of a prior's sd that is gone where the logs determine a value.
DETERMINED = 0.8
#: Factor on the sd of what is known badly, under which a value must stay determined to be called identified:
#: data sheets and priors are optimistic, and how far parts of the logs scatter is known from two or three.
DOUBT = 2.0
#: Correlation from which two parameters are known only together.
TOGETHER = 0.9
#: Share of a variance from which a source of it is given as a reason.
COUNTS = 0.25
#: Terms that no number which somebody gives would remove: the logs or the model contradict themselves.
CONTRADICTIONS = ("parts", "curvature")


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """Evidence that verdicts are read from.

    Args:
        z: The estimate, shape (d,).
        ledger: All terms of its error.
        active: Parameters that the logs depend on, shape (d,).
        idle: Why the logs do not depend on the others, by name.
        misfit: What speaks against every value.
        blamed: What speaks against some values, in words, by their names.
        rival: A second minimum.
        doubled_prior: Where the estimate would move if each parameter's prior sd were doubled, shape (d,).
        non_smooth: The response jitters, as behind contacts.
        means: Names of the values that common means are of, by the means' names.
        unbounded: Where the estimate would be without bounds, shape (d,); None: where it is.
    """

    z: FloatArray
    ledger: Ledger
    active: np.ndarray
    idle: Mapping[str, str]
    misfit: Sequence[Against]
    blamed: Mapping[str, tuple[str, ...]]
    rival: Rival | None
    doubled_prior: FloatArray
    non_smooth: bool = False
    means: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    unbounded: FloatArray | None = None
    correlations: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "correlations", correlation(self.ledger.covariance))


def verdicts(space: ParameterSpace, evidence: Evidence) -> tuple[ParameterResult, ...]:
    """One line for each parameter, with a verdict and its reasons."""
    return tuple(_parameter(space, evidence, i) for i in range(len(space)))


def _parameter(space: ParameterSpace, evidence: Evidence, i: int) -> ParameterResult:
    p, sd = space.parameters[i], float(evidence.ledger.sd[i])
    estimate = float(space.theta_of(evidence.z)[i])
    low, high = interval(space, evidence.z, sd, i)
    moved = evidence.z + np.eye(len(space))[i] * evidence.doubled_prior[i]
    verdict, given = "prior", ""
    if evidence.active[i]:
        misses = bool(evidence.misfit or evidence.blamed.get(p.name))
        verdict, given = verdict_of(evidence.ledger, i, (p.name,), misses=misses)
    return ParameterResult(
        name=p.name,
        unit=p.unit,
        estimate=estimate,
        prior=p.nominal,
        prior_sd=(p.nominal if p.log else 1.0) * p.prior_sd,
        sd=sd * p.prior_sd * (estimate if p.log else 1.0),
        lower=low,
        upper=high,
        bounds=(p.lower, p.upper),
        shrinkage=1.0 - sd,
        verdict=verdict,
        reasons=tuple(_reasons(space, evidence, i)),
        budget=evidence.ledger.budget(i),
        doubled_prior=float(space.theta_of(space.clip(moved))[i]) - estimate,
        given=given,
    )


def verdict_of(ledger: Ledger, i: int, own: Collection[str], *, misses: bool) -> tuple[str, str]:
    """The verdict on one number of a ledger that the logs depend on, and what a conditional one rests on.

    Args:
        ledger: The ledger; its numbers are in prior sd.
        i: The number.
        own: Parameters whose priors are its own.
        misses: Whether the model misses the logs.
    """
    total, rests = float(ledger.covariance[i, i]), ledger.given(i, own)
    given = sum(variance for variance, _ in rests)
    # of a ratio that logs show, more data leave nothing but the other's prior, however wide the own one is;
    # where logs tell both apart, more data take that part away
    priors = [(variance, source) for variance, source in rests if source.parameter]
    borrowed = sum(variance for variance, _ in priors)
    contradictions = ledger.variance(i, CONTRADICTIONS)
    contradictions += sum(variance for variance, _ in ledger.given(i, own, doubted=True))
    more = DOUBT**2 - 1.0  # of a variance whose sd is so many times as large

    def shrinkage(variance: float) -> float:
        return 1.0 - float(np.sqrt(max(variance, 0.0)))

    if misses:
        best = shrinkage(total - max(given, contradictions))
        return "model-sensitive" if best >= NOTHING else "prior", ""
    stays = DOUBT**2 * borrowed <= total
    if stays and shrinkage(total + more * (given + contradictions)) >= DETERMINED:
        return "identified", ""
    if shrinkage(total - given + more * contradictions) >= DETERMINED:
        return "conditional", _given((rests if stays else priors)[0][1])
    if shrinkage(total - contradictions) >= DETERMINED:
        return "model-sensitive", ""
    # two solutions are two values, not none
    return "weak" if shrinkage(total - ledger.variance(i, ("minimum",))) >= NOTHING else "prior", ""


def _reasons(space: ParameterSpace, evidence: Evidence, i: int) -> list[Reason]:
    """Why, the most important first: bound, misfit, then what of the variance counts, the largest first."""
    name, reasons = space.names[i], _at_bound(space, evidence, i)
    if not evidence.active[i]:
        text = f"{evidence.idle[name]}: not identifiable, held at its prior"
        return [*reasons, Reason("idle", (name,), 1.0, text)]
    for text in (*(one.text for one in evidence.misfit), *evidence.blamed.get(name, ())):
        reasons.append(Reason("misfit", (name,), 1.0, text))
    total, terms = float(evidence.ledger.covariance[i, i]), []
    ledger = evidence.ledger
    for variance, source in (*ledger.given(i), *ledger.given(i, (name,), doubted=True)):
        if variance > COUNTS * total:
            kind = "prior" if source.parameter else "assumed"
            terms.append(Reason(kind, (name,), variance / total, _rests(space, i, variance, source)))
    terms += _of_terms(space, evidence, i, total)
    reasons += sorted(terms, key=lambda reason: -reason.size)
    if evidence.ledger.sd[i] > 1.0 - NOTHING and not any(reason.kind == "minimum" for reason in reasons):
        away = abs(float(evidence.z[i]))
        value = "the value is your prior" if away <= NOTHING else f"it is {away:.1f} prior sd from your prior"
        reasons.append(Reason("open", (name,), away, f"the logs hardly narrow it down: {value}"))
    if values := evidence.means.get(name, ()):
        reasons.append(Reason("together", values, 1.0, f"the common mean of {len(values)} values"))
    return [*reasons, *_partners(space, evidence, i)]


def _rests(space: ParameterSpace, i: int, variance: float, source: Source) -> str:
    """'given the force limit of servo, 0.77: known to 20 %, that leaves 20 % open'."""
    step = float(np.sqrt(variance))
    if source.parameter == space.names[i]:
        known = f": {source.value}, known to {source.times()}" if source.value else ""
        return f"your own prior counts{known}"
    acts = "" if source.acts is None else f", which acts in {100.0 * source.acts:.2g} % of the steps"
    width = f"known to {source.times()}, that" if source.times() else "that"
    verb = "the logs speak against" if source.doubted else "given"
    return f"{verb} {_given(source)}{acts}: {width} leaves {size(space, i, step).lstrip('+-')} open"


def _given(source: Source) -> str:
    return f"{source.name}, {source.value}" if source.value else source.name


def _of_terms(space: ParameterSpace, evidence: Evidence, i: int, total: float) -> list[Reason]:
    """The terms but noise, priors and assumed values that hold a share of one parameter's variance."""
    reasons, name, ledger = [], space.names[i], evidence.ledger
    for term in ledger.terms:
        share = float((term.errors[i] ** 2).sum()) / total
        if share <= COUNTS:
            continue
        if term.kind == "parts":
            _, source = term.of(i)[0]
            text = f"{source.name} disagree by {size(space, i, source.apart[i])}"
        elif term.kind == "minimum" and evidence.rival is not None:
            text = evidence.rival.text(space, i)
        elif term.kind in _TEXTS:
            text = _TEXTS[term.kind]
            if term.kind == "curvature" and evidence.non_smooth:
                text = "the response is jagged: the value hangs on details of contact, and its sd is rough"
        else:
            continue
        reasons.append(Reason(term.kind, (name,), share, text))
    return reasons


_TEXTS = {
    "repeats": "residuals repeat from sample to sample, as errors of the model do: more data of this kind "
    "will not narrow it",
    "curvature": "the response bends within the interval: its sd is rough, and more data narrow it",
    "search": "the search was still moving",
    "spread": "its values differ from log to log, and few say little of their mean: more logs narrow it",
    "declared": "identify.model_error says so",
}


def _at_bound(space: ParameterSpace, evidence: Evidence, i: int) -> list[Reason]:
    """Where an estimate is at a bound: the bound decides it, not the data.

    A linear scale may well end at 0 where the truth is: an armature that a sensor does not feel. It only
    decides where the data want less by more than chance.
    """
    lower, upper = (b[i] for b in space.bounds)
    p, sd = space.parameters[i], float(evidence.ledger.sd[i])
    margin = min(0.01 * (upper - lower), 0.5 * sd)
    wanted = evidence.z[i] if evidence.unbounded is None else evidence.unbounded[i]
    if evidence.z[i] <= lower + margin and (p.log or p.lower != 0.0 or wanted < lower - SURPRISE * sd):
        return [
            Reason("bound", (p.name,), 1.0, f"it stops at its lower bound {p.lower:g}: the data want less")
        ]
    if evidence.z[i] >= upper - margin:
        return [
            Reason("bound", (p.name,), 1.0, f"it stops at its upper bound {p.upper:g}: the data want more")
        ]
    return []


def _partners(space: ParameterSpace, evidence: Evidence, i: int) -> list[Reason]:
    """With which others a value trades places, if only by way of one; all have the same words."""
    size = np.abs(evidence.correlations) * (1 - np.eye(len(space)))
    linked = size > TOGETHER
    group = np.arange(len(space)) == i
    while (more := group | linked[group].any(axis=0)).sum() > group.sum():
        group = more
    if group.sum() == 1:
        return []
    names = tuple(name for name, inside in zip(space.names, group, strict=True) if inside)
    most = float(size[np.ix_(group, group)].max())
    first, second = np.flatnonzero(group)[:2]
    signed = f"correlation {evidence.correlations[first, second]:+.2f}"
    extent = signed if len(names) == 2 else f"correlations up to {most:.2f} in size"
    text = f"known mostly together: {', '.join(names[:-1])} and {names[-1]} ({extent})"
    return [Reason("together", names, most, text)]
