"""`amhe emulate`: a Go1 and its motion capture on this computer."""

from __future__ import annotations

from amhe_cli.cli import options
from amhe_cli.cli.command import Given, command, option
from amhe_cli.cli.kinds import PORT
from amhe_cli.cli.session import Session, stopping

MOCAP = ("natnet", "udp", "none")


@command(
    "A Go1 and its motion capture, emulated on this computer.",
    options.task("Whose box to put down."),
    option("--host ADDRESS", "To listen on.", default="127.0.0.1"),
    option("--port", "Of the robot.", PORT, default=8007),
    option("--mocap", "Its cameras' protocol.", MOCAP, default="natnet"),
    option(
        "--mocap-port",
        "natnet: where Motive listens; udp: where poses are sent to.  [default: 1510 or 1512]",
        PORT,
    ),
    option(
        "--fault NAME=V,...", "What goes wrong, such as loss=0.02,after=5,hot=20 (docs/go1.md).", default=""
    ),
    options.seed,
    options.tuning,
)
def emulate(session: Session, given: Given) -> None:
    """Emulate a Go1 in low-level mode, lying before the task's box, until interrupted.

    It speaks the robot's own UDP protocol, with MuJoCo physics behind it, and streams the poses of "go1" and
    "box" as motion capture does. Try `amhe run --target go1 --host 127.0.0.1` on it. Of the settings that
    `amhe run` takes, boxes.box makes the box another one, go1.trunk, go1.box, go1.trunk_offset and
    go1.box_offset the rigid bodies, go1.crc the checksums, and go1.slow the pace: the same --config suits
    both.
    """
    from amhe_cli.robots.go1.emulator.emulator import Emulator, EmulatorOptions
    from amhe_cli.robots.go1.emulator.ports import parse_faults
    from amhe_cli.robots.go1.link.process import ROBOT, take_priority
    from amhe_cli.robots.go1.poses.sources import NATNET_PORT, UDP_PORT
    from amhe_cli.robots.go1.run import RunOptions, task_and_system
    from amhe_cli.robots.go1.settings import settings_of

    mocap, mocap_port = given.mocap, given.mocap_port
    chosen = RunOptions(given.task, target="go1", settings=given.overrides.all)
    measured, system = task_and_system(chosen)
    s = settings_of(system).go1
    pose_port = mocap_port if mocap_port is not None else {"natnet": NATNET_PORT}.get(mocap, UDP_PORT)
    emulated = EmulatorOptions(
        measured, given.host, given.port, mocap, pose_port, parse_faults(given.fault), s.slow, given.seed,
        (s.trunk, s.box), (s.trunk_offset, s.box_offset),
        s.crc,
    )  # fmt: skip
    with stopping(session) as stopped, Emulator(emulated) as emulator:
        robot, cameras = emulator.address, emulator.mocap_address
        seen = f", motion capture on {cameras[0]}:{cameras[1]}" if cameras else ""
        session.say("", f"a Go1 before the box of {given.task} on {robot[0]}:{robot[1]}{seen}; Ctrl-C ends")
        take_priority(ROBOT)  # a robot does not wait for whoever plans on the same computer
        emulator.serve(stopped)
        accepted, rejected = emulator.counts
        lag = (
            f"; this computer was {emulator.lag:.1f} s too slow: larger `go1.slow`, or no other emulator"
            if emulator.lag > 0.05
            else ""
        )
        session.say("", f"{accepted} commands, {rejected} damaged datagrams{lag}")
