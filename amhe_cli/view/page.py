"""One page of HTML that plays a viewing: data, style and script are in it, and it opens no connection.

The page of a saved file and that of a server are the same; a served one may also receive frames.
"""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.errors import printable
from amhe_cli.core.parameters import ParameterSpace
from amhe_cli.core.shown import TimeCurve
from amhe_cli.system.parameters.inertia import inertia_of
from amhe_cli.view.ghosts import Plotted, Recording, Take, Track, Viewing
from amhe_cli.view.scene import Scene
from amhe_cli.web import page as web

#: How far ghosts may leave the measured places, before they stop at an edge [m].
_BEYOND = 2.0
#: The 16-bit number that stands for no value.
_NONE = -32768
#: The largest 16-bit number of a value.
_MOST = 32767
#: Largest force that is drawn, in weights of the scene.
_STRONGEST = 10.0
#: Gravity of that weight [m/s^2].
_GRAVITY = 9.81
#: Most points of a curve.
_POINTS = 4000


@dataclass(frozen=True, slots=True)
class Heading:
    """What stands around the scene.

    Args:
        title: Title of the page.
        facts: The line below it, in parts.
        notes: Sentences that a reader needs to know.
        parameters: Rows of the table of parameters, see `parameter_rows`.
    """

    title: str
    facts: Sequence[str] = ()
    notes: Sequence[str] = ()
    parameters: Sequence[Mapping[str, Any]] = field(default_factory=tuple)


#: Packs a track as plain values.
Packed = Callable[[Track], dict[str, Any]]


def saved_page(viewing: Viewing, heading: Heading, **more: Any) -> str:
    """The page of a viewing, with all of its frames.

    Args:
        heading: What stands around the scene.
        more: `report`: address of the report of the same result; `asks`: who serves the page answers where
            it asks for another ghost.
    """
    data, packed = _recorded(viewing)
    return _page(heading, data | {"takes": [take_data(take, packed) for take in viewing.takes]} | more)


def ghost_data(viewing: Viewing, ghost: Track | None, cost: float) -> dict[str, Any]:
    """Another ghost of a clip as plain values, packed as in the page."""
    return {"track": None if ghost is None else _recorded(viewing)[1](ghost), "cost": cost}


def strip_data(viewing: Viewing, take: Take, scene: Scene, instants: int) -> dict[str, Any]:
    """A clip at some instants: the bodies as they were measured and as each candidate predicts them.

    One of them is the instant at which the first candidate is farthest away.

    Args:
        take: The clip.
        scene: What is drawn, of the same bodies.
        instants: How many; the last one is the end of the clip.
    """
    rows = np.linspace(0, len(take.rows) - 1, instants + 1).round().astype(int)[1:]
    tracks = [track for track in (take.measured, *take.ghosts) if track is not None]
    if len(tracks) > 1:
        noise = np.array([one.noise or 1.0 for one in viewing.columns])
        gaps = np.nan_to_num(np.abs(tracks[1].values - tracks[0].values) / noise, posinf=0.0)
        widest = int(np.argmax(gaps.max(axis=1)))
        if widest != rows[-1]:  # the last one stays the end
            rows[np.argmin(abs(rows[:-1] - widest))] = widest
    return _about(scene, (), viewing.candidates) | {
        "times": take.ends[0] + take.measured.step * rows,
        "frames": [[_floats(track.poses[row]) for track in tracks] for row in rows],
    }


def live_page(
    scene: Scene, ghosts: Sequence[str], curves: Sequence[TimeCurve], step: float, heading: Heading
) -> str:
    """A page whose frames are still to come.

    Args:
        scene: What is drawn.
        ghosts: Names of the ghosts.
        curves: What will be plotted; it has no values yet.
        step: Time between two frames [s].
        heading: What stands around the scene.
    """
    empty = Track(step, np.empty((0, len(scene.bodies), 7)), np.empty((0, 0)))
    none = Viewing(scene, (), tuple(ghosts), (Recording("", empty, np.empty((0, 2)), curves),), (), 0)
    return _page(heading, _recorded(none)[0] | {"takes": [], "live": True})


def take_data(take: Take, packed: Packed) -> dict[str, Any]:
    """A clip as plain values."""
    tracks = (take.measured, *take.ghosts)
    return {
        "recording": take.recording, "start": take.ends[0], "stop": take.ends[1], "held": take.held_out,
        "costs": take.costs, "tracks": [None if one is None else packed(one) for one in tracks],
    }  # fmt: skip


def _recorded(viewing: Viewing) -> tuple[dict[str, Any], Packed]:
    """The data of a page but its clips, and what packs their tracks."""
    poses = _Range.of_poses([recording.track for recording in viewing.recordings])
    values = _Range.of_values([recording.track for recording in viewing.recordings])
    weight = _GRAVITY * float(viewing.scene.system.model.body_mass.sum())
    forces = _Range.of_forces(poses, weight)

    def packed(track: Track) -> dict[str, Any]:
        found = {
            "step": track.step, "poses": poses.packed(track.poses), "values": values.packed(track.values),
        }  # fmt: skip
        if track.forces is None or not track.forces.size:
            return found
        return found | {"forces": forces.packed(track.forces), "touching": track.forces.shape[1]}

    data = {
        **_about(viewing.scene, viewing.columns, viewing.candidates),
        "ranges": {"poses": poses.ends, "values": values.ends, "forces": forces.ends},
        "weight": weight,
        "recordings": [
            {
                "name": printable(one.name), "gaps": one.gaps, "track": packed(one.track),
                "curves": [_curve(curve) for curve in one.curves], "events": one.events,
            }
            for one in viewing.recordings
        ],
    }  # fmt: skip
    return data, packed


