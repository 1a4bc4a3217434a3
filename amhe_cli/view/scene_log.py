"""A scene in a log: 3-D panels of viewers draw its geoms, which are written once, where its bodies are.

The messages are foxglove_msgs/SceneUpdate and foxglove_msgs/FrameTransforms, which viewers know by name.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import groupby
from typing import Any

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.errors import LogError
from amhe_cli.core.log import Log
from amhe_cli.logs import LogWriter
from amhe_cli.system.system import System
from amhe_cli.view.ghosts import MeasuredLog
from amhe_cli.view.scene import Geom, Scene, scene_of

#: Topic of the geoms.
GEOMS = "/amhe/scene"
#: Topic of the frames that they are fixed to.
FRAMES = "/amhe/frames"
#: Most messages of frames in a second.
RATE = 50.0
#: Most messages of frames of one replay.
MOST = 20_000
#: Before the names of bodies: a signal may be called as a body is, and has measured poses of its own on /tf.
_PREFIX = "scene/"

_POSE, _COLOR = "geometry_msgs/Pose pose\n", "foxglove_msgs/Color color\n"
_SIZED = f"{_POSE}geometry_msgs/Vector3 size\n"
_POINTS = f"geometry_msgs/Point[] points\n{_COLOR}foxglove_msgs/Color[] colors\nuint32[] indices\n"
#: Types of foxglove_msgs by name, as published (github.com/foxglove/foxglove-sdk, schemas/ros2).
TYPES = {
    "Color": "float64 r\nfloat64 g\nfloat64 b\nfloat64 a\n",
    "KeyValuePair": "string key\nstring value\n",
    "ArrowPrimitive": f"{_POSE}float64 shaft_length\nfloat64 shaft_diameter\nfloat64 head_length\n"
    f"float64 head_diameter\n{_COLOR}",
    "CubePrimitive": f"{_SIZED}{_COLOR}",
    "SpherePrimitive": f"{_SIZED}{_COLOR}",
    "CylinderPrimitive": f"{_SIZED}float64 bottom_scale\nfloat64 top_scale\n{_COLOR}",
    "LinePrimitive": "uint8 LINE_STRIP=0\nuint8 LINE_LOOP=1\nuint8 LINE_LIST=2\n"
    f"uint8 type\n{_POSE}float64 thickness\nbool scale_invariant\n{_POINTS}",
    "TriangleListPrimitive": f"{_POSE}{_POINTS}",
    "TextPrimitive": f"{_POSE}bool billboard\nfloat64 font_size\nbool scale_invariant\n{_COLOR}string text\n",
    "ModelPrimitive": f"{_POSE}geometry_msgs/Vector3 scale\n{_COLOR}bool override_color\nstring url\n"
    "string media_type\nuint8[] data\n",
    "SceneEntityDeletion": "uint8 MATCHING_ID=0\nuint8 ALL=1\n"
    "builtin_interfaces/Time timestamp\nuint8 type\nstring id\n",
    "SceneEntity": "builtin_interfaces/Time timestamp\nstring frame_id\nstring id\n"
    "builtin_interfaces/Duration lifetime\nbool frame_locked\nfoxglove_msgs/KeyValuePair[] metadata\n"
    + "".join(
        f"foxglove_msgs/{kind}Primitive[] {name}\n"
        for kind, name in (
            ("Arrow", "arrows"), ("Cube", "cubes"), ("Sphere", "spheres"), ("Cylinder", "cylinders"),
            ("Line", "lines"), ("TriangleList", "triangles"), ("Text", "texts"), ("Model", "models"),
        )
    ),
    "SceneUpdate": "foxglove_msgs/SceneEntityDeletion[] deletions\nfoxglove_msgs/SceneEntity[] entities\n",
    "FrameTransform": "builtin_interfaces/Time timestamp\nstring parent_frame_id\nstring child_frame_id\n"
    "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n",
    "FrameTransforms": "foxglove_msgs/FrameTransform[] transforms\n",
}  # fmt: skip


class SceneLog:
    """Writes a scene into one log.

    Args:
        scene: What is drawn.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self._frames = [_PREFIX + name for name in scene.names]
        self._due = 0.0

    def begin(self, log: LogWriter, stamp_ns: int) -> None:
        """Write the geoms; a robot that runs must not wait for it.

        Args:
            log: The log.
            stamp_ns: Time of the first state [ns].
        """
        for name, definition in TYPES.items():
            log.define(f"foxglove_msgs/msg/{name}", definition)
        log.prepare(["foxglove_msgs/msg/FrameTransforms"])
        entities = list(self._entities(log, stamp_ns))
        self._write(log, GEOMS, "SceneUpdate", stamp_ns, deletions=[], entities=entities)

    def write_state(self, log: LogWriter, stamp_ns: int, qpos: FloatArray) -> None:
        """Write the frames of a state, shape (nq,), unless they were written just before."""
        if stamp_ns >= self._due:
            self.write(log, stamp_ns, self.scene.poses(qpos[None])[0])

    def write(self, log: LogWriter, stamp_ns: int, poses: FloatArray) -> None:
        """Write the frames.

        Args:
            log: The log.
            stamp_ns: Time of the poses [ns].
            poses: Positions [m] and quaternions of the scene's bodies, shape (b, 7).
        """
        self._due = stamp_ns + 1e9 / RATE - 1e3  # stamps are rounded
        transforms = [
            log.message(
                "foxglove_msgs/msg/FrameTransform", timestamp=log.time(stamp_ns), parent_frame_id="world",
                child_frame_id=frame, translation=log.vector(pose[:3]), rotation=log.quaternion(pose[3:]),
            )
            for frame, pose in zip(self._frames, poses, strict=True)
        ]  # fmt: skip
        self._write(log, FRAMES, "FrameTransforms", stamp_ns, transforms=transforms)

    @staticmethod
    def _write(log: LogWriter, topic: str, kind: str, stamp_ns: int, **fields: Any) -> None:
        name = f"foxglove_msgs/msg/{kind}"
        log.write(topic, name, stamp_ns, log.message(name, **fields))

    def _entities(self, log: LogWriter, stamp_ns: int) -> Iterator[Any]:
        """One entity for each body, and one for all that never moves."""
        nothing = dict.fromkeys(
            ("metadata", "arrows", "cubes", "spheres", "cylinders", "lines", "texts", "models"), ()
        )
        geoms = sorted(self.scene.geoms, key=lambda geom: geom.body)
        for body, own in groupby(geoms, key=lambda geom: geom.body):
            frame = self._frames[body] if body >= 0 else "world"
            yield log.message(
                "foxglove_msgs/msg/SceneEntity", timestamp=log.time(stamp_ns), frame_id=frame, id=frame,
                lifetime=log.message("builtin_interfaces/msg/Duration", sec=0, nanosec=0), frame_locked=True,
                triangles=[_triangles(log, geom) for geom in own], **nothing,
            )  # fmt: skip


