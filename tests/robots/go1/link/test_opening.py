"""What a dry run says of this computer's pace."""

from __future__ import annotations

import errno
import os
import resource
import signal
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import pytest

from amhe_cli.core.errors import AmheError
from amhe_cli.robots.go1.emulator import Emulator, EmulatorOptions
from amhe_cli.robots.go1.link.calibration import Calibration
from amhe_cli.robots.go1.link.link import Link
from amhe_cli.robots.go1.link.open import pace
from amhe_cli.robots.go1.link.packets import LinkError
from amhe_cli.robots.go1.link.process import (
    PLANNER,
    POSES,
    SENDER,
    Child,
    Clock,
    planning_first,
    take_priority,
)
from amhe_cli.robots.go1.link.target import Go1Target
from amhe_cli.robots.go1.model import Box
from amhe_cli.robots.go1.poses.feed import PoseFeed
from amhe_cli.robots.go1.settings import Go1Settings
from amhe_cli.robots.go1.tasks import find_task
from tests.robots.go1.stand_ins import free_port

pytestmark = pytest.mark.flaky(reruns=2)


def cycles(ms: float, rollouts: int) -> list:
    step = SimpleNamespace(rollouts=rollouts)
    return [SimpleNamespace(plan_ms=ms, plan=SimpleNamespace(step=step))] * 100


def test_a_pace_that_is_held_is_said_in_numbers() -> None:
    found = pace(cycles(14.0, 8) + cycles(17.0, 6), 8, 0.02)
    assert found == "7.0 of 8 rollouts in a cycle (6 at least), 16 ms of 20 ms (99 %: 17 ms)"


def test_a_computer_on_which_the_least_does_not_fit_is_refused_with_the_numbers() -> None:
    with pytest.raises(LinkError, match=r"4 rollouts .* takes 34 ms, the median of 100, .* is 20 ms"):
        pace(cycles(34.0, 4), 8, 0.02)
    assert pace(cycles(34.0, 8), 8, 0.16).endswith("34 ms of 160 ms (99 %: 34 ms)")


SETTINGS, CLOCK = Go1Settings(), Clock()


def open_files() -> int:
    return len(list(Path("/dev/fd").iterdir()))


def taken(port: int) -> bool:
    """Whether somebody has a UDP port of this computer."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(("127.0.0.1", port))
        except OSError:
            return True
    return False


class Processes:
    """Starts processes as `subprocess.Popen`, until one is to fail: it does once the poses' port is bound."""

    def __init__(self, pose_port: int) -> None:
        self.started: list[subprocess.Popen[bytes]] = []
        self.allowed, self._port, self._start = 99, pose_port, subprocess.Popen

    def __call__(self, *arguments, **options) -> subprocess.Popen[bytes]:
        if len(self.started) == self.allowed:
            self.wait_for_the_port()
            raise BlockingIOError("no more processes")
        self.started.append(self._start(*arguments, **options))
        return self.started[-1]

    def wait_for_the_port(self) -> None:
        end = time.monotonic() + 20.0
        while self.started and not taken(self._port):
            assert time.monotonic() < end, "the pose source never listened"
            time.sleep(0.01)


@pytest.fixture
def port() -> int:
    return free_port()


@pytest.fixture
def processes(port: int, monkeypatch: pytest.MonkeyPatch) -> Iterator[Processes]:
    counted = Processes(port)
    monkeypatch.setattr(subprocess, "Popen", counted)
    yield counted
    for process in counted.started:
        process.kill()
        process.wait()


def target(link: Link, feed: PoseFeed) -> AbstractContextManager:
    return Go1Target(link, feed, SETTINGS, CLOCK, 0.02, Box())


def calibration(link: Link, feed: PoseFeed) -> AbstractContextManager:
    return Calibration(link, feed, SETTINGS, CLOCK, Box())


def no_wakeup(processes: Processes) -> Callable[..., int]:
    def fail(descriptor: int, **_: object) -> int:
        if descriptor >= 0:
            processes.wait_for_the_port()
            raise ValueError("no signals")
        return -1

    return fail


