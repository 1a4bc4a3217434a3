"""The sender on loopback: it connects, stands up, plays, and lets the robot down whatever happens."""

from __future__ import annotations

import errno
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from amhe_cli.core.errors import OperatorStopError
from amhe_cli.robots.go1.kinematics import HOME
from amhe_cli.robots.go1.link import link as link_module
from amhe_cli.robots.go1.link import link as watch
from amhe_cli.robots.go1.link.link import Link
from amhe_cli.robots.go1.link.machine import Machine
from amhe_cli.robots.go1.link.mail import Inbox, Phase, StoppedError, Targets
from amhe_cli.robots.go1.link.packets import DAMPED, SERVO, LinkError, decode_state, encode_state, pressing
from amhe_cli.robots.go1.link.process import SENDER, Child, Clock, Pipe, take_priority, ticks_ahead
from amhe_cli.robots.go1.link.sender import RobotSocket, Sender, Share, connected
from amhe_cli.robots.go1.settings import Go1Settings
from tests.robots.go1.stand_ins import FOLDED, Puppet, a_state, damps, repeating, udp

pytestmark = pytest.mark.realtime

ROOT = Path(__file__).parents[4]
#: As fast as the settings allow; the machine under the tests is slow, so be patient with states.
QUICK = Go1Settings.model_validate(
    {
        "gain_time": 0.1, "stand_speed": 3.0, "sit_time": 0.3, "damp_time": 0.3, "hold_time": 0.1,
        "connect_time": 4.0, "trips": {"state_age": 0.3, "report_age": 1.0, "packet_gap": 0.2},
    }
)  # fmt: skip
HASTY = QUICK.model_copy(update={"connect_time": 1.0})
CLOCK = Clock()


@pytest.fixture
def puppet() -> Iterator[Puppet]:
    with Puppet() as it:
        yield it


def a_link(puppet: Puppet, settings: Go1Settings = QUICK, keys: int = -1) -> Link:
    return Link("127.0.0.1", puppet.port, settings, CLOCK, keys)


def wait_for(link: Link, phase: Phase) -> None:
    while not link.reached(phase):
        time.sleep(0.002)


def running(link: Link) -> None:
    link.connect()
    link.stand()
    wait_for(link, Phase.READY)
    link.arm()
    wait_for(link, Phase.RUN)


@contextmanager
def driven(puppet: Puppet) -> Iterator[Link]:
    """A link whose robot has begun to stand up."""
    with a_link(puppet) as link:
        link.connect()
        link.stand()
        puppet.wait(lambda got: got.kp[0] > 10.0)
        yield link


def play(link: Link) -> None:
    """Hand over a fresh plan by a fresh pose."""
    link.play(Targets(CLOCK.now(), 0.02, np.tile(HOME + 0.1, (16, 1))), CLOCK.now())


@contextmanager
def playing(puppet: Puppet) -> Iterator[Link]:
    """A link whose robot follows plans."""
    with a_link(puppet) as link:
        running(link)
        with repeating(0.02, lambda: play(link)):
            puppet.wait(lambda got: bool(np.allclose(got.position, HOME + 0.1, atol=1e-3)))
            yield link


@pytest.mark.medium
def test_a_whole_day_of_a_robot(puppet: Puppet) -> None:
    with playing(puppet) as link:
        samples = link.samples()
    commands = [command for _, command in puppet.received]
    gains = np.array([command.kp[0] for command in commands])
    assert gains[0] == 0.0
    assert gains.max() == QUICK.kp
    assert gains[-1] == 0.0
    assert link.report.phase == Phase.OVER
    assert link.report.trip == ""
    assert link.report.intervals["packets"] == pytest.approx(len(commands), abs=5)
    driven = np.array([command.position for command in commands if command.kp[0] > 0])
    assert np.abs(np.diff(driven, axis=0)).max() < 0.05
    # the offset of the robot's clock has been found by the time it stands
    stamps = np.array([sample["time"] for sample in samples if sample["phase"] >= Phase.READY])
    assert (np.diff(stamps) > 0).all()
    assert abs(stamps[-1] - CLOCK.now()) < 15.0
    assert {int(sample["phase"]) for sample in samples} >= {Phase.CONNECT, Phase.STAND, Phase.RUN}


