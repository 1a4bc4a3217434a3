"""Verdicts: which parameters the logs determine and which they do not, with the reasons in words."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from amhe_cli.core.arrays import BoolArray, FloatArray
from amhe_cli.core.parameters import ParameterSpace
from amhe_cli.core.statistics import Z90, correlation
from amhe_cli.estimation.offline.posterior import Disagreement
from amhe_cli.estimation.offline.result import ParameterResult

#: Shrinkage below which the data say nothing, and from which they determine.
NOTHING, DETERMINED = 0.3, 0.8
#: Prior sd from its prior at which a value that the logs hardly determine has gone astray (one is common),
#: and up to which it is called the prior.
ASTRAY, PRIOR = 2.0, 0.3
#: Shrinkage that what the model assumes must leave.
HALVED = 0.5
#: Ratio of the sd to that at a doubled step that a linearisation may show.
LINEAR = (0.7, 1.4)
#: Disagreements beyond this many sd are no chance. They widen the sd; from NOTED, a share of the value,
#: they are reported, and from NOTABLE they make the number model-sensitive.
SURPRISE, NOTED, NOTABLE = 3.0, 0.05, 0.25
#: Correlation from which two parameters are known only together.
TOGETHER = 0.9
#: A shift is given as a reason where it is more than this share of the sd.
COUNTS = 0.5
#: Posterior over prior sd from which a prior was too narrow.
WIDER = 1.05
#: Factor on the sd from which residuals that repeat are a reason.
REPEATED = 2.0
#: Beginning of the reason of an interval that rests on a number which is taken as exact.
RESTS = "it rests on"


@dataclass(frozen=True, slots=True, eq=False)
class Shift:
    """Where the estimate would move if something that the model takes as exact were otherwise.

    Args:
        text: What moves it, in words; `{}` is the size of the move.
        z: The move, shape (d,) in z.
        spread: What of it counts as one standard deviation: a vector along which it adds its own covariance,
            shape (d,); 0 where chance explains the move.
        assumed: It moves because a number is assumed, not because something speaks against the model.
    """

    text: str
    z: FloatArray
    spread: FloatArray
    assumed: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Rival:
    """Other values that fit the logs as well as the estimate does.

    Args:
        z: These values, shape (d,).
        share: Probability that they are meant, and not the estimate.
        differs: The parameters in which the two differ by more than chance, shape (d,).
        costs: Cost of the estimate, and theirs, in units of the declared noise.
    """

    z: FloatArray
    share: float
    differs: BoolArray
    costs: tuple[float, float]


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """All that was measured about an estimate; vectors are (d,) in z unless said otherwise.

    Args:
        z: The estimate.
        covariance: Posterior covariance, shape (d, d).
        own_sd: Posterior sd before anything widened it.
        active: Parameters that the logs depend on.
        idle: Why the logs do not depend on the others, by name.
        step_ratio: Posterior sd over that at a doubled step.
        bootstrap: Spread over resampled clips.
        disagreements: Name of a comparison -> difference between two parts of the data.
        shifts: What changes of the model would do to the estimate.
        profiles: Column -> (theta values (K,), costs (K,)).
        repeats: Factor by which residuals that repeat have widened the sd that noise alone gives.
        unexplained, blamed: What speaks against every value, and against some by their names, in words.
        rough: The response jitters, as behind contacts.
        causes: What widened the sd beyond noise, in words -> variance that it added.
        rival: A second minimum.
        draws: Draws of the posterior, shape (n, d), from which the intervals are; None: the covariance's.
        exact: Rulers that act and that the settings take as exact.
    """

    z: FloatArray
    covariance: FloatArray
    own_sd: FloatArray
    active: np.ndarray
    idle: Mapping[str, str]
    step_ratio: FloatArray
    bootstrap: FloatArray
    disagreements: Mapping[str, Disagreement]
    shifts: Sequence[Shift]
    profiles: Mapping[int, tuple[FloatArray, FloatArray]]
    repeats: FloatArray
    causes: Mapping[str, FloatArray]
    unexplained: Sequence[str]
    rough: bool
    rival: Rival | None = None
    draws: FloatArray | None = None
    exact: tuple[str, ...] = ()
    blamed: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    @property
    def shrinkage(self) -> FloatArray:
        """1 - posterior sd / prior sd of each parameter, shape (d,)."""
        return 1.0 - np.sqrt(np.diag(self.covariance))


def verdicts(space: ParameterSpace, evidence: Evidence) -> tuple[ParameterResult, ...]:
    """One line per parameter, with a verdict and its reasons in words."""
    return tuple(_parameter(space, evidence, i) for i in range(len(space)))


def _parameter(space: ParameterSpace, evidence: Evidence, i: int) -> ParameterResult:
    p = space.parameters[i]
    sd = float(np.sqrt(evidence.covariance[i, i]))
    estimate = float(space.theta_of(evidence.z)[i])
    low, high = interval(space, evidence.z, sd, i)
    if evidence.draws is not None:
        low, high = map(float, np.quantile(space.theta_of(evidence.draws)[:, i], (0.05, 0.95)))
    verdict, reasons = _verdict(space, evidence, i)
    slope = (estimate if p.log else 1.0) * p.prior_sd
    return ParameterResult(
        name=p.name,
        unit=p.unit,
        estimate=estimate,
        prior=p.nominal,
        prior_sd=(p.nominal if p.log else 1.0) * p.prior_sd,
        sd=sd * slope,
        lower=low,
        upper=high,
        bounds=(p.lower, p.upper),
        shrinkage=1.0 - sd,
        verdict=verdict,
        reasons=reasons,
        step_ratio=float(evidence.step_ratio[i]),
        bootstrap_sd=float(evidence.bootstrap[i]) * slope,
        profile=evidence.profiles.get(i),
    )


def interval(space: ParameterSpace, z: FloatArray, sd: float, i: int) -> tuple[float, float]:
    """90 % interval of a parameter whose z has this sd, within its bounds."""
    p = space.parameters[i]
    ends = []
    for side in (-1.0, 1.0):
        moved = np.array(z)
        moved[i] += side * Z90 * sd
        ends.append(float(np.clip(space.theta_of(moved)[i], p.lower, p.upper)))
    return ends[0], ends[1]


def _verdict(space: ParameterSpace, evidence: Evidence, i: int) -> tuple[str, tuple[str, ...]]:
    """The first rule that gives a reason, and else 'identified'."""
    for verdict, rule in RULES:
        if reasons := rule(space, evidence, i):
            return verdict, (*reasons, *_bound(space, evidence, i))
    return "identified", (*_bound(space, evidence, i), *_remarks(space, evidence, i))


def _unfelt(space: ParameterSpace, evidence: Evidence, i: int) -> tuple[str, ...]:
    if evidence.active[i]:
        return ()
    return (f"{evidence.idle[space.names[i]]}: not identifiable, held at its prior",)


def _strayed(space: ParameterSpace, evidence: Evidence, i: int) -> tuple[str, ...]:
    away = abs(evidence.z[i])
    if evidence.shrinkage[i] >= NOTHING or away <= ASTRAY:
        return ()
    text = f"it is {away:.1f} prior sd from its prior although the logs hardly determine it"
    return (text, *_wider(evidence, i))


def _rivalled(space: ParameterSpace, evidence: Evidence, i: int) -> tuple[str, ...]:
    rival = evidence.rival
    if rival is None or not rival.differs[i]:
        return ()
    p, cost = space.parameters[i], " against ".join(f"{cost:.3g}" for cost in reversed(rival.costs))
    value = f"{space.theta_of(rival.z)[i]:.3g} {p.unit}".strip()
    return (f"another minimum explains the logs too: {value} (cost {cost} here)",)


def _open(space: ParameterSpace, evidence: Evidence, i: int) -> tuple[str, ...]:
    if evidence.shrinkage[i] >= NOTHING:
        return ()
    away = abs(evidence.z[i])
    value = "the value is your prior" if away <= PRIOR else f"it is {away:.1f} prior sd from your prior"
    return _wider(evidence, i) or (f"the logs hardly narrow it down: {value}",)


def _unexplained(space: ParameterSpace, evidence: Evidence, i: int) -> tuple[str, ...]:
    return (*evidence.unexplained, *evidence.blamed.get(space.names[i], ()))


def _jagged(space: ParameterSpace, evidence: Evidence, i: int) -> tuple[str, ...]:
    """The sd itself is rough, because the response is no straight line over the width of the samples."""
    ratio = evidence.step_ratio[i]
    if not np.isfinite(ratio) or LINEAR[0] <= ratio <= LINEAR[1]:
        return ()
    changes = f"its sd changes {1.0 / ratio:.2f}x when the step is doubled"
    if evidence.rough:
        return (
            f"the response is jagged ({changes}): the value hangs on details of contact; the sd is rough",
        )
    return (f"the response bends within the interval ({changes}): the sd is rough; more data narrow it",)


def _contradicted(space: ParameterSpace, evidence: Evidence, i: int) -> tuple[str, ...]:
    return _contradictions(space, evidence, i, NOTABLE, np.inf)


def _narrowed(space: ParameterSpace, evidence: Evidence, i: int) -> tuple[str, ...]:
    """What is assumed widens the interval, and is a remark; what the logs themselves leave open decides."""
    assumed = sum(float(shift.spread[i]) ** 2 for shift in evidence.shifts if shift.assumed)
    shrinkage = float(evidence.shrinkage[i])
    left = float(np.sqrt(max((1.0 - shrinkage) ** 2 - assumed, evidence.own_sd[i] ** 2)))
    if 1.0 - left >= DETERMINED and shrinkage >= HALVED:
        return ()
    return (*_remarks(space, evidence, i), f"the logs narrow the prior by {shrinkage:.0%} only")


#: Verdicts and the rules that give them, in their order; a rule that does not apply gives no reason. Where
#: none applies, the parameter is identified.
RULES: tuple[tuple[str, Callable[[ParameterSpace, Evidence, int], tuple[str, ...]]], ...] = (
    ("prior", _unfelt),
    ("weak", _rivalled),
    ("model-sensitive", _strayed),
    ("prior", _open),
    ("model-sensitive", _unexplained),
    ("model-sensitive", _jagged),
    ("model-sensitive", _contradicted),
    ("weak", _narrowed),
)


def _remarks(space: ParameterSpace, evidence: Evidence, i: int) -> tuple[str, ...]:
    """What the sd allows for, and with what a parameter is known together."""
    noted = map(_allowed, _contradictions(space, evidence, i, NOTED, NOTABLE))
    return (*_rests(space, evidence, i), *_partners(space, evidence, i), *noted, *_repeats(evidence, i))


def _allowed(text: str) -> str:
    """A remark on what is in the sd already; advice follows a semicolon."""
    what, semicolon, advice = text.partition(";")
    return f"{what}, which the sd allows for{semicolon}{advice}"


def _wider(evidence: Evidence, i: int) -> tuple[str, ...]:
    """The reason that applies where the sd came back wider than the prior's, with its largest cause."""
    sd = float(np.sqrt(evidence.covariance[i, i]))
    if sd <= WIDER or not evidence.causes:
        return ()
    cause = max(evidence.causes, key=lambda name: evidence.causes[name][i])
    return (f"its sd is {sd:.1f} times the prior's, which is too narrow for these logs: {cause}",)


