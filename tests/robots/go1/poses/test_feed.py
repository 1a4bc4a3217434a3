"""Poses of cameras: the feed, and the gate that they pass."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from amhe_cli.core.rotations import exp, multiply, rotate
from amhe_cli.robots.go1.link.process import Clock, ClockMap
from amhe_cli.robots.go1.poses.feed import PoseFeed, TimedPose, _Sender
from amhe_cli.robots.go1.poses.gate import Gate, check_axes, check_place, offset_pose, tilt_offset
from amhe_cli.robots.go1.poses.sources import PoseError, Sighting, UdpPoses, pose_datagram, read_pose
from amhe_cli.robots.go1.settings import Go1Settings, PoseSettings
from amhe_cli.robots.go1.state import Plane
from tests.robots.go1.stand_ins import free_port, repeating, udp

CLOCK = Clock()
BODIES = ("go1", "box")


@contextmanager
def sending(port: int, *bodies: str) -> Iterator[None]:
    """Poses of bodies at 200 Hz, by a clock that is 1000 s off."""

    def send() -> None:
        now = CLOCK.now() + 1000.0
        for body in bodies:
            message = pose_datagram(body, now, np.array([now, 0.0, 0.1]), np.array([1.0, 0, 0, 0]))
            client.sendto(message, ("127.0.0.1", port))

    with udp() as client, repeating(0.005, send):
        yield


@pytest.mark.flaky(reruns=2)
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


def passed_on(*looks: list[Sighting]) -> list[tuple[str, float]]:
    """Body and place of what the feed's process passes on, of what it sees at each look."""
    sent: list[tuple[str, float]] = []

    class Sent:
        def send(self, pose: TimedPose) -> None:
            sent.append((pose.body, pose.position[0]))

    sender = _Sender(Sent(), CLOCK)  # type: ignore[arg-type]
    for look in looks:
        sender.pass_on(look)
    return sent


def at(place: float, stamp: float | None = None, body: str = "go1") -> Sighting:
    return Sighting(body, np.array([place, 0.0, 0.3]), np.array([1.0, 0.0, 0.0, 0.0]), stamp)


def test_of_poses_that_waited_together_the_last_one_has_a_time() -> None:
    """Others without stamps would be steps in no time, and none of them true."""
    stamped = [at(float(k), 0.01 * k) for k in range(4)]
    assert passed_on(stamped) == [("go1", 0.0), ("go1", 1.0), ("go1", 2.0), ("go1", 3.0)]
    assert passed_on([at(0.0), at(1.0), at(5.0, body="box"), at(2.0)]) == [("box", 5.0), ("go1", 2.0)]


def test_a_pose_that_tells_no_time_and_stays_the_same_is_not_new() -> None:
    looks = [[at(place)] for place in (0.1, 0.1, 0.1, 0.2, 0.2, 0.1)]
    assert passed_on(*looks) == [("go1", 0.1), ("go1", 0.2), ("go1", 0.1)]


@pytest.mark.flaky(reruns=2)
def test_a_body_that_never_comes_is_named_with_those_that_do() -> None:
    port = free_port()
    with (
        sending(port, "go1", "box"),
        PoseFeed("udp", "127.0.0.1", port, Go1Settings(box="crate", connect_time=0.5)) as feed,
        pytest.raises(PoseError, match="no pose of 'crate'.*it has: box"),
    ):
        feed.first()


@pytest.mark.flaky(reruns=2)
def test_silence_is_named() -> None:
    feed = PoseFeed("udp", "127.0.0.1", free_port(), Go1Settings(connect_time=0.3))
    with feed, pytest.raises(PoseError, match="no body at all"):
        feed.first()


@pytest.mark.flaky(reruns=2)
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


@pytest.mark.flaky(reruns=2)
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


@pytest.mark.flaky(reruns=2)
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
             '{"body": "a", "position": [1, 2, 3], "orientation": [0, 0, 0, 0]}',
             f'{{"body": "a", "time": 1{"0" * 400}, "position": [1, 2, 3], "orientation": [1, 0, 0, 0]}}',
             "[]", '"x"', "7"],
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


