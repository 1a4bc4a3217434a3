"""Numbers for people: no more digits than are known, units that fit, no 'nan'."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from amhe_cli.core.errors import and_more

#: Names of a long list that are said.
MOST_NAMES = 6
#: Sizes below which numbers have an exponent, and below which, in their resolution, they are 0.
SMALL, NOTHING = 1e-3, 1e-6
#: Text for a missing number.
MISSING = "–"


def rounded(value: float, resolution: float, size: float | None = None) -> str:
    """`value` with as many decimals as show two digits of `resolution`, and never as 0 if it is not.

    Args:
        value: The number.
        resolution: What its last digits are worth.
        size: The largest of the numbers beside it; below 1e-3 they have exponents. None: it stands alone.
    """
    if not math.isfinite(value):
        return MISSING
    if not (math.isfinite(resolution) and resolution > 0.0):
        return f"{value:.4g}"
    if abs(value) < NOTHING * resolution:
        return "0"
    decimals = 1 - math.floor(math.log10(resolution))
    text = f"{round(value, decimals):.{max(decimals, 0)}f}"
    digits = decimals + math.floor(math.log10(abs(value)))  # behind the first
    if (abs(value) if size is None else size) < SMALL or not float(text):
        return f"{value:.{min(max(digits, 0), 5)}e}"
    return f"{value:.{min(1 + max(0, digits), 6)}g}" if abs(value) >= 1e6 or decimals > 8 else text


def with_sd(estimate: float, sd: float) -> str:
    """Estimate with sd: '0.7421 ± 0.0041'; what is none of the sd's digits is 0."""
    size = max(abs(estimate), sd)
    if abs(estimate) < 1e-3 * sd:
        estimate = 0.0
    return f"{rounded(estimate, sd, size)} ± {rounded(sd, sd, size)}"


def interval(lower: float, upper: float) -> str:
    """Interval: '0.735 to 0.749', with three digits of its width."""
    step, size = (upper - lower) / 4.0, max(abs(lower), abs(upper))
    return f"{rounded(lower, step, size)} to {rounded(upper, step, size)}"


def percent(fraction: float) -> str:
    """Percentage: '1.2 %', '95 %', '0.031 %'."""
    if not math.isfinite(fraction):
        return MISSING
    value = 100.0 * fraction
    return f"{value:.0f} %" if abs(value) >= 10.0 or value == 0.0 else f"{value:.2g} %"


def shrinkage(fraction: float) -> str:
    """A percentage that is never 100 %: no log determines a parameter exactly."""
    value = 100.0 * max(fraction, 0.0)
    return f"{min(value, 99.9):.1f} %" if value > 99.0 else percent(max(fraction, 0.0))


def unit_of(unit: str) -> str:
    """The unit to print after a number: nothing for '-'."""
    return "" if unit in ("-", "") else unit


def quantity(text: str, unit: str) -> str:
    """A number and its unit."""
    return f"{text} {unit_of(unit)}".rstrip()


def length(metres: float) -> str:
    """A small length in the unit that reads best."""
    if not math.isfinite(metres):
        return MISSING
    return f"{1e3 * metres:.3g} mm" if abs(metres) < 1.0 else f"{metres:.3g} m"


def angle(radians: float) -> str:
    """An angle in degrees."""
    return f"{math.degrees(radians):.3g}°" if math.isfinite(radians) else MISSING


def named(values: Mapping[str, float]) -> str:
    """Values by name: 'gain_scale 1, command_delay 0.012'."""
    return ", ".join(f"{name} {value:.4g}" for name, value in values.items())


def some(names: Sequence[str]) -> str:
    """List of the first few: 'a, b and 3 more', or 'a, b and c'."""
    return joined(names) if len(names) <= MOST_NAMES + 1 else and_more(names, MOST_NAMES)


def joined(names: Sequence[str]) -> str:
    """List in words: 'a, b and c'."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
