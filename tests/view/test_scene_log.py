"""Scenes in logs: by the published schemas, where MuJoCo has the bodies, and nothing else changes."""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

import amhe_cli as amhe
from amhe_cli.cli.main import run
from amhe_cli.core import rotations
from amhe_cli.logs import LogWriter, survey
from amhe_cli.robots.go1.recording import recorder_of
from amhe_cli.robots.go1.run import RunOptions, open_run
from amhe_cli.view.scene import scene_of
from amhe_cli.view.scene_log import FRAMES, GEOMS, SceneLog

#: Fields of foxglove's schemas in their order, as foxglove-schemas-protobuf 0.4.0 has them.
PUBLISHED = {
    "SceneUpdate": "deletions entities",
    "SceneEntityDeletion": "timestamp type id",
    "SceneEntity": "timestamp frame_id id lifetime frame_locked metadata "
    "arrows cubes spheres cylinders lines triangles texts models",
    "KeyValuePair": "key value",
    "ArrowPrimitive": "pose shaft_length shaft_diameter head_length head_diameter color",
    "Color": "r g b a",
    "CubePrimitive": "pose size color",
    "SpherePrimitive": "pose size color",
    "CylinderPrimitive": "pose size bottom_scale top_scale color",
    "LinePrimitive": "type pose thickness scale_invariant points color colors indices",
    "TriangleListPrimitive": "pose points color colors indices",
    "TextPrimitive": "pose billboard font_size scale_invariant color text",
    "ModelPrimitive": "pose scale color override_color url media_type data",
    "FrameTransforms": "transforms",
    "FrameTransform": "timestamp parent_frame_id child_frame_id translation rotation",
}


def messages(path: Path) -> dict[str, list[tuple[int, bytes]]]:
    """Every message by topic, as it lies in the file."""
    found: dict[str, list[tuple[int, bytes]]] = {}
    with path.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            found.setdefault(channel.topic, []).append((message.log_time, message.data))
    return found


def decoded(path: Path, topic: str) -> list[Any]:
    """The messages of a topic, by the definitions that the log has."""
    store, known, found = get_typestore(Stores.LATEST), set(), []
    with path.open("rb") as file:
        for schema, _, message in make_reader(file).iter_messages(topics=[topic]):
            assert schema is not None
            if schema.name not in known:
                types = get_types_from_msg(schema.data.decode(), schema.name)
                store.register({name: t for name, t in types.items() if name.startswith("foxglove")})
                known.add(schema.name)
            found.append(store.deserialize_cdr(message.data, schema.name))
    return found


def corners(entity: Any) -> np.ndarray:
    """All corners of an entity in its frame, shape (n, 3)."""
    found = []
    for part in entity.triangles:
        at, turn = part.pose.position, part.pose.orientation
        points = np.array([(p.x, p.y, p.z) for p in part.points])
        assert part.indices.max() < len(points)
        assert len(part.indices) % 3 == 0
        q = np.array([turn.w, turn.x, turn.y, turn.z])
        found.append(rotations.rotate(q, points) + np.array([at.x, at.y, at.z]))
    return np.concatenate(found)