def _repeats(evidence: Evidence, i: int) -> tuple[str, ...]:
    """The reason that applies where the model's own errors, not noise, limit what is known."""
    if evidence.repeats[i] < REPEATED:
        return ()
    return (
        f"residuals repeat from sample to sample, as errors of the model do: the sd is "
        f"{evidence.repeats[i]:.1f} times that of noise, and more data of this kind will not narrow it",
    )


def _bound(space: ParameterSpace, evidence: Evidence, i: int) -> tuple[str, ...]:
    """The reason that applies where an estimate is at a bound: the bound decides it, not the data."""
    lower, upper = (b[i] for b in space.bounds)
    margin = min(0.01 * (upper - lower), 0.5 * float(np.sqrt(evidence.covariance[i, i])))
    p = space.parameters[i]
    if evidence.z[i] <= lower + margin:
        return (f"it stops at its lower bound {p.lower:g}: the data want less",)
    if evidence.z[i] >= upper - margin:
        return (f"it stops at its upper bound {p.upper:g}: the data want more",)
    return ()


def _contradictions(
    space: ParameterSpace, evidence: Evidence, i: int, least: float, most: float
) -> tuple[str, ...]:
    """Differences beyond chance between parts of the data, or models, of a size in [least, most)."""
    found = []  # with NOTED, of models all that widen
    sd = float(np.sqrt(evidence.covariance[i, i]))
    for name, difference in evidence.disagreements.items():
        value, repeated = difference.value[i], difference.share > 0.5
        moved = share(space, i, value)
        # what all logs show alike is an error of the model, however small
        counts = max(moved, NOTABLE) if repeated and moved >= NOTED else moved
        if abs(value) > SURPRISE * difference.sd[i] and least <= counts < most:
            again = ", again and again" if repeated else ""
            found.append(f"{name} disagree by {size(space, i, value)}{again}")
    found += [
        shift.text.format(size(space, i, shift.z[i]))
        for shift in evidence.shifts
        if not shift.assumed
        and abs(shift.spread[i]) > COUNTS * sd
        and (0.0 if least == NOTED else least) <= share(space, i, shift.z[i]) < most
    ]
    return tuple(found)


