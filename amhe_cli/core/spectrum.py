"""Motion out of noisy positions: values, first and second derivatives, by a filter that the spectrum gives.

Positions are x + n: a motion with the spectrum S_x, and white noise, whose floor is what the spectrum levels
out at. The filter of least error is Wiener's, H = S_x / (S_x + S_n). It is symmetric in time, so that nothing
lags. What it misses of the motion is uncorrelated with what it returns, so that a regression on the result is
not pulled towards zero, as one on noisy values is; the error of a k-th derivative has the variance

    sigma^2 mean over frequencies of (2 pi f)^(2 k) H(f)

(Wiener 1949, "Extrapolation, Interpolation, and Smoothing of Stationary Time Series"; Berkson 1950, "Are
there two regressions?").
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amhe_cli.core.arrays import FloatArray, IntArray

#: Bins that a spectrum is averaged over, at least, and as a share of the frequency.
_BINS, _SHARE = 16, 0.1
#: Sd by which an averaged spectrum must exceed the floor to be motion.
_SURE = 6.0
#: Samples from which either end is taken, at least, and as a share of 1 / band.
_FEWEST, _BENT = 15, 2.0
#: Beyond the last of the motion, its spectrum falls with this power of the frequency.
_FALLS = 8
#: Parts of the upper half of all frequencies.
_PARTS = 4
#: The smallest noise that is told from rounding, as a share of the range of the values.
_ROUNDING = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class Smooth:
    """A smooth motion at n instants, and what is wrong with it.

    Args:
        values, first, second: The motion and its derivatives, shape (n, k).
        sd: Sd of the errors of each of these, shape (3, k).
        band: Frequency of each column above which the noise is larger than the motion, shape (k,) [Hz].
        noise: Noise sd of each column, shape (k,).
    """

    values: FloatArray
    first: FloatArray
    second: FloatArray
    sd: FloatArray
    band: FloatArray
    noise: FloatArray


def smooth(values: FloatArray, dt: float) -> Smooth:
    """Smooth evenly spaced positions, and differentiate them twice.

    Within about 1 / band of either end the second derivative is bent towards zero.

    Args:
        values: Positions, shape (n, k), n at least 8.
        dt: Time between two of them [s].
    """
    n = len(values)
    frequency: FloatArray = np.asarray(np.fft.rfftfreq(2 * n - 2, dt), dtype=np.float64)
    omega = 2.0 * np.pi * frequency[:, None]
    base = _between_ends(values, np.zeros(values.shape[1], dtype=np.int64), dt)
    for turn in range(2):
        away = values - base[0]
        # an odd motion that has no bend at its ends goes on smoothly beyond them
        spectrum = np.fft.rfft(np.concatenate((away, -away[-2:0:-1])), axis=0)
        power = np.abs(spectrum) ** 2 / (2 * n - 2)
        gain, band, floor = _wiener(power, frequency, np.ptp(values, axis=0))
        if turn == 0:
            reach = np.clip(_BENT / (band * dt), _FEWEST, n // 2).astype(np.int64)
            base = _between_ends(values, reach, dt)
    values, first, second = (
        base[k] + np.fft.irfft((1j * omega) ** k * gain * spectrum, 2 * n - 2, axis=0)[:n] for k in range(3)
    )
    sd = np.array([np.sqrt(floor * (omega ** (2 * k) * gain).mean(axis=0)) for k in range(3)])
    return Smooth(values, first, second, sd, band, np.sqrt(floor))


def _between_ends(values: FloatArray, reach: IntArray, dt: float) -> list[FloatArray]:
    """The cubic that has the values and second derivatives of both ends, and its derivatives, (n, k) each.

    Args:
        values: Positions, shape (n, k).
        reach: Samples of each column from which they are taken, shape (k,); 0 for no second derivative.
        dt: Time between two positions [s].
    """
    n, columns = len(values), []
    for column, some in zip(values.T, reach, strict=True):
        near = max(int(some), min(_FEWEST, n))
        both = np.stack((column[:near], column[: -near - 1 : -1]), axis=1)
        fitted = np.polynomial.polynomial.polyfit(np.arange(near) * dt, both, 3 if some else 2)
        columns.append([fitted[0], 2.0 * fitted[2] * (some > 0)])
    (x0, x1), (a0, a1) = np.moveaxis(np.array(columns), 0, -1)
    length = (n - 1) * dt
    t = np.arange(n)[:, None] * dt
    jerk = (a1 - a0) / length
    slope = (x1 - x0) / length - length * (a0 / 2.0 + (a1 - a0) / 6.0)
    return [
        x0 + t * (slope + t * (a0 / 2.0 + t * jerk / 6.0)),
        slope + t * (a0 + t * jerk / 2.0),
        a0 + t * jerk,
    ]


def _wiener(
    power: FloatArray, frequency: FloatArray, extent: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Gain (f, k), band (k,) and noise variance (k,) of columns with a spectrum (f, k)."""
    count, (mean, bins) = len(frequency), _averaged(power)
    # the quietest part of the upper half is noise at most
    floor = np.min([part.mean(axis=0) for part in np.array_split(power[count // 2 :], _PARTS)], axis=0)
    floor = np.maximum(floor, (_ROUNDING * extent) ** 2 + 1e-300)
    over, rows = mean / floor, np.arange(count)[:, None]
    moves = over > 1.0 + _SURE * np.sqrt(2.0 / bins)[:, None]  # the sd of a mean of white noise's bins
    last = np.maximum(count - 1 - np.argmax(moves[::-1], axis=0), 1)
    band = frequency[last]
    shape = np.maximum.accumulate(np.where(rows <= last, over, 1.0)[::-1], axis=0)[::-1]
    with np.errstate(divide="ignore", over="ignore"):
        tail = np.minimum((band / frequency[:, None]) ** _FALLS, 1e12)
    ratio = np.where(rows <= last, np.maximum(shape - 1.0, tail), tail)
    return ratio / (1.0 + ratio), band, floor


def _averaged(power: FloatArray) -> tuple[FloatArray, IntArray]:
    """A spectrum (f, k) averaged over neighbours, more of them at higher frequencies, and how many (f,)."""
    count = len(power)
    half = np.maximum(_BINS // 2, (_SHARE / 2 * np.arange(count)).astype(int))
    low, high = np.maximum(np.arange(count) - half, 0), np.minimum(np.arange(count) + half + 1, count)
    total = np.concatenate((np.zeros((1, power.shape[1])), np.cumsum(power, axis=0)))
    return (total[high] - total[low]) / (high - low)[:, None], high - low
