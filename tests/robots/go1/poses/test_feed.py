"""Pose sources in their process: what comes through, and what is reported when nothing does."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from amhe_cli.robots.go1.link.process import Clock, ClockMap
from amhe_cli.robots.go1.poses.feed import PoseFeed
from amhe_cli.robots.go1.poses.sources import PoseError, UdpPoses, pose_datagram, read_pose
from amhe_cli.robots.go1.settings import Go1Settings

CLOCK = Clock()
BODIES = ("go1", "box")


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@contextmanager
def sending(port: int, *bodies: str) -> Iterator[None]:
    """Poses of bodies at 200 Hz, by a clock that is 1000 s off."""
    stop = threading.Event()

    def send() -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
            while not stop.wait(0.005):
                now = CLOCK.now() + 1000.0
                for body in bodies:
                    place = np.array([now, 0.0, 0.1])
                    message = pose_datagram(body, now, place, np.array([1.0, 0, 0, 0]))
                    client.sendto(message, ("127.0.0.1", port))

    thread = threading.Thread(target=send)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


def test_poses_come_through_on_our_clock() -> None:
    port = free_port()
    with sending(port, *BODIES), PoseFeed("udp", "127.0.0.1", port, Go1Settings(connect_time=3.0)) as feed:
        assert set(feed.first()) == set(BODIES)
        time.sleep(0.3)
        poses = feed.poses()
    assert len(poses) > 30
    # the position tells when it was taken
    late = [pose.time - (pose.position[0] - 1000.0) for pose in poses]
    assert 0.0 <= np.median(late) < 0.03
    assert np.ptp(late) < 0.01


def test_a_pose_that_tells_no_time_and_stays_the_same_is_not_new() -> None:
    port, seen, places = free_port(), [], iter((0.1, 0.1, 0.1, 0.2, 0.2, 0.1))
    message = '{"body": "%s", "position": [1, 2, %s], "orientation": [1, 0, 0, 0]}'
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client,
        PoseFeed("udp", "127.0.0.1", port, Go1Settings(connect_time=20.0)) as feed,
    ):
        client.connect(("127.0.0.1", port))
        end = time.monotonic() + 10.0
        while not seen and time.monotonic() < end:  # until it listens
            with suppress(ConnectionRefusedError):
                client.send((message % ("other", time.monotonic())).encode())
            seen = feed.poses()
            time.sleep(0.01)
        for place in places:
            client.send((message % ("go1", place)).encode())
        client.send((message % ("last", 0.0)).encode())
        while seen[-1].body != "last" and time.monotonic() < end:
            seen += feed.poses()
    assert [pose.position[2] for pose in seen if pose.body == "go1"] == [0.1, 0.2, 0.1]


def test_a_body_that_never_comes_is_named_with_those_that_do() -> None:
    port = free_port()
    with (
        sending(port, "go1", "box"),
        PoseFeed("udp", "127.0.0.1", port, Go1Settings(box="crate", connect_time=0.5)) as feed,
        pytest.raises(PoseError, match="no pose of 'crate'.*it has: box"),
    ):
        feed.first()


def test_silence_is_named() -> None:
    feed = PoseFeed("udp", "127.0.0.1", free_port(), Go1Settings(connect_time=0.3))
    with feed, pytest.raises(PoseError, match="no body at all"):
        feed.first()


def test_a_source_that_blocks_for_ever_is_given_up() -> None:
    pytest.importorskip("motioncapture")
    begun = time.monotonic()
    feed = PoseFeed("motioncapture", "vicon:192.0.2.1", 0, Go1Settings(connect_time=0.5))
    with feed, pytest.raises(PoseError, match="no pose of 'go1' and 'box'"):
        feed.first()
    assert time.monotonic() - begun < 15.0


_PROGRAM = """
import sys, time
from amhe_cli.robots.go1.poses.feed import PoseFeed
from amhe_cli.robots.go1.settings import Go1Settings
with PoseFeed("udp", "127.0.0.1", int(sys.argv[1]), Go1Settings(connect_time=20.0)) as feed:
    while not feed._messages():
        time.sleep(0.01)
    print(feed._child.process.pid, flush=True)
    time.sleep(60)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="no child is notified elsewhere")
