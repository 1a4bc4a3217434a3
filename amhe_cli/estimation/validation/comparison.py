"""Which of several models predicts better what was not fitted? Paired errors on the same held-out clips.

Each model has an error on each clip and horizon. Models are paired clip by clip, and a bootstrap over clips
gives the interval of the ratio of their errors: what is hard for all models does not count as noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from amhe_cli.estimation.core.result import AtHorizon, Identification
from amhe_cli.estimation.validation.horizon import ClipErrors

#: Resamples of the clips, ends of the interval, and the fewest clips that can tell.
RESAMPLES, ENDS, FEWEST = 2000, (2.5, 97.5), 4
#: One over degrees of freedom, and by how much Student's 95 % interval is wider than a normal one.
STUDENT = (0.0, 1 / 20, 1 / 10, 1 / 5, 1 / 3), (1.0, 1.064, 1.137, 1.312, 1.624)
#: A diverged prediction counts as one that is off by so many times the usual error.
_DIVERGED = 100.0


@dataclass(frozen=True, slots=True, eq=False)
class Compared:
    """What the errors of several models say.

    Args:
        names: Names of the models.
        found: What was identified of each.
        horizons: Their errors at each horizon.
        best: Index of the model that predicts best.
        verdicts: What the logs say of it against each other model, in words.
    """

    names: tuple[str, ...]
    found: tuple[Identification, ...]
    horizons: tuple[AtHorizon, ...]
    best: int
    verdicts: tuple[str, ...]


def at_horizon(
    horizon: float, to_end: bool, found: Sequence[Sequence[ClipErrors]], rng: np.random.Generator
) -> AtHorizon:
    """Compare the errors of each system, those of the joints and poses that all of them predict.

    Args:
        horizon, to_end: See `AtHorizon`.
        found: Errors of each system on the same clips; the first candidate's count.
        rng: Generator of the resamples.
    """
    by_name = [{(one.channel, one.column, one.unit): one.errors[0] for one in each} for each in found]
    common = [key for key in by_name[0] if all(key in each for each in by_name)]
    errors = np.array([[each[key] for key in common] for each in by_name])
    errors = errors.reshape(len(found), len(common), -1 if common else 0)  # (m, k, c)
    known = ~np.isnan(errors).any(axis=(0, 1))
    errors = errors[:, :, known]
    finite = np.isfinite(errors)
    total = np.sum(np.where(finite, errors, 0.0) ** 2, axis=(0, 2), keepdims=True)
    usual = np.sqrt(total / np.maximum(finite.sum(axis=(0, 2), keepdims=True), 1))
    squares = np.minimum(errors / np.maximum(usual, 1e-300), _DIVERGED) ** 2
    squares = squares.sum(axis=1) / max(len(common), 1)  # (m, c)
    clips = squares.shape[1]
    picks = rng.integers(0, max(clips, 1), (RESAMPLES, clips))
    with np.errstate(invalid="ignore"):  # without clips all is NaN
        means = squares[:, picks].sum(axis=-1) / clips  # (m, resamples)
        ratios = np.sqrt(means[:, None] / means[None])
        whole = squares.sum(axis=1) / clips
        rms = np.sqrt((errors**2).sum(axis=-1) / clips)  # (m, k)
    ends = np.percentile(ratios, ENDS, axis=-1)
    if clips < FEWEST:
        ends[:] = np.nan
    else:  # a bootstrap over few clips is too narrow, as a normal interval is against Student's
        wider = np.sqrt(clips / (clips - 1.0)) * np.interp(1.0 / (clips - 1.0), *STUDENT)
        centre = np.sqrt(whole[:, None] / whole[None])
        ends = centre * (ends / centre) ** wider
    return AtHorizon(
        horizon=horizon,
        to_end=to_end,
        clips=clips,
        errors={(column or channel, unit): rms[:, i] for i, (channel, column, unit) in enumerate(common)},
        ratios=np.sqrt(whole[:, None] / whole[None]),
        lower=ends[0],
        upper=ends[1],
    )


def best_of(found: Sequence[AtHorizon]) -> int:
    """The system whose errors are smallest, in the mean of their logarithms over the horizons."""
    telling = (
        [one for one in found if one.clips >= FEWEST] or [one for one in found if one.clips] or list(found)
    )
    return int(np.mean([np.log(one.ratios).mean(axis=1) for one in telling], axis=0).argmin())


def simplest_of(found: Sequence[AtHorizon], sizes: Sequence[int]) -> int:
    """The smallest model that is within one standard error of the best.

    The standard error is that of the paired difference, in the mean over the horizons, from the interval of
    the bootstrap.

    Args:
        found: Errors at each horizon.
        sizes: Number of parameters of each model.
    """
    best, telling = best_of(found), [one for one in found if one.clips >= FEWEST]
    within = np.zeros(len(sizes), dtype=bool)
    within[best] = True
    if telling:
        worse = np.mean([np.log(one.ratios[:, best]) for one in telling], axis=0)
        width = np.mean([np.log(one.upper[:, best] / one.lower[:, best]) for one in telling], axis=0)
        within |= worse <= width / (2.0 * 1.96)
    return min(map(int, np.flatnonzero(within)), key=lambda i: (sizes[i], i != best))


def improves(found: Sequence[AtHorizon], one: int, other: int) -> bool:
    """Whether a system predicts better than another by more than chance, and nowhere worse.

    It is one test over the horizons together, since each more would be one more chance to err.
    The mean of the logarithms of its ratios, each with weight 1 / sd^2, must be below 0 by as many sd as an
    interval is wide. The horizons look at the same clips: their errors are taken to go up and down together.
    """
    telling = [at for at in found if at.clips >= FEWEST and np.isfinite(at.upper[one, other])]
    if not telling or any(at.better(other, one) for at in found):
        return False
    logs, upper = (np.log([each[one, other] for each in arrays]) for arrays in (
        [at.ratios for at in telling], [at.upper for at in telling]
    ))  # fmt: skip
    width = np.maximum(upper - logs, 1e-12)
    return bool((upper / width**2).sum() < 0.0)


def verdict(found: Sequence[AtHorizon], names: Sequence[str], best: int, other: int) -> str:
    """What the logs say of the best system against another one, in words."""
    one, two = names[best], names[other]
    wins = [at for at in found if at.better(best, other)]
    losses = [at for at in found if at.better(other, best)]
    if improves(found, best, other):
        telling = wins or [at for at in found if at.clips >= FEWEST]
        sizes = _listed([f"{1.0 - at.ratios[best, other]:.0%} after {at.horizon:.3g} s" for at in telling])
        return f"{one} predicts better than {two}: its error is smaller by {sizes}"
    if wins and not losses:
        times = _listed([f"{at.horizon:.3g} s" for at in wins])
        return f"{one} predicts better than {two} after {times}, but not over all horizons together"
    if wins:
        times = _listed([f"{at.horizon:.3g} s" for at in wins])
        worse = _listed([f"{at.horizon:.3g} s" for at in losses])
        return f"{one} predicts better than {two} after {times}, and worse after {worse}"
    if losses:
        sizes = _listed([f"{1.0 - at.ratios[other, best]:.0%} after {at.horizon:.3g} s" for at in losses])
        return f"{two} predicts better than {one}: its error is smaller by {sizes}"
    if all(at.clips < FEWEST for at in found):
        return f"the logs cannot tell {one} from {two}: fewer than {FEWEST} clips were held out"
    return f"the logs cannot tell {one} from {two}: their errors differ by no more than chance"


def _listed(parts: Sequence[str]) -> str:
    return parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} and {parts[-1]}"
