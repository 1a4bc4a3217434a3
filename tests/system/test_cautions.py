"""Contact traps that make a parameter look unidentifiable are reported when a system is loaded."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from amhe_cli.system.system import System

MODEL = """
<mujoco>
  {option}
  <worldbody>
    <geom name="floor" type="plane" size="5 5 1" friction="1 0.005 0.0001"/>
    <body name="box" pos="0 0 0.1">
      <freejoint/><geom name="box" type="box" size="0.1 0.1 0.1" friction="0.5 0.005 0.0001" {box}/>
    </body>
  </worldbody>
  {pair}
</mujoco>
"""
SIGNALS = "signals: {b: {topic: /b, body: box, noise: {position: 0.01}}}\n"


@pytest.fixture
def warnings_of(written: Callable[..., Path], caplog) -> Callable[..., str]:
    """What is warned of one target."""

    def load(target: str, keys: str = "", box: str = "", pair: str = "", option: str = "") -> str:
        model = MODEL.format(box=box, pair=pair, option=option)
        text = f"  p: {{targets: [{target}]{keys}}}\n"
        System.load(written(text, signals=SIGNALS, model=model, more=""))
        return caplog.text

    return load


PAIR = '<contact><pair name="slide" geom1="box" geom2="floor" condim="{}"/></contact>'
FRICTION = "{geom: box, set: sliding_friction}"


def test_the_larger_friction_of_two_geoms_hides_the_smaller(warnings_of) -> None:
    assert "below 1 it changes nothing against geom 'floor'" in warnings_of(FRICTION)


def test_not_when_both_are_set_together(warnings_of) -> None:
    both = f"{FRICTION}, {{geom: floor, set: sliding_friction}}"
    assert warnings_of(both, ", nominal: 0.5") == ""


def test_not_when_the_geom_has_priority(warnings_of) -> None:
    assert warnings_of(FRICTION, box='priority="1"') == ""


def test_priority_of_the_other_geom_decides(warnings_of) -> None:
    assert "whose higher priority decides" in warnings_of(
        "{geom: floor, set: sliding_friction}", box='priority="1"'
    )


def test_not_when_the_bounds_stay_above_the_other_geom(warnings_of) -> None:
    assert warnings_of(FRICTION, ", nominal: 2, bounds: [1.5, 3]") == ""


def test_a_geom_that_only_collides_in_pairs_ignores_its_own_friction(warnings_of) -> None:
    text = warnings_of(FRICTION, box='contype="0" conaffinity="0"', pair=PAIR.format(3))
    assert "target the pair" in text


def test_torsional_friction_needs_a_larger_contact_dimension(warnings_of) -> None:
    text = warnings_of("{pair: slide, set: torsional_friction}", pair=PAIR.format(3))
    assert "pair 'slide' has condim 3; torsional friction acts from condim 4" in text
    assert "rolling friction acts from condim 6" in warnings_of("{geom: box, set: rolling_friction}")


def test_enough_contact_dimension_is_quiet(warnings_of) -> None:
    assert warnings_of("{pair: slide, set: torsional_friction}", pair=PAIR.format(4)) == ""


def test_a_time_constant_below_two_steps_is_not_what_is_simulated(warnings_of) -> None:
    text = warnings_of("{geom: box, set: contact_time_constant}", ", bounds: [0.001, 0.1]")
    assert "below two time steps, 0.004 s, acts as 0.004 s" in text


SPARSE = '<option jacobian="sparse" {}/>'


@pytest.mark.parametrize(
    ("version", "option", "warned"),
    [
        ("4.0.0", SPARSE.format(""), True),
        ("4.0.0", "", False),
        ("4.0.0", SPARSE.format('solver="CG"'), False),
        ("4.0.1", SPARSE.format(""), False),
    ],
)
def test_the_sparse_newton_solver_of_mujoco_4_0_0_is_warned_of(
    warnings_of, monkeypatch, version: str, option: str, warned: bool
) -> None:
    monkeypatch.setattr("mujoco.__version__", version)
    text = warnings_of(FRICTION, ", nominal: 2, bounds: [1.5, 3]", option=option)
    assert ('<option jacobian="dense"/>' in text) == warned
    assert warned or text == ""


def test_a_nominal_that_is_far_from_the_models_own_number(warnings_of) -> None:
    """A friction of 0.005 that is given as a factor, too, is 200 times too small; a value near it is none."""
    torsional = ", ".join(
        f"{{geom: {geom}, set: torsional_friction, mode: scale}}" for geom in ("box", "floor")
    )
    solid = 'condim="4"'
    assert "starts at" not in warnings_of(torsional, ", nominal: 0.5", box=solid)
    assert "starts at 2.5e-05, where the model's own number is 0.005" in warnings_of(
        torsional, ", nominal: 0.005, bounds: [0.001, 0.01]", box=solid
    )