def measured_scene(system: System, recorded: Log, z: FloatArray) -> Callable[[LogWriter], None]:
    """What writes a system's scene as a log measured it, with that log's stamps; nothing where it never did.

    Args:
        system: The system.
        recorded: The log.
        z: Parameters that readings are corrected with, shape (d,).
    """

    def write(log: LogWriter) -> None:
        scene = scene_of(system)
        try:
            track = MeasuredLog(scene, recorded, z).track(min(RATE, MOST / max(recorded.duration, 1.0)))
        except LogError:  # there is no instant with a whole state
            return
        drawn = SceneLog(scene)
        drawn.begin(log, recorded.start_ns)
        for row, poses in enumerate(track.poses):
            drawn.write(log, recorded.start_ns + round(1e9 * row * track.step), poses)

    return write


def _triangles(log: LogWriter, geom: Geom) -> Any:
    r, g, b, a = geom.color
    point = "geometry_msgs/msg/Point"
    return log.message(
        "foxglove_msgs/msg/TriangleListPrimitive",
        pose=log.pose_of(geom.pose[:3], geom.pose[3:]),
        points=[log.message(point, x=x, y=y, z=z) for x, y, z in geom.shape.vertices.tolist()],
        color=log.message("foxglove_msgs/msg/Color", r=r, g=g, b=b, a=a),
        colors=[],
        indices=geom.shape.faces.ravel().astype(np.uint32),
    )