@pytest.mark.medium
def test_the_robots_clock_begins_again_at_its_end(puppet: Puppet) -> None:
    begun = CLOCK.now()
    puppet.change = lambda sent: replace(sent, tick=(sent.tick + 2**32 - 600) % 2**32)
    with a_link(puppet) as link:
        link.connect()
        link.stand()
        wait_for(link, Phase.READY)
        stamps = np.array([sample["time"] for sample in link.samples()])
    assert begun < stamps[0] < stamps[-1] < CLOCK.now()
    assert stamps[-1] - stamps[0] > 0.6
    # a packet that is less late than all before it moves the stamps back; the clock's end would by 50 days
    assert np.abs(np.diff(stamps)).max() < 1.0


@pytest.mark.parametrize(
    ("tick", "before", "ahead"),
    [(5, 3, 2), (3, 5, -2), (3, 3, 0), (2, 2**32 - 1, 3), (2**32 - 1, 2, -3), (3, 2**32 + 1, 2)],
)
def test_ticks_are_ahead_past_the_end_of_the_clock(tick: int, before: int, ahead: int) -> None:
    assert ticks_ahead(tick, before) == ahead


def test_nothing_but_idle_packets_before_the_order_to_stand(puppet: Puppet) -> None:
    with a_link(puppet) as link:
        link.connect()
        assert link.report.contact["round_trip_ms"] < 50.0
        assert link.report.contact["share"] > 0.9
    assert puppet.idle


@pytest.mark.medium
@pytest.mark.parametrize(
    ("fault", "trip"),
    [
        ("remote", "remote"),
        ("silence", "state_lost"),
        ("replay", "state_lost"),
        pytest.param("crc", "damaged", marks=pytest.mark.slow),
    ],
)
def test_a_fault_of_the_robot_damps_the_motors(puppet: Puppet, fault: str, trip: str) -> None:
    """The trips themselves are in test_machine.py."""
    with driven(puppet) as link:
        if fault == "silence":
            puppet.mangle = lambda packet: None
        elif fault == "replay":  # two old states by turns: a clock that goes to and fro
            old = [encode_state(a_state(tick=tick, joints=FOLDED)) for tick in (1, 3)]
            puppet.mangle = lambda packet: old[decode_state(packet).tick % 2]
        elif fault == "crc":
            puppet.mangle = lambda packet: packet[:-1] + bytes([packet[-1] ^ 1])
        else:
            puppet.change = lambda sent: replace(sent, remote=pressing("L2", "B"))
        puppet.wait(damps)
        with pytest.raises(OperatorStopError if fault == "remote" else StoppedError):
            wait_for(link, Phase.READY)
    assert link.report.trip == trip


@pytest.mark.medium
@pytest.mark.parametrize(
    "how", ["key", *(pytest.param(how, marks=pytest.mark.slow) for how in ("stop", "gone"))]
)
def test_an_operator_who_stops(puppet: Puppet, how: str) -> None:
    keys, terminal = socket.socketpair()
    with keys, terminal, a_link(puppet, keys=keys.fileno()) as link:
        link.connect()
        link.stand()
        wait_for(link, Phase.READY)
        terminal.send(b"\n")
        wait_for(link, Phase.RUN)
        if how == "stop":
            link._send(stop="asked to stop")
        elif how == "key":
            terminal.send(b" ")
        else:
            terminal.close()
        puppet.wait(damps)
    assert link.report.trip == "order"


@pytest.mark.medium
def test_the_keys_of_a_real_terminal_come_through_its_number_0(puppet: Puppet) -> None:
    """A child's own standard input is another one."""
    keys, terminal = socket.socketpair()
    ours = os.dup(0)
    with keys, terminal:
        os.dup2(keys.fileno(), 0)
        try:
            with a_link(puppet, keys=0) as link:
                link.connect()
                link.stand()
                wait_for(link, Phase.READY)
                terminal.send(b"\n")
                wait_for(link, Phase.RUN)
                terminal.send(b" ")
                puppet.wait(damps)
        finally:
            os.dup2(ours, 0)
            os.close(ours)
    assert link.report.reason == "key"


