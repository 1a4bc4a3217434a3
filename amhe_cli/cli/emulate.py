"""`amhe emulate`: a Go1 and its motion capture on this computer."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from amhe_cli.cli import options, parsing
from amhe_cli.cli.session import Session, stopping

if TYPE_CHECKING:
    from amhe_cli.cli.settings import Overrides

MOCAP = ("natnet", "udp", "none")


@click.command(cls=parsing.Command, short_help="A Go1 and its motion capture, emulated on this computer.")
@options.task("Whose box to put down.")
@click.option("--host", default="127.0.0.1", show_default=True, metavar="ADDRESS", help="To listen on.")
@click.option(
    "--port",
    type=parsing.WholeNumber(0, 65535),
    default=8007,
    show_default=True,
    metavar="N",
    help="Of the robot.",
)
@options.choice("--mocap", MOCAP, "natnet", "Its cameras' protocol.")
@click.option(
    "--mocap-port",
    type=parsing.WholeNumber(0, 65535),
    metavar="N",
    help="natnet: where Motive listens; udp: where poses are sent to.  [default: 1510 or 1512]",
)
@click.option(
    "--fault",
    default="",
    metavar="NAME=V,...",
    help="What goes wrong, such as loss=0.02,after=5,hot=20 (docs/go1.md).",
)
@options.seed
@options.tuning
@options.common
@click.pass_obj
def emulate(
    session: Session,
    task: str,
    host: str,
    port: int,
    mocap: str,
    mocap_port: int | None,
    fault: str,
    seed: int,
    overrides: Overrides,
) -> None:
    """Emulate a Go1 in low-level mode, lying before the task's box, until interrupted.

    It speaks the robot's own UDP protocol, with MuJoCo physics behind it, and streams the poses of "go1" and
    "box" as motion capture does. Try `amhe run --target go1 --host 127.0.0.1` on it. Of the settings that
    `amhe run` takes, boxes.box makes the box another one, go1.trunk, go1.box, go1.trunk_offset and
    go1.box_offset the rigid bodies, go1.crc the checksums, and go1.slow the pace: the same --config suits
    both.
    """
    from amhe_cli.robots.go1.emulator.emulator import Emulator, EmulatorOptions
    from amhe_cli.robots.go1.emulator.faults import parse_faults
    from amhe_cli.robots.go1.link.child import ROBOT, take_priority
    from amhe_cli.robots.go1.poses import natnet, udp
    from amhe_cli.robots.go1.run import RunOptions, task_and_system
    from amhe_cli.robots.go1.settings import settings_of

    session.hush_mujoco()
    chosen = RunOptions(task, target="go1", settings=overrides.all)
    measured, system = task_and_system(chosen)
    s = settings_of(system).go1
    pose_port = mocap_port if mocap_port is not None else {"natnet": natnet.PORT}.get(mocap, udp.PORT)
    emulated = EmulatorOptions(
        measured, host, port, mocap, pose_port, parse_faults(fault), s.slow, seed,  # type: ignore[arg-type]
        (s.trunk, s.box), (s.trunk_offset, s.box_offset),
        s.crc,
    )  # fmt: skip
    with stopping(session) as stopped, Emulator(emulated) as emulator:
        robot, cameras = emulator.address, emulator.mocap_address
        seen = f", motion capture on {cameras[0]}:{cameras[1]}" if cameras else ""
        session.say("", f"a Go1 before the box of {task} on {robot[0]}:{robot[1]}{seen}; Ctrl-C ends")
        take_priority(ROBOT)  # a robot does not wait for whoever plans on the same computer
        emulator.serve(stopped)
        accepted, rejected = emulator.counts
        lag = (
            f"; this computer was {emulator.lag:.1f} s too slow: larger `go1.slow`, or no other emulator"
            if emulator.lag > 0.05
            else ""
        )
        session.say("", f"{accepted} commands, {rejected} damaged datagrams{lag}")