@pytest.mark.flaky(reruns=2)
def test_poses_are_taken_from_the_first_that_sends_one(tmp_path: Path) -> None:
    port = free_port()
    with closing(UdpPoses("127.0.0.1", port)) as source, udp() as one, udp() as other:
        source.connect()
        for number in range(3):
            one.sendto(MESSAGE % (b"go1", number), ("127.0.0.1", port))
            other.sendto(MESSAGE % (b"box", number), ("127.0.0.1", port))
        assert [seen.body for seen in source.wait(1.0)] == ["go1"] * 3


@pytest.mark.flaky(reruns=2)
def test_poses_are_taken_from_the_named_port_only() -> None:
    port = free_port()
    with udp() as one, udp() as other:
        one.bind(("127.0.0.1", 0))
        with closing(UdpPoses("127.0.0.1", port, f"127.0.0.1:{one.getsockname()[1]}")) as source:
            source.connect()
            other.sendto(MESSAGE % (b"box", 1), ("127.0.0.1", port))
            one.sendto(MESSAGE % (b"go1", 1), ("127.0.0.1", port))
            assert [seen.body for seen in source.wait(1.0)] == ["go1"]


MESSAGE = b'{"body": "%s", "position": [1, 2, %d], "orientation": [1, 0, 0, 0]}'


LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
WANTED = np.array([0.6, 0.0, 0.15])


def turned(x: float, y: float, z: float) -> np.ndarray:
    return exp(np.array([x, y, z]))


def test_the_tasks_frame_lies_under_the_trunk_along_its_heading() -> None:
    heading = turned(0.0, 0.0, 2.0)
    trunk = (np.array([3.0, -1.0, 0.09]), multiply(heading, turned(0.02, -0.03, 0.0)))
    world = Plane.under(*trunk)
    position, orientation = world.seen(*trunk)
    np.testing.assert_allclose(position, [0.0, 0.0, 0.09], atol=1e-12)
    ahead = rotate(orientation, np.array([1.0, 0.0, 0.0]))
    assert np.arctan2(ahead[1], ahead[0]) == pytest.approx(0.0, abs=1e-9)
    box = (trunk[0] + rotate(heading, np.array([0.6, 0.1, 0.06])), heading)
    np.testing.assert_allclose(world.place(box[0]), [0.6, 0.1, 0.15], atol=0.01)


def test_a_rigid_body_elsewhere_on_the_trunk_is_moved_to_its_centre() -> None:
    centre, turn = np.array([1.0, 2.0, 0.3]), turned(0.1, -0.2, 0.7)
    offset = (0.05, -0.01, -0.08, 0.0, 0.0, 0.4)
    orientation = multiply(turn, turned(0.0, 0.0, -0.4))
    position = centre - rotate(orientation, np.array(offset[:3]))
    found = offset_pose((position, orientation), offset)
    np.testing.assert_allclose(found[0], centre, atol=1e-12)
    np.testing.assert_allclose(np.abs(found[1] @ turn), 1.0)


def test_the_tilt_that_is_proposed_makes_imu_and_cameras_agree() -> None:
    imu = turned(0.05, -0.04, 0.3)
    seen = multiply(turned(0.0, 0.0, 1.0), multiply(imu, turned(0.1, 0.2, 0.0)))
    pose = (np.array([0.0, 0.0, 0.1]), seen)
    mended = offset_pose(pose, (0.0, 0.0, 0.0, *tilt_offset(pose, imu)))
    np.testing.assert_allclose(tilt_offset(mended, imu), 0.0, atol=1e-9)


def test_a_frame_that_is_right_is_taken() -> None:
    check_axes((np.array([5.0, 1.0, 0.09]), turned(0.02, 0.0, 2.5)), turned(0.0, 0.03, -1.0))
    check_place(np.array([0.65, -0.05, 0.16]), WANTED, 0.15)


@pytest.mark.parametrize(
    ("position", "orientation", "message"),
    [
        ([0.0, 0.09, 0.0], turned(-np.pi / 2, 0.0, 0.0), "Up Axis: Z"),
        ([0.0, 0.0, 90.0], LEVEL, "stream metres"),
        ([0.0, 0.0, -0.2], LEVEL, "origin on the floor"),
        ([0.0, 0.0, 0.09], turned(0.4, 0.0, 0.0), "disagree by 23 degrees"),
    ],
)
def test_a_frame_that_cannot_be_is_refused(position, orientation, message: str) -> None:
    with pytest.raises(PoseError, match=message):
        check_axes((np.array(position), orientation), LEVEL)