def _rests(space: ParameterSpace, evidence: Evidence, i: int) -> tuple[str, ...]:
    """Numbers taken as exact that the sd owes much to, the largest first."""
    least = COUNTS * float(np.sqrt(evidence.covariance[i, i]))
    found = [s for s in evidence.shifts if s.assumed and abs(s.spread[i]) > least]
    found.sort(key=lambda shift: -abs(shift.spread[i]))
    sizes = (size(space, i, s.spread[i]).lstrip("+-") for s in found)
    return tuple(_allowed(s.text.format(text)) for s, text in zip(found, sizes, strict=True))


def _partners(space: ParameterSpace, evidence: Evidence, i: int) -> tuple[str, ...]:
    matrix = correlation(evidence.covariance)
    return tuple(
        f"known mostly together with {space.names[j]} (correlation {matrix[i, j]:+.2f})"
        for j in range(len(space))
        if j != i and abs(matrix[i, j]) > TOGETHER
    )


def share(space: ParameterSpace, i: int, dz: float) -> float:
    """Size of a step in z: relative for log-scaled parameters, in prior sd for linear ones."""
    return abs(float(np.expm1(dz * space.prior_sd[i]))) if space.log[i] else abs(dz)


def size(space: ParameterSpace, i: int, dz: float) -> str:
    """A step in z in words: a percentage for log-scaled parameters, in the unit for linear ones."""
    p = space.parameters[i]
    if not p.log:
        return f"{dz * p.prior_sd:+.2g} {p.unit}"
    percent = 100.0 * np.expm1(dz * p.prior_sd)
    return f"{percent:+.0f}%" if abs(percent) >= 1.0 else f"{percent:+.1g}%"