@pytest.fixture(scope="module")
def toss(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cube that falls and turns for a second, written 1000 times."""
    path = tmp_path_factory.mktemp("scene") / "toss.mcap"
    scene = scene_of(amhe.System.load("cube_toss"))
    drawn = SceneLog(scene)
    qpos = scene.system.model.qpos0.copy()
    with LogWriter(path) as log:
        drawn.begin(log, 10**9)
        for step in range(1000):
            qpos[:3], qpos[3:7] = (
                (0.1, 0.2, 1.0 - 1e-3 * step),
                rotations.exp(np.array([0.0, 1e-3 * step, 0.0])),
            )
            drawn.write_state(log, 10**9 + step * 10**6, qpos)
    return path


def test_the_definitions_are_the_published_ones(toss: Path) -> None:
    with toss.open("rb") as file:
        schemas = make_reader(file).get_summary().schemas.values()  # type: ignore[union-attr]
    found: dict[str, Any] = {}
    for schema in schemas:
        assert schema.encoding == "ros2msg"
        found |= get_types_from_msg(schema.data.decode(), schema.name)
    ours = {
        name.split("/")[-1]: fields
        for name, (_, fields) in found.items()
        if name.startswith("foxglove_msgs/msg/")
    }
    assert {name: " ".join(field for field, _ in fields) for name, fields in ours.items()} == PUBLISHED


def test_a_cube_is_drawn_where_it_is(toss: Path) -> None:
    (update,), frames = decoded(toss, GEOMS), decoded(toss, FRAMES)
    assert len(frames) == 50, "a second at 50 Hz at most, however often it is written"
    cube = next(e for e in update.entities if e.frame_id == "scene/cube")
    assert cube.frame_locked
    assert (cube.lifetime.sec, cube.lifetime.nanosec) == (0, 0), "it stays until it is replaced"
    model = amhe.System.load("cube_toss").model
    half = np.array(model.geom("cube").size if "cube" in [model.geom(i).name for i in range(model.ngeom)]
                    else model.geom_size[model.body("cube").geomadr[0]])  # fmt: skip
    assert np.abs(corners(cube)).max(axis=0) == pytest.approx(half)
    last = frames[-1].transforms[0]
    stamp = last.timestamp.sec + 1e-9 * last.timestamp.nanosec
    assert (last.parent_frame_id, last.child_frame_id) == ("world", "scene/cube")
    assert last.translation.z == pytest.approx(1.0 - (stamp - 1.0))
    assert last.rotation.y == pytest.approx(np.sin(0.5 * (stamp - 1.0)))


def test_a_layout_of_it_has_a_panel_with_everything_that_is_drawn(toss: Path) -> None:
    panel = json.loads(amhe.layout(toss, "foxglove"))["configById"]["3D!scene"]
    assert set(panel["topics"]) == {GEOMS, FRAMES}
    assert panel["followTf"] == "world"


def test_the_robot_is_drawn_as_mujoco_has_it(tmp_path: Path) -> None:
    scene = scene_of(amhe.System.load("go1_push"))
    model, data = scene.system.model, mujoco.MjData(scene.system.model)
    data.qpos += np.random.default_rng(0).normal(0.0, 0.1, model.nq)
    mujoco.mj_kinematics(model, data)
    drawn = SceneLog(scene)
    with LogWriter(tmp_path / "a.mcap") as log:
        drawn.begin(log, 1)
        drawn.write_state(log, 1, data.qpos)
    (frames,), (update,) = decoded(tmp_path / "a.mcap", FRAMES), decoded(tmp_path / "a.mcap", GEOMS)
    assert len(frames.transforms) == 14
    for transform in frames.transforms:
        body = data.body(transform.child_frame_id.removeprefix("scene/"))
        at, turn = transform.translation, transform.rotation
        assert (at.x, at.y, at.z) == pytest.approx(tuple(body.xpos))
        assert (turn.w, turn.x, turn.y, turn.z) == pytest.approx(tuple(body.xquat))
    known = {transform.child_frame_id for transform in frames.transforms} | {"world"}
    assert {entity.frame_id for entity in update.entities} == known
    assert len({entity.id for entity in update.entities}) == len(update.entities)
    assert (tmp_path / "a.mcap").stat().st_size < 300_000


@pytest.mark.medium
def test_a_run_is_recorded_with_it_as_without_it(tmp_path: Path) -> None:
    system = amhe.System.load("go1_push")
    settings = {"control": {"samples": 5, "horizon": 8}}
    logs = []
    for name, drawing in (("bare", None), ("drawn", SceneLog(scene_of(system)))):
        opened = open_run(RunOptions("t1", duration=0.3, settings=settings))
        with recorder_of(opened, tmp_path / f"{name}.mcap", drawing) as recorder:
            for cycle in opened.episode.cycles():
                recorder.write(cycle)
        logs.append(messages(tmp_path / f"{name}.mcap"))
    bare, drawn = logs
    assert set(drawn) - set(bare) == {GEOMS, FRAMES}
    assert all(bare[topic] == drawn[topic] for topic in set(bare) - {"/amhe/timing", "/diagnostics"})
    assert drawn[GEOMS][0][0] == drawn[FRAMES][0][0] == drawn["/joint_commands"][0][0]
    first, second = (amhe.read_log(tmp_path / f"{name}.mcap", system) for name in ("bare", "drawn"))
    assert first.digest() == second.digest()
    topics = {topic.name: topic for topic in survey(tmp_path / "drawn.mcap").topics}
    assert not topics[GEOMS].paths, "thousands of corners are not listed as if they were measurements"
    pairs = itertools.pairwise(stamp for stamp, _ in drawn[FRAMES])
    assert all(after - before >= 19_000_000 for before, after in pairs)


def test_init_takes_no_frame_of_a_scene_for_a_measurement(tmp_path: Path) -> None:
    scene = scene_of(amhe.System.load("cube_toss"))
    drawn = SceneLog(scene)
    with LogWriter(tmp_path / "a.mcap") as log:
        drawn.begin(log, 10**7)
        for step in range(1, 60):
            drawn.write_state(log, step * 20_000_000, scene.system.model.qpos0)
            log.odometry(
                "/cube/odom", step * 20_000_000, (0.0, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0), child_frame="cube"
            )
    out = tmp_path / "out"
    assert (
        run(
            [
                "init",
                str(Path(__file__).parents[2] / "models/cube_toss/scene.xml"),
                str(tmp_path / "a.mcap"),
                "-o",
                str(out),
            ]
        )
        == 0
    )
    text = (out / "system.yaml").read_text()
    assert "/cube/odom" in text
    assert "/amhe/" not in text
