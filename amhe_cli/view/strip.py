"""Pictures of clips as vector graphics: measured and predicted bodies over each other, for a report.

They need no renderer and no script: each geom is the outline of its projection, those further away first.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from amhe_cli.core import rotations
from amhe_cli.core.arrays import FloatArray
from amhe_cli.view.ghosts import Take, Track, Viewing
from amhe_cli.view.scene import Geom, Scene

#: Instants of a clip that are drawn, as shares of it.
INSTANTS = (1.0 / 3.0, 2.0 / 3.0, 1.0)
#: Width and height of one picture.
_SIZE = (360.0, 250.0)
#: Direction of the camera (azimuth, elevation) [rad], its distance in radii of the motion, its focal
#: length in heights of the picture before it zooms; and the direction to the light.
_AROUND, _ABOVE, _AWAY, _FOCAL = -2.2, 0.36, 3.2, 1.6
_LIGHT = np.array([-0.31, 0.4, 0.86])
#: Share of a picture's width and height that the bodies of all instants fill, above the line of the time.
_FILLED, _LINE = 0.9, 26.0
#: How far ghosts count for the frame beside the measured bodies, in sizes of these: they may run away.
_STRAY = 0.5
#: Most triangles of a shape whose sides are drawn one by one, as those of a box.
_SIDES = 12
#: How far the depth of a side counts beside that of its geom.
_TIE = 0.25
#: Middle of the part of a picture above the line of the time.
_MIDDLE = 0.5 * np.array([_SIZE[0], _SIZE[1] - _LINE])
_TINTS = ("#d97706", "#2563eb")


def strip(viewing: Viewing, take: Take) -> str:
    """An SVG element: a clip at some instants, side by side; nominal in amber, identified in blue."""
    width, height = _SIZE
    parts, frames = [], [round(share * (len(take.measured.poses) - 1)) for share in INSTANTS]
    camera = _Camera(viewing.scene, take, frames)
    for i, frame in enumerate(frames):
        ghosts = [track and track.poses[frame] for track in take.ghosts]
        seconds = take.start + frame * take.measured.step
        parts.append(
            f'<svg x="{i * (width + 8):g}" width="{width:g}" height="{height:g}">'
            f'<rect width="100%" height="100%" class="sky" fill="#eef2f6"/>'
            + "".join(_picture(viewing.scene, camera, take.measured.poses[frame], ghosts))
            + f'<text x="10" y="{height - 10:g}" font-size="13" class="ink" fill="#475569">'
            + f"{seconds:.2f} s</text></svg>"
        )
    whole = len(INSTANTS) * (width + 8) - 8
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {whole:g} {height:g}" role="img" '
        f'aria-label="measured and predicted bodies at three instants">{"".join(parts)}</svg>'
    )


def _picture(
    scene: Scene, camera: _Camera, measured: FloatArray, ghosts: Sequence[FloatArray | None]
) -> Iterator[str]:
    floor = max((g.pose[2] for g in scene.geoms if g.floor), default=None)
    if floor is not None:
        shadows = [
            _outline(camera.seen(_flat(_world(geom, measured), floor))[0])
            for geom in scene.geoms
            if geom.body >= 0
        ]
        yield f'<g opacity="0.16" fill="#0f172a">{"".join(map(_polygon, shadows))}</g>'
    yield _drawn(scene, camera, measured, None, moving=False)
    tints = _TINTS[-len(ghosts) :] if len(ghosts) > 1 else _TINTS
    for poses, tint in zip(ghosts, tints, strict=False):
        if poses is not None:
            yield f'<g opacity="0.55">{_drawn(scene, camera, poses, tint)}</g>'
    yield _drawn(scene, camera, measured, None)  # on top: ghosts are seen where they leave it


class _Camera:
    """Looks at a clip so that the bodies of all its pictures are inside, as large as possible."""

    def __init__(self, scene: Scene, take: Take, frames: Sequence[int]) -> None:
        measured = _bodies(scene, take.measured, frames)
        low, high = measured.min(axis=0), measured.max(axis=0)
        stray = _STRAY * float(np.linalg.norm(high - low))
        ghosts = [_bodies(scene, track, frames) for track in take.ghosts if track is not None]
        standing = [
            _world(geom, take.measured.poses[0]) for geom in scene.geoms if geom.body < 0 and not geom.floor
        ]
        near = [one for one in standing if (one > low - stray).all() and (one < high + stray).all()]
        shown = np.concatenate(
            [measured, *near, *(np.clip(one, low - stray, high + stray) for one in ghosts)]
        )
        toward = np.array(
            [np.cos(_AROUND) * np.cos(_ABOVE), np.sin(_AROUND) * np.cos(_ABOVE), np.sin(_ABOVE)]
        )
        right = np.array([-np.sin(_AROUND), np.cos(_AROUND), 0.0])
        self.axes = np.stack((right, np.cross(toward, right), toward), axis=1)
        self.eye = 0.5 * (low + high) + _AWAY * max(stray, 1e-3) * toward
        self._zoom, self._middle = 1.0, np.zeros(2)
        places = self.seen(shown)[0] - _MIDDLE
        ends = np.stack((places.min(axis=0), places.max(axis=0)))
        self._middle = ends.mean(axis=0)
        self._zoom = float(np.min(_FILLED * 2.0 * _MIDDLE / np.maximum(np.ptp(ends, axis=0), 1.0)))

    def seen(self, points: FloatArray) -> tuple[FloatArray, float]:
        """Places in the picture (n, 2) of points (n, 3), and their mean distance."""
        x, y, z = ((points - self.eye) @ self.axes).T
        scale = _FOCAL * _SIZE[1] / np.maximum(-z, 1e-3)
        places = self._zoom * (np.stack((scale * x, -scale * y), axis=1) - self._middle)
        return places + _MIDDLE, float(-z.mean())


def _bodies(scene: Scene, track: Track, frames: Sequence[int]) -> FloatArray:
    """Corners (n, 3) of the bodies that move, at some frames."""
    moving = [geom for geom in scene.geoms if geom.body >= 0]
    return np.concatenate([_world(geom, track.poses[frame]) for frame in frames for geom in moving])


def _drawn(scene: Scene, camera: _Camera, poses: FloatArray, tint: str | None, moving: bool = True) -> str:
    """The geoms that move, or those that do not, the furthest first; in their own colours, or all in one."""
    found = []
    for geom in scene.geoms:
        if geom.floor or (geom.body >= 0) is not moving:
            continue
        points = _world(geom, poses)
        middle = camera.seen(points)[1]
        for corners, light in _sides(geom, points, camera):
            flat, depth = camera.seen(corners)
            depth = middle + _TIE * (depth - middle)  # between geoms their middles decide
            color = tint or _color(geom, light)
            found.append((-depth, _polygon(_outline(flat), color, tint or _color(geom, 0.55 * light))))
    return "".join(text for _, text in sorted(found, key=lambda pair: pair[0]))


def _sides(geom: Geom, points: FloatArray, camera: _Camera) -> Iterator[tuple[FloatArray, float]]:
    """Corners of each visible side, and how much light falls on it; a round shape is one side."""
    faces = geom.shape.faces
    if not geom.shape.flat or len(faces) > _SIDES:
        yield points, 0.9
        return
    normals = np.cross(points[faces[:, 1]] - points[faces[:, 0]], points[faces[:, 2]] - points[faces[:, 0]])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    for normal in np.unique(normals.round(3), axis=0):
        own = np.unique(faces[(normals @ normal) > 0.99])
        if (camera.eye - points[own[0]]) @ normal > 0.0:
            yield points[own], float(0.62 + 0.4 * max(normal @ _LIGHT, 0.0))


def _world(geom: Geom, poses: FloatArray) -> FloatArray:
    """Corners of a geom in the world, shape (v, 3)."""
    points = rotations.rotate(geom.pose[3:], geom.shape.vertices) + geom.pose[:3]
    if geom.body < 0:
        return points
    return rotations.rotate(poses[geom.body, 3:], points) + poses[geom.body, :3]


def _flat(points: FloatArray, height: float) -> FloatArray:
    """Points moved along the light onto the floor."""
    shadow = points - (points[:, 2:] - height) / _LIGHT[2] * _LIGHT
    return shadow


def _outline(points: FloatArray) -> FloatArray:
    """Convex hull of points in a plane (n, 2), in order (Andrew's monotone chain)."""
    rows = np.unique((2.0 * points).round() / 2.0, axis=0).tolist()
    if len(rows) < 3:
        return np.array(rows)
    hull: list[list[float]] = []
    for order in (rows, rows[::-1]):
        start = len(hull)
        for x, y in order:
            while len(hull) - start > 1:
                (ax, ay), (bx, by) = hull[-2:]
                if (bx - ax) * (y - ay) - (by - ay) * (x - ax) > 0.0:
                    break
                hull.pop()
            hull.append([x, y])
        hull.pop()
    return np.array(hull)


def _polygon(points: FloatArray, fill: str = "", stroke: str = "") -> str:
    text = " ".join(f"{x:g},{y:g}" for x, y in points)
    paint = f' fill="{fill}" stroke="{stroke}" stroke-width="0.6"' if fill else ""
    return f'<polygon points="{text}"{paint}/>'


def _color(geom: Geom, light: float) -> str:
    return "#" + "".join(f"{round(255 * min(1.0, max(0.0, light * c))):02x}" for c in geom.color[:3])