@pytest.mark.usefixtures("hangs_up")
@pytest.mark.parametrize(
    ("number", "reason", "stop"),
    [
        (signal.SIGTSTP, "SIGTSTP would suspend the sender", StoppedError),
        (signal.SIGQUIT, "SIGQUIT", OperatorStopError),
        (signal.SIGHUP, "SIGHUP", OperatorStopError),
    ],
)
def test_a_sender_that_is_to_be_suspended_or_to_quit_damps_instead(
    puppet: Puppet, number: signal.Signals, reason: str, stop: type[Exception]
) -> None:
    with driven(puppet) as link:
        sender = link.process.pid
        assert os.getsid(sender) == sender  # keys of our terminal do not reach it as signals
        os.kill(sender, number)
        puppet.wait(damps)
    assert link.report.reason == reason
    assert type(link.report.stop) is stop


@pytest.mark.parametrize("number", [signal.SIGTTIN, signal.SIGTTOU])
def test_no_other_signal_of_a_terminal_suspends_a_sender(number: signal.Signals) -> None:
    sender = Sender(QUICK, None, Mock(), CLOCK, -1, -1, False)  # type: ignore[arg-type]
    sender.stop_on(number)
    assert sender._inbox.stop == f"{number.name} would suspend the sender"


@pytest.mark.medium
@pytest.mark.parametrize(
    ("number", "message"), [(signal.SIGKILL, "has died"), (signal.SIGSTOP, "hangs: no report for")]
)
def test_a_sender_that_dies_or_hangs_is_stood_in_for(
    puppet: Puppet, monkeypatch: pytest.MonkeyPatch, number: signal.Signals, message: str
) -> None:
    """Motors follow the last command that they got for good; one that hangs for good would not even end.

    Nothing is opened in the emergency, which could fail.
    """
    monkeypatch.setattr(watch, "_DAMP", 0.5)
    with driven(puppet) as link:
        monkeypatch.setattr(socket, "socket", Mock(side_effect=OSError(errno.EMFILE, "Too many open files")))
        link.process.send_signal(number)
        puppet.wait(damps)
        with pytest.raises(StoppedError, match=message):
            wait_for(link, Phase.READY)
    assert link.process.returncode == -signal.SIGKILL
    assert (link.report.phase, link.report.trip) == (Phase.OVER, "sender_lost")
    end = time.monotonic() + 10.0
    while puppet.received[-1][1].kd.max() > 0.0 and time.monotonic() < end:  # until it has read all
        time.sleep(0.01)
    commands = [command for _, command in puppet.received]
    last_driven = max(number for number, command in enumerate(commands) if command.kp[0] > 0)
    assert all(map(damps, commands[last_driven + 1 : -1]))
    assert len(commands) - last_driven > 50
    assert commands[-1].kp.max() == commands[-1].kd.max() == 0.0


def in_a_thread(action: Callable[[], bool]) -> bool:
    """What an action returns in a thread, which keeps the priority and the cores that it gets."""
    with ThreadPoolExecutor(1) as thread:
        return thread.submit(action).result()