def _curve(curve: TimeCurve) -> dict[str, Any]:
    lower, upper = (None, None) if curve.band is None else curve.band
    numbers = {"times": curve.times, "values": curve.values, "lower": lower, "upper": upper}
    every = max(1, -(-len(curve.times) // _POINTS))
    return {"name": printable(curve.name), "group": curve.group, "unit": _unit(curve.unit)} | {
        name: None if values is None else _floats(values[::every]) for name, values in numbers.items()
    }


def parameter_rows(
    space: ParameterSpace,
    first: Mapping[str, float],
    known: Mapping[str, tuple[float, float, float]],
    verdicts: Mapping[str, str],
    bodies: Sequence[Mapping[str, Any]] = (),
) -> list[dict[str, Any]]:
    """Name, unit, first value and the ends of a slider of each parameter; estimate, interval and verdict.

    `bodies`: numbers of bodies, as in result.json, in place of the coordinates of their inertias.
    """
    rows, far = [], np.full(len(space), 2.5)
    whole = {one["name"].rpartition(".")[0] for one in bodies}
    for p, *ends in zip(space.parameters, space.theta_of(-far), space.theta_of(far), strict=True):
        low, high = (float(np.clip(end, p.lower, p.upper)) for end in ends)
        row: dict[str, Any] = {"name": p.name, "unit": _unit(p.unit), "first": first[p.name], "log": p.log}
        row |= {"low": low, "high": high, "verdict": verdicts.get(p.name, "")}
        if p.name in known:
            estimate, lower, upper = known[p.name]
            row |= {"estimate": estimate, "lower": max(lower, p.lower), "upper": min(upper, p.upper)}
        rows.append(row | ({"hidden": True} if inertia_of(p.name) in whole else {}))
    for one in bodies:
        rounding = 3e-4 * (one["upper"] - one["lower"])  # what is none of the interval's digits
        values = {"first": one["prior"], **{name: one[name] for name in ("estimate", "lower", "upper")}}
        values = {name: 0.0 if abs(value) < rounding else value for name, value in values.items()}
        rows.append({"name": one["name"], "unit": _unit(one["unit"]), "verdict": one["verdict"], **values})
    return rows


def _about(scene: Scene, columns: Sequence[Plotted], candidates: Sequence[str]) -> dict[str, Any]:
    """Scene, columns and candidates, as every page has them."""
    return {
        "bodies": [printable(name) for name in scene.names],
        "unmeasured": scene.unmeasured,
        "geoms": [
            {
                "body": geom.body, "pose": geom.pose, "color": geom.color, "floor": geom.floor,
                "flat": geom.shape.flat, "vertices": _floats(geom.shape.vertices),
                "faces": _text(geom.shape.faces.astype("<u2")),
            }
            for geom in scene.geoms
        ],
        "columns": [
            {"channel": c.channel, "name": printable(c.name), "unit": c.unit, "noise": c.noise}
            for c in columns
        ],
        "candidates": list(candidates),
    }  # fmt: skip


def _page(heading: Heading, data: dict[str, Any]) -> str:
    data |= {"notes": list(heading.notes), "parameters": list(heading.parameters)}
    title = f"{heading.title} · amhe view"
    return web.template("view.html.j2").render(
        title=title, heading=heading.title, facts=heading.facts, data=web.data(data)
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Range:
    """Lowest and highest value of each column of arrays that are packed as 16-bit numbers."""

    low: FloatArray
    high: FloatArray

    @classmethod
    def of_poses(cls, tracks: Sequence[Track]) -> _Range:
        places = np.concatenate([track.poses[..., :3].reshape(-1, 3) for track in tracks])
        low, high = (places.min(axis=0), places.max(axis=0)) if places.size else (np.zeros(3), np.zeros(3))
        return cls(np.append(low - _BEYOND, [-1.0] * 4), np.append(high + _BEYOND, [1.0] * 4))

    @classmethod
    def of_values(cls, tracks: Sequence[Track]) -> _Range:
        values = np.concatenate([track.values for track in tracks])
        low, high = np.zeros(values.shape[1]), np.zeros(values.shape[1])
        for k, column in enumerate(values.T):
            if (known := column[np.isfinite(column)]).size:
                low[k], high[k] = known.min(), known.max()
        margin = np.maximum(high - low, 1e-9)  # ghosts go further
        return cls(low - margin, high + margin)

    @classmethod
    def of_forces(cls, poses: _Range, weight: float) -> _Range:
        strongest = np.full(3, _STRONGEST * max(weight, 1e-9))
        return cls(np.append(poses.low[:3], -strongest), np.append(poses.high[:3], strongest))

    @property
    def ends(self) -> tuple[FloatArray, FloatArray]:
        return self.low, self.high

    def packed(self, values: FloatArray) -> str:
        share = (np.clip(values, self.low, self.high) - self.low) / (self.high - self.low)
        whole = np.where(np.isfinite(share), np.round((2.0 * share - 1.0) * _MOST), _NONE)
        return _text(whole.astype("<i2"))


def _unit(unit: str) -> str:
    return "" if unit == "-" else unit


def _floats(values: FloatArray) -> str:
    return _text(values.astype("<f4"))


def _text(values: Any) -> str:
    return b64encode(np.ascontiguousarray(values).tobytes()).decode()
