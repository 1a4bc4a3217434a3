from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml

from amhe_cli.core.belief import Belief, belief_for, belief_text
from amhe_cli.core.errors import ConfigError
from amhe_cli.core.parameters import Parameter, ParameterSpace
from tests.report.synthetic import NAMES, identification

SYSTEM: Any = SimpleNamespace(
    name="pendulum",
    space=ParameterSpace(tuple(Parameter(name, "-", 0.5, 1e-4, 10.0, True, 1.0) for name in NAMES)),
    fixed={},
    parts={},
    sets={name: f"a number called {name}" for name in NAMES},
)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "belief.yaml"
    path.write_text(belief_text(identification().belief), encoding="utf-8")
    return path


def test_a_belief_survives_its_file(file: Path) -> None:
    belief, read = identification().belief, Belief.load(file, SYSTEM)
    assert (read.system, read.names, read.units, read.log) == (
        belief.system,
        belief.names,
        belief.units,
        belief.log,
    )
    np.testing.assert_array_equal(read.estimate, belief.estimate)
    np.testing.assert_array_equal(read.covariance, belief.covariance)
    assert read.systematic is None
    replace(belief, systematic=0.3 * belief.covariance).save(file)
    np.testing.assert_array_equal(Belief.load(file, SYSTEM).systematic, 0.3 * belief.covariance)
    error = 0.5 * np.linalg.cholesky(belief.covariance)[:, 0]
    whole = replace(belief, systematic=np.outer(error, error), owed={"the base's tilt": error})
    whole.save(file)
    np.testing.assert_array_equal(Belief.load(file, SYSTEM).owed["the base's tilt"], error)
    least = error * [1e-17, 1.0, 1.0, 1.0]  # rounding is all that is left of it where nothing is owed
    rounded = np.outer(least, least)
    rounded[0, 0] *= 0.3
    replace(belief, systematic=rounded, owed={"the base's tilt": least}).save(file)
    assert Belief.load(file, SYSTEM).owed.keys() == {"the base's tilt"}
    replace(whole, owed={"the base's tilt": 1.1 * error}).save(file)
    with pytest.raises(ConfigError, match="owed must have errors"):
        Belief.load(file, SYSTEM)


def test_the_numbers_for_people_are_in_the_parameters_own_unit(file: Path) -> None:
    entry = yaml.safe_load(file.read_text())["parameters"][0]
    assert entry["sd"] == pytest.approx(0.7421 * 0.0055)
    assert entry["lower"] < entry["estimate"] < entry["upper"]


def changed(file: Path, **changes: object) -> Path:
    content = yaml.safe_load(file.read_text())
    for key, value in changes.items():
        part, place = content, key.split("__")
        for step in place[:-1]:
            part = part[int(step) if step.isdigit() else step]
        part[int(place[-1]) if place[-1].isdigit() else place[-1]] = value
    file.write_text(yaml.safe_dump(content, sort_keys=False))
    return file


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"system": "go1_push"}, "about 'go1_push', not about 'pendulum'"),
        ({"parameters__0__name": "load_mas"}, "did you mean 'load_mass'"),
        ({"parameters__0__name": "damping"}, "here twice"),
        ({"parameters__0__scale": "linear"}, "scale of load_mass is log"),
        ({"parameters__0__estimate": 99.0}, "between 0.0001 and 10 would be valid"),
        ({"parameters__0__estimate": 9e-5}, "between 0.0001 and 10 would be valid"),
        ({"parameters__0__estimate": "heavy"}, "estimate is 'heavy'; a number"),
        ({"covariance": [[1.0]]}, "4 x 4"),
        ({"covariance": np.diag([1.0, 1.0, 1.0, -1.0]).tolist()}, "positive definite"),
        ({"covariance": (1e308 * np.eye(4)).tolist()}, "an sd of 1e+154; at most 50 would be valid"),
        ({"covariance__0": [1.0, float("nan"), 0.0, 0.0]}, "finite"),
        ({"systematic": [[0.0]]}, "systematic must be symmetric"),
        ({"owed": {"x": []}}, "owed must have errors of 4 numbers"),
        ({"systematic": np.diag([0.0, 0.0, 0.0, -1.0]).tolist()}, "systematic must be symmetric, positive"),
        ({"systematic": (1e308 * np.eye(4)).tolist()}, "no more than covariance"),
        ({"colour": "blue"}, "colour"),
        ({"schema_version": 2}, "schema_version"),
    ],
)
def test_a_mistake_is_named_with_its_place(file: Path, changes, message) -> None:
    with pytest.raises(ConfigError) as error:
        Belief.load(changed(file, **changes), SYSTEM)
    assert message in str(error.value)
    assert str(error.value).startswith(f"{file}:")


@pytest.mark.parametrize("estimate", [1e-4, 10.0, float(np.exp(np.log(10.0)))])
def test_an_estimate_may_have_ended_on_a_bound(file: Path, estimate: float) -> None:
    assert Belief.load(changed(file, parameters__0__estimate=estimate), SYSTEM).estimate[0] == estimate


@pytest.mark.parametrize("text", ["", "[1, 2", "!!python/object/apply:os.getcwd []", "just words", "\x00"])
def test_what_is_no_belief_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "belief.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError):
        Belief.load(path, SYSTEM)


def test_a_result_is_not_taken_for_a_belief(tmp_path: Path) -> None:
    path = tmp_path / "result.json"
    path.write_text('{"command": "run", "parameters": []}')
    with pytest.raises(ConfigError, match=r"result.json: a result, no belief; give the belief.yaml"):
        Belief.load(path, SYSTEM)