@pytest.mark.slow
def test_a_sender_that_spins_on_the_only_core_is_stood_in_for(
    puppet: Puppet, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With its real-time priority nobody else gets to run there."""
    if not in_a_thread(lambda: take_priority(SENDER)):
        pytest.skip("no real-time priority is granted here: a sender that spins stops nobody else")
    monkeypatch.setattr(watch, "_DAMP", 0.5)
    monkeypatch.setattr(
        link_module, "Child", lambda _, *settings: Child("tests.robots.go1.stand_ins", *settings)
    )
    trips = QUICK.trips.model_copy(update={"report_age": 0.5})
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(cores)})
    try:
        with a_link(puppet, QUICK.model_copy(update={"trips": trips})) as link:
            link.connect()
            link.stand()
            puppet.wait(lambda got: got.kp[0] > 10.0)
            puppet.wait(damps)
    finally:
        os.sched_setaffinity(0, cores)
    assert link.report.trip == "sender_lost"


def test_a_signal_after_the_sender_has_died_is_no_exception(
    puppet: Puppet, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Python writes its number to whoever listens, and complains where nobody does."""
    complaints: list[object] = []
    monkeypatch.setattr(sys, "unraisablehook", complaints.append)
    before = signal.signal(signal.SIGUSR1, lambda *_: None)
    try:
        with a_link(puppet) as link:
            while not link.report.contact:
                time.sleep(0.002)
            link.process.kill()
            link.process.wait()
            signal.raise_signal(signal.SIGUSR1)
    finally:
        signal.signal(signal.SIGUSR1, before)
    assert not complaints


def test_a_sender_that_hangs_before_anything_moved_is_one_line(puppet: Puppet) -> None:
    puppet.mangle = lambda packet: None
    with a_link(puppet) as link:
        while not link.report.contact:
            time.sleep(0.002)
        link.process.send_signal(signal.SIGSTOP)
        with pytest.raises(StoppedError, match="hangs"):
            link.connect()
    assert not any(map(damps, [command for _, command in puppet.received]))


@pytest.mark.medium
def test_a_sender_that_stalled_damps_when_it_goes_on(puppet: Puppet) -> None:
    """Fresh states may have come by the time that it has read the old ones."""
    with playing(puppet) as link:
        link.process.send_signal(signal.SIGSTOP)
        time.sleep(0.4)
        count = len(puppet.received)
        link.process.send_signal(signal.SIGCONT)
        puppet.wait(damps)
    assert link.report.trip == "stalled"
    assert all(got.kp.max() == 0.0 for _, got in puppet.received[count + 1 :])


def test_a_plan_that_waited_in_the_pipe_is_as_old_as_it_is_and_the_first_reason_to_stop_stays() -> None:
    inbox, plan = Inbox(), Targets(1.0, 0.02, np.tile(HOME, (16, 1)))
    for news in ({"plan": plan, "pose_time": 0.9, "plan_time": 1.0}, {"stop": "first"}, {"stop": "second"}):
        inbox.take(news)
    assert (inbox.plan, inbox.plan_time, inbox.pose_time, inbox.stop) == (plan, 1.0, 0.9, "first")


def test_what_a_process_said_last_is_read_after_it_has_gone() -> None:
    ends = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    ours, theirs = map(Pipe, ends)
    ours.send("never read")
    theirs.send("last words")
    theirs.close()
    assert not ours.send("too late")
    assert list(ours.received()) == ["last words"]
    assert not ours.open
    ours.close()


_PROGRAM = """
import os, sys, time
from amhe_cli.robots.go1.link.process import Clock
from amhe_cli.robots.go1.link.link import Link
from tests.robots.go1.link.test_link import QUICK, play, repeating, running
import signal
signal.signal(signal.SIGTERM, lambda *_: None)
signal.signal(signal.SIGINT, lambda *_: None)
with Link("127.0.0.1", int(sys.argv[1]), QUICK, Clock()) as link:
    running(link)
    with repeating(0.02, lambda: play(link)):
        print("running", link.process.pid, flush=True)
        time.sleep(30)
"""


@pytest.mark.medium
@pytest.mark.parametrize(
    "number",
    [
        signal.SIGINT,
        signal.SIGKILL,
        *(pytest.param(number, marks=pytest.mark.slow) for number in (signal.SIGTERM, signal.SIGSTOP)),
    ],
)
def test_a_program_that_is_killed_or_hangs_leaves_motors_damped_and_no_process(
    puppet: Puppet, number: int
) -> None:
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    with subprocess.Popen(
        [sys.executable, "-c", _PROGRAM, str(puppet.port)], stdout=subprocess.PIPE, text=True, env=environment
    ) as program:
        assert program.stdout is not None
        assert program.stdout.readline().startswith("running")
        time.sleep(0.1)
        program.send_signal(number)
        puppet.wait(damps)
        # at last packets that do nothing at all, then silence
        puppet.wait(lambda got: got.kp.max() == got.kd.max() == 0.0)
        program.kill()
    count = len(puppet.received)
    time.sleep(0.2)
    assert len(puppet.received) <= count + 1


_INTERRUPTED = """
import os, signal, sys, threading, time
from amhe_cli.robots.go1.link import link as watch
from amhe_cli.robots.go1.link.process import Clock
from amhe_cli.robots.go1.link.link import Link
from amhe_cli.robots.go1.link.mail import Phase
from tests.robots.go1.link.test_link import QUICK
watch._DAMP = 1.0
def interrupt():
    for _ in range(2):
        time.sleep(0.2)
        os.kill(os.getpid(), signal.SIGINT)
with Link("127.0.0.1", int(sys.argv[1]), QUICK, Clock()) as link:
    link.connect()
    link.stand()
    time.sleep(0.3)
    link.process.kill()
    while link.report.phase != Phase.DAMP:
        time.sleep(0.002)
    threading.Thread(target=interrupt, daemon=True).start()
"""


@pytest.mark.medium
def test_neither_the_first_nor_the_second_ctrl_c_cuts_off_who_stands_in_for_the_sender(
    puppet: Puppet,
) -> None:
    """The first ends the wait for the last phase, the second the wait for the watch; then Python ends."""
    command = [sys.executable, "-c", _INTERRUPTED, str(puppet.port)]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.stderr.rstrip().endswith("KeyboardInterrupt")
    end = time.monotonic() + 10.0
    while damps(puppet.received[-1][1]) and time.monotonic() < end:  # until it has read all
        time.sleep(0.01)
    damped = [when for when, got in puppet.received if damps(got)]
    assert damped[-1] - damped[0] > 0.9
    assert puppet.received[-1][1].kd.max() == 0.0


@pytest.mark.slow
def test_an_error_of_the_program_sits_the_robot_down(puppet: Puppet) -> None:
    """As a full disk."""
    with pytest.raises(OSError, match="No space left"), playing(puppet) as link:
        raise OSError(errno.ENOSPC, "No space left on device")
    commands = [got for _, got in puppet.received]
    folded = next(i for i, got in enumerate(commands) if i > 500 and got.kp[0] > 0 and got.position[2] < -2.0)
    assert folded < next(i for i, got in enumerate(commands) if i > folded and damps(got))
    assert (link.report.phase, link.report.trip) == (Phase.OVER, "")


@pytest.mark.medium
def test_nobody_there() -> None:
    with udp() as deaf:
        deaf.bind(("127.0.0.1", 0))
        port = deaf.getsockname()[1]
        message = f"nothing answers from 127.0.0.1:{port}"
        with Link("127.0.0.1", port, HASTY, CLOCK) as link, pytest.raises(LinkError, match=message):
            link.connect()
    with Link("127.0.0.1", port, HASTY, CLOCK) as link, pytest.raises(LinkError, match="nobody listens"):
        link.connect()


ENCRYPTED = encode_state(a_state(), "encrypted")


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (bytes(1087), "high-level mode"),
        (b"hello", "no Go1: datagrams of 5 bytes"),
        (ENCRYPTED, "checksum of 807-byte states is encrypted .`go1.crc=encrypted`"),
        (ENCRYPTED[:-2] + b"no", "checksum of 807-byte states is wrong"),
        (bytes(807), "begins with 0000, not feef"),
    ],
)
def test_another_program_on_the_port(puppet: Puppet, answer: bytes, message: str) -> None:
    puppet.mangle = lambda packet: answer
    with a_link(puppet, HASTY) as link, pytest.raises(LinkError, match=message):
        link.connect()


