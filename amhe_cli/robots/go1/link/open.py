"""A task's name and options become an episode on a Go1 that is reached by wire."""

from __future__ import annotations

import ipaddress
import socket
from dataclasses import dataclass

from amhe_cli.core.errors import ConfigError, one_of
from amhe_cli.robots.go1.known import latency_of
from amhe_cli.robots.go1.link.calibration import Calibration
from amhe_cli.robots.go1.link.child import planning_first
from amhe_cli.robots.go1.link.clock import Clock
from amhe_cli.robots.go1.link.link import Link
from amhe_cli.robots.go1.link.target import Go1Target
from amhe_cli.robots.go1.poses import natnet, udp
from amhe_cli.robots.go1.poses.feed import KINDS, FeedOptions, PoseFeed
from amhe_cli.robots.go1.run import Run, RunOptions, generator, run_on, task_and_system
from amhe_cli.robots.go1.settings import Go1Settings, settings_of
from amhe_cli.robots.go1.tasks import Task

#: The robot's own address and port, as it leaves the factory.
HOST, PORT = "192.168.123.10", 8007
_POSE_HOSTS = {"natnet": "192.168.123.100", "udp": "127.0.0.1"}
_POSE_PORTS = {"natnet": natnet.PORT, "udp": udp.PORT}


@dataclass(frozen=True, slots=True)
class WireOptions:
    """How robot and motion capture are reached.

    Args:
        host, port: Address of the robot.
        pose: Protocol of motion capture.
        pose_host, pose_port: Address of motion capture, see `FeedOptions`; None: the default of the protocol.
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
        options: Options of the run.
        wire: Addresses of robot and motion capture.
        task: The task, in place of the one that the options name.

    Raises:
        ConfigError: What `open_run` refuses, and what only a simulation can do.
    """
    _refuse(options)
    task, system = task_and_system(options, task)
    settings, period = settings_of(system).go1, settings_of(system).control.period
    if settings.arm == "auto" and not _on_loopback(wire.host):
        raise ConfigError(f"go1.arm=auto is for the emulator on this computer; {wire.host} is a robot")
    clock = _clock(wire, settings)
    feed = PoseFeed(_feed(wire, settings))
    link = Link(wire.host, wire.port, settings, clock, wire.keys)
    target = Go1Target(link, feed, settings, clock, period, task.box, latency_of(system))
    samples = generator(options.seed, "samples")
    with planning_first() as (cores, _):  # the threads of its rollouts, too
        threads = min(options.threads, cores)
        return run_on(options, task, system, target, None, samples, threads, settings.slow)


def open_calibration(options: RunOptions, wire: WireOptions) -> Calibration:
    """Robot, motion capture and the task's box; nothing is sent yet.

    Raises:
        ConfigError: A wrong setting or pose source.
    """
    task, system = task_and_system(options)
    settings = settings_of(system).go1
    clock = _clock(wire, settings)
    link, feed = Link(wire.host, wire.port, settings, clock), PoseFeed(_feed(wire, settings))
    return Calibration(link, feed, settings, clock, task.box)


def _clock(wire: WireOptions, settings: Go1Settings) -> Clock:
    """The program's clock. A real robot's must not be slow: thresholds would be longer than they say."""
    if settings.slow != 1.0 and not _on_loopback(wire.host):
        raise ConfigError(f"go1.slow is for the emulator on this computer; {wire.host} is a robot")
    return Clock(settings.slow)


def _refuse(options: RunOptions) -> None:
    if options.mode == "true":
        raise ConfigError(
            "`mode=true` needs a plant whose parameters are known; on go1 use adaptive or baseline"
        )
    if options.plant is not None:
        raise ConfigError("`plant` is the robot of a simulation; leave it out with `target=go1`")


def _feed(wire: WireOptions, settings: Go1Settings) -> FeedOptions:
    if wire.pose not in KINDS:
        raise ConfigError(one_of("pose source", wire.pose, KINDS))
    host = wire.pose_host or _POSE_HOSTS.get(wire.pose)
    if host is None:
        raise ConfigError("`pose=motioncapture` needs `pose_host` KIND:HOST, such as vicon:192.168.1.5")
    port = wire.pose_port if wire.pose_port is not None else _POSE_PORTS.get(wire.pose, 0)
    bodies = (settings.trunk, settings.box)
    if bodies[0] == bodies[1]:
        raise ConfigError(f"go1.trunk and go1.box have the same name {bodies[0]!r}")
    return FeedOptions(wire.pose, host, port, bodies, settings.connect_time, settings.slow, settings.poses)


def _on_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(socket.gethostbyname(host)).is_loopback
    except OSError:
        return False
