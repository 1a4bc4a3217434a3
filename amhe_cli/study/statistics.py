"""Statistics over seeds: spreads, bootstrap intervals of means and paired differences, Wilson intervals."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass

import numpy as np

from amhe_cli.core.arrays import FloatArray

#: Resamples of a bootstrap.
RESAMPLES = 10_000
#: 97.5 % point of the normal distribution.
_Z95 = 1.959963984540054


@dataclass(frozen=True, slots=True)
class Spread:
    """Distribution of values over seeds; NaN where there are too few.

    Args:
        n: Number of values.
        mean: Mean of the values; of a rate, the share.
        sd: Standard deviation of the values (n - 1).
        median: Median of the values.
        low, high: 95 % interval of the mean.
    """

    n: int
    mean: float
    sd: float
    median: float
    low: float
    high: float

    @property
    def numbers(self) -> dict[str, float]:
        """All but n, by name."""
        return {name: value for name, value in asdict(self).items() if name != "n"}


def spread(values: FloatArray, rng: np.random.Generator) -> Spread:
    """Spread of a measure, shape (n,); NaN values do not count. The interval is that of the bootstrap."""
    values = values[np.isfinite(values)]
    low, high = bootstrap(values[:, None], lambda x: x[..., 0].mean(axis=-1), rng)
    return _spread(values, low, high)


def rate(values: FloatArray) -> Spread:
    """Rate of a yes or no, shape (n,) of 0 and 1, with Wilson's interval."""
    return _spread(values, *wilson(int(values.sum()), values.size))


def _spread(values: FloatArray, low: float, high: float) -> Spread:
    if not values.size:
        return Spread(0, *[float("nan")] * 5)
    sd = float(values.std(ddof=1)) if values.size > 1 else float("nan")
    return Spread(values.size, float(values.mean()), sd, float(np.median(values)), low, high)


@dataclass(frozen=True, slots=True)
class Difference:
    """One mode against another on the same seeds.

    Args:
        n: Number of seeds that both have.
        mean, low, high: Mean of the paired differences, with its 95 % interval.
        ratio, ratio_low, ratio_high: Ratio of the means minus one, with its interval: 0.05 is five percent
            more.
    """

    n: int
    mean: float
    low: float
    high: float
    ratio: float
    ratio_low: float
    ratio_high: float


def paired(values: FloatArray, reference: FloatArray, rng: np.random.Generator) -> Difference:
    """How `values` (n,) differ from `reference` (n,), pair by pair; NaN in either drops the pair."""
    pairs = np.stack((values, reference), axis=1)
    pairs = pairs[np.isfinite(pairs).all(axis=1)]
    if not len(pairs):
        return Difference(0, *[float("nan")] * 6)

    def difference(x: FloatArray) -> FloatArray:
        return (x[..., 0] - x[..., 1]).mean(axis=-1)

    def ratio(x: FloatArray) -> FloatArray:
        with np.errstate(divide="ignore", invalid="ignore"):
            return x[..., 0].mean(axis=-1) / x[..., 1].mean(axis=-1) - 1.0

    return Difference(
        len(pairs),
        float(difference(pairs)), *bootstrap(pairs, difference, rng),
        float(ratio(pairs)), *bootstrap(pairs, ratio, rng),
    )  # fmt: skip


def bootstrap(
    rows: FloatArray, statistic: Callable[[FloatArray], FloatArray], rng: np.random.Generator
) -> tuple[float, float]:
    """95 % percentile interval, widened by sqrt(n / (n - 1)) since few rows make it too narrow.

    Hesterberg, What Teachers Should Know About the Bootstrap (2015), section 4.

    Args:
        rows: Independent rows, shape (n, k); fewer than two have no interval.
        statistic: Takes resamples (r, n, k) to an array (r,), and rows (n, k) to a number.
        rng: Random generator of the resampling.
    """
    n = len(rows)
    if n < 2:
        return float("nan"), float("nan")
    resampled = statistic(rows[rng.integers(n, size=(RESAMPLES, n))])
    centre, wider = float(statistic(rows)), np.sqrt(n / (n - 1))
    low, high = centre + wider * (np.quantile(resampled, (0.025, 0.975)) - centre)
    return float(low), float(high)


def wilson(successes: int, n: int) -> tuple[float, float]:
    """95 % interval of a rate by Wilson's score; it stays within 0 and 1, and is right at both ends."""
    if not n:
        return float("nan"), float("nan")
    share, z2 = successes / n, _Z95**2
    centre = (share + z2 / (2 * n)) / (1 + z2 / n)
    half = _Z95 * np.sqrt(share * (1 - share) / n + z2 / (4 * n * n)) / (1 + z2 / n)
    return max(0.0, float(centre - half)), min(1.0, float(centre + half))
