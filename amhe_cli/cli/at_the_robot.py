"""What a command needs at a real robot; `amhe calibrate` and `amhe emulate`, which need nothing else."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, closing, contextmanager, suppress
from typing import TYPE_CHECKING, Any

from amhe_cli.cli import options
from amhe_cli.cli.command import Given, Option, command, flag, in_panel, option
from amhe_cli.cli.kinds import PORT, WholeNumber
from amhe_cli.cli.session import Session, stopping

if TYPE_CHECKING:
    from amhe_cli.core.errors import AmheError, Ending
    from amhe_cli.live.recorder import Recorder
    from amhe_cli.robots.go1.judge import History
    from amhe_cli.robots.go1.link.calibration import Offsets
    from amhe_cli.robots.go1.link.open import WireOptions
    from amhe_cli.robots.go1.run import Run


POSES = ("natnet", "motioncapture", "udp")
#: Of the attributes of a terminal: flags of its input, the keys that mean something to it, and none of them.
_INPUT, _CONTROL, _NO_KEY = 0, 6, b"\0"

_PORT = WholeNumber(1, 65535)
#: Options by which a real robot and its motion capture are reached.
REACH = in_panel(
    "A real Go1",
    option("--host ADDRESS", "Of the robot.  [default: 192.168.123.10]"),
    option("--port", "Of the robot.  [default: 8007]", _PORT),
    option("--pose", "Kind of motion capture.  [default: natnet]", POSES),
    option(
        "--pose-host ADDRESS",
        "Of motion capture; motioncapture: KIND:ADDRESS; udp: to listen on.  "
        "[default: natnet 192.168.123.100, udp 127.0.0.1]",
    ),
    option("--pose-port", "Likewise.  [default: natnet 1510, udp 1512]", _PORT),
)
#: What a dry run does at a real robot.
CHECKS = "go1: check robot, poses, box and this computer's pace; send nothing that moves."


def target(about: str) -> Option:
    """A simulation, or the robot."""
    return option("--target", about, ("sim", "go1"), default="sim")


def dry_run_option(about: str) -> Option:
    """Nothing moves."""
    return flag("--dry-run", about)


def wire_of(target: str, chosen: Given) -> WireOptions | None:
    """How the robot is reached; None: it is simulated.

    Raises:
        ConfigError: Options that do not go together.
    """
    from amhe_cli.core.errors import ConfigError

    wire = chosen.pick(*(str(one.name) for one in REACH))
    given = {name: value for name, value in wire.items() if value}
    if target != "go1":
        if given:
            name = next(iter(given)).replace("_", "-")
            raise ConfigError(f"--{name} is of a real robot: give --target go1 too")
        return None
    from amhe_cli.robots.go1.link.open import WireOptions

    return WireOptions(**given, keys=_terminal())


def dry_run(session: Session, run: Run) -> None:
    """Check everything, plan without sending, and say what was found; nothing moves."""
    from amhe_cli.robots.go1.link.open import rehearse

    with closing(run.episode.belief), run.target as target:  # type: ignore[union-attr]
        found = target.check() | rehearse(run)
    if session.gave(session.record(checks=found)):
        return
    for name, value in found.items():
        print(f"{name}: {value}")
    print("all is well; nothing has moved")


@contextmanager
def ready(target: Any, session: Session) -> Iterator[None]:
    """A target that waits for plans; a robot has stood up by then, and is let down in the end.

    What stopped it is written before it is let down, which takes seconds.

    Raises:
        StoppedError, OperatorStopError: A trip, or the operator, came before it stood ready.
        LinkError, PoseError: Something is not as it should be.
    """
    from amhe_cli.live.target import SimTarget

    if isinstance(target, SimTarget):
        yield
        return
    from amhe_cli.robots.go1.link.packets import LinkError
    from amhe_cli.robots.go1.poses.sources import PoseError

    with _unseen_keys(), target:
        for name, value in target.check().items():
            session.say("", f"{name}: {value}")
        try:
            target.begin(lambda text: session.say("", text))
            yield
        except (LinkError, PoseError) as error:
            if target.begun and not target.stop:
                session.say("error", f"{error}; the robot is let down")
            raise
        finally:
            if target.stop:
                _say_stop(session, target.stop, target.report.phase)


def _say_stop(session: Session, stop: AmheError, phase: int) -> None:
    from amhe_cli.robots.go1.link.mail import Phase

    damped = phase >= Phase.DAMP
    then = "motors are damped" if damped else "the robot sits down, then its motors are damped"
    session.say("error" if is_trip(stop) else "", f"{stop}; {then}")


def is_trip(error: Exception | None) -> bool:
    """Whether an error is a trip of the robot, which was printed when it came."""
    if error is None:
        return False
    from amhe_cli.robots.go1.link.mail import StoppedError

    return isinstance(error, StoppedError)


def attended(target: Any, session: Session, go: Callable[[], Ending]) -> Ending:
    """How it ended, what `go` does with a `ready` target; to be stopped on the way there is an end, too.

    Raises:
        LinkError, PoseError: Before anything moved.
    """
    from amhe_cli.core.errors import AmheError, Ending, OperatorStopError
    from amhe_cli.live.target import SimTarget

    try:
        with ready(target, session):
            return go()
    except AmheError as error:
        if not target.begun:
            raise
        return Ending(interrupted=True) if isinstance(error, OperatorStopError) else Ending(error=error)
    except KeyboardInterrupt:  # once more, while a robot is let down: it must not cost the log
        if isinstance(target, SimTarget) or not target.begun:
            raise
        return Ending(error=target.stop) if is_trip(target.stop) else Ending(interrupted=True)


def attendant(
    session: Session, link: dict[str, Any]
) -> Callable[[Any, Recorder, History], AbstractContextManager[None]]:
    """As `ready`, for a run that is recorded; what `link_record` reports in the end goes into `link`."""

    @contextmanager
    def attend(target: Any, recorder: Recorder, history: History) -> Iterator[None]:
        from amhe_cli.core.errors import OperatorStopError

        try:
            with ready(target, session):
                yield
        except OperatorStopError:
            raise KeyboardInterrupt from None
        link.update(link_record(target, recorder, history))

    return attend


def link_record(target: Any, recorder: Recorder, history: History) -> dict[str, Any]:
    """What result.json says of the link, which the log's last diagnostics say too; {} for a simulation."""
    from amhe_cli.live.target import SimTarget
    from amhe_cli.logs.messages.writer import ERROR, OK

    if isinstance(target, SimTarget):
        return {}
    report, slow = target.report, target.slow
    packets = ", ".join(f"{name} {value:g}" for name, value in report.intervals.items())
    words = f"sender: {packets}; time {slow:g} times slower than the clock"
    level = ERROR if report.trip else OK
    time = float(history.column("time")[-1]) if history.cycles else 0.0
    recorder.note(time + 1e-3, level, f"{words}; {report.trip}: {report.reason}" if report.trip else words)
    return {
        "link": {
            "trip": report.trip, "reason": report.reason, "slow": slow, "notes": target.notes,
            "round_trip_ms": report.contact.get("round_trip_ms"), "packets": report.intervals,
            "dropped_poses": target.dropped_poses,
        }
    }  # fmt: skip


