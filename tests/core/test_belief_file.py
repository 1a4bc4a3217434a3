from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

from amhe_cli.core.belief_file import belief_text, read_belief
from amhe_cli.core.errors import ConfigError
from amhe_cli.core.parameters import Belief, Parameter, ParameterSpace
from tests.report.synthetic import NAMES, identification

SYSTEM = SimpleNamespace(
    name="pendulum",
    space=ParameterSpace(tuple(Parameter(name, "-", 0.5, 1e-4, 10.0, True, 1.0) for name in NAMES)),
)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "belief.yaml"
    path.write_text(belief_text(identification().belief), encoding="utf-8")
    return path


def test_a_belief_survives_its_file(file: Path) -> None:
    belief, read = identification().belief, read_belief(file, SYSTEM)
    assert (read.system, read.names, read.units, read.log) == (
        belief.system,
        belief.names,
        belief.units,
        belief.log,
    )
    np.testing.assert_array_equal(read.estimate, belief.estimate)
    np.testing.assert_array_equal(read.covariance, belief.covariance)


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
        ({"parameters__0__estimate": "heavy"}, "parameters.0.estimate"),
        ({"covariance": [[1.0]]}, "4 x 4"),
        ({"covariance": np.diag([1.0, 1.0, 1.0, -1.0]).tolist()}, "positive definite"),
        ({"covariance__0": [1.0, float("nan"), 0.0, 0.0]}, "finite"),
        ({"colour": "blue"}, "colour"),
        ({"schema_version": 2}, "schema_version"),
    ],
)
def test_a_mistake_is_named_with_its_place(file: Path, changes, message) -> None:
    with pytest.raises(ConfigError) as error:
        read_belief(changed(file, **changes), SYSTEM)
    assert message in str(error.value)
    assert str(error.value).startswith(f"{file}:")


@pytest.mark.parametrize("text", ["", "[1, 2", "!!python/object/apply:os.getcwd []", "just words", "\x00"])
def test_what_is_no_belief_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "belief.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError):
        read_belief(path, SYSTEM)


def test_a_belief_can_be_read_without_its_system(file: Path) -> None:
    assert Belief.load(file).names == identification().belief.names
    with pytest.raises(ConfigError, match="here twice"):
        Belief.load(changed(file, parameters__0__name="damping"))


def test_save_is_the_inverse_of_load(file: Path, tmp_path: Path) -> None:
    belief = Belief.load(file, SYSTEM)
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


def test_a_belief_about_another_system_is_refused() -> None:
    belief = identification().belief
    belief.check(SYSTEM)
    with pytest.raises(ConfigError, match="about 'pendulum', not about 'arm'"):
        belief.check(SimpleNamespace(name="arm", space=SYSTEM.space))
    few = SimpleNamespace(name="pendulum", space=ParameterSpace(SYSTEM.space.parameters[1:]))
    with pytest.raises(ConfigError, match=f"no parameter '{NAMES[0]}'"):
        belief.check(few)
