"""A task's name and options become an episode on a Go1 that is reached by wire, and a rehearsal of it."""

from __future__ import annotations

import ipaddress
import socket
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np

from amhe_cli.control.controller import LEAST
from amhe_cli.core.errors import ConfigError, one_of
from amhe_cli.live.episode import Cycle
from amhe_cli.robots.go1.link.calibration import Calibration
from amhe_cli.robots.go1.link.link import Link
from amhe_cli.robots.go1.link.packets import LinkError
from amhe_cli.robots.go1.link.process import Clock, planning_first
from amhe_cli.robots.go1.link.target import Go1Target
from amhe_cli.robots.go1.poses.feed import KINDS, PoseFeed
from amhe_cli.robots.go1.poses.sources import NATNET_PORT, UDP_PORT
from amhe_cli.robots.go1.run import Run, RunOptions, latency_of, run_on, task_and_system
from amhe_cli.robots.go1.settings import Go1Settings, settings_of
from amhe_cli.robots.go1.tasks import Task

#: Cycles that are planned.
_CYCLES = 100


class _Patient:
    """A judge of a robot that lies and will not arrive."""

    verdict = (0, "")

    def watch(self, state: object) -> bool:
        """See `EpisodeJudge`."""
        return False


def rehearse(run: Run) -> dict[str, str]:
    """Plan cycles of the task from what is measured, and send none; the pace in words.

    Args:
        run: The run, at a robot that has been checked; it cannot be run any more.

    Raises:
        LinkError: Even the least number of rollouts takes longer than a control period.
    """
    assert isinstance(run.target, Go1Target)
    run.target.rehearse()
    cycles = list(islice(replace(run.episode, judge=_Patient()).cycles(), _CYCLES))
    settings = settings_of(run.system).control
    return {"pace": pace(cycles, settings.samples, settings.period * run.target.slow)}


def pace(cycles: Sequence[Cycle], samples: int, period: float) -> str:
    """The pace of some cycles in words.

    Args:
        samples: Rollouts that each should have had.
        period: Control period by the wall clock [s].

    Raises:
        LinkError: See `rehearse`.
    """
    median, slow = np.quantile([cycle.plan_ms for cycle in cycles], (0.5, 0.99))
    made = [cycle.plan.step.rollouts for cycle in cycles if cycle.plan.step]
    if median > 1e3 * period:
        raise LinkError(
            f"this computer is too slow: a cycle with {min(made)} rollouts ({LEAST} are the least) takes "
            f"{median:.0f} ms, the median of {len(cycles)}, and the control period is {1e3 * period:g} ms; "
            "end other programs, or at the emulator give both commands a larger `go1.slow`"
        )
    return (
        f"{np.mean(made):.1f} of {samples} rollouts in a cycle ({min(made)} at least), {median:.0f} ms of "
        f"{1e3 * period:g} ms (99 %: {slow:.0f} ms)"
    )


#: The robot's own address and port, as it leaves the factory.
HOST, PORT = "192.168.123.10", 8007
_POSE_HOSTS = {"natnet": "192.168.123.100", "udp": "127.0.0.1"}
_POSE_PORTS = {"natnet": NATNET_PORT, "udp": UDP_PORT}


@dataclass(frozen=True, slots=True)
class WireOptions:
    """How robot and motion capture are reached.

    Args:
        host, port: Address of the robot.
        pose: Protocol of motion capture.
        pose_host, pose_port: Address of motion capture, see `PoseFeed`; None: the default of the protocol.
        keys: Descriptor of a terminal whose keys arm and stop; -1: none.
    """

    host: str = HOST
    port: int = PORT
    pose: str = "natnet"
    pose_host: str | None = None
    pose_port: int | None = None
    keys: int = -1


def open_go1_run(options: RunOptions, wire: WireOptions, task: Task | None = None) -> Run:
    """Set everything up; nothing is sent yet.

    Args:
        wire: Addresses of robot and motion capture.
        task: The task, in place of the one that the options name.

    Raises:
        ConfigError: What `open_run` refuses, and what only a simulation can do.
    """
    if options.mode == "true":
        raise ConfigError(
            "`mode=true` needs a plant whose parameters are known; on go1 use adaptive or baseline"
        )
    if options.plant is not None:
        raise ConfigError("`plant` is the robot of a simulation; leave it out with `target=go1`")
    task, system = task_and_system(options, task)
    settings, period = settings_of(system).go1, settings_of(system).control.period
    if settings.arm == "auto" and not _on_loopback(wire.host):
        raise ConfigError(f"go1.arm=auto is for the emulator on this computer; {wire.host} is a robot")
    clock = _clock(wire, settings)
    link, feed = Link(wire.host, wire.port, settings, clock, wire.keys), _feed(wire, settings)
    target = Go1Target(link, feed, settings, clock, period, task.box, latency_of(system))
    with planning_first() as (cores, _):  # the threads of its rollouts, too
        options = replace(options, threads=min(options.threads, cores))
        return run_on(options, task, system, target, None, settings.slow)


def open_calibration(options: RunOptions, wire: WireOptions) -> Calibration:
    """Robot, motion capture and the task's box; nothing is sent yet.

    Raises:
        ConfigError: A wrong setting or pose source.
    """
    task, system = task_and_system(options)
    settings = settings_of(system).go1
    clock = _clock(wire, settings)
    link = Link(wire.host, wire.port, settings, clock)
    return Calibration(link, _feed(wire, settings), settings, clock, task.box)


def _clock(wire: WireOptions, settings: Go1Settings) -> Clock:
    """The program's clock. A real robot's must not be slow: thresholds would be longer than they say."""
    if settings.slow != 1.0 and not _on_loopback(wire.host):
        raise ConfigError(f"go1.slow is for the emulator on this computer; {wire.host} is a robot")
    return Clock(settings.slow)


def _feed(wire: WireOptions, settings: Go1Settings) -> PoseFeed:
    if wire.pose not in KINDS:
        raise ConfigError(one_of("pose source", wire.pose, KINDS))
    host = wire.pose_host or _POSE_HOSTS.get(wire.pose)
    if host is None:
        raise ConfigError("`pose=motioncapture` needs `pose_host` KIND:HOST, such as vicon:192.168.1.5")
    port = wire.pose_port if wire.pose_port is not None else _POSE_PORTS.get(wire.pose, 0)
    if settings.trunk == settings.box:
        raise ConfigError(f"go1.trunk and go1.box have the same name {settings.box!r}")
    return PoseFeed(wire.pose, host, port, settings)


def _on_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(socket.gethostbyname(host)).is_loopback
    except OSError:
        return False