def test_a_source_that_blocks_for_ever_ends_with_a_program_that_is_killed() -> None:
    command = [sys.executable, "-c", _PROGRAM, str(free_port())]
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[4])}
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as program:
        assert program.stdout is not None
        feed = int(program.stdout.readline())
        os.kill(feed, signal.SIGSTOP)  # it does nothing any more, like one that waits for a camera
        program.kill()
    try:
        end = time.monotonic() + 10.0
        while _lives(feed) and time.monotonic() < end:
            time.sleep(0.01)
        assert not _lives(feed)
    finally:
        if _lives(feed):
            os.kill(feed, signal.SIGKILL)


def _lives(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_libmotioncapture_comes_through() -> None:
    pytest.importorskip("motioncapture")
    mocked = "mock:go1(0,0,0.3,1,0,0,0);box(0.6,0.1,0.15,0,0,0,1)"
    with PoseFeed("motioncapture", mocked, 0, Go1Settings(connect_time=3.0)) as feed:
        seen = feed.first()
    np.testing.assert_allclose(seen["box"].position, [0.6, 0.1, 0.15], atol=1e-6)
    np.testing.assert_allclose(np.abs(seen["box"].orientation), [0, 0, 0, 1], atol=1e-6)
    assert abs(seen["go1"].time - CLOCK.now()) < 5.0


@pytest.mark.medium
@settings(deadline=None, max_examples=50)
@given(st.binary(max_size=300) | st.text(max_size=200).map(str.encode))
def test_rubbish_is_no_pose(message: bytes) -> None:
    assert read_pose(message) is None


@pytest.mark.parametrize(
    "message", ['{"body": "a", "position": [1, 2], "orientation": [1, 0, 0, 0]}',
             '{"body": "a", "position": [1, 2, NaN], "orientation": [1, 0, 0, 0]}',
             '{"body": "a", "position": [1, 2, 3], "orientation": [0, 0, 0, 0]}', "[]", '"x"', "7"],
)  # fmt: skip
def test_what_is_no_pose_is_left_out(message: str) -> None:
    assert read_pose(message.encode()) is None


def test_the_offset_of_a_clock_is_found_under_jitter_and_drift() -> None:
    rng, known = np.random.default_rng(0), ClockMap()
    errors = []
    for sent in np.arange(0.0, 30.0, 0.002):
        ours = 500.0 + sent * 1.00005  # 50 ppm
        arrival = ours + 0.0003 + rng.exponential(0.002)
        errors.append(known.see(sent, arrival) - ours)
    late = np.array(errors[1000:])
    assert late.min() > 0.0
    assert late.max() < 0.0007


def test_poses_are_taken_from_the_first_that_sends_one(tmp_path: Path) -> None:
    port = free_port()
    with closing(UdpPoses("127.0.0.1", port)) as source, a_socket() as one, a_socket() as other:
        source.connect()
        for number in range(3):
            one.sendto(MESSAGE % (b"go1", number), ("127.0.0.1", port))
            other.sendto(MESSAGE % (b"box", number), ("127.0.0.1", port))
        assert [seen.body for seen in source.wait(1.0)] == ["go1"] * 3


def test_poses_are_taken_from_the_named_port_only() -> None:
    port = free_port()
    with a_socket() as one, a_socket() as other:
        one.bind(("127.0.0.1", 0))
        with closing(UdpPoses("127.0.0.1", port, f"127.0.0.1:{one.getsockname()[1]}")) as source:
            source.connect()
            other.sendto(MESSAGE % (b"box", 1), ("127.0.0.1", port))
            one.sendto(MESSAGE % (b"go1", 1), ("127.0.0.1", port))
            assert [seen.body for seen in source.wait(1.0)] == ["go1"]


MESSAGE = b'{"body": "%s", "position": [1, 2, %d], "orientation": [1, 0, 0, 0]}'


def a_socket() -> socket.socket:
    return socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
