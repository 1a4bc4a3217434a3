"""Vicon, VRPN, Qualisys and others by `motioncapture` (libmotioncapture).

It gives no time stamps and no validity, and `connect` to a host that does not answer waits for ever: that is
why every source lives in a process that can be ended.
"""

from __future__ import annotations

from typing import Any

from amhe_cli.robots.go1.poses.source import PoseError, Sighting, sighting

#: The kinds that its package on PyPI was built with.
KINDS = ("vicon", "vrpn", "qualisys", "optitrack", "mock")


class MotionCapture:
    """See `source.PoseSource`.

    Args:
        kind: One of `KINDS`.
        host: Host of the system; for `mock`: what to mock, 'name(x,y,z,qw,qx,qy,qz);...'.
    """

    def __init__(self, kind: str, host: str) -> None:
        self._kind, self._host = kind, host
        self._client: Any = None

    @property
    def about(self) -> str:
        """See `PoseSource`."""
        return f"{self._kind} at {self._host}, by libmotioncapture, which checks no sender"

    def connect(self) -> None:
        """See `PoseSource`."""
        try:
            import motioncapture  # pyright: ignore[reportMissingImports]
        except ImportError:
            raise PoseError("`pose=motioncapture` needs: pip install 'amhe[mocap]'") from None
        mock = {"rigid_bodies": self._host, "frequency": "100"}
        settings = mock if self._kind == "mock" else {"hostname": self._host}
        self._client = motioncapture.connect(self._kind, settings)  # pyright: ignore[reportAttributeAccessIssue]
        if self._client is None:
            raise PoseError(
                f"this build of motioncapture knows no {self._kind!r}; there is: {', '.join(KINDS)}"
            )

    def wait(self, seconds: float) -> list[Sighting]:
        """See `PoseSource`; waits for the next frame, however long."""
        self._client.waitForNextFrame()
        found = []
        for name, body in dict(self._client.rigidBodies).items():
            turn = body.rotation
            one = sighting(name, body.position, (turn.w, turn.x, turn.y, turn.z))
            if one:
                found.append(one)
        return found

    def close(self) -> None:
        """See `PoseSource`."""
        self._client = None