def test_the_setting_of_the_checksum_holds_for_states_too(puppet: Puppet) -> None:
    puppet.mangle = lambda packet: encode_state(decode_state(packet), "encrypted")
    with a_link(puppet, QUICK.model_copy(update={"crc": "encrypted"})) as link:
        link.connect()


def test_what_waited_unread_is_as_old_as_it_may_be() -> None:
    """A sender that stalled must not take old states for new ones."""
    with udp() as robot, closing(connected("127.0.0.1", bound_port(robot))) as end:
        ours = RobotSocket(end, CLOCK)
        assert list(ours.received(0.0)) == []
        looked = CLOCK.now()
        ours.send(b"hello")
        robot.sendto(b"state", robot.recvfrom(9)[1])
        time.sleep(0.05)
        for _ in ours.received(0.0):
            assert ours.empty <= looked
        assert ours.empty > looked


def test_states_from_another_port_are_not_taken() -> None:
    with udp() as robot, udp() as stranger, closing(connected("127.0.0.1", bound_port(robot))) as end:
        ours = RobotSocket(end, CLOCK)
        ours.send(b"hello")
        _, peer = robot.recvfrom(9)
        for _ in range(200):
            stranger.sendto(b"forged", peer)
        robot.sendto(b"state", peer)
        assert [datagram for datagram, _ in ours.received(CLOCK.now() + 0.01)] == [b"state"]


