"""The interface of pose sources, each of which has its own protocol."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.errors import AmheError

#: A body's position [m], shape (3,), and its orientation, a unit quaternion w, x, y, z, shape (4,).
Pose = tuple[FloatArray, FloatArray]


class PoseError(AmheError):
    """Poses do not come, or cannot be trusted."""


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """One body at one instant, as the source reports it.

    Args:
        body: Name of the body.
        position: Position [m], shape (3,).
        orientation: Unit quaternion w, x, y, z, shape (4,).
        stamp: Time stamp on the source's own clock [s]; None: it gives none.
        age: Time from the exposure to the sending, as far as the source gives it [s].
    """

    body: str
    position: FloatArray
    orientation: FloatArray
    stamp: float | None = None
    age: float = 0.0


class PoseSource(Protocol):
    """A source of poses. It lives in a process of its own: it may block, and may die."""

    @property
    def about(self) -> str:
        """Whom it listens to, in words."""
        ...

    def connect(self) -> None:
        """Reach the source.

        Raises:
            PoseError: It cannot be reached; the text says what to check.
        """
        ...

    def wait(self, seconds: float) -> list[Sighting]:
        """What was seen since the last call; waits for something, but no longer than this [s]."""
        ...

    def close(self) -> None:
        """Disconnect."""
        ...


def sighting(
    body: str, position: object, orientation: object, stamp: float | None = None, age: float = 0.0
) -> Sighting | None:
    """A sighting of a valid pose; None for any other: sources mark lost bodies by NaN or 0.

    Raises:
        ValueError, TypeError, OverflowError: Position or orientation are no numbers that fit.
    """
    place = np.asarray(position, dtype=np.float64)
    turn = np.asarray(orientation, dtype=np.float64)
    if place.shape != (3,) or turn.shape != (4,):
        return None
    size = math.hypot(*turn.tolist())
    if not (np.isfinite(place).all() and 0.5 < size < 2.0 and math.isfinite(stamp or 0.0)):
        return None
    return Sighting(body, place, turn / size, stamp, age)
