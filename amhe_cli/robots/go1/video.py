"""Films of the plant, without a screen: EGL, or OSMesa where there is none.

The library chooses MuJoCo's renderer by the environment when it is imported, too early for us: the contexts
are made here by themselves. Everything that a film needs is tried before a run begins.
"""

from __future__ import annotations

import copy
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.errors import ConfigError
from amhe_cli.core.floor import Floor
from amhe_cli.robots.go1.model import layout

Frame = NDArray[np.uint8]

FPS = 25
#: How fast the camera follows [1/s].
_FOLLOW = 1.5
_PATH_COLOR, _GOAL_COLOR, _FLOOR_COLOR = (
    (0.15, 0.39, 0.92, 0.55),
    (0.08, 0.55, 0.25, 1.0),
    (0.2, 0.3, 0.22, 0.4),
)
#: Distance [m], azimuth and elevation [degrees] of the camera, where a leg pushes and where the robot walks.
_VIEW_OF_LEG, _VIEW_OF_WALK = (2.2, 188.0, -24.0), (3.0, 108.0, -20.0)
#: Angle of view [degrees]: as of a lens from some way off.
_VIEW = 30.0
_LINE = 0.012  # half the width of lines on the floor [m]


class Film:
    """A camera that follows robot and box.

    Args:
        model: Model of the plant; a copy of it is drawn.
        floor: Lines and marks to draw on the floor.
        size: Width and height [pixels].

    Raises:
        ConfigError: Nothing can be drawn on this machine.
    """

    def __init__(self, model: mujoco.MjModel, floor: Floor, size: tuple[int, int] = (848, 480)) -> None:
        self._model, self._at, self._floor = copy.copy(model), layout(model), floor
        _simplify(self._model)
        self._data = mujoco.MjData(self._model)
        self.size = size
        self._gl = _gl_context(*size)
        self._gl.make_current()
        self._context = mujoco.MjrContext(self._model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._scene = mujoco.MjvScene(self._model, maxgeom=1000)
        self._options = mujoco.MjvOption()
        self._camera = mujoco.MjvCamera()
        view = _VIEW_OF_LEG if floor.one_leg else _VIEW_OF_WALK
        self._camera.distance, self._camera.azimuth, self._camera.elevation = view
        self._looking: FloatArray | None = None

    def frame(self, qpos: FloatArray, elapsed: float = np.inf) -> Frame:
        """A picture (height, width, 3) of coordinates (nq,), so many seconds after the last one."""
        self._data.qpos[:] = qpos
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_comPos(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
        self._follow(elapsed)
        everything = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(
            self._model, self._data, self._options, None, self._camera, everything, self._scene
        )
        self._decorate()
        width, height = self.size
        view, picture = mujoco.MjrRect(0, 0, width, height), np.empty((height, width, 3), np.uint8)
        self._gl.make_current()
        mujoco.mjr_render(view, self._scene, self._context)
        mujoco.mjr_readPixels(picture, None, view, self._context)
        return picture[::-1]

    def close(self) -> None:
        """Free the renderer; before another one is made, or it would free the other's pictures."""
        self._gl.make_current()
        self._context.free()
        self._gl.free()

    @contextmanager
    def shooting(self, path: Path, later: bool = False) -> Iterator[Shots]:
        """A function that takes the shots; the film is complete when the block ends, however it ends.

        Args:
            path: Path of the .mp4 file.
            later: Whether to draw only when the block ends, so that no time is lost before.
        """
        shots = Shots(self, path, later)
        try:
            yield shots
        finally:
            shots.close()
            self.close()

    def _follow(self, elapsed: float) -> None:
        places = self._data.qpos[self._at.trunk][:3], self._data.qpos[self._at.box][:3]
        wanted = 0.5 * (places[0] + places[1])
        wanted[2] = 0.16
        before = wanted if self._looking is None else self._looking
        self._looking = before + (1.0 - np.exp(-_FOLLOW * elapsed)) * (wanted - before)
        self._camera.lookat[:] = self._looking

    def _decorate(self) -> None:
        floor = self._floor
        if floor.other_floor is not None:
            half = 4.0
            self._plate((floor.other_floor + half, 0.0), (half, 1.2), 0.0, _FLOOR_COLOR, 0.0005)
        for start, end in zip(floor.path[:-1], floor.path[1:], strict=True):
            along = end - start
            half = 0.5 * float(np.hypot(*along))
            yaw = float(np.arctan2(along[1], along[0]))
            self._plate(0.5 * (start + end), (half + 0.2 * _LINE, _LINE), yaw, _PATH_COLOR, 0.001)
        self._outline(floor.path[-1], floor.goal_yaw)

    def _outline(self, place: FloatArray, yaw: float) -> None:
        """Draw the outline of a place where the box should stand."""
        depth, width = (0.5 * edge for edge in self._floor.footprint)
        ahead, left = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])
        self._plate(place, (depth, width), yaw, (*_GOAL_COLOR[:3], 0.25), 0.0015)
        for side in (-1.0, 1.0):
            self._plate(place + side * depth * ahead, (_LINE, width + _LINE), yaw, _GOAL_COLOR, 0.002)
            self._plate(place + side * width * left, (depth + _LINE, _LINE), yaw, _GOAL_COLOR, 0.002)

    def _plate(
        self, place: Any, half: tuple[float, float], yaw: float, color: Sequence[float], height: float
    ) -> None:
        """A thin plate on the floor, without shadow."""
        if self._scene.ngeom >= self._scene.maxgeom:
            return
        c, s = np.cos(yaw), np.sin(yaw)
        geom = self._scene.geoms[self._scene.ngeom]
        mujoco.mjv_initGeom(
            geom, mujoco.mjtGeom.mjGEOM_BOX, np.array([*half, 0.0002]), np.array([*place, height]),
            np.array([c, -s, 0.0, s, c, 0.0, 0.0, 0.0, 1.0]), np.array(color, np.float32),
        )  # fmt: skip
        geom.category = mujoco.mjtCatBit.mjCAT_DECOR
        self._scene.ngeom += 1


