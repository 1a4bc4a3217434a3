"""Verdicts: which parameters the logs determine and which they do not, with the reasons in words."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.parameters import ParameterSpace
from amhe_cli.core.statistics import Z90, correlation
from amhe_cli.estimation.offline.posterior import Disagreement
from amhe_cli.estimation.offline.result import Combination, ParameterResult

#: Shrinkage below which the data say nothing, and from which they determine.
NOTHING, DETERMINED = 0.3, 0.8
#: Residuals of this many times the declared noise make every number the model's.
MISSED = 5.0
#: Ratio of the sd to that at a doubled step that a linearisation may show.
LINEAR = (0.7, 1.4)
#: Disagreements beyond this many sd are no chance. They widen the sd; from NOTED, a share of the value,
#: they are reported, and from NOTABLE they make the number model-sensitive.
SURPRISE, NOTED, NOTABLE = 3.0, 0.05, 0.25
#: Correlation from which two parameters are known only together.
TOGETHER = 0.9
#: A shift is given as a reason where it is more than this share of the sd.
COUNTS = 0.5
#: Factor on the sd from which residuals that repeat are a reason.
REPEATED = 2.0
#: Smallest exponent of a combination: a smaller one rounds to 0.
EXPONENT = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class Shift:
    """Where the estimate would move if something that the model takes as exact were otherwise.

    Args:
        text: What moves it, in words; `{}` is the size of the move.
        z: The move, shape (d,) in z.
        spread: What of it counts as one standard deviation: a vector along which it adds its own covariance,
            shape (d,); 0 where chance explains the move.
    """

    text: str
    z: FloatArray
    spread: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """All that was measured about an estimate; vectors are (d,) in z unless said otherwise.

    Args:
        z: The estimate.
        covariance: Posterior covariance, shape (d, d).
        active: Parameters that the logs depend on.
        idle: Why the logs do not depend on the others, by name.
        step_ratio: Posterior sd over that at a doubled step.
        bootstrap: Spread over resampled clips.
        disagreements: Name of a comparison -> difference between two parts of the data.
        shifts: What changes of the model would do to the estimate.
        profiles: Column -> (theta values (K,), costs (K,)).
        noise_scale: Channel -> residual sd over declared noise sd.
        repeats: Factor by which residuals that repeat have widened the sd that noise alone gives.
    """

    z: FloatArray
    covariance: FloatArray
    active: np.ndarray
    idle: Mapping[str, str]
    step_ratio: FloatArray
    bootstrap: FloatArray
    disagreements: Mapping[str, Disagreement]
    shifts: Sequence[Shift]
    profiles: Mapping[int, tuple[FloatArray, FloatArray]]
    noise_scale: Mapping[str, float]
    repeats: FloatArray


def verdicts(space: ParameterSpace, evidence: Evidence) -> tuple[ParameterResult, ...]:
    """One line per parameter, with a verdict and its reasons in words."""
    return tuple(_parameter(space, evidence, i) for i in range(len(space)))


def _parameter(space: ParameterSpace, evidence: Evidence, i: int) -> ParameterResult:
    p = space.parameters[i]
    sd = float(np.sqrt(evidence.covariance[i, i]))
    estimate = float(space.theta_of(evidence.z)[i])
    low, high = _interval(space, evidence.z, sd, i)
    verdict, reasons = _verdict(space, evidence, i, 1.0 - sd)
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


def _interval(space: ParameterSpace, z: FloatArray, sd: float, i: int) -> tuple[float, float]:
    p = space.parameters[i]
    ends = []
    for side in (-1.0, 1.0):
        moved = np.array(z)
        moved[i] += side * Z90 * sd
        ends.append(float(np.clip(space.theta_of(moved)[i], p.lower, p.upper)))
    return ends[0], ends[1]


def _verdict(
    space: ParameterSpace, evidence: Evidence, i: int, shrinkage: float
) -> tuple[str, tuple[str, ...]]:
    if not evidence.active[i]:
        return "prior", (f"{evidence.idle[space.names[i]]}: not identifiable, held at its prior",)
    if shrinkage < NOTHING and abs(evidence.z[i]) > 1.0:
        away = f"it is {abs(evidence.z[i]):.1f} prior sd from its prior although the logs hardly determine it"
        return "model-sensitive", (away, *_bound(space, evidence, i))
    if shrinkage < NOTHING:
        return "prior", (
            "the logs hardly narrow it down: the value is your prior",
            *_bound(space, evidence, i),
        )
    sensitive = _sensitivities(space, evidence, i)
    if sensitive:
        return "model-sensitive", (*sensitive, *_bound(space, evidence, i))
    allowed = _contradictions(space, evidence, i, NOTED, NOTABLE)
    reasons = (
        *_bound(space, evidence, i),
        *_partners(space, evidence, i),
        *(f"{text}, which the sd allows for" for text in allowed),
        *_repeats(evidence, i),
    )
    if shrinkage < DETERMINED:
        return "weak", (*reasons, f"the logs narrow the prior by {shrinkage:.0%} only")
    return "identified", reasons


def _repeats(evidence: Evidence, i: int) -> tuple[str, ...]:
    """The reason that applies where the model's own errors, not noise, limit what is known."""
    if evidence.repeats[i] < REPEATED:
        return ()
    return (
        f"residuals repeat from sample to sample, which noise does not: the sd is {evidence.repeats[i]:.1f} "
        f"times that of noise, since more data of this kind averages no error of the model away",
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


def _sensitivities(space: ParameterSpace, evidence: Evidence, i: int) -> tuple[str, ...]:
    """Reasons to distrust the number although the data narrow it down."""
    ratio = evidence.step_ratio[i]
    jagged = (
        f"the response is jagged (its sd changes {1.0 / ratio:.2f}x when the step is doubled): the value "
        f"hangs on details that the model gets wrong; the sd is rough"
    )
    rough = np.isfinite(ratio) and not LINEAR[0] <= ratio <= LINEAR[1]
    worst = max(evidence.noise_scale, key=lambda key: evidence.noise_scale[key], default="")
    missed = (
        f"the model misses {worst} by {evidence.noise_scale[worst]:.0f} times its noise"
        if worst and evidence.noise_scale[worst] > MISSED
        else ""
    )
    found = ([missed] if missed else []) + ([jagged] if rough else [])
    return (*found, *_contradictions(space, evidence, i, NOTABLE, np.inf))


def _contradictions(
    space: ParameterSpace, evidence: Evidence, i: int, least: float, most: float
) -> tuple[str, ...]:
    """Differences beyond chance between parts of the data, or models, of a size in [least, most)."""
    found = []
    sd = float(np.sqrt(evidence.covariance[i, i]))
    for name, difference in evidence.disagreements.items():
        value = difference.value[i]
        if abs(value) > SURPRISE * difference.sd[i] and least <= share(space, i, value) < most:
            found.append(f"{name} disagree by {size(space, i, value)}")
    found += [
        shift.text.format(size(space, i, shift.z[i]))
        for shift in evidence.shifts
        if abs(shift.spread[i]) > COUNTS * sd and least <= share(space, i, shift.z[i]) < most
    ]
    return tuple(found)


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
    return f"{np.expm1(dz * p.prior_sd):+.0%}" if p.log else f"{dz * p.prior_sd:+.2g} {p.unit}"


def combinations(
    space: ParameterSpace, covariance: FloatArray, active: np.ndarray
) -> tuple[Combination, ...]:
    """Products of log-scaled parameters that are known much better, or worse, than each alone.

    For every strongly correlated pair, the eigenvectors of its covariance in log(theta): the sharp one is
    what the data determine, the blunt one what they leave open.
    """
    matrix = correlation(covariance)
    phi = covariance * np.outer(space.prior_sd, space.prior_sd)
    found = []
    for i in range(len(space)):
        for j in range(i + 1, len(space)):
            together = active[i] and active[j] and abs(matrix[i, j]) > TOGETHER
            if together and space.log[i] and space.log[j]:
                found += _pair(space, phi, (i, j))
    return tuple(found)


def _pair(space: ParameterSpace, phi: FloatArray, pair: tuple[int, int]) -> list[Combination]:
    block = phi[np.ix_(pair, pair)]
    values, vectors = np.linalg.eigh(block)
    result = []
    for value, vector in zip(values, vectors.T, strict=True):
        powers = vector / vector[np.argmax(np.abs(vector))]
        prior = np.sqrt(((powers * space.prior_sd[list(pair)]) ** 2).sum())
        sd = float(np.sqrt(value) * np.linalg.norm(powers))
        if np.abs(powers).min() >= EXPONENT:
            text = _product([space.names[i] for i in pair], powers)
            result.append(Combination(text, sd, 1.0 - sd / float(prior)))
    return result


def _product(names: Sequence[str], powers: FloatArray) -> str:
    """'mass * friction^0.9', 'gain / mass'."""
    factors = sorted(zip(map(float, powers), names, strict=True), reverse=True)
    text = _power(factors[0][1], factors[0][0])
    for power, name in factors[1:]:
        text += f" {'*' if power > 0.0 else '/'} {_power(name, abs(power))}"
    return text


def _power(name: str, power: float) -> str:
    return name if abs(power - 1.0) < 0.05 else f"{name}^{power:.1f}"


def profiles(
    space: ParameterSpace,
    cost: Callable[[FloatArray], FloatArray],
    z: FloatArray,
    sd: FloatArray,
    active: np.ndarray,
    points: int,
) -> dict[int, tuple[FloatArray, FloatArray]]:
    """Cost along each active parameter through the estimate, the others held.

    Args:
        cost: Costs (p,) of candidates (p, d).
        sd: Posterior sd of z: the profile reaches 4 of them, at least 0.3 prior sd, to either side.
        points: Points of each profile.
    """
    columns = np.flatnonzero(active)
    if points < 3 or not columns.size:
        return {}
    reach = np.maximum(4.0 * sd, 0.3)
    candidates = np.repeat(z[None], columns.size * points, axis=0).reshape(columns.size, points, -1)
    for row, i in enumerate(columns):
        lower, upper = (b[i] for b in space.bounds)
        candidates[row, :, i] = np.linspace(max(lower, z[i] - reach[i]), min(upper, z[i] + reach[i]), points)
    costs = cost(candidates.reshape(-1, z.size)).reshape(columns.size, points)
    theta = space.theta_of(candidates)
    return {int(i): (theta[row, :, i], costs[row]) for row, i in enumerate(columns)}