def _terminal() -> int:
    return sys.stdin.fileno() if sys.stdin.isatty() else -1


@contextmanager
def _unseen_keys() -> Iterator[None]:
    """Each key is handed over at once and not shown; as before in the end.

    Only Ctrl-C is a signal. Ctrl-Z, Ctrl-backslash, Ctrl-S and Ctrl-Q are keys like all others: they stop.
    """
    descriptor = _terminal()
    if descriptor < 0:
        yield
        return
    import termios
    import tty

    before = termios.tcgetattr(descriptor)
    try:
        tty.setcbreak(descriptor)
        changed = termios.tcgetattr(descriptor)
        changed[_INPUT] &= ~termios.IXON
        for meaning in (termios.VSUSP, termios.VQUIT):
            changed[_CONTROL][meaning] = _NO_KEY
        termios.tcsetattr(descriptor, termios.TCSADRAIN, changed)
        yield
    finally:
        with suppress(termios.error):  # it has been closed
            termios.tcsetattr(descriptor, termios.TCSADRAIN, before)


#: The file of settings that is written.
SETTINGS = "offsets.yaml"


@command(
    "Offsets of the rigid bodies on a real robot and its box.",
    options.task("Whose box it is, and where it is put down."),
    REACH,
    options.seconds("How long each body is looked at.", 2.0, min=0.5, max=60, min_open=False),
    flag("--yes", "Robot and box are in place: ask nothing."),
    options.tuning,
    options.output,
)
def calibrate(session: Session, given: Given) -> None:
    """Find go1.trunk_offset and go1.box_offset from robot and box that you put where it says.

    Writes offsets.yaml, for --config of `amhe run` and `amhe probe`, and result.json. The robot must be in
    low-level mode (docs/go1.md); its joints and its IMU show how it lies. Nothing moves.
    """
    from amhe_cli.core.files import filling, json_text
    from amhe_cli.robots.go1.link.open import open_calibration
    from amhe_cli.robots.go1.run import RunOptions

    reached = wire_of("go1", given)
    assert reached is not None
    chosen = RunOptions(given.task, target="go1", settings=given.overrides.all)
    calibration = open_calibration(chosen, reached)
    folder = given.reserve()
    with calibration:
        found = calibration.offsets(_asking(session, given.yes), given.seconds)
    text = _settings(found)
    record = session.record(
        task=given.task, trunk_offset=found.trunk, box_offset=found.box, trunk_height_m=found.height,
        trunk_tilt_rad=found.tilt, out=str(folder),
    )  # fmt: skip
    with filling(folder) as scratch:
        (scratch / SETTINGS).write_text(text, encoding="utf-8")
        (scratch / "result.json").write_text(json_text(record), encoding="utf-8")
    if not session.gave(record):
        print(text, end="")
        print(f"next: amhe run --task {given.task} --target go1 --dry-run --config {folder / SETTINGS}")


