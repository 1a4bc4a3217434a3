"""Every target, written into a Batch and into one model."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from mujoco.batch import Batch

from amhe_cli.core.errors import ConfigError
from amhe_cli.core.rotations import rotate
from amhe_cli.system.parameters.inertia import (
    body_numbers,
    inertia_about_com,
    log_cholesky,
    principal_axis,
    pseudo_inertia,
    quaternion_of,
    rotation_matrix,
    upper_factor,
)
from amhe_cli.system.system import System

Write = Callable[..., Path]

TARGETS = {  # target: (keys, theta, field, index, expected)
    "{body: box, set: mass}": ("", 3.0, "body_mass", 1, 3.0),
    "{body: box, set: mass, mode: scale}": ("", 1.5, "body_mass", 1, 3.0),
    "{body: box, set: mass, mode: add}": ("bounds: [-1, 1]", 0.5, "body_mass", 1, 2.5),
    "{body: box, set: inertia, axis: z}": ("", 0.02, "body_inertia", (1, 2), 0.02),
    "{body: hand, set: inertia, axis: x, mode: scale}": ("", 2.0, "body_inertia", None, None),
    "{body: hand, set: center_of_mass, axis: x}": ("bounds: [-0.1, 0.1]", 0.05, "body_ipos", (3, 0), 0.05),
    "{pair: slide, set: sliding_friction}": ("", 0.3, "pair_friction", (0, slice(2)), 0.3),
    "{pair: [table, upper], set: rolling_friction}": ("", 0.01, "pair_friction", (0, slice(3, 5)), 0.01),
    "{pair: slide, set: contact_time_constant}": ("", 0.05, "pair_solref", (0, 0), 0.05),
    "{pair: slide, set: contact_overlap}": ("bounds: [-1, 1]", 0.01, "pair_margin", 0, -0.01),
    "{pair: slide, set: contact_damping_ratio}": ("", 0.5, "pair_solref", (0, 1), 0.5),
    "{geom: floor, set: sliding_friction}": ("", 1.3, "geom_friction", (0, 0), 1.3),
    "{geom: box, set: torsional_friction}": ("", 0.02, "geom_friction", (1, 1), 0.02),
    "{body: box, set: sliding_friction}": ("", 1.2, "geom_friction", (1, 0), 1.2),
    "{geom: box, set: contact_damping_ratio}": ("", 0.4, "geom_solref", (1, 1), 0.4),
    "{joint: hip, set: damping}": ("", 0.7, "dof_damping", 6, 0.7),
    "{joint: hip, set: damping_quadratic}": ("nominal: 0.1", 0.7, "dof_dampingpoly", (6, 0), 0.7),
    "{joint: hip, set: damping_cubic}": ("nominal: 0.1", 0.7, "dof_dampingpoly", (6, 1), 0.7),
    "{joint: '*', set: armature}": ("nominal: 0.1", 0.2, "dof_armature", slice(None), 0.2),
    "{joint: hip, set: friction_loss}": ("", 0.2, "dof_frictionloss", 6, 0.2),
    "{joint: hip, set: stiffness}": ("", 5.0, "jnt_stiffness", 1, 5.0),
    "{joint: hip, set: spring_rest}": ("bounds: [-1, 1]", 0.3, "qpos_spring", 7, 0.3),
    "{actuator: hip_servo, set: gain}": ("", 30.0, "actuator_biasprm", (0, 1), -30.0),
    "{actuator: knee_motor, set: gain}": ("", 2.0, "actuator_gainprm", (1, 0), 2.0),
    "{actuator: knee_speed, set: gain}": ("", 4.0, "actuator_biasprm", (2, 2), -4.0),
    "{actuator: hip_servo, set: actuator_damping}": ("", 3.0, "actuator_biasprm", (0, 2), -3.0),
    "{actuator: hip_servo, set: force_limit}": ("", 4.0, "actuator_forcerange", 0, [-4.0, 4.0]),
    "{actuator: knee_motor, set: force_limit, mode: scale}": ("", 2.0, "actuator_forcerange", 1, [0.0, 6.0]),
    "{joint: hip, set: force_limit}": ("", 2.0, "jnt_actfrcrange", 1, [-2.0, 2.0]),
    "{actuator: knee_motor, set: ctrl_limit}": ("", 0.5, "actuator_ctrlrange", 1, [-0.5, 0.5]),
    "{actuator: hip_servo, set: gain, carry_limit: true}": ("", 30.0, "actuator_forcerange", 0, [-7.5, 7.5]),
}


@pytest.mark.parametrize("target", TARGETS)
def test_a_target_sets_its_number_in_a_batch_and_in_a_model(target: str, with_target: Write) -> None:
    keys, value, field, index, expected = TARGETS[target]
    system = System.load(with_target(target, keys))
    edited = system.edits.apply(system.model, np.array([value]))
    if index is not None:
        np.testing.assert_allclose(getattr(edited, field)[index], expected)
    assert_batch_equals_models(system, np.array([[value], [0.9 * value]]))


def assert_batch_equals_models(system, theta: np.ndarray) -> None:
    """A Batch of the candidates has the numbers of one edited model each, derived constants included."""
    batch = Batch(system.model, len(theta), 1)
    arrays = {name: batch.expand(name) for name in system.edits.fields}
    for _ in range(2):  # writing twice is writing once
        system.edits.write(arrays, theta)
    if system.edits.needs_set_const:
        batch.set_const()
    for row, candidate in enumerate(theta):
        single = system.edits.apply(system.model, candidate)
        for name in (*system.edits.fields, "body_subtreemass", "body_invweight0", "dof_invweight0", "dof_M0"):
            own = getattr(single, name)
            many = batch.expanded(name)
            many = np.array(batch.get_model(row).__getattribute__(name)) if many is None else many[row]
            np.testing.assert_allclose(many.reshape(own.shape), own, rtol=1e-12, atol=1e-15, err_msg=name)


def test_mass_carries_its_inertia_along_unless_told_not_to(with_target: Write) -> None:
    plain = System.load(with_target("{body: box, set: mass}"))
    heavy = plain.edits.apply(plain.model, np.array([6.0]))
    np.testing.assert_allclose(heavy.body_inertia[1], 3.0 * plain.model.body_inertia[1])
    alone = System.load(with_target("{body: box, set: mass, carry_inertia: false}"))
    heavy = alone.edits.apply(alone.model, np.array([6.0]))
    np.testing.assert_array_equal(heavy.body_inertia[1], alone.model.body_inertia[1])


def test_a_limit_stays_unless_the_gain_carries_it(with_target: Write) -> None:
    alone = System.load(with_target("{actuator: hip_servo, set: gain}"))
    strong = alone.edits.apply(alone.model, np.array([30.0]))
    np.testing.assert_array_equal(strong.actuator_forcerange[0], [-5.0, 5.0])


def test_a_limit_of_force_has_the_unit_of_its_joint(with_target: Write) -> None:
    system = System.load(with_target("{actuator: hip_servo, set: force_limit}"))
    assert (system.space.parameters[0].unit, system.space.nominal[0]) == ("N m", 5.0)


def test_mass_and_inertia_scale_compose_in_either_order(written: Write) -> None:
    system = System.load(
        written(
            "  scale: {targets: [{body: box, set: inertia, mode: scale}]}\n"
            "  mass: {targets: [{body: box, set: mass}]}\n"
        )
    )
    edited = system.edits.apply(system.model, np.array([1.5, 4.0]))
    np.testing.assert_allclose(edited.body_inertia[1], 1.5 * 2.0 * system.model.body_inertia[1])


def test_apply_leaves_its_model_alone_and_derives_constants(with_target: Write) -> None:
    system = System.load(with_target("{body: box, set: mass}"))
    heavy = system.edits.apply(system.model, np.array([20.0]))
    assert system.model.body_mass[1] == pytest.approx(2.0)
    assert system.edits.needs_set_const
    assert heavy.body_invweight0[1, 0] == pytest.approx(system.model.body_invweight0[1, 0] / 10.0)
    assert heavy.body_subtreemass[1] == pytest.approx(20.0)


def test_friction_alone_needs_no_derived_constants(with_target: Write) -> None:
    assert not System.load(with_target("{pair: slide, set: sliding_friction}")).edits.needs_set_const


def test_pair_friction_is_written_for_both_tangents(with_target: Write) -> None:
    system = System.load(with_target("{pair: slide, set: sliding_friction}"))
    edited = system.edits.apply(system.model, np.array([0.123]))
    np.testing.assert_allclose(edited.pair_friction[0, :2], 0.123)


def test_a_moving_centre_of_mass_compiles_the_body_in_its_general_form(with_target: Write) -> None:
    """MuJoCo takes short cuts for bodies whose frame is their inertial frame; Batch refuses to leave them."""
    system = System.load(with_target("{body: box, set: center_of_mass, axis: y}", "bounds: [-0.05, 0.05]"))
    assert system.model.body_simple[1] == 0
    assert_batch_equals_models(system, np.array([[0.02], [-0.03]]))


def test_the_models_own_values_are_the_default_prior(with_target: Write) -> None:
    parameter = System.load(with_target("{joint: hip, set: damping}")).space.parameters[0]
    assert (parameter.nominal, parameter.log, parameter.unit) == (0.1, True, "N m s/rad")
    assert (parameter.lower, parameter.upper) == (pytest.approx(0.01), pytest.approx(1.0))
    assert parameter.prior_sd == 0.5


def test_the_model_is_compiled_at_the_nominal_parameters(with_target: Write) -> None:
    system = System.load(with_target("{body: box, set: mass}", "nominal: 5"))
    assert system.model.body_mass[1] == pytest.approx(5.0)
    back = system.edits.apply(system.model, np.array([2.0]))
    assert back.body_inertia[1, 0] == pytest.approx(2.0 * 0.2**2 / 6.0)


def test_single_moments_stay_those_of_a_real_body(written: Write) -> None:
    keys = "bounds: [0.0001, 1]"
    system = System.load(
        written(
            f"  x: {{targets: [{{body: box, set: inertia, axis: x}}], {keys}}}\n"
            f"  y: {{targets: [{{body: box, set: inertia, axis: y}}], {keys}}}\n"
        )
    )
    inertia = system.edits.apply(system.model, np.array([0.5, 0.1])).body_inertia[1]
    np.testing.assert_allclose(inertia, [0.1 + 2.0 * 0.2**2 / 6.0, 0.1, 2.0 * 0.2**2 / 6.0])
    assert_batch_equals_models(system, np.array([[0.5, 0.1], [0.01, 0.02]]))


class TestPseudoInertia:
    @pytest.fixture
    def system(self, with_target: Write):
        return System.load(with_target("{body: hand, set: pseudo_inertia}"))

    def test_is_ten_parameters(self, system) -> None:
        names = ["alpha", "d1", "d2", "d3", "s12", "s23", "s13", "t1", "t2", "t3"]
        assert system.space.names == tuple(f"p.{name}" for name in names)

    def test_zero_is_the_nominal_body(self, system) -> None:
        body = system.model.body("hand").id
        nominal = system.edits.apply(system.model, np.zeros(10))
        plain = system.original.copy().compile()
        assert nominal.body_mass[body] == pytest.approx(plain.body_mass[body])
        np.testing.assert_allclose(nominal.body_ipos[body], plain.body_ipos[body], atol=1e-12)
        np.testing.assert_allclose(np.sort(nominal.body_inertia[body]), np.sort(plain.body_inertia[body]))

    def test_alpha_scales_mass_and_inertia_together(self, system) -> None:
        body = system.model.body("hand").id
        heavy = system.edits.apply(system.model, np.array([0.5, *[0.0] * 9]))
        assert heavy.body_mass[body] == pytest.approx(np.exp(1.0) * system.model.body_mass[body])
        np.testing.assert_allclose(heavy.body_ipos[body], system.model.body_ipos[body], atol=1e-12)

    def test_batch_equals_models(self, system) -> None:
        theta = np.random.default_rng(0).normal(0.0, 0.3, (4, 10))
        assert_batch_equals_models(system, theta)

    def test_of_an_impossible_body_is_refused(self, with_target: Write) -> None:
        model = """<mujoco><compiler boundmass="0"/><worldbody><body name="b"><freejoint/>
          <inertial pos="0 0 0" mass="1" diaginertia="1 1 2"/></body></worldbody></mujoco>"""
        folder = with_target("{body: b, set: pseudo_inertia}", model=model)
        text = (folder / "system.yaml").read_text()
        (folder / "system.yaml").write_text(
            text.split("signals")[0].replace("keyframe: home\n", "")
            + "signals: {b: {topic: /b, body: b, noise: {position: 0.01}}}\n"
        )
        with pytest.raises(ConfigError, match="no real body has"):
            System.load(folder)


def test_a_command_delay_is_a_column_of_theta(written: Write) -> None:
    system = System.load(
        written(
            "  mass: {targets: [{body: box, set: mass}]}\n"
            "  delay: {nominal: 0.01, bounds: [0.001, 0.05], targets: [{set: command_delay}]}\n",
            signals="signals: {c: {topic: /c, actuators: [hip_servo]}}\n",
        )
    )
    assert system.edits.longest_delay == 0.05
    late = system.edits.delays(np.array([[1.0, 0.02], [1.0, 0.03]]))
    np.testing.assert_array_equal(late, [[0.02, 0, 0, 0, 0, 0], [0.03, 0, 0, 0, 0, 0]])
    assert system.space.parameters[1].unit == "s"


def test_each_group_of_drives_has_its_own_delay(written: Write) -> None:
    system = System.load(
        written(
            "  hip: {nominal: 0.01, bounds: [0, 0.05], targets: [{actuator: 'hip*', set: command_delay}]}\n"
            "  knee: {nominal: 0.02, bounds: [0, .08], targets: [{actuator: 'knee*', set: command_delay}]}\n",
            signals="signals: {c: {topic: /c, actuators: [hip_servo, knee_motor]}}\n",
        )
    )
    assert system.edits.longest_delay == 0.08 and system.edits.late == {"hip", "knee"}
    np.testing.assert_array_equal(system.edits.delays(np.array([[0.02, 0.03]])), [[0.02, 0.03, 0, 0, 0, 0]])
    assert system.sets["knee"] == "command_delay of knee_motor"


TWICE = {
    "{actuator: hip_servo, set: command_delay}": "already sets this number",
    "{actuator: knee_speed, set: command_delay}": "no actuator that a signal commands 'knee_speed'",
    "{joint: hip, set: command_delay}": "needs actuator: NAME",
}


@pytest.mark.parametrize("target", TWICE)
def test_a_delay_that_two_parameters_or_none_would_set_is_refused(target: str, written: Write) -> None:
    folder = written(
        "  delay: {nominal: 0.01, bounds: [0, 0.05], targets: [{set: command_delay}]}\n"
        f"  more: {{nominal: 0.01, bounds: [0, 0.05], targets: [{target}]}}\n",
        signals="signals: {c: {topic: /c, actuators: [hip_servo]}}\n",
    )
    with pytest.raises(ConfigError, match=TWICE[target]):
        System.load(folder)


def test_a_delay_of_no_command_is_refused(written: Write) -> None:
    folder = written("  delay: {nominal: 0.01, bounds: [0.001, 0.05], targets: [{set: command_delay}]}\n")
    with pytest.raises(ConfigError, match="no signal commands actuators"):
        System.load(folder)


def test_without_a_command_delay_it_is_zero(with_target: Write) -> None:
    system = System.load(with_target("{body: box, set: mass}"))
    assert system.edits.longest_delay == 0.0
    np.testing.assert_array_equal(system.edits.delays(np.ones((3, 1))), np.zeros((3, 1)))


REFUSED = {
    "{body: world, set: mass}": "fixed to the world",
    "{body: table, set: mass}": "fixed to the world",
    "{body: table, set: inertia}": "fixed to the world",
    "{body: boxx, set: mass}": "no body 'boxx' (did you mean 'box'?)",
    "{body: 'leg_*', set: mass}": "no body that matches 'leg_*'",
    "{joint: hip, set: mass}": "target 'mass' needs body: NAME, not joint",
    "{body: box, set: mas}": "no target 'mas' (did you mean 'mass'?)",
    "{body: box, set: mass, axis: x}": "takes no axis",
    "{body: box, set: center_of_mass}": "needs axis",
    "{joint: knee, set: stiffness, mode: scale}": "scales zero",
    "{joint: knee, set: stiffness}": "the model's own stiffness is 0",
    "{joint: '*', set: damping}": "own values differ",
    "{actuator: muscle, set: gain}": "no fixed gain",
    "{actuator: two, set: integral_gain}": "no integral_gain in the model",
    "{actuator: knee_motor, set: slew_limit}": "is no <pid>",
    "{actuator: knee_motor, set: static_friction}": "is no <dcmotor>",
    "{actuator: knee_motor, set: actuator_damping}": "is a motor",
    "{actuator: knee_speed, set: force_limit}": "'knee_speed' has no forcerange",
    "{joint: knee, set: force_limit}": "'knee' has no actuatorfrcrange",
    "{actuator: hip_servo, set: ctrl_limit}": "'hip_servo' has no ctrlrange",
    "{actuator: knee_speed, set: gain, carry_limit: true}": "'knee_speed' has no forcerange",
    "{pair: [box, floor], set: sliding_friction}": "no contact pair between 'box' and 'floor'",
    "{pair: slip, set: sliding_friction}": "no pair 'slip' (did you mean 'slide'?)",
    "{set: command_delay}": "give a nominal value",
    "{actuator: knee_motor, set: resistance}": "'knee_motor' is no <dcmotor>",
    "{joint: hip, set: damping_cubic}": "the model's own damping_cubic is 0",
    "{body: '*', set: pseudo_inertia}": "bodies; a pseudo_inertia is of one",
}


@pytest.mark.parametrize("target", REFUSED)
def test_a_target_that_changes_nothing_is_refused_by_name(target: str, with_target: Write) -> None:
    with pytest.raises(ConfigError) as error:
        System.load(with_target(target))
    assert REFUSED[target] in str(error.value)
    assert "system.yaml:4:" in str(error.value)


@pytest.mark.parametrize(
    ("target", "keys", "text"),
    [
        ("{body: box, set: mass}", "nominal: 1, bounds: [-1, 3], scale: linear", "must be above 0"),
        ("{body: box, set: mass}", "nominal: 1, bounds: [0, 3], scale: linear", "must be above 0"),
        ("{body: box, set: mass, mode: add}", "bounds: [-2, 2]", "makes mass 0; it must be above 0"),
        ("{geom: box, set: sliding_friction}", "bounds: [-0.1, 3], scale: linear", "must be at least 0"),
        ("{joint: hip, set: damping, mode: scale}", "bounds: [-1, 2], scale: linear", "must be at least 0"),
        ("{joint: hip, set: damping}", "nominal: 2, bounds: [0.1, 1]", "strictly between its bounds"),
        ("{joint: hip, set: damping}", "bounds: [0, 1]", "needs a lower bound above 0"),
        ("{joint: hip, set: damping}", "scale: linear", "give bounds"),
        ("{body: hand, set: pseudo_inertia}", "bounds: [0.1, 1]", "must hold 0"),
        ("{body: hand, set: pseudo_inertia}", "nominal: 0.1", "relative to the model's own inertia"),
    ],
)
def test_impossible_values_are_refused(target: str, keys: str, text: str, with_target: Write) -> None:
    """MuJoCo accepts a negative mass in silence."""
    with pytest.raises(ConfigError, match=text):
        System.load(with_target(target, keys))


def test_two_parameters_cannot_set_the_same_number(written: Write) -> None:
    folder = written(
        "  one: {targets: [{joint: hip, set: damping}]}\n"
        "  two: {nominal: 1, targets: [{joint: '*', set: damping}]}\n"
    )
    with pytest.raises(ConfigError, match="parameter 'one' already sets this number"):
        System.load(folder)


def test_a_number_is_set_before_others_are_added_to_it(with_target: Write) -> None:
    """In any order in the file: else what is added would be lost."""
    folder = with_target("{joint: hip, set: damping, mode: add}", "bounds: [-0.05, 1]")
    text = (folder / "system.yaml").read_text()
    more = "parameters:\n  late: {nominal: 0.5, targets: [{joint: hip, set: damping}]}"
    for place in (
        text.replace("parameters:", more, 1),
        text.replace("\nsignals:", f"\n{more[12:]}\nsignals:", 1),
    ):
        (folder / "system.yaml").write_text(place)
        system = System.load(folder)
        names = list(system.space.names)
        theta = np.zeros(2)
        theta[names.index("late")], theta[1 - names.index("late")] = 0.5, 0.25
        assert system.edits.apply(system.model, theta).dof_damping[6] == pytest.approx(0.75)


numbers = arrays(np.float64, 10, elements=st.floats(-1.0, 1.0))
quaternions = arrays(np.float64, 4, elements=st.floats(-1.0, 1.0)).filter(lambda q: np.linalg.norm(q) > 0.1)


@given(numbers)
def test_every_vector_is_a_real_body(p: np.ndarray) -> None:
    mass, _, quaternion, inertia = body_numbers(log_cholesky(p)[None])
    assert mass[0] > 0.0
    assert np.all(inertia > 0.0)
    assert inertia[0].sum() - 2.0 * inertia[0].max() > -1e-12 * inertia.sum()  # triangle inequality
    assert np.linalg.norm(quaternion[0]) == pytest.approx(1.0)


@given(numbers)
def test_pseudo_inertia_round_trip(p: np.ndarray) -> None:
    factor = log_cholesky(p)
    mass, com, quaternion, inertia = (x[0] for x in body_numbers(factor[None]))
    j = pseudo_inertia(float(mass), com, quaternion, inertia)
    assert np.all(np.linalg.eigvalsh(j) > 0.0)
    np.testing.assert_allclose(j, factor @ factor.T, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(upper_factor(j), factor, atol=1e-7)


@given(quaternions)
def test_rotation_matrix_and_back(q: np.ndarray) -> None:
    q = q / np.linalg.norm(q)
    matrix = rotation_matrix(q)
    np.testing.assert_allclose(matrix @ [1.0, 2.0, 3.0], rotate(q, np.array([1.0, 2.0, 3.0])), atol=1e-12)
    back = quaternion_of(matrix)
    np.testing.assert_allclose(back * np.sign(back @ q), q, atol=1e-9)


def test_an_impossible_inertia_has_no_factor() -> None:
    bent = np.array([1.0, 1.0, 3.0])  # 3 > 1 + 1
    with pytest.raises(np.linalg.LinAlgError):
        upper_factor(pseudo_inertia(1.0, np.zeros(3), np.array([1.0, 0, 0, 0]), bent))


def test_principal_axes_are_found_whatever_their_order() -> None:
    quarter_about_y = np.array([np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0])  # x -> -z, z -> x
    assert [principal_axis(quarter_about_y, axis) for axis in range(3)] == [2, 1, 0]


def test_a_body_in_kg_and_m_is_that_of_its_mass_points() -> None:
    """A cloud of mass points: mass, centre of mass and inertia matrix by their definitions."""
    rng = np.random.default_rng(0)
    weights, points = rng.uniform(0.1, 1.0, 20), rng.normal(0.0, [0.1, 0.2, 0.3], (20, 3))
    homogeneous = np.concatenate((points, np.ones((20, 1))), axis=1)
    factor = upper_factor((weights[:, None] * homogeneous).T @ homogeneous)
    found = {name: value[0] for name, value in inertia_about_com(factor[None]).items()}
    com = weights @ points / weights.sum()
    x, _, z = (points - com).T
    assert found["mass"] == pytest.approx(weights.sum())
    assert [found[f"com_{axis}"] for axis in "xyz"] == pytest.approx(com)
    assert found["I_yy"] == pytest.approx(weights @ (x**2 + z**2))
    assert found["I_xz"] == pytest.approx(-weights @ (x * z))
    assert list(found)[4:] == ["I_xx", "I_yy", "I_zz", "I_xy", "I_xz", "I_yz"]
