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

from amhe_cli.core.arrays import AnyArray, BoolArray, FloatArray, IntArray

#: Bins that a spectrum is averaged over, at least, and as a share of the frequency.
_BINS, _SHARE = 16, 0.1
#: Times by which an averaged spectrum must exceed the floor to be motion, and by how many of its sd: what is
#: hardly above the noise is noise that is not white, such as an encoder's steps.
_ABOVE, _SURE = 30.0, 6.0
#: Samples that first say what the ends are; then the spectrum above this times the band does, so often.
_NEAREST, _CLEAR, _TURNS = 15, 1.3, 4
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
        band: Frequency of each column above which the noise is larger than the motion, shape (k,) [Hz]; 0 of
            one that stands.
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
    cubics = _cubics(n, dt)
    of_cubics, whole = _spectrum(cubics[0]), _spectrum(values)
    first = np.concatenate((_ends(values), np.zeros((2, values.shape[1]))))  # in the order of the cubics
    ends, found, band, floor = first, values, frequency[-1:], np.zeros(values.shape[1])
    for turn in range(_TURNS):
        if turn:
            bend = np.sqrt((found**2).mean(axis=0))
            expected = np.stack((*2 * [2.0 * np.sqrt(floor)], *2 * [bend]))
            ends = first + _corrections(
                of_cubics, whole - of_cubics @ first, frequency > _CLEAR * band[:, None], floor * n, expected
            )
        spectrum = whole - of_cubics @ ends
        gain, band, floor = _wiener(np.abs(spectrum) ** 2 / (2 * n - 2), frequency, np.ptp(values, axis=0))
        smoothed, slopes, found = (
            cubics[k] @ ends + np.fft.irfft((1j * omega) ** k * gain * spectrum, 2 * n - 2, axis=0)[:n]
            for k in range(3)
        )
    sd = np.array([np.sqrt(floor * (omega ** (2 * k) * gain).mean(axis=0)) for k in range(3)])
    return Smooth(smoothed, slopes, found, sd, band, np.sqrt(floor))


def _spectrum(values: FloatArray) -> AnyArray:
    """Spectrum (f, k) of values (n, k) that go on beyond either end as odd functions of the time from there.

    What is zero there, and does not bend, has no step in it, and none in its first three derivatives.
    """
    return np.fft.rfft(np.concatenate((values, -values[-2:0:-1])), axis=0)


def _ends(values: FloatArray) -> FloatArray:
    """First and last value of parabolas through the nearest samples, shape (2, k)."""
    some = min(_NEAREST, len(values))
    both = np.concatenate((values[:some], values[: -some - 1 : -1]), axis=1)
    powers = np.vander(np.arange(some), 3, increasing=True)
    return np.linalg.lstsq(powers, both, rcond=None)[0][0].reshape(2, -1)


def _corrections(
    of_cubics: AnyArray, left: AnyArray, above: BoolArray, noise: FloatArray, expected: FloatArray
) -> FloatArray:
    """Multiples (4, k) of the cubics that leave least of a spectrum where there is no motion.

    Args:
        of_cubics: Spectrum of the cubics, shape (f, 4).
        left: Spectrum of what they shall explain, shape (f, k).
        above: Frequencies without motion of each column, shape (k, f).
        noise: Variance of the real and of the imaginary part of the noise's spectrum, shape (k,).
        expected: Sd of the multiples before, shape (4, k).
    """
    found = np.empty_like(expected)
    for k, some in enumerate(above):
        parts = (np.concatenate((one.real, one.imag)) for one in (of_cubics[some], left[some, k]))
        slopes, target = (one / np.sqrt(noise[k]) for one in parts)
        known = slopes.T @ slopes + np.diag(1.0 / np.maximum(expected[:, k], 1e-100) ** 2)
        found[:, k] = np.linalg.lstsq(known, slopes.T @ target, rcond=None)[0]
    return found


def _cubics(n: int, dt: float) -> FloatArray:
    """Cubics (3, n, 4), with their derivatives, of unit value or second derivative at one end, 0 elsewhere.

    A motion less the right sum of them is zero at both ends, and does not bend there. The right one leaves
    least above the band of the motion.
    """
    s, length = np.linspace(0.0, 1.0, n), (n - 1) * dt
    after = np.stack((s, (s**3 - s) / 6.0)), np.stack((np.ones(n), (3.0 * s**2 - 1.0) / 6.0))
    after = (*after, np.stack((np.zeros(n), s)))
    both = [
        np.stack((sign * one[0, ::-1], one[0], sign * length**2 * one[1, ::-1], length**2 * one[1]), axis=1)
        / length**k
        for k, (sign, one) in enumerate(zip((1, -1, 1), after, strict=True))
    ]
    return np.stack(both)


def _wiener(
    power: FloatArray, frequency: FloatArray, extent: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Gain (f, k), band (k,) and noise variance (k,) of columns with a spectrum (f, k)."""
    count, (mean, bins) = len(frequency), _averaged(power)
    # the quietest part of the upper half is noise at most
    floor = np.min([part.mean(axis=0) for part in np.array_split(power[count // 2 :], _PARTS)], axis=0)
    floor = np.maximum(floor, (_ROUNDING * extent) ** 2 + 1e-300)
    over, rows = mean / floor, np.arange(count)[:, None]
    moves = over > np.maximum(_ABOVE, 1.0 + _SURE * np.sqrt(2.0 / bins)[:, None])  # the sd of such a mean
    moves[1] = True  # what stands moves in no frequency at all
    last = count - 1 - np.argmax(moves[::-1], axis=0)
    band = frequency[last]
    shape = np.maximum.accumulate(np.where(rows <= last, over, 1.0)[::-1], axis=0)[::-1]
    with np.errstate(divide="ignore", over="ignore"):
        tail = np.minimum((band / frequency[:, None]) ** _FALLS, 1e12)
    ratio = np.where(rows <= last, np.maximum(shape - 1.0, tail), tail)
    return ratio / (1.0 + ratio), np.where(last > 1, band, 0.0), floor


def _averaged(power: FloatArray) -> tuple[FloatArray, IntArray]:
    """A spectrum (f, k) averaged over neighbours, more of them at higher frequencies, and how many (f,)."""
    count = len(power)
    half = np.maximum(_BINS // 2, (_SHARE / 2 * np.arange(count)).astype(int))
    low, high = np.maximum(np.arange(count) - half, 0), np.minimum(np.arange(count) + half + 1, count)
    total = np.concatenate((np.zeros((1, power.shape[1])), np.cumsum(power, axis=0)))
    return (total[high] - total[low]) / (high - low)[:, None], high - low
