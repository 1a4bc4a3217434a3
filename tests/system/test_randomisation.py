"""Randomisation files: functions and arguments that mjlab and Isaac Lab have, and the belief's intervals."""

from __future__ import annotations

import inspect
import re
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest

from amhe_cli.core.belief import Belief, belief_of
from amhe_cli.core.statistics import Z90
from amhe_cli.system.export.randomisation import randomisation, usual_load
from amhe_cli.system.export.trainings import ISAACLAB_TOOL, MJLAB_TOOL
from amhe_cli.system.parameters.inertia import (
    body_numbers,
    log_cholesky,
    log_cholesky_of,
    pseudo_inertia,
    upper_factor,
)
from amhe_cli.system.system import System

Write = Callable[..., Path]


def mjlab_text(system: System, belief: Belief) -> str:
    return randomisation(system, belief, MJLAB_TOOL)


def isaaclab_text(system: System, belief: Belief) -> str:
    return randomisation(system, belief, ISAACLAB_TOOL)


#: Arguments of mjlab 1.6.0's functions, `env` and `env_ids` apart.
_FIELD = {"ranges", "asset_cfg", "distribution", "operation", "axes", "shared_random"}
_U = {
    f"{name}_range" for name in ("alpha", "d", "d1", "d2", "d3", "s12", "s13", "s23", "t", "t1", "t2", "t3")
}
MJLAB = {
    "joint_damping": _FIELD,
    "joint_armature": _FIELD,
    "joint_friction": _FIELD,
    "joint_stiffness": _FIELD,
    "geom_friction": _FIELD,
    "pair_friction": _FIELD | {"isotropic"},
    "body_mass": _FIELD,
    "body_com_offset": _FIELD,
    "pseudo_inertia": _U | {"distribution", "asset_cfg"},
    "encoder_bias": {"bias_range", "asset_cfg"},
}
#: Those of Isaac Lab 3.0.0's terms.
ISAAC = {
    "randomize_joint_parameters": {"asset_cfg", "armature_distribution_params", "operation"},
    "randomize_actuator_gains": {
        "asset_cfg", "stiffness_distribution_params", "damping_distribution_params", "operation",
    },
    "randomize_rigid_body_mass": {"asset_cfg", "mass_distribution_params", "operation", "recompute_inertia"},
    "randomize_rigid_body_com": {"asset_cfg", "com_range"},
}  # fmt: skip


def module(monkeypatch: pytest.MonkeyPatch, name: str, **content: Any) -> ModuleType:
    """A module in place of a package that is not installed."""
    made = ModuleType(name)
    vars(made).update(content)
    monkeypatch.setitem(sys.modules, name, made)
    return made


