import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from amhe_cli.report import numbers


@pytest.mark.parametrize(
    ("estimate", "sd", "text"),
    [
        (0.742137, 0.00412, "0.7421 ± 0.0041"),
        (0.5, 0.25, "0.50 ± 0.25"),
        (123.456, 12.3, "123 ± 12"),
        (1234.5, 456.0, "1230 ± 460"),
        (3.2e-9, 1.0e-10, "3.2e-09 ± 1e-10"),
        (1.0, float("nan"), "1 ± –"),
        (-0.001, 0.25, "0.00 ± 0.25"),
    ],
)
def test_an_estimate_has_the_digits_that_its_sd_leaves(estimate, sd, text) -> None:
    assert numbers.with_sd(estimate, sd) == text


@given(st.floats(1e-8, 1e8), st.floats(1e-8, 1e8))
def test_rounding_moves_a_value_by_less_than_its_resolution(value, resolution) -> None:
    shown = float(numbers.rounded(value, resolution))
    assert math.isclose(shown, value, rel_tol=1e-5) or abs(shown - value) <= resolution


@pytest.mark.parametrize(
    ("fraction", "text"), [(0.99, "99 %"), (0.0123, "1.2 %"), (0.0, "0 %"), (math.inf, "–")]
)
def test_percent(fraction, text) -> None:
    assert numbers.percent(fraction) == text


def test_long_lists_are_cut() -> None:
    assert numbers.some(list("abc")) == "a, b and c"
    assert numbers.some(list("abcdefg")) == "a, b, c, d, e, f and g"
    assert numbers.some(list("abcdefgh")) == "a, b, c, d, e, f and 2 more"


def test_units() -> None:
    assert numbers.length(0.0092) == "9.2 mm"
    assert numbers.length(math.nan) == "–"
    assert numbers.angle(math.pi / 2) == "90°"
    assert numbers.quantity("0.3", "-") == "0.3"
    assert numbers.quantity("0.3", "kg") == "0.3 kg"
