"""The series of a log from arrays: checked, given missing velocities, and brought onto the model's clock."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from amhe_cli.core import rotations
from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.corrections import cleaned, corrected
from amhe_cli.core.errors import LogError, one_of
from amhe_cli.core.resample import common_rows, differentiated, longest_bridge, resample, too_many
from amhe_cli.core.signals import DERIVED, Measured, Series, Signal

logger = logging.getLogger(__name__)

#: Quaternions may be off the unit norm by this much.
_NORM = 0.05


def series_of(
    arrays: Mapping[str, Mapping[str, ArrayLike]], system: Measured, name: str
) -> tuple[dict[str, Series], int]:
    """The series of `Log.from_arrays`, and the stamp of row 0 [ns]."""
    signals = {signal.name: signal for signal in system.signals}
    for key in arrays:
        if key not in signals:
            raise LogError(f"{name}: {one_of('signal', str(key), signals)}")
    missing = [key for key in signals if key not in arrays]
    if missing:
        raise LogError(f"{name}: the system {system.name!r} needs the signal {' and '.join(missing)} too")
    stamps_ns = {key: _stamps(arrays[key], signal, name) for key, signal in signals.items()}
    step = system.dt * 1e9
    phase, begin, rows = common_rows([(stamps_ns[k], s.is_input) for k, s in signals.items()], step)
    if rows < 1:
        spans = ", ".join(f"{k} {t[0] / 1e9:g} to {t[-1] / 1e9:g} s" for k, t in stamps_ns.items())
        raise LogError(f"{name}: the signals do not overlap in time: {spans}")
    if why := too_many(rows, max(stamps.size for stamps in stamps_ns.values()), system.dt):
        raise LogError(f"{name}: {why}: time must be in seconds")
    start_ns = phase + round(begin)
    grid = np.arange(rows, dtype=np.float64) * system.dt
    series: dict[str, Series] = {}
    for key, signal in signals.items():
        times = (stamps_ns[key] - start_ns) / 1e9
        samples = _samples(arrays[key], signal, times.size, system.widths, name)
        for quantity in samples:
            samples[quantity], notes = cleaned(
                signal, quantity, samples[quantity], times, system.settings.logs
            )
            for note in notes:
                logger.warning("%s: signal %r: %s", name, key, note)
        columns = {quantity: _columns(signal, values.shape[1]) for quantity, values in samples.items()}
        series |= on_grid(grid, times, signal, samples, columns, system.settings.logs.max_gap)
    return corrected(series, system.signals, system.dt), start_ns


def on_grid(
    grid: FloatArray,
    times: FloatArray,
    signal: Signal,
    samples: Mapping[str, FloatArray],
    columns: Mapping[str, tuple[str, ...]],
    max_gap: float,
) -> dict[str, Series]:
    """Series of each quantity of a signal at the instants of a clock, velocities differentiated if need be.

    Args:
        grid: Instants of the clock [s], uniform, shape (T,).
        times: Times of the samples [s], strictly increasing, shape (n,).
        samples: Quantity -> samples in SI, shape (n, k), or those of what it is the derivative of.
        columns: Names of the columns of each.
        max_gap: Longest silence that is bridged [s].
    """
    bridge, series = longest_bridge(times, max_gap, signal.held), dict[str, Series]()
    for quantity in signal.quantities:
        source = quantity if quantity in samples else DERIVED[quantity]
        values, derived = samples[source], source != quantity
        series[signal.key(quantity)] = resample(
            times,
            differentiated(times, values, source, bridge) if derived else values,
            ("x", "y", "z") if derived and source == "orientation" else columns[source],
            grid,
            bridge=bridge,
            hold=signal.held,
            rotation=quantity == "orientation",
            derived=derived,
        )
    return series


def _stamps(given: Any, signal: Signal, name: str) -> np.ndarray:
    """Times of a signal in ns, with the signal's own offset."""
    where = f"{name}: signal {signal.name!r}"
    if not isinstance(given, Mapping) or "time" not in given:
        raise LogError(f"{where}: give a dictionary with `time` and {', '.join(signal.quantities)}")
    times = floats(given["time"], f"{where}: time")
    if times.ndim != 1 or times.size < (1 if signal.is_input else 2):
        raise LogError(f"{where}: time has the shape {times.shape}; it must be (n,), of two samples or more")
    check_times(times, where)
    stamps_ns = np.round((times + signal.offset) * 1e9)
    if np.abs(stamps_ns).max() >= 2.0**63:
        raise LogError(f"{where}: time reaches {np.abs(times).max():.3g} s: time must be in seconds")
    return stamps_ns.astype(np.int64)


