"""A system without a folder: a model and plain dictionaries."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest
import yaml

from amhe_cli.core.errors import ConfigError
from amhe_cli.core.log import Log
from amhe_cli.core.settings import ClipSettings, Settings
from amhe_cli.system.description.folders import find_system
from amhe_cli.system.description.schema import ParameterEntry, SignalEntry, TargetEntry
from amhe_cli.system.export.mjcf import identified_xml
from amhe_cli.system.provenance import attachments, system_files
from amhe_cli.system.system import System

FOLDER = find_system("pendulum")
SCENE = FOLDER / "scene.xml"
FILE: dict[str, Any] = yaml.safe_load((FOLDER / "system.yaml").read_text(encoding="utf-8"))


def made(model: Any = SCENE, **changes: Any) -> System:
    given = {key: FILE[key] for key in ("parameters", "signals", "settings")} | changes
    return System.from_model(model, **given)


def assert_same(made: System, loaded: System) -> None:
    for name in ("space", "signals", "channels", "inputs", "input_spec", "settings", "keyframe"):
        assert getattr(made, name) == getattr(loaded, name), name
    assert made.spec.to_xml() == loaded.spec.to_xml()


@pytest.mark.parametrize("kind", ["path", "text", "spec"])
def test_dictionaries_make_the_system_that_the_folder_makes(kind: str) -> None:
    model = {
        "path": lambda: SCENE,
        "text": lambda: str(SCENE),
        "spec": lambda: mujoco.MjSpec.from_file(str(SCENE)),
    }[kind]()
    system = made(model, name="pendulum")
    assert_same(system, System.load("pendulum"))
    assert (system.name, system.folder) == ("pendulum", None)
    assert system.space == System.load("pendulum").space


def test_a_compiled_model_is_refused() -> None:
    with pytest.raises(ConfigError, match="give an MJCF, a URDF or an MjSpec"):
        made(mujoco.MjModel.from_xml_path(str(SCENE)))


def test_the_spec_that_was_given_stays_as_it_was() -> None:
    spec = mujoco.MjSpec.from_file(str(SCENE))
    before = spec.to_xml()
    signal = {"body": "load", "noise": {"position": 0.01}}
    system = made(spec, signals=FILE["signals"] | {"load": signal})
    assert spec.to_xml() == before
    assert "amhe/load/position" in system.spec.to_xml()


def test_pydantic_classes_do_as_well() -> None:
    parameter = ParameterEntry(targets=[TargetEntry(joint="hinge", set="damping")], nominal=0.02)
    joints = SignalEntry(topic="/joint_states", joints=["hinge"], noise={"position": 0.002})
    settings = Settings(clips=ClipSettings(count=7))
    system = made(parameters={"damping": parameter}, signals={"joints": joints}, settings=settings)
    assert system.space.names == ("damping",)
    assert system.settings.clips.count == 7


def test_a_topic_is_not_needed() -> None:
    system = made(signals={"joints": {"joints": ["hinge"], "noise": {"position": 0.002}}})
    assert system.signals[0].topic == "/joints"


def test_every_mistake_names_the_path_of_its_key() -> None:
    wrong = {
        "damping": {"nominal": "x", "targets": [{"joint": "hinge", "set": "damping"}]},
        "mass": {"targets": [{"body": "lood", "set": "mass"}]},
        "gain": {"targets": [{"actuator": "servo", "set": "gian"}]},
    }
    signals = FILE["signals"] | {"other": {"joints": ["hip"], "noise": {"positon": 1.0}}}
    with pytest.raises(ConfigError) as error:
        made(parameters=wrong, signals=signals, settings={"clips": {"lenght": 1.0}})
    places = {line.split(": ")[0]: line for line in str(error.value).splitlines()}
    assert (
        set(places) == {"parameters.damping.nominal", "signals.other", "settings.clips.lenght"}
        and "did you mean 'length'" in places["settings.clips.lenght"]
    )
    with pytest.raises(ConfigError) as error:
        made(parameters=wrong | {"damping": FILE["parameters"]["damping"]})
    assert [line.split(": ")[0] for line in str(error.value).splitlines()] == [
        "parameters.mass.targets[0]",
        "parameters.gain.targets[0]",
    ]


def test_a_path_that_does_not_exist_is_reported() -> None:
    with pytest.raises(ConfigError, match="`model`: there is no file 'nowhere.xml'"):
        made("nowhere.xml")


def test_files_that_need_a_folder_do_without() -> None:
    system = made()
    theta = system.space.nominal
    assert "identified by amhe, system scene" in identified_xml(system, theta)
    assert set(system_files(system)) == {"model.xml", "system.yaml"}
    text = attachments(system)["system.yaml"]
    assert yaml.safe_load(text)["parameters"].keys() == FILE["parameters"].keys()


def test_commands_may_be_smooth() -> None:
    """A command in steps of 20 ms becomes a line again, where the drive interpolates."""
    command = FILE["signals"]["command"] | {"smooth": 0.05}
    system = made(signals=FILE["signals"] | {"command": command})
    time = 0.002 * np.arange(500)
    stepped = np.floor(time / 0.02) * 0.02
    joints = {"time": time, "position": time, "velocity": np.ones_like(time)}
    arrays = {"joints": joints, "command": {"time": time, "position": stepped}}
    ramp = Log.from_arrays(arrays, system)["command.position"].values[50:-50, 0]
    assert np.diff(ramp).min() > 0.0 and np.ptp(ramp - 0.002 * np.arange(ramp.size)) < 0.01
