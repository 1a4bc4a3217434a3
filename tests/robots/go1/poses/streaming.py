"""Cameras that send our own datagrams at 100 Hz."""

from __future__ import annotations

import socket
import threading

import numpy as np

from amhe_cli.core.rotations import exp, multiply, rotate
from amhe_cli.robots.go1.link.process import Clock
from amhe_cli.robots.go1.poses.sources import pose_datagram

#: A robot that lies somewhere, headed somewhere.
TRUNK = (np.array([2.0, -1.0, 0.09]), exp(np.array([0.0, 0.0, 0.7])))


def free_port() -> int:
    """A UDP port that nobody has."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


class Stage:
    """Robot and box before cameras; use it as a context manager.

    Args:
        port: Where to send poses.
        box: Its place as the robot sees it [m].
        turn: Of the cameras' frame.
        names: Of trunk and box.
    """

    def __init__(
        self, port: int, box: tuple[float, float, float] = (0.6, 0.0, 0.15),
        turn: np.ndarray | None = None, names: tuple[str, str] = ("go1", "box"),
    ) -> None:  # fmt: skip
        self.trunk, self.silent = TRUNK, False
        self.extra: list[bytes] = []
        self.off = 0
        floor = TRUNK[0] * [1.0, 1.0, 0.0]
        poses = [TRUNK, (floor + rotate(TRUNK[1], np.array(box)), TRUNK[1])]
        if turn is not None:
            poses = [(rotate(turn, place), multiply(turn, pose)) for place, pose in poses]
        self._bodies = list(zip(names, poses, strict=True))
        self._to, self._stop = ("127.0.0.1", port), threading.Event()
        self._thread = threading.Thread(target=self._send)

    def __enter__(self) -> Stage:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def move_box(self, by: tuple[float, float, float]) -> None:
        """In the cameras' frame [m]."""
        name, (place, turn) = self._bodies[1]
        self._bodies[1] = name, (place + by, turn)

    def shift_box(self, frames: int) -> None:
        """Show it 0.5 m off to the side in the next frames."""
        self.off = frames

    def _send(self) -> None:
        clock = Clock()
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
            while not self._stop.wait(0.01):
                now = clock.now() - 77.0
                while self.extra:
                    client.sendto(self.extra.pop(), self._to)
                shift = np.array([0.0, 0.5, 0.0]) if self.off > 0 else np.zeros(3)
                self.off -= 1
                for number, (name, (true, pose)) in enumerate(self._bodies):
                    place = true + number * shift
                    if not self.silent:
                        client.sendto(pose_datagram(name, now, place, pose), self._to)