def check_times(times: FloatArray, where: str) -> None:
    """Refuse times that are not finite or do not increase.

    Args:
        times: Times [s], shape (n,).
        where: What they are times of; begins the error.

    Raises:
        LogError: A time is wrong; the text names its row.
    """
    if not np.isfinite(times).all():
        raise LogError(f"{where}: time is not finite at row {int(np.argmin(np.isfinite(times)))}")
    backwards = np.flatnonzero(np.diff(times) <= 0.0)
    if backwards.size:
        row = int(backwards[0]) + 1
        step = f"from {times[row - 1]:g} to {times[row]:g} s"
        raise LogError(f"{where}: time must increase; at row {row} it goes {step}")


def _samples(
    given: Mapping[str, ArrayLike], signal: Signal, count: int, widths: Mapping[str, int], name: str
) -> dict[str, FloatArray]:
    """Quantity -> values (n, k), checked."""
    where = f"{name}: signal {signal.name!r}"
    quantities = dict.fromkeys((*signal.quantities, *(DERIVED[q] for q in signal.quantities if q in DERIVED)))
    samples: dict[str, FloatArray] = {}
    for quantity, array in given.items():
        if quantity == "time":
            continue
        if quantity not in quantities:
            raise LogError(f"{where}: {one_of('quantity', quantity, ('time', *quantities))}")
        values = floats(array, f"{where}: {quantity}")
        values = values[:, None] if values.ndim == 1 else values
        width = widths.get(signal.key(quantity)) or (4 if quantity == "orientation" else values.shape[-1])
        if values.shape != (count, width):
            wanted = f"({count}, {width})" if width > 1 else f"({count},) or ({count}, 1)"
            text = f"{quantity} has the shape {np.shape(array)}; it must be {wanted}"
            raise LogError(f"{where}: {text}, with a row for each time")
        if quantity == "orientation":
            values = unit_quaternions(values, where)
        samples[quantity] = values
    for quantity in signal.quantities:
        if quantity not in samples and DERIVED.get(quantity) not in samples:
            raise LogError(f"{where}: {quantity} is missing")
    return samples


def unit_quaternions(quaternions: FloatArray, where: str) -> FloatArray:
    """Quaternions, shape (n, 4), with the last deviations from the unit norm removed.

    Raises:
        LogError: One is far from the unit norm; the text begins with `where`.
    """
    norms = np.linalg.norm(quaternions, axis=1)
    wrong = np.flatnonzero(np.abs(norms - 1.0) > _NORM)
    if wrong.size:
        row = int(wrong[0])
        raise LogError(f"{where}: orientation is no unit quaternion at row {row}: {quaternions[row]}")
    return rotations.normalised(quaternions)


def floats(array: ArrayLike, what: str) -> FloatArray:
    """An array of numbers; NaN stands for a value that was not measured, and so does one that is masked.

    Raises:
        LogError: It is no array of real numbers, or infinite somewhere; the text begins with `what`.
    """
    try:
        given = array if np.ma.isMaskedArray(array) else np.asarray(array)
    except (TypeError, ValueError):  # rows of several lengths
        raise LogError(f"{what} is no array of numbers") from None
    if given.dtype.kind not in "fiub":
        raise LogError(f"{what} is no array of numbers but of {given.dtype}; give real ones, as of float64")
    values = np.ma.filled(given.astype(np.float64), np.nan)
    if np.isinf(values).any():
        raise LogError(f"{what} is infinite somewhere; write NaN where nothing was measured")
    return values


def _columns(signal: Signal, width: int) -> tuple[str, ...]:
    """Names of the columns, as a log file's would be."""
    if len(signal.names) == width:
        return signal.names
    return ("w", "x", "y", "z")[-width:] if width in (3, 4) else tuple(f"[{i}]" for i in range(width))