@pytest.mark.parametrize(
    ("what", "step"), [(target, "poses"), (target, "sender"), (target, "signals"), (calibration, "sender")]
)
def test_a_step_that_fails_leaves_nothing_behind(
    what: Callable[[Link, PoseFeed], AbstractContextManager], step: str, port: int, processes: Processes,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    if step == "signals":
        monkeypatch.setattr(signal, "set_wakeup_fd", no_wakeup(processes))
    else:
        processes.allowed = ("poses", "sender").index(step)
    link = Link("127.0.0.1", free_port(), SETTINGS, CLOCK)
    feed = PoseFeed("udp", "127.0.0.1", port, SETTINGS)
    files = open_files()
    # its traceback keeps all that was made: no collector may help
    with pytest.raises((BlockingIOError, ValueError), match="no more processes|no signals") as raised:
        what(link, feed).__enter__()
    assert len(processes.started) == {"poses": 0, "sender": 1, "signals": 2}[step]
    assert all(process.poll() is not None for process in processes.started), "a process lives on"
    assert not taken(port)
    assert open_files() == files, raised.value


@pytest.mark.parametrize("step", ["cameras", "body"])
def test_an_emulator_that_cannot_open_gives_its_ports_back(
    step: str, port: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise AmheError("no body")

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        mocap = other.getsockname()[1] if step == "cameras" else 0
        if step == "body":
            monkeypatch.setattr("amhe_cli.robots.go1.emulator.EmulatedBody", fail)
        emulator = Emulator(EmulatorOptions(find_task("t1"), port=port, mocap_port=mocap))
        with pytest.raises(AmheError, match="cannot be had|no body") as raised, emulator:
            pass
        assert not taken(port), raised.value
    if step == "cameras":
        assert "give this one `mocap_port` and its `amhe run` the same `pose_port`" in str(raised.value)


def test_without_linux_sockets_the_link_says_so_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*kind: int) -> None:
        raise OSError(errno.EPROTONOSUPPORT, "Protocol not supported")  # as macOS does

    monkeypatch.setattr(socket, "socketpair", refuse)
    with pytest.raises(AmheError, match="the link to a robot needs Linux"):
        Child("amhe_cli.robots.go1.link.sender", {})


def scheduling() -> tuple[int, int, set[int]]:
    return os.sched_getscheduler(0), os.sched_getparam(0).sched_priority, os.sched_getaffinity(0)


def test_a_planner_keeps_off_the_last_core_and_goes_first_while_it_plans() -> None:
    before = scheduling()
    found, within = [], []

    def plan() -> None:
        with planning_first() as cores_and_priority:
            found.append(cores_and_priority)
            within.append(scheduling())
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        plan()
    assert scheduling() == before
    (((policy, _, used),), ((cores, first),)) = within, found
    assert first == (policy == os.SCHED_FIFO)
    assert used == (before[2] - {max(before[2])} if first and len(before[2]) > 1 else before[2])
    assert cores == len(used)


@pytest.fixture
def granted(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The highest real-time priority that is granted (as `ulimit -r`), then those that were taken."""
    most: list[int] = []

    def choose(_: int, policy: int, param: os.sched_param) -> None:
        if policy == os.SCHED_FIFO and param.sched_priority > most[0]:
            raise PermissionError
        most.append(param.sched_priority)

    monkeypatch.setattr(os, "sched_setscheduler", choose)
    monkeypatch.setattr(os, "sched_setaffinity", Mock())
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1, 2})
    monkeypatch.setattr(os, "nice", Mock())
    return most


def test_a_planner_takes_real_time_priority_below_all_else_of_the_link(granted: list[int]) -> None:
    granted.append(99)
    with planning_first() as (cores, first):
        assert granted[-1] == PLANNER
    assert (cores, first) == (2, True)
    assert granted[-1] == scheduling()[1]


@pytest.mark.parametrize("most", [0, PLANNER, SENDER - 1])
def test_without_real_time_priority_for_all_nobody_has_it_and_no_core_is_given_up(
    granted: list[int], most: int
) -> None:
    """A planner alone with it would go before the sender."""
    granted.append(most)
    with planning_first() as (cores, first):
        pass
    assert (cores, first) == (3, False)
    assert not take_priority(POSES)
    assert granted == [most]
    os.sched_setaffinity.assert_not_called()  # type: ignore[attr-defined]


def test_a_core_that_is_refused_costs_no_priority(
    granted: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    granted.append(99)
    monkeypatch.setattr(os, "sched_setaffinity", Mock(side_effect=OSError(errno.EINVAL, "Invalid argument")))
    assert take_priority(SENDER)


@pytest.mark.parametrize("refusal", [OSError("blocked"), ValueError("not allowed to raise maximum limit")])
def test_without_a_limit_on_computing_there_is_no_real_time_priority(
    granted: list[int], monkeypatch: pytest.MonkeyPatch, refusal: Exception
) -> None:
    """A sender that then computes for ever would stop everybody else on its core."""
    granted.append(99)
    monkeypatch.setattr(resource, "setrlimit", Mock(side_effect=refusal))
    assert not take_priority(SENDER, longest=1.0)
    assert granted == [99]


def test_where_nothing_is_known_of_priorities_a_planner_plans(monkeypatch: pytest.MonkeyPatch) -> None:
    """The line that the link needs Linux comes later."""
    for name in ("sched_getscheduler", "sched_getparam", "sched_getaffinity", "sched_setscheduler"):
        monkeypatch.delattr(os, name)
    with planning_first() as (cores, first):
        assert cores > 0
    assert not first