def _simplify(model: mujoco.MjModel) -> None:
    """Remove reflections, which are a second picture: without a GPU, half of the time of a frame."""
    model.vis.quality.shadowsize, model.vis.quality.offsamples = 4096, 4
    model.mat_reflectance[:] = 0.0
    model.vis.global_.fovy = _VIEW
    model.vis.map.shadowclip = 12.0  # the floor is speckled where the edge of the light's view meets it


class Shots:
    """Frames on their way into a file, one every 1 / FPS seconds."""

    def __init__(self, film: Film, path: Path, later: bool) -> None:
        self._film, self._later, self._kept = film, later, []
        self._writer = _writer(path, film.size)
        self._taken = 0

    def __call__(self, time: float, qpos: FloatArray) -> None:
        """Take a shot if one is due: the plant at a time [s] with coordinates (nq,)."""
        while self._taken <= time * FPS + 1e-6:
            self._taken += 1
            if self._later:
                self._kept.append(qpos)
            else:
                self._draw(qpos)

    def close(self) -> None:
        """Draw the postponed shots, and end the file."""
        for qpos in self._kept:
            self._draw(qpos)
        self._writer.close()

    def _draw(self, qpos: FloatArray) -> None:
        self._writer.send(np.ascontiguousarray(self._film.frame(qpos, 1.0 / FPS)))


def strip(frames: Sequence[Frame], width: int, gap: int = 6) -> Frame:
    """Pictures side by side, the middle `width` columns of each, with white gaps [pixels]."""
    columns = []
    for frame in frames:
        left = (frame.shape[1] - width) // 2
        columns += [np.full((frame.shape[0], gap, 3), 255, np.uint8), frame[:, left : left + width]]
    return np.concatenate(columns[1:], axis=1)


def check_encoder() -> None:
    """Check that a film could be written.

    Raises:
        ConfigError: There is no encoder.
    """
    try:
        import imageio_ffmpeg

        imageio_ffmpeg.get_ffmpeg_exe()
    except (ImportError, RuntimeError):
        raise ConfigError("`video` needs imageio-ffmpeg: pip install 'amhe[video]'") from None


def _writer(path: Path, size: tuple[int, int]) -> Any:
    import imageio_ffmpeg

    writer = imageio_ffmpeg.write_frames(
        str(path), size, fps=FPS, codec="libx264", quality=5, macro_block_size=2, ffmpeg_log_level="error",
        output_params=["-movflags", "+faststart"],
    )  # fmt: skip
    writer.send(None)
    return writer


def _gl_context(width: int, height: int) -> Any:
    """An off-screen OpenGL context of the first kind that works here."""
    kinds = ("egl", "osmesa") if sys.platform.startswith("linux") else ("cgl", "glfw")
    preferred = os.environ.get("MUJOCO_GL", "").strip().lower()
    failures = []
    for kind in sorted(kinds, key=lambda kind: kind != preferred):
        try:
            return _context_of(kind, width, height)
        except Exception as error:  # missing libraries fail in as many ways as there are drivers
            failures.append(f"{kind}: {' '.join(str(error).split()) or type(error).__name__}")
            _forget_opengl()
    raise ConfigError(f"`video` cannot draw on this machine: {'; '.join(failures)}")


def _context_of(kind: str, width: int, height: int) -> Any:
    from importlib import import_module

    return import_module(f"mujoco.{kind}").GLContext(width, height)


def _forget_opengl() -> None:
    """Unload PyOpenGL: it keeps the platform that it was first loaded for, even if that failed."""
    os.environ.pop("PYOPENGL_PLATFORM", None)
    for name in [name for name in sys.modules if name.split(".")[0] == "OpenGL"]:
        del sys.modules[name]
    for name in [name for name in sys.modules if name.startswith(("mujoco.egl", "mujoco.osmesa"))]:
        del sys.modules[name]