def bound_port(end: socket.socket) -> int:
    end.bind(("127.0.0.1", 0))
    return end.getsockname()[1]


def test_a_second_sender_is_noticed(puppet: Puppet) -> None:
    """It takes every other state away."""
    puppet.mangle = lambda packet: packet if decode_state(packet).tick % 2 else None
    with a_link(puppet, HASTY) as link, pytest.raises(LinkError, match="another program"):
        link.connect()


def test_a_robot_that_another_program_drives_is_left_alone(puppet: Puppet) -> None:
    puppet.change = lambda sent: replace(sent, torques=np.full(12, 6.0))
    with a_link(puppet) as link:
        with pytest.raises(LinkError, match="driven already"):
            link.connect()
        count = len(puppet.received)
        time.sleep(0.3)
        assert len(puppet.received) <= count + 1
    assert puppet.idle
    assert len(puppet.received) < 0.5 * QUICK.connect_time * QUICK.rate


def test_a_second_sender_that_comes_later_damps(puppet: Puppet) -> None:
    with driven(puppet) as link:
        puppet.mangle = lambda packet: packet if decode_state(packet).tick % 2 else None
        puppet.wait(damps)
    assert link.report.trip == "share"


def test_the_share_of_states_that_arrive() -> None:
    share = Share()
    assert {share.see(tick) for tick in range(1, 500)} == {1.0}
    assert share.see(900) == 0.95  # a pause
    assert [share.see(tick) for tick in range(901, 1101)][-1] == 1.0
    assert [share.see(tick) for tick in range(1101, 1501, 2)][-1] == 0.5


@pytest.mark.parametrize("mode", [SERVO, DAMPED])
def test_a_robot_that_takes_no_commands_is_noticed(puppet: Puppet, mode: int) -> None:
    """However long it is asked: either mode is commanded in turn, and its state shows one of them."""
    puppet.change = lambda sent: replace(sent, modes=np.full(12, mode))
    with a_link(puppet) as link, pytest.raises(LinkError, match="encrypted"):
        link.connect()


@pytest.mark.medium
@pytest.mark.parametrize("slow", [2.0, 0.5])
def test_a_robot_that_is_slowed_down_otherwise_is_noticed(puppet: Puppet, slow: float) -> None:
    with (
        Link("127.0.0.1", puppet.port, HASTY, Clock(slow)) as link,
        pytest.raises(LinkError, match="same `go1.slow`"),
    ):
        link.connect()


@pytest.mark.medium
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"charge": 3}, "battery"),
        ({"temperatures": np.full(12, 88.0)}, "hot"),
        ({"quaternion": np.array([np.cos(0.6), np.sin(0.6), 0.0, 0.0])}, "leans"),
        ({"joint_rates": np.full(12, np.nan)}, "not a number"),
        ({"remote": pressing("select")}, "remote"),
    ],
)
def test_a_robot_in_no_condition_is_unfit(change: dict, message: str) -> None:
    inbox = Inbox(replace(a_state(), **change), state_time=1.0)
    assert message in Machine(QUICK).unfit(1.0, inbox)


def test_an_unfit_robot_is_refused(puppet: Puppet) -> None:
    puppet.change = lambda sent: replace(sent, charge=3)
    with a_link(puppet, HASTY) as link, pytest.raises(LinkError, match="battery"):
        link.connect()


def test_a_motor_in_no_mode_to_be_driven_is_refused(puppet: Puppet) -> None:
    """It has echoed its modes, and then switches itself off."""
    with a_link(puppet) as link:
        link.connect()
        puppet.change = lambda sent: replace(sent, modes=np.full(12, 8))
        with pytest.raises(LinkError, match="is in mode 8, too hot"):
            while True:
                link.connect()


def test_no_such_host_is_one_line() -> None:
    with pytest.raises(LinkError, match="no way to"), Link("256.1.1.1", 8007, QUICK, CLOCK):
        pass
