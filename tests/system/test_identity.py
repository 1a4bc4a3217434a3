"""What a belief is about: the model's parts, and what each parameter sets."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

from amhe_cli.core.errors import ConfigError
from amhe_cli.system.system import System
from tests.system.conftest import MODEL

PARAMETERS = {
    "mass": {"prior_sd": 0.1, "targets": [{"body": "box", "set": "mass"}]},
    "damping": {"nominal": 0.2, "targets": [{"joint": "[hk]*", "set": "damping"}]},
    "scale": {"targets": [{"geom": "box", "set": "sliding_friction", "mode": "scale"}]},
    "delay": {"nominal": 0.01, "bounds": [0.0, 0.05], "targets": [{"set": "command_delay"}]},
}
SIGNALS = {"hip": {"joints": ["hip"], "noise": {"position": 0.01}}, "command": {"actuators": ["hip_servo"]}}


def made(xml: str = MODEL, **changes: object) -> System:
    arguments = {"parameters": PARAMETERS, "signals": SIGNALS, "name": "one"} | changes
    return System.from_model(mujoco.MjSpec.from_string(xml), warn=False, **arguments)  # pyright: ignore


def changed(other: System) -> list[str]:
    own = made()
    assert own.parts.keys() == other.parts.keys()
    return [part for part in own.parts if own.parts[part] != other.parts[part]]


@pytest.mark.parametrize(
    ("old", "new", "parts"),
    [
        ('damping="0.3"', 'damping="0.4"', ["joints"]),
        ('mass="1"/>', 'mass="1.1"/>', ["bodies"]),
        ('kp="20"', 'kp="21"', ["actuators"]),
        ('gear="3"', 'gear="-3"', ["actuators"]),
        ('friction="1 0.005 0.0001"', 'friction="0.9 0.005 0.0001"', ["geoms"]),
        ('solref="0.02 1"', 'solref="0.03 1"', ["contact pairs"]),
        ("<worldbody>", '<option timestep="0.001"/><worldbody>', ["options"]),
    ],
)
def test_a_changed_model_is_known_by_its_part(old: str, new: str, parts: list[str]) -> None:
    assert old in MODEL
    assert changed(made(MODEL.replace(old, new, 1))) == parts


def test_what_does_not_act_makes_no_other_model() -> None:
    assert changed(made(name="two")) == []
    assert changed(made(parameters={k: PARAMETERS[k] for k in ("damping", "scale")})) == []
    nominal = PARAMETERS["damping"] | {"nominal": 0.5}
    assert changed(made(parameters=PARAMETERS | {"damping": nominal})) == []
    assert changed(made().fixing({"mass": 2.5, "scale": 0.7})) == []
    visual = '<geom type="sphere" size="0.3" mass="0" contype="0" conaffinity="0"/>'
    seen = MODEL.replace('<body name="box" pos="0 0 0.1">', f'<body name="box" pos="0 0 0.1">{visual}')
    assert changed(made(seen)) == []


def test_the_same_model_has_the_same_parts_in_another_folder(tmp_path: Path) -> None:
    for name in ("here", "there"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "model.xml").write_text(MODEL)
        (tmp_path / name / "system.yaml").write_text(
            "model: model.xml\nparameters: {mass: {targets: [{body: box, set: mass}]}}\n"
            "signals: {hip: {topic: /j, joints: [hip], noise: {position: 0.01}}}\n"
        )
    here, there = (System.load(tmp_path / name, warn=False) for name in ("here", "there"))
    assert here.parts == there.parts == made().parts


def test_what_a_parameter_sets_is_in_words() -> None:
    assert made().sets == {
        "mass": "body_mass of box with its inertia",
        "damping": "dof_damping of hip, knee",
        "scale": "scale geom_friction[0] of box",
        "delay": "command_delay",
    }


def test_a_fixed_parameter_is_in_the_model_and_not_in_theta() -> None:
    whole = made()
    system = whole.fixing({"damping": 0.7, "delay": 0.02})
    assert system.space.names == ("mass", "scale") and system.fixed == {"damping": 0.7, "delay": 0.02}
    full = whole.edits.apply(whole.model, np.array([3.0, 0.7, 0.5, 0.02]))
    free = system.edits.apply(system.model, np.array([3.0, 0.5]))
    for field in ("body_mass", "body_inertia", "dof_damping", "geom_friction", "dof_M0"):
        np.testing.assert_array_equal(getattr(free, field), getattr(full, field))
    late = [[0.02, 0, 0, 0, 0, 0]]
    np.testing.assert_array_equal(system.edits.delays(np.ones((2, 2))), late * 2)
    assert system.model.dof_damping[6] == 0.7
    np.testing.assert_array_equal(
        system.edits.upon(whole.model).delays(np.ones((1, 2))), [[0.02, 0, 0, 0, 0, 0]]
    )


def test_a_prior_without_width_fixes_a_parameter() -> None:
    known = PARAMETERS | {"damping": PARAMETERS["damping"] | {"prior_sd": 0}}
    system = made(parameters=known)
    assert system.fixed == {"damping": 0.2} and "damping" not in system.space.names
    assert system.model.dof_damping[6] == 0.2
    with pytest.raises(ConfigError, match="every parameter has the prior_sd 0"):
        made(parameters={"damping": known["damping"]})


def test_only_fixes_all_others_at_their_nominal_values() -> None:
    system = made().fixing({"mass": 1.5}, only=["dam*", "scale"])
    assert system.space.names == ("damping", "scale") and system.fixed == {"mass": 1.5, "delay": 0.01}


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"fix": {"mas": 1.0}}, "`fix`: no parameter 'mas' (did you mean 'mass'?)"),
        ({"fix": {"mass": 99.0}}, "`fix`: mass cannot be 99.0; between 0.2 and 20 would be valid"),
        ({"only": ["dampin"]}, "`only`: no parameter 'dampin' (did you mean 'damping'?)"),
        ({"only": "mass"}, "`only`: give a list of names"),
        ({"only": ["mass"], "fix": {"mass": 2.0}}, "`only`: mass is fixed too"),
        ({"fix": {"mass": 2.0, "damping": 0.2, "scale": 1.0, "delay": 0.01}}, "every parameter is fixed"),
    ],
)
def test_a_wrong_name_or_value_is_refused(arguments: dict, said: str) -> None:
    with pytest.raises(ConfigError) as error:
        made().fixing(**arguments)
    assert said in str(error.value) and "\n" not in str(error.value)