def loaded(text: str, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Names of a randomisation file, run with stand-ins of the two packages."""

    def term(**values: Any) -> SimpleNamespace:
        return SimpleNamespace(**values)

    def scene(entity: str, **names: Any) -> dict[str, Any]:
        return {"entity": entity, **names}

    dr = SimpleNamespace(**{name: name for name in MJLAB})
    for package in ("mjlab", "mjlab.envs", "mjlab.managers", "isaaclab", "torch"):
        module(monkeypatch, package)
    module(monkeypatch, "mjlab.envs.mdp", dr=dr)
    module(
        monkeypatch,
        "mjlab.managers.event_manager",
        EventTermCfg=term,
        requires_model_fields=lambda *fields: lambda function: function,
    )
    module(monkeypatch, "mjlab.managers.scene_entity_config", SceneEntityCfg=scene)
    mdp = module(monkeypatch, "isaaclab.envs.mdp", **{name: name for name in ISAAC})
    module(monkeypatch, "isaaclab.envs", mdp=mdp)
    module(monkeypatch, "isaaclab.managers", EventTermCfg=term, SceneEntityCfg=scene)
    module(monkeypatch, "isaaclab.utils.configclass", configclass=lambda one: one)
    module(monkeypatch, "isaaclab.utils.math", sample_uniform=lambda *given: given)
    names: dict[str, Any] = {}
    exec(compile(text, "events.py", "exec"), names)
    return names


#: Target, and mjlab's function for it.
TARGETS = {
    "{joint: hip, set: damping}": "joint_damping",
    "{joint: hip, set: armature}": "joint_armature",
    "{joint: hip, set: friction_loss}": "joint_friction",
    "{joint: hip, set: stiffness}": "joint_stiffness",
    "{geom: box, set: sliding_friction}": "geom_friction",
    "{pair: slide, set: sliding_friction}": "pair_friction",
    "{body: hand, set: mass, carry_inertia: false}": "body_mass",
    "{body: hand, set: center_of_mass, axis: x}": "body_com_offset",
    "{actuator: hip_servo, set: gain}": "randomize_actuator",
    "{actuator: hip_servo, set: actuator_damping}": "randomize_actuator",
    "{actuator: hip_servo, set: force_limit}": "randomize_actuator",
}


@pytest.mark.parametrize("target", TARGETS)
def test_mjlab_takes_every_target(target: str, with_target: Write, monkeypatch: pytest.MonkeyPatch) -> None:
    system = System.load(with_target(target, "nominal: 0.7, bounds: [0.001, 100], scale: log, prior_sd: 0.2"))
    belief = belief_of(system, np.zeros(1), np.eye(1))
    events = loaded(mjlab_text(system, belief), monkeypatch)["identified_events"]("robot")
    (event,) = events.values()
    name = getattr(event.func, "__name__", event.func)  # mjlab's by its name, the file's own as it is
    assert name == TARGETS[target]
    arguments = MJLAB.get(name) or set(inspect.signature(event.func).parameters) - {"env", "env_ids"}
    assert set(event.params) <= arguments
    interval = 0.7 * np.exp(np.array([-1, 1]) * Z90 * 0.2)
    given = [
        bounds
        for key, value in event.params.items()
        for bounds in (value.values() if isinstance(value, dict) else [value])
        if key != "asset_cfg" and isinstance(bounds, tuple)
    ]
    assert any(np.allclose(bounds, interval, rtol=0.02) for bounds in given)


def test_a_mass_with_its_inertia_stretches_the_body(
    with_target: Write, monkeypatch: pytest.MonkeyPatch
) -> None:
    system = System.load(with_target("{body: hand, set: mass}", "nominal: 0.7, scale: log, prior_sd: 0.2"))
    belief = belief_of(system, np.zeros(1), np.eye(1))
    events = loaded(mjlab_text(system, belief), monkeypatch)["identified_events"]("robot")
    (event,) = events.values()
    assert set(event.params) == {"asset_cfg", "alpha_range"}  # mass and inertia scale by exp(2 alpha)
    np.testing.assert_allclose(event.params["alpha_range"], np.array([-1, 1]) * Z90 * 0.1, rtol=0.05)


def test_the_ten_numbers_of_a_stretch_make_the_body() -> None:
    p = np.random.default_rng(1).normal(0.0, 0.3, (5, 10))
    np.testing.assert_allclose(log_cholesky_of(log_cholesky(p)), p, atol=1e-12)
    own = (0.5, np.array([0.02, 0.0, -0.1]), np.array([1.0, 0, 0, 0]), np.array([2e-3, 1.8e-3, 3e-4]))
    base = upper_factor(pseudo_inertia(*own))
    mass = body_numbers(log_cholesky(np.array([[0.1, *np.zeros(9)]])) @ base)[0]
    assert mass[0] == pytest.approx(0.5 * np.exp(0.2))


def test_joints_that_share_a_value_are_drawn_together(
    written: Write, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = "targets: [{joint: hip, set: damping}, {joint: knee, set: damping}]"
    system = System.load(written(f"  p: {{nominal: 0.2, bounds: [0.01, 2], {target}}}\n"))
    belief = belief_of(system, np.zeros(1), 0.01 * np.eye(1))
    events = loaded(mjlab_text(system, belief), monkeypatch)["identified_events"]("robot")
    (event,) = events.values()
    assert event.params["asset_cfg"]["joint_names"] == ("hip", "knee")
    assert event.params["shared_random"]


BOTH = """
  damping: {nominal: 0.2, bounds: [0.01, 2], targets: [{joint: hip, set: damping}]}
  armature: {nominal: 0.02, bounds: [0.001, 2], targets: [{joint: hip, set: armature}]}
  gain: {nominal: 20, bounds: [1, 200], targets: [{actuator: hip_servo, set: gain}]}
  mass: {nominal: 0.5, bounds: [0.1, 2], targets: [{body: hand, set: mass}]}
  com: {nominal: 0.02, bounds: [-1, 1], scale: linear, targets: [{body: hand, set: center_of_mass, axis: x}]}
  friction: {nominal: 0.5, bounds: [0.1, 2], targets: [{geom: box, set: sliding_friction}]}
  late: {nominal: 0.01, bounds: [0.001, 0.05], targets: [{set: command_delay}]}
"""
COMMANDED = """
signals:
  hip: {topic: /joint_states, joints: [hip], noise: {position: 0.01}}
  command: {topic: /command, actuators: [hip_servo], quantity: position}
"""


def test_isaac_lab_takes_every_term(written: Write, monkeypatch: pytest.MonkeyPatch) -> None:
    system = System.load(written(BOTH, COMMANDED))
    correlated = np.eye(7)
    correlated[0, 1] = correlated[1, 0] = 0.9
    text = isaaclab_text(system, belief_of(system, np.zeros(7), 0.01 * correlated))
    names = loaded(text, monkeypatch)
    terms = {key: one for key, one in vars(names["IdentifiedEventsCfg"]).items() if hasattr(one, "params")}
    assert set(terms) == {"hip_armature", "hip_friction", "hip_gains", "hand_mass", "hand_com"}
    for name, term in terms.items():
        if name == "hip_friction":
            assert term.func is names["randomize_joint_friction"]
            assert term.params["dry"] == (0.05, 0.05)  # the model's own: no parameter sets it
        else:
            assert set(term.params) <= ISAAC[term.func]
    low, high = terms["hand_com"].params["com_range"]["x"]
    assert low < 0.0 < high
    assert "# friction, " in text  # what no term covers is named
    assert "# late, " not in text  # the actuators have it
    assert "that of damping and armature is 0.90" in text


@pytest.mark.parametrize("version", ["_index", ""])  # of Isaac Lab 3, and of those before
def test_isaac_labs_own_term_for_friction_writes_both(
    version: str, written: Write, monkeypatch: pytest.MonkeyPatch
) -> None:
    system = System.load(written(BOTH, COMMANDED))
    names = loaded(isaaclab_text(system, belief_of(system, np.zeros(7), 0.01 * np.eye(7))), monkeypatch)
    written_values: dict[str, Any] = {}
    asset = SimpleNamespace(device="cpu", num_joints=2)
    setattr(asset, f"write_joint_friction_coefficient_to_sim{version}", written_values.update)

    class Scene(dict):
        num_envs = 4

    env = SimpleNamespace(scene=Scene(robot=asset))
    config = SimpleNamespace(name="robot", joint_ids=[1])
    names["randomize_joint_friction"](env, None, config, (0.1, 0.2), (0.3, 0.4))
    assert written_values["joint_friction_coeff"] == (0.1, 0.2, (4, 1), "cpu")
    assert written_values["joint_viscous_friction_coeff"] == (0.3, 0.4, (4, 1), "cpu")


def test_an_encoders_zero_is_a_bias_of_mjlab(written: Write, monkeypatch: pytest.MonkeyPatch) -> None:
    target = "targets: [{signal: hip, quantity: position, joint: hip, set: bias}]"
    text = f"  zero: {{nominal: 0.02, bounds: [-0.5, 0.5], scale: linear, prior_sd: 0.01, {target}}}\n"
    system = System.load(written(text))
    made = mjlab_text(system, belief_of(system, np.zeros(1), np.eye(1)))
    (event,) = loaded(made, monkeypatch)["identified_events"]("robot").values()
    assert event.func == "encoder_bias"
    np.testing.assert_allclose(event.params["bias_range"], 0.02 + np.array([-1, 1]) * Z90 * 0.01, atol=1e-3)
    assert "not in these terms" not in made


class Draws:
    """In place of torch: draws are the middle of their ranges."""

    @staticmethod
    def rand(shape: tuple[int, int], device: str) -> np.ndarray:
        return np.full(shape, 0.5)

    @staticmethod
    def arange(count: int, device: str) -> np.ndarray:
        return np.arange(count)


def test_one_servo_is_drawn_alone(written: Write, monkeypatch: pytest.MonkeyPatch) -> None:
    text = """  kp: {nominal: 20, bounds: [1, 100], targets: [{actuator: hip_servo, set: gain}]}
  limit: {nominal: 5, bounds: [1, 100], targets: [{actuator: hip_servo, set: force_limit}]}
  speed: {nominal: 2, bounds: [1, 3], prior_sd: 0, targets: [{actuator: knee_speed, set: gain}]}
  fixed: {nominal: 0.5, bounds: [0.1, 3], prior_sd: 0, targets: [{joint: knee, set: damping}]}
"""
    system = System.load(written(text, COMMANDED))
    names = loaded(mjlab_text(system, belief_of(system, np.zeros(2), 0.01 * np.eye(2))), monkeypatch)
    events = names["identified_events"]("robot")
    assert set(events) == {"hip_servo_gains", "hip_servo_effort"}  # what is fixed is not drawn
    # their names in the MJCF, and in `identified_actuators`
    assert {event.params["asset_cfg"]["actuator_names"] for event in events.values()} == {("hip_servo|hip",)}
    names["torch"] = Draws
    fields = {"actuator_gainprm": 10, "actuator_biasprm": 10, "actuator_forcerange": 2}
    model = SimpleNamespace(**{name: np.zeros((4, 3, width)) for name, width in fields.items()})
    robot = SimpleNamespace(indexing=SimpleNamespace(ctrl_ids=np.arange(3)))
    sim = SimpleNamespace(model=model)
    env = SimpleNamespace(scene={"robot": robot}, sim=sim, num_envs=4, device="cpu")
    for event in events.values():
        config = SimpleNamespace(name="robot", actuator_ids=[1])
        names["randomize_actuator"](env, None, **event.params | {"asset_cfg": config})
    np.testing.assert_allclose(model.actuator_gainprm[:, 1, 0], 20.0, rtol=0.02)
    np.testing.assert_allclose(model.actuator_biasprm[:, 1, 1], -model.actuator_gainprm[:, 1, 0])
    np.testing.assert_allclose(model.actuator_biasprm[:, 1, 2], -1.0)
    np.testing.assert_allclose(model.actuator_forcerange[:, 1], 4 * [[-5.0, 5.0]], rtol=0.02)
    assert not any(getattr(model, name)[:, [0, 2]].any() for name in fields)


GEARED = """  late: {nominal: 0.01, bounds: [0, 0.05], prior_sd: 0.002, targets: [{set: command_delay}]}
  load: {nominal: 0.1, bounds: [-0.2, 1], prior_sd: 0.05, targets: [{joint: hip, set: load_friction}]}
  dry: {nominal: 0.05, bounds: [0.01, 1], targets: [{joint: hip, set: friction_loss}]}
  emf: {nominal: 0.3, bounds: [0, 1], prior_sd: 0.05, targets: [{actuator: hip_servo, set: back_emf}]}
  kp: {nominal: 20, bounds: [1, 100], targets: [{actuator: hip_servo, set: gain}]}
"""


@pytest.mark.parametrize(("write", "module_name"), [(mjlab_text, "mjlab"), (isaaclab_text, "isaaclab")])
def test_actuators_have_the_identified_numbers(
    write: Callable[..., str], module_name: str, written: Write, monkeypatch: pytest.MonkeyPatch
) -> None:
    system = System.load(written(GEARED, COMMANDED))
    belief = belief_of(system, np.zeros(5), np.diag([1.0, *[1e-6] * 4]))
    text = write(system, belief)
    names = loaded(text, monkeypatch)
    one = {"mjlab": "BuiltinPositionActuatorCfg", "isaaclab": "DelayedPDActuatorCfg"}[module_name]
    kind = {"mjlab": "actuator", "isaaclab": "actuators"}[module_name]
    module(monkeypatch, f"{module_name}.{kind}", **{one: lambda **values: values})
    made = names["identified_actuators"](timestep=0.001)
    (servo,) = made if module_name == "mjlab" else made.values()
    assert (servo["stiffness"], servo["damping"], servo["effort_limit"]) == (20.0, 1.3, 5.0)
    assert servo["armature"] == 0.01
    lags = [servo[key] for key in servo if "delay" in key]
    assert lags[:2] == [7, 13]  # 10 ms +- 1.645 times 2 ms
    assert lags[2:] == ([10**9, False] if module_name == "mjlab" else [])  # mjlab: a lag holds until a reset
    dry = servo.get("frictionloss", servo.get("friction"))
    model = system.edits.apply(system.model, belief.estimate)
    load = usual_load(model)[model.joint("hip").dofadr[0]]
    assert dry == pytest.approx(0.05 + 2 * 0.1 * load, rel=1e-3) and load > 0.1
    assert "friction of gears: constant" in text
    # what is drawn at the start of a training would else take the load's share and the back-EMF away again
    mjlab = module_name == "mjlab"
    terms = names["identified_events"]("robot") if mjlab else vars(names["IdentifiedEventsCfg"])
    drawn = {k: v for term in terms.values() for k, v in getattr(term, "params", {}).items()}
    of = ("kd", "ranges") if mjlab else ("damping_distribution_params", "dry")
    np.testing.assert_allclose([np.mean(drawn[key]) for key in of], [servo["damping"], dry], rtol=1e-3)
    assert "\n# load" not in text and "\n# emf" not in text, "what is drawn is not among what is lost"


def test_what_friction_of_a_gear_loses_is_said_number_by_number(written: Write) -> None:
    rest = "  rest: {nominal: 0.1, bounds: [0, 1], targets: [{joint: hip, set: stribeck_friction}]}\n"
    alone = GEARED.splitlines(keepends=True)[1]  # no parameter of the model's own field carries the share
    for more, lost in ((GEARED + rest, ["rest"]), (alone, ["load"])):
        system, names = System.load(written(more, COMMANDED)), re.findall(r"^  (\w+):", more, re.M)
        text = mjlab_text(system, belief_of(system, np.zeros(len(names)), 1e-6 * np.eye(len(names))))
        assert [name for name in names if f"\n# {name}, " in text] == lost


def test_the_usual_load_is_that_of_gravity() -> None:
    xml = '<mujoco><worldbody><body><joint axis="0 1 0" limited="true" range="80 100"/>'
    xml += '<geom type="sphere" size=".01" pos="0 0 -.5" mass="2"/></body></worldbody></mujoco>'
    assert usual_load(mujoco.MjModel.from_xml_string(xml))[0] == pytest.approx(9.81, rel=0.02)
