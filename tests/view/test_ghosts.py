"""Scenes and ghosts: what is drawn stands where the model and the log say."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

import amhe_cli as amhe
from amhe_cli.core.belief import belief_of
from amhe_cli.core.errors import ConfigError
from amhe_cli.core.rotations import exp
from amhe_cli.core.shown import TimeCurve
from amhe_cli.engine.open import open_engine
from amhe_cli.estimation.offline.clips import whole
from amhe_cli.report.identification_page import Beside
from amhe_cli.view.ghosts import Viewing, continued, viewing
from amhe_cli.view.open import view_of
from amhe_cli.view.page import Heading, saved_page, strip_data
from amhe_cli.view.scene import scene_of
from amhe_cli.view.shapes import Shape, decimated, shape_of
from tests.conftest import PENDULUM_TRUTH, write_pendulum_log
from tests.matching.test_efforts import recorded, system_of
from tests.report.synthetic import identification
from tests.report.test_identification import page as report_of


@pytest.fixture(scope="module")
def system() -> amhe.System:
    return amhe.System.load("pendulum")


@pytest.fixture(scope="module")
def log(pendulum_log: Path, system: amhe.System) -> amhe.Log:
    return amhe.read_log(pendulum_log, system)


@pytest.fixture(scope="module")
def shown(system: amhe.System, log: amhe.Log) -> Viewing:
    truth = system.space.z_of(np.array([PENDULUM_TRUTH[name] for name in system.space.names]))
    return viewing(
        system, [(whole(log), None)], {"nominal": np.zeros(4), "truth": truth}, open_engine(system)
    )


def test_the_ghost_of_the_true_parameters_stays_with_the_measured_body(shown: Viewing) -> None:
    for take in shown.takes:
        away = [
            np.abs(ghost.poses[..., :3] - take.measured.poses[..., :3]).max()
            for ghost in take.ghosts
            if ghost
        ]
        assert away[1] < 0.01  # [m]; the noise of the first state
        assert away[0] > 2.0 * away[1]


def test_ghosts_begin_where_the_clip_was_measured(shown: Viewing) -> None:
    for take in shown.takes:
        for ghost in take.ghosts:
            assert ghost is not None
            assert ghost.poses[0] == pytest.approx(take.measured.poses[0], abs=1e-6)


def test_bodies_stand_where_kinematics_puts_them(shown: Viewing, log: amhe.Log) -> None:
    angle, track = log["joints.position"].values[:, 0], shown.recordings[0].track
    model = shown.scene.system.model
    data, load = mujoco.MjData(model), shown.scene.names.index("load")
    for frame in (0, 57, 200):
        data.qpos[:] = angle[round(frame * track.step / log.dt)]
        mujoco.mj_kinematics(model, data)
        assert track.poses[frame, load, :3] == pytest.approx(data.body("load").xpos)


def test_clips_come_by_their_misfit_those_held_out_first(system: amhe.System, log: amhe.Log) -> None:
    half = log.steps // 2
    parts = [
        (replace(whole(log), length=half), False),
        (replace(whole(log), start=half, length=half - 1), True),
    ]
    found = viewing(system, parts, {"nominal": np.zeros(4)}, open_engine(system))
    held = [take.held_out is True for take in found.takes]
    assert held == sorted(held, reverse=True)
    for group in (True, False):
        costs = [take.costs[-1] for take in found.takes if take.held_out is group]
        assert len(costs) > 1
        assert costs == sorted(costs, reverse=True)


def test_a_gap_is_marked_and_keeps_the_last_state(system: amhe.System, tmp_path: Path) -> None:
    path = write_pendulum_log(tmp_path / "gap.mcap", 4.0, silent=(1.5, 2.5))
    log = amhe.read_log(path, system)
    found = viewing(system, [(whole(log), None)], {"nominal": np.zeros(4)}, open_engine(system))
    (gap,) = found.recordings[0].gaps
    assert gap == pytest.approx([1.5, 2.5], abs=0.02)
    track = found.recordings[0].track
    assert (np.ptp(track.poses[round(1.6 / track.step) : round(2.4 / track.step)], axis=0) == 0.0).all()


def test_another_ghost_is_predicted_when_it_is_asked_for(system: amhe.System, log: amhe.Log) -> None:
    view = view_of(system, [log])
    first = system.space.named(system.space.nominal)
    (nominal,) = view.found.takes[2].ghosts
    assert nominal is not None
    same, cost = view.found.again(view.found.takes[2], system.space.nominal)
    assert same is not None and same.poses == pytest.approx(nominal.poses, abs=1e-9)
    assert cost == pytest.approx(view.found.takes[2].costs[0])
    asked = {"take": "2", **{name: str(value) for name, value in first.items()}}
    true = {name: str(value) for name, value in PENDULUM_TRUTH.items()}
    assert view.answer(asked)["cost"] == pytest.approx(cost)
    assert view.answer(asked | true)["cost"] < 0.2 * cost
    for wrong in (
        {"take": "999"},
        {"take": "x"},
        {"load_mass": "nan"},
        {"load_mass": "-1"},
        {"load_mass": "1e9"},
    ):
        with pytest.raises(ConfigError):
            view.answer(asked | wrong)
    with pytest.raises(ConfigError):
        view.answer({})


def test_what_was_believed_then_predicts_each_clip(system: amhe.System, log: amhe.Log) -> None:
    """The estimate becomes true in the middle of the log: clips before it are predicted as before it."""
    times, half = np.array([0.0, 4.0]), PENDULUM_TRUTH
    first = system.space.named(system.space.nominal)
    curves = [
        TimeCurve(name, "parameters", "", times, np.array([first[name], half[name]]))
        for name in system.space.names
    ]
    view = view_of(system, [log], curves=curves)
    assert view.found.candidates == ("before", "at that time")
    for take in view.found.takes:
        before, then = take.costs
        assert then < 0.5 * before if take.ends[0] >= 4.0 else then == pytest.approx(before)


def test_a_page_of_a_long_log_stays_small(system: amhe.System, tmp_path: Path) -> None:
    time = np.arange(0.0, 600.0, 0.01)
    (quantity,) = next(signal.quantities for signal in system.signals if signal.name == "command")
    arrays = {
        "joints": {"time": time, "position": np.sin(time), "velocity": np.cos(time)},
        "command": {"time": time, quantity: np.sin(time)},
    }
    page = view_of(system, [amhe.Log.from_arrays(arrays, system)]).page()
    assert len(page) < 5_000_000
    assert "more clips are not shown" in page


def test_the_best_ghost_has_the_forces_under_its_parameters() -> None:
    model = """<mujoco><worldbody><geom type="plane" size="2 2 0.1"/>
      <body name="box"><freejoint name="free"/><geom type="box" size="0.1 0.1 0.1" mass="2"/></body>
      </worldbody></mujoco>"""
    system = amhe.System.from_model(
        mujoco.MjSpec.from_string(model),
        parameters={"m": {"unit": "kg", "nominal": 2.0, "bounds": [0.1, 9.0], "scale": "log", "prior_sd": 0.3,
                          "targets": [{"body": "box", "set": "mass"}]}},
        signals={"box": {"body": "box", "quantity": ["position", "orientation"],
                         "noise": {"position": 0.01, "orientation": 0.01}}},
        warn=False,
    )  # fmt: skip
    time = np.arange(0.0, 2.0, 0.01)
    place = np.stack((0.4 * time, 0.0 * time, 0.0 * time + 0.0999), axis=1)
    level = np.tile([1.0, 0.0, 0.0, 0.0], (time.size, 1))
    log = amhe.Log.from_arrays({"box": {"time": time, "position": place, "orientation": level}}, system)
    z = {"nominal": np.zeros(1), "heavy": system.space.z_of(np.array([3.0]))}
    found = viewing(system, [(whole(log), None)], z, open_engine(system))
    assert found.takes
    for take in found.takes:
        nominal, heavy = take.ghosts
        assert nominal is not None
        assert heavy is not None
        assert nominal.forces is None
        assert heavy.forces is not None
        # it slides on the floor with the weight of its own mass, below its centre
        assert np.median(heavy.forces[:, 0, 5]) == pytest.approx(3.0 * 9.81, rel=0.05)
        assert heavy.forces[-1, 0, :2] == pytest.approx(heavy.poses[-1, 0, :2], abs=0.1)


def test_a_model_without_shapes_of_which_nothing_is_compared_has_a_page() -> None:
    model = """<mujoco><worldbody><body><joint name="a"/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
      </body></worldbody></mujoco>"""
    system = amhe.System.from_model(
        mujoco.MjSpec.from_string(model),
        parameters={"damping": {"nominal": 0.1, "targets": [{"joint": "a", "set": "damping"}]}},
        signals={"joints": {"joints": ["a"]}},
        warn=False,
    )
    time = np.arange(0.0, 1.0, 0.01)
    log = amhe.Log.from_arrays({"joints": {"time": time, "position": np.sin(time)}}, system)
    assert "<html" in amhe.show(system, [log]).html


def test_a_body_whose_joint_has_no_signal_is_unmeasured() -> None:
    model = """<mujoco><worldbody><body name="one"><joint name="a" axis="0 1 0"/><geom size="0.1" mass="1"/>
      <body name="two"><joint name="b" axis="0 1 0"/><geom size="0.1" mass="1" pos="0 0 1"/></body></body>
      <body name="three"><joint name="c"/><geom size="0.1" mass="1"/></body></worldbody></mujoco>"""
    system = amhe.System.from_model(
        mujoco.MjSpec.from_string(model),
        parameters={"m": {"unit": "kg", "nominal": 1.0, "bounds": [0.1, 9.0], "scale": "log", "prior_sd": 0.3,
                          "targets": [{"body": "one", "set": "mass"}]}},
        signals={"joints": {"joints": ["a"], "quantity": "position", "noise": {"position": 0.01}}},
        warn=False,
    )  # fmt: skip
    scene = scene_of(system)
    assert [scene.names[i] for i in scene.unmeasured] == ["two", "three"]


SHAPES = {
    "sphere": ('type="sphere" size="0.2"', 4 / 3 * np.pi * 0.2**3),
    "capsule": ('type="capsule" size="0.1 0.3"', np.pi * 0.1**2 * 0.6 + 4 / 3 * np.pi * 0.1**3),
    "cylinder": ('type="cylinder" size="0.1 0.3"', np.pi * 0.1**2 * 0.6),
    "ellipsoid": ('type="ellipsoid" size="0.1 0.2 0.3"', 4 / 3 * np.pi * 0.006),
    "box": ('type="box" size="0.1 0.2 0.3"', 8 * 0.006),
}


def volume(shape: Shape) -> float:
    """By the divergence theorem: right only if the surface is closed and each triangle looks outwards."""
    a, b, c = (shape.vertices[column] for column in shape.faces.T)
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0)


@pytest.mark.parametrize("kind", SHAPES)
def test_shapes_have_the_volume_of_their_geoms(kind: str) -> None:
    text, expected = SHAPES[kind]
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody><geom {text}/></worldbody></mujoco>")
    shape = shape_of(model, 0, 1000)
    assert shape is not None
    assert volume(shape) == pytest.approx(expected, rel=0.08)  # inscribed facets


def test_a_decimated_mesh_keeps_its_extent() -> None:
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><asset><mesh name="m" builtin="sphere" params="4"/></asset>'
        '<worldbody><geom type="mesh" mesh="m"/></worldbody></mujoco>'
    )
    fine, coarse = shape_of(model, 0, 10**6), shape_of(model, 0, 800)
    assert fine is not None
    assert coarse is not None
    assert len(coarse.faces) <= 800 < len(fine.faces)
    assert volume(coarse) == pytest.approx(volume(fine), rel=0.15)
    assert decimated(coarse, 10**6) is coarse


def test_rotation_vectors_go_on_beyond_a_turn() -> None:
    angle = np.linspace(0.0, 12.0, 50)
    axis = np.array([0.6, 0.0, 0.8])
    wrapped = amhe_log(angle[:, None] * axis)
    assert continued(wrapped) == pytest.approx(angle[:, None] * axis)
    assert continued(wrapped[-3:], angle[-3] * axis) == pytest.approx(angle[-3:, None] * axis)


def amhe_log(vectors: np.ndarray) -> np.ndarray:
    from amhe_cli.core.rotations import log

    return log(exp(vectors))


def test_a_strip_has_the_instant_of_the_largest_gap_and_no_instant_twice(shown: Viewing) -> None:
    take, scene = shown.takes[0], scene_of(shown.scene.system)
    first, *others = take.ghosts
    assert first is not None
    last = len(take.rows) - 1
    for widest in (2, last // 2 + 1, last):
        values = take.measured.values.copy()
        values[widest] += 100.0
        apart = replace(take, ghosts=(replace(first, values=values), *others))
        times = strip_data(shown, apart, scene, 5)["times"]
        assert len(set(times)) == 5 and times[-1] == pytest.approx(take.ends[0] + take.measured.step * last)
        assert np.isclose(times, take.ends[0] + take.measured.step * widest).any()


def test_names_from_a_log_cannot_end_the_script(shown: Viewing) -> None:
    evil = replace(shown.recordings[0], name="</script><script>alert(1)</script>")
    page = saved_page(replace(shown, recordings=(evil,)), Heading("<b>"))
    assert "alert(1)</script>" not in page
    assert "<b>" not in page.partition("<style>")[0]


def test_a_model_without_shapes_is_drawn_as_rods() -> None:
    model = """<mujoco><worldbody><body name="upper"><joint name="a"/>
      <inertial pos="0 0 -.2" mass="1" diaginertia="1 1 1"/><body name="lower" pos="0 0 -.3"><joint name="b"/>
      <inertial pos="0 0 -.1" mass="1" diaginertia="1 1 1"/></body></body></worldbody></mujoco>"""
    system = amhe.System.from_model(
        mujoco.MjSpec.from_string(model),
        parameters={"damping": {"nominal": 0.1, "targets": [{"joint": "a", "set": "damping"}]}},
        signals={"joints": {"joints": ["a", "b"], "noise": {"position": 0.01}}},
        warn=False,
    )
    scene = scene_of(system)
    assert scene.names == ["upper", "lower"]
    lengths = [(geom.body, np.ptp(geom.shape.vertices[:, 2])) for geom in scene.geoms]
    assert lengths == [(0, pytest.approx(0.2)), (0, pytest.approx(0.3)), (1, pytest.approx(0.1))]


@pytest.mark.medium
def test_matched_efforts_are_ghosts_that_move_as_measured() -> None:
    system = system_of()
    truth = dict(zip(system.space.names, system.space.nominal, strict=True)) | {"lower": 0.8, "offset": 0.2}
    theta = np.array([truth[name] for name in system.space.names])
    log = recorded(system, theta)
    found = viewing(
        system,
        [(whole(log), None)],
        {"before": np.zeros(len(theta)), "after": system.space.z_of(theta)},
        open_engine(system),
    )
    assert len(found.takes) > 3 and {one.channel for one in found.columns} == {"torque.effort"}
    for take in found.takes:
        before, after = take.ghosts
        assert before is not None and after is not None
        assert (after.poses == take.measured.poses).all()
        misses = [np.sqrt(np.nanmean((one.values - take.measured.values) ** 2)) for one in (before, after)]
        assert misses[1] < 0.15 < misses[0]  # [N m]; the noise is .1
        assert take.costs[1] < take.costs[0]
    assert found.again(found.takes[0], theta)[1] == pytest.approx(found.takes[0].costs[1])
    notes = view_of(system, [log]).heading.notes
    assert any("along the measured motion" in note for note in notes)


@pytest.mark.medium
def test_the_demos_pages_are_light() -> None:
    system = amhe.System.load("go1_push")
    log = amhe.read_log("example:t1", system)
    truth = json.loads(log.metadata["truth"])
    z = system.space.z_of(np.array([truth[name] for name in system.space.names]))
    view = view_of(system, [log], belief=belief_of(system, z, 1e-4 * np.eye(len(z))), fitted=True)
    assert len(view.page().encode()) < 1_500_000
    seen = Beside(view.strip(0), view.whole_log())
    assert len(report_of(identification(), seen=seen).encode()) < 600_000