@pytest.mark.parametrize(
    ("box", "message"),
    [
        ([-0.6, 0.0, 0.09], "each other's name"),
        ([0.9, 0.0, 0.15], "wants it at"),
        ([0.6, 0.0, 0.5], "wants it at"),
    ],
)
def test_a_box_that_is_elsewhere_is_refused(box, message: str) -> None:
    with pytest.raises(PoseError, match=message):
        check_place(np.array(box), WANTED, 0.15)


PERIOD = 0.01


class Cameras:
    """A robot that walks ahead of cameras, and the box before it."""

    def __init__(self) -> None:
        self.gate = Gate(PoseSettings(), "go1", "box")
        self.time, self.rng = 50.0, np.random.default_rng(0)

    def shows(self, body: str = "go1", by=(0.0, 0.0, 0.0), turn=(0.0, 0.0, 0.0), early: float = 0.0) -> bool:
        """Whether the next pose of a body is believed, that is off by so much."""
        self.time += PERIOD
        sway = 0.01 * np.sin(12.0 * self.time)
        place = np.array([0.3 * (self.time - 50.0) + 0.6 * (body == "box"), sway, 0.2])
        noisy = place + 0.001 * self.rng.standard_normal(3) + by
        pose = noisy, multiply(exp(np.array([0.0, 0.3 * sway, 0.0])), exp(np.array(turn)))
        return self.gate.believes(body, self.time + early, pose, self.time + 0.005, LEVEL, "")


@pytest.fixture
def cameras() -> Cameras:
    seen = Cameras()
    assert all(seen.shows(body) for _ in range(200) for body in ("go1", "box"))
    assert (seen.gate.dropped, seen.gate.doubt) == (0, "")
    return seen


@pytest.mark.parametrize(
    "wrong",
    [
        {"by": (1e300, 0.0, 0.0)}, {"by": (np.nan, 0.0, 0.0)}, {"by": (0.0, 25.0, 0.0)},
        {"by": (0.0, 0.1, 0.0)}, {"by": (0.0, 0.05, 0.0)}, {"turn": (0.0, 0.0, 0.5)},
        {"early": 1e9}, {"early": -0.2},
    ],
)  # fmt: skip
@pytest.mark.parametrize("body", ["go1", "box"])
def test_a_pose_that_cannot_be_true_is_dropped(cameras: Cameras, body: str, wrong: dict) -> None:
    assert not cameras.shows(body, **wrong)
    assert cameras.gate.dropped == 1
    assert all(cameras.shows(body) for _ in range(20))
    assert cameras.gate.doubt == ""


@pytest.mark.parametrize("by", [(-0.7, 0.0, 0.0), (1.6, 0.0, 0.0)])
def test_a_box_behind_the_robot_or_out_of_reach_is_none(by: tuple[float, float, float]) -> None:
    seen = Cameras()
    assert seen.shows("go1")
    assert not any(seen.shows("box", by) for _ in range(10))
    assert "10 of the last 100 poses of 'box' cannot be true: the box would be" in seen.gate.doubt


def test_ten_of_a_hundred_are_too_many(cameras: Cameras) -> None:
    for number in range(80):
        assert cameras.shows(by=(0.0, 0.5, 0.0) if number % 10 == 0 else (0.0, 0.0, 0.0)) == (number % 10 > 0)
    assert cameras.gate.doubt == ""
    for _ in range(2):
        assert not cameras.shows(by=(0.0, 0.5, 0.0))
    assert cameras.gate.doubt.startswith("10 of the last 100 poses of 'go1' cannot be true: it steps by")


def test_a_tilt_that_the_imu_does_not_feel_is_doubted_after_a_while(cameras: Cameras) -> None:
    """It grows slowly: no single pose is out of the way."""
    leant = 0
    for number in range(60):
        assert cameras.shows(turn=(0.0, 0.02 * number, 0.0))
        leant += 0.02 * number > np.deg2rad(15.5)
        if cameras.gate.doubt:
            break
    assert 18 <= leant <= 24
    assert "disagree by" in cameras.gate.doubt