def _asking(session: Session, ready: bool) -> Callable[[str], None]:
    """Tell the operator what to do, and wait for Enter; where everything is ready, only tell."""
    from amhe_cli.core.errors import ConfigError

    def ask(text: str) -> None:
        session.say("", text if ready else f"{text}; then press Enter")
        if not ready:
            try:
                input()
            except EOFError:
                raise ConfigError("nobody is there to press Enter; give --yes once all is in place") from None

    return ask


def _settings(found: Offsets) -> str:
    """As YAML, to 0.1 mm and 0.01 degrees."""
    rows = [
        f"  {name}: [{', '.join(f'{value:.4f}' for value in offset)}]\n"
        for name, offset in (("trunk_offset", found.trunk), ("box_offset", found.box))
    ]
    return "# place [m] and rotation vector [rad] in the rigid body's frame\ngo1:\n" + "".join(rows)


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
    from amhe_cli.robots.go1.emulator import Emulator, EmulatorOptions, parse_faults
    from amhe_cli.robots.go1.link.process import ROBOT, take_priority
    from amhe_cli.robots.go1.poses.sources import NATNET_PORT, UDP_PORT
    from amhe_cli.robots.go1.run import RunOptions, task_and_system
    from amhe_cli.robots.go1.settings import settings_of

    mocap, mocap_port = given.mocap, given.mocap_port
    chosen = RunOptions(given.task, target="go1", settings=given.overrides.all)
    measured, system = task_and_system(chosen)
    pose_port = mocap_port if mocap_port is not None else {"natnet": NATNET_PORT}.get(mocap, UDP_PORT)
    emulated = EmulatorOptions(
        measured, given.host, given.port, mocap, pose_port, parse_faults(given.fault), given.seed,
        settings_of(system).go1,
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
