"""False poses of an emulated robot's cameras, and what `amhe run` does about them."""

from __future__ import annotations

import json
import os
import random
import re
import socket
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from amhe_cli import System, read_log
from tests.cli.test_go1_run import QUICK, ROBOT, ROOT
from tests.robots.go1.emulator.emulating import emulating
from tests.robots.go1.poses.streaming import free_port

#: Makes the datagrams that are passed on in place of a pose; called with the number of poses since it walks.
Forge = Callable[[int, dict[str, Any]], list[dict[str, Any]]]
#: A robot that has come so far ahead walks [m].
WALKS = 0.03
#: From this pose on it pushes the box.
_PUSHING = 200

#: What is said of poses that froze: by legs that move, or by cameras whose noise is gone.
FROZEN = "cameras and legs contradict each other|its cameras were never so still"


class Relay:
    """Passes the poses of the emulated cameras on, and forges them once the robot walks."""

    def __init__(self, to: int, forge: Forge) -> None:
        self._end = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._end.bind(("127.0.0.1", 0))
        self._end.settimeout(0.1)
        self.port, self._to, self._forge = self._end.getsockname()[1], ("127.0.0.1", to), forge
        self._stop, self._walked = threading.Event(), 0
        self._thread = threading.Thread(target=self._serve)

    def __enter__(self) -> Relay:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        self._end.close()

    def _serve(self) -> None:
        start = None
        while not self._stop.is_set():
            try:
                pose = json.loads(self._end.recv(2048))
            except TimeoutError:
                continue
            if pose["body"] == "go1":
                start = start if start is not None else pose["position"][0]
                self._walked += pose["position"][0] - start > WALKS
            for one in self._forge(self._walked, pose) if self._walked else [pose]:
                self._end.sendto(json.dumps(one).encode(), self._to)


def held(body: str, noise: float, slide: float) -> Forge:
    """Shows a body where it was when it had begun to push, or sliding aside [m/s]; its times go on."""
    kept: list[dict[str, Any]] = []
    chance = random.Random(0)

    def forge(number: int, pose: dict[str, Any]) -> list[dict[str, Any]]:
        if number < _PUSHING or pose["body"] != body:
            return [pose]
        kept.append(kept[0] if kept else pose)
        x, y, z = (x + chance.gauss(0.0, noise) for x in kept[0]["position"])
        place = [x, y + slide * (pose["time"] - kept[0]["time"]), z]
        return [kept[0] | {"time": pose["time"], "position": place}]

    return forge


def walked(tmp_path: Path, forge: Forge, seconds: float) -> tuple[int, str, dict[str, Any]]:
    """A run with forged poses: its exit code, what it printed, and its result.json."""
    port = free_port()
    with Relay(port, forge) as relay:
        cameras = ["--mocap", "udp", "--mocap-port", str(relay.port)]
        with emulating("--set", "go1.slow=2", *cameras) as emulated:
            eyes = ["--pose", "udp", "--pose-port", str(port)]
            where = ["--host", "127.0.0.1", "--port", str(emulated.port), *eyes, "--set", "go1.slow=2"]
            more = ["--set", "go1.arm=auto", *QUICK, "--duration", str(seconds), "-o", str(tmp_path / "out")]
            ended = subprocess.run(
                [sys.executable, "-m", "amhe_cli", *ROBOT, *where, *more], check=False, timeout=120,
                stderr=subprocess.PIPE, text=True, env=os.environ | {"PYTHONPATH": str(ROOT)},
            )  # fmt: skip
    return ended.returncode, ended.stderr, json.loads((tmp_path / "out/result.json").read_text())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("body", "noise", "slide", "latest", "message"),
    [
        ("go1", 0.0, 0.0, 0.5, FROZEN),
        ("go1", 1e-6, 0.0, 0.5, FROZEN),
        ("go1", 1e-6, 0.3, 0.5, "cameras and legs contradict each other"),
        ("box", 0.0, 0.0, 1.0, "cm inside the box"),
        ("box", 1e-6, 0.0, 1.0, "cm inside the box"),
    ],
)
def test_a_pose_that_freezes_or_slides_damps_the_motors(
    tmp_path: Path, body: str, noise: float, slide: float, latest: float, message: str
) -> None:
    """It stays, equal to the last bit or with 1 um of noise, or slides aside, and its times go on.

    Single ones before that cannot be true, or are not numbers, change nothing.
    """
    wrong = {5: {"position": [1e300, 0.0, 0.0]}, 20: {"time": 1e9}, 35: {"position": [float("nan")] * 3}}
    hold = held(body, noise, slide)

    def forge(number: int, pose: dict[str, Any]) -> list[dict[str, Any]]:
        more = [pose | wrong.pop(number)] if pose["body"] == "box" and number in wrong else []
        return hold(number, pose) + more

    code, printed, record = walked(tmp_path, forge, 8.0)
    assert not wrong
    assert (code, record["link"]["trip"], record["link"]["dropped_poses"]) == (1, "pose_false", 2), printed
    assert record["diverged"] == 0
    assert re.search(message, printed), printed
    log = read_log(tmp_path / "out/log.mcap", System.load("go1_push"))
    seen = log.series["trunk.position" if body == "go1" else "box.position"]
    ahead = seen.values[seen.valid, 0]  # it slides aside
    stays = log.dt * (np.abs(ahead - ahead[-1]) < 1e-3).sum()
    print("noticed after", stays)
    assert 0.05 < stays < latest