def test_a_belief_can_be_read_without_its_system(file: Path) -> None:
    assert Belief.load(file).names == identification().belief.names
    with pytest.raises(ConfigError, match="here twice"):
        Belief.load(changed(file, parameters__0__name="damping"))


def test_save_is_the_inverse_of_load(file: Path, tmp_path: Path) -> None:
    belief = Belief.load(file)
    belief.save(tmp_path / "again.yaml")
    assert (tmp_path / "again.yaml").read_text() == file.read_text()


def test_draws_have_the_moments_of_the_belief() -> None:
    belief = identification().belief
    draws = np.log(belief.sample(40_000, np.random.default_rng(1)))
    sd = np.sqrt(np.diag(belief.covariance))
    assert all(belief.log)
    np.testing.assert_allclose((draws.mean(axis=0) - np.log(belief.estimate)) / sd, 0.0, atol=0.03)
    np.testing.assert_allclose(np.cov(draws.T), belief.covariance, atol=0.03 * sd.max() ** 2)
    np.testing.assert_array_equal(belief.sample(3, 1), belief.sample(3, np.random.default_rng(1)))
    assert (belief.sample(3) != belief.sample(3)).all(), "without a seed each call draws anew"


def system(**changes: object) -> Any:
    return SimpleNamespace(**(vars(SYSTEM) | {"parts": {"bodies": "a", "joints": "b"}} | changes))


def test_a_belief_that_does_not_describe_its_model_is_known_by_its_name() -> None:
    belief = identification().belief
    assert belief_for(SYSTEM, belief).names == belief.names
    with pytest.raises(
        ConfigError, match="about 'pendulum', not about 'arm'; `belief_anyway=True` accepts it"
    ):
        belief_for(system(name="arm"), belief)
    assert belief_for(system(name="arm"), belief, belief_anyway=True).system == "arm"


def test_what_a_belief_is_about_counts_and_not_its_name(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    belief = belief_for(system(), identification().belief)
    belief.save(tmp_path / "belief.yaml")
    assert Belief.load(tmp_path / "belief.yaml", system(name="another folder")).names == belief.names
    heavy = system(parts={"bodies": "c", "joints": "b"})
    with pytest.raises(ConfigError, match=r"belief.yaml:.*about another model: its bodies differ"):
        Belief.load(tmp_path / "belief.yaml", heavy)
    assert not caplog.text
    Belief.load(tmp_path / "belief.yaml", heavy, belief_anyway=True)
    assert "its bodies differ; it is used anyway" in caplog.text
    other = system(sets=SYSTEM.sets | {NAMES[0]: "body_mass of rod"})
    with pytest.raises(ConfigError, match=f"{NAMES[0]} set a number called .*; now it sets body_mass of rod"):
        belief_for(other, belief)


def test_a_parameter_that_the_system_lacks_is_refused_or_left_out() -> None:
    belief = identification().belief
    few = {
        "space": ParameterSpace(SYSTEM.space.parameters[1:]),
        "sets": {name: SYSTEM.sets[name] for name in NAMES[1:]},
    }
    with pytest.raises(ConfigError, match=f"no parameter '{NAMES[0]}'"):
        belief_for(system(**few), belief)
    rest = belief_for(system(**few), belief, belief_anyway=True)
    assert rest.names == belief.names[1:]
    np.testing.assert_array_equal(rest.covariance, belief.covariance[1:, 1:])


def test_a_fixed_parameter_conditions_the_others(caplog: pytest.LogCaptureFixture) -> None:
    """Of two correlated numbers, one known: mean and sd of the other follow from the regression line."""
    belief = Belief(
        "s",
        ("m", "x"),
        ("kg", "m"),
        (True, False),
        np.array([2.0, -1.0]),
        np.array([[0.04, 0.03], [0.03, 0.09]]),
    )
    known = belief.given({"x": -0.4, "y": 1.0})
    assert known.systematic is None
    # an error b of the model moves m by 0.1 b and x by 0.2 b; the known x corrects m by 0.03 / 0.09 of x's
    error = np.array([0.1, 0.2])
    moved = replace(belief, systematic=np.outer(error, error), owed={"b": error}).given({"x": -0.4})
    np.testing.assert_allclose(moved.owed["b"], [0.1 - 0.2 * 0.03 / 0.09])
    np.testing.assert_allclose(moved.systematic, [[(0.1 - 0.2 * 0.03 / 0.09) ** 2]])
    assert known.names == ("m",) and known.fixed == {"x": -0.4}
    np.testing.assert_allclose(known.estimate, [2.0 * np.exp(0.03 / 0.09 * 0.6)])
    np.testing.assert_allclose(known.covariance, [[0.04 - 0.03**2 / 0.09]])
    np.testing.assert_allclose(belief.given({"m": 3.0}).estimate, [-1.0 + 0.03 / 0.04 * np.log(1.5)])
    here: Any = SimpleNamespace(
        name="s",
        space=ParameterSpace((Parameter("m", "kg", 1.0, 0.1, 10.0, True, 0.5),)),
        fixed={"x": -0.4},
        parts={},
        sets={"m": "", "x": ""},
    )
    assert belief_for(here, belief).estimate == pytest.approx(known.estimate)
    assert not caplog.text
    belief_for(system(**(vars(here) | {"fixed": {"x": 0.0}})), known)
    assert "rests on x fixed at -0.4; here it is fixed at 0" in caplog.text
