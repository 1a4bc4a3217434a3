"""The emulated robot and its cameras, on loopback, through other people's software too."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import replace
from itertools import count
from unittest.mock import Mock

import numpy as np
import pytest

from amhe_cli.cli.main import run
from amhe_cli.core.errors import AmheError, ConfigError
from amhe_cli.robots.go1.behaviours.gait import Gait, walk
from amhe_cli.robots.go1.emulator import (
    STEP,
    EmulatedBody,
    Emulator,
    EmulatorOptions,
    Faults,
    Motive,
    RobotPort,
    parse_faults,
)
from amhe_cli.robots.go1.kinematics import HOME, TORQUE_LIMIT
from amhe_cli.robots.go1.link.machine import Machine, tilt
from amhe_cli.robots.go1.link.mail import Inbox, Phase, Targets
from amhe_cli.robots.go1.link.packets import (
    DAMPED,
    SERVO,
    MotorCommand,
    PacketError,
    decode_state,
    encode_command,
)
from amhe_cli.robots.go1.poses.sources import NatNet, PoseError
from amhe_cli.robots.go1.settings import Go1Settings
from amhe_cli.robots.go1.tasks import find_task
from tests.robots.go1.stand_ins import a_state, emulating, free_port, repeating, udp

T1 = find_task("t1")
FOLDED = np.tile([0.0, 1.2, -2.6], 4)


@pytest.fixture(scope="module")
def lying() -> EmulatedBody:
    """A robot as it is switched on; tests leave it as they will."""
    return EmulatedBody(T1, np.random.default_rng(0))


def servo(position: np.ndarray, kp: float = 60.0, kd: float = 3.0) -> MotorCommand:
    return MotorCommand(SERVO, position, np.zeros(12), np.zeros(12), np.full(12, kp), np.full(12, kd))


def stands_up(body: EmulatedBody) -> None:
    state, _ = body.obey(MotorCommand())
    for start, end, seconds in ((state.joints, FOLDED, 0.5), (FOLDED, HOME, 1.0), (HOME, HOME, 0.5)):
        for share in np.linspace(0.0, 1.0, round(seconds * 1000)):
            body.obey(servo(start + share * (end - start)))


@pytest.mark.medium
def test_it_lies_with_folded_calves_stands_up_and_sinks_when_damped(lying: EmulatedBody) -> None:
    state, _ = lying.obey(MotorCommand(DAMPED))
    assert 0.05 < lying.state.trunk.position[2] < 0.12
    assert (state.joints[2::3] < -2.6).all()
    stands_up(lying)
    assert 0.24 < lying.state.trunk.position[2] < 0.3
    state, _ = lying.obey(servo(HOME))
    assert state.accelerometer[2] == pytest.approx(9.81, abs=1.5)
    assert (state.modes == SERVO).all()
    for _ in range(1500):
        state, _ = lying.obey(MotorCommand(velocity=np.zeros(12), kd=np.full(12, 3.0)))
    assert lying.state.trunk.position[2] < 0.16


def test_torques_are_clipped_and_stopped_loops_are_off() -> None:
    body = EmulatedBody(T1, np.random.default_rng(0))
    state, _ = body.obey(servo(HOME + 3.0, kp=200.0))
    assert (np.abs(state.torques) <= TORQUE_LIMIT + 1e-6).all()
    assert np.abs(state.torques).max() > 20.0
    state, _ = body.obey(replace(MotorCommand(), kp=np.full(12, 60.0), kd=np.full(12, 3.0)))
    np.testing.assert_allclose(state.torques, 0.0, atol=1e-9)
    state, _ = body.obey(replace(MotorCommand(), torque=np.full(12, 2.0)))
    np.testing.assert_allclose(state.torques, 2.0, atol=1e-9)


def test_time_based_changes_count_from_the_first_push() -> None:
    body = EmulatedBody(find_task("t3"), np.random.default_rng(0))
    mass = body.parameters["box_mass"]
    assert mass == pytest.approx(4.0)
    body._moving_since = body.time - 9.9985
    body.obey(MotorCommand())
    assert body.parameters["box_mass"] == pytest.approx(4.0)
    body.obey(MotorCommand())
    assert body.parameters["box_mass"] == pytest.approx(6.0)


def test_the_port_answers_the_last_sender_and_takes_only_good_commands() -> None:
    port = RobotPort("127.0.0.1", 0, Faults())
    with udp() as one, udp() as other:
        for client in (one, other):
            client.bind(("127.0.0.1", 0))
            client.settimeout(1.0)
        good = encode_command(servo(HOME))
        for client, datagram in ((one, good), (one, good[:-1]), (other, b"\0" * 614), (other, good)):
            client.sendto(datagram, port.address)
        assert len(port.receive(0.0)) == 2
        assert (port.accepted, port.rejected) == (2, 2)
        port.send(a_state(tick=77), 0.0)
        assert decode_state(other.recv(2000)).tick == 77
        one.settimeout(0.05)
        with pytest.raises(TimeoutError):
            one.recv(2000)
    port.close()


def test_a_lossy_late_line_loses_delays_and_damages() -> None:
    faults = parse_faults("loss=0.5,duplicate=0.2,corrupt=0.2,delay=5ms")
    port = RobotPort("127.0.0.1", 0, faults)
    with udp() as client:
        for _ in range(200):
            client.sendto(encode_command(servo(HOME)), port.address)
        assert port.receive(1.0) == []
        assert 60 < len(port.receive(1.006)) < 160
        for tick in range(200):
            port.send(a_state(tick=tick), 2.0)
        port.receive(2.006)
        client.setblocking(False)
        good, bad = set(), 0
        while True:
            try:
                datagram = client.recv(2000)
            except BlockingIOError:
                break
            try:
                good.add(decode_state(datagram).tick)
            except PacketError:
                bad += 1
        assert 50 < len(good) < 110
        assert 5 < bad < 50
    port.close()


def test_a_line_is_good_until_its_faults_begin() -> None:
    options = EmulatorOptions(T1, port=0, mocap="none", faults=parse_faults("loss=1,after=0.02"))
    with Emulator(options) as emulator, udp() as client:
        client.setblocking(False)
        client.connect(emulator.address)

        def ticks(milliseconds: int, kp: float) -> list[int]:
            client.send(encode_command(servo(FOLDED, kp=kp)))
            for _ in range(milliseconds):
                emulator._millisecond()
            seen = []
            with suppress(BlockingIOError):
                while True:
                    seen.append(decode_state(client.recv(2000)).tick)
            return seen

        idle = ticks(40, kp=0.0)  # drives nothing yet
        assert len(idle) == 40
        assert ticks(60, kp=1.0) == list(range(idle[-1] + 1, idle[-1] + 21))


@pytest.mark.parametrize("text", ["los=0.1", "loss", "delay=soon"])
def test_a_fault_that_is_none_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="loss|delay"):
        parse_faults(text)


def test_a_port_that_is_taken_is_one_line() -> None:
    with udp() as other:
        other.bind(("127.0.0.1", 0))
        with pytest.raises(AmheError, match=f"port {other.getsockname()[1]} of 127.0.0.1"):
            RobotPort("127.0.0.1", other.getsockname()[1], Faults())


@pytest.fixture
def motive() -> Iterator[Motive]:
    with closing(Motive("127.0.0.1", 0, ("go1", "box"))) as server:
        yield server


TURN = np.array([np.cos(0.3), 0.0, 0.0, np.sin(0.3)])


@contextmanager
def serving(motive: Motive) -> Iterator[None]:
    """Frames at 100 Hz or so; the box is seen from 5.6 s on."""
    times = count(5.01, 0.01)

    def serve() -> None:
        now = next(times)
        motive.serve(now)
        box = (np.array([0.6, 0.1, 0.15]), -TURN) if now > 5.6 else None
        motive.show([(np.array([1.0, 2.0, 0.3]), TURN), box], now)

    with repeating(0.005, serve):
        yield


@pytest.mark.flaky(reruns=2)
def test_natnet_reads_what_motive_streams(motive: Motive) -> None:
    pytest.importorskip("natnet")
    with serving(motive), closing(NatNet(*motive.address, 2.0)) as source:
        source.connect()
        seen, end = {}, time.monotonic() + 5.0
        while len(seen) < 2 and time.monotonic() < end:
            seen |= {one.body: one for one in source.wait(0.05)}
    np.testing.assert_allclose(seen["go1"].position, [1.0, 2.0, 0.3], atol=1e-6)
    np.testing.assert_allclose(seen["go1"].orientation, TURN, atol=1e-6)
    np.testing.assert_allclose(seen["box"].orientation, -TURN, atol=1e-6)
    assert seen["box"].stamp > 5.6
    assert seen["go1"].age == pytest.approx(0.004)


@pytest.mark.flaky(reruns=2)
@pytest.mark.parametrize("address", ["127.0.0.2", "127.0.0.1"])
def test_natnet_listens_at_one_address_and_to_one_port(motive: Motive, address: str) -> None:
    pytest.importorskip("natnet")
    there = np.array([9.0, 9.0, 9.0]), TURN
    with (
        serving(motive),
        closing(NatNet(*motive.address, 2.0)) as source,
        closing(Motive(address, 0, ("go1", "box"))) as impostor,
    ):
        source.connect()
        client = source._client
        sockets = [client._NatNetClient__data_socket, client._NatNetClient__command_socket]
        assert {one.getsockname()[0] for one in sockets} == {"127.0.0.1"}
        impostor._clients = {one.getsockname(): 0.0 for one in sockets}
        seen, end = [], time.monotonic() + 5.0
        while len(seen) < 50 and time.monotonic() < end:
            impostor.show([there, there], 0.0)
            impostor.serve(1.0)
            seen += source.wait(0.05)
    assert seen
    assert not any(one.position[0] == 9.0 for one in seen)


def test_a_frame_comes_as_late_as_it_says(motive: Motive) -> None:
    """Stamped at its exposure, it must not show what came to pass only when it was sent."""
    with udp() as client:
        client.setblocking(False)
        client.sendto(bytes(4), motive.address)  # 0: connect
        motive.serve(5.0)
        assert client.recv(4096)[:2] == b"\x01\x00"
        seen = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
        motive.show([seen, seen], 5.0)
        motive.serve(5.003)
        with pytest.raises(BlockingIOError):
            client.recv(4096)
        motive.serve(5.0041)
        assert client.recv(4096)[:2] == b"\x07\x00"


def test_no_motive_is_one_line() -> None:
    pytest.importorskip("natnet")
    with udp() as deaf:
        deaf.bind(("127.0.0.1", 0))
        with pytest.raises(PoseError, match="no Motive answers"):
            NatNet("127.0.0.1", deaf.getsockname()[1], 0.2).connect()


@pytest.mark.medium
def test_the_vendors_own_client_stands_the_robot_up_through_it() -> None:
    """The emulator's socket on one side, their `UDP` class on the other, in step with the emulated clock."""
    sdk = pytest.importorskip(
        "unitree_legged_sdk.robot_interface", reason="unitree-legged-sdk has no wheel here"
    )
    with Emulator(EmulatorOptions(T1, port=0, mocap="none")) as emulator:
        link = sdk.UDP(0xFF, free_port(), *emulator.address)
        sent, read = sdk.LowCmd(), sdk.LowState()
        link.InitCmdData(sent)
        safe = sdk.Safety(sdk.LeggedType.Go1)

        def turn(target: np.ndarray | None, kp: float) -> np.ndarray:
            if target is not None:
                for motor, q in zip(sent.motorCmd[:12], target, strict=False):
                    motor.q, motor.dq, motor.Kp, motor.Kd, motor.tau = q, 0.0, kp, 3.0, 0.0
                safe.PowerProtect(sent, read, 7)
            link.SetSend(sent)
            link.Send()
            for _ in range(2):
                emulator._millisecond()
            link.Recv()
            link.GetRecv(read)
            return np.array([motor.q for motor in read.motorState[:12]])

        for _ in range(20):
            start = turn(None, 0.0)
        assert read.bms.SOC == 85
        for begin, end, ticks in ((start, FOLDED, 200), (FOLDED, HOME, 500), (HOME, HOME, 150)):
            for share in np.linspace(0.0, 1.0, ticks):
                joints = turn(begin + share * (end - begin), 60.0)
        assert emulator.body.state.trunk.position[2] > 0.24
        np.testing.assert_allclose(joints, HOME, atol=0.12)
        assert emulator.counts[1] == 0


def test_the_command_emulates_the_box_that_was_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever its name, where its marker sits and how fast: the settings of `amhe run` suit both."""
    emulator = Mock(side_effect=AmheError("seen"))
    monkeypatch.setattr("amhe_cli.robots.go1.emulator.Emulator", emulator)
    given = ("boxes.box=[0.6,0.5,0.4]", "go1.box=crate", "go1.box_offset=[0,0,-0.2,0,0,0]", "go1.slow=2")
    assert run(["emulate", *(word for one in given for word in ("--set", one))]) != 0
    (seen,) = emulator.call_args.args
    assert seen.task.box.size == pytest.approx((0.6, 0.5, 0.4))
    assert seen.task.box.position == pytest.approx((0.75, 0.0)), "its near face is that of the task's box"
    given = seen.settings
    assert (given.box, given.box_offset, given.slow) == ("crate", (0, 0, -0.2, 0, 0, 0), 2.0)


@pytest.mark.flaky(reruns=2)
@pytest.mark.medium
def test_the_command_serves_says_where_and_ends_in_order() -> None:
    with emulating("--task", "t4", "--mocap", "natnet") as emulated:
        with udp() as client:
            client.settimeout(5.0)
            client.connect(("127.0.0.1", emulated.port))
            client.send(encode_command(MotorCommand()))
            ticks = [decode_state(client.recv(2000)).tick for _ in range(50)]
        assert (np.diff(ticks) > 0).all()
    assert "1 commands, 0 damaged" in emulated.stderr
    assert emulated.process.returncode == 0


SETTINGS = Go1Settings(gain_time=0.2, stand_speed=3.0, damp_time=0.3, arm="auto")
PERIOD, LONGEST = 0.02, 15.0
#: Ahead [m/s].
TWIST = np.array([0.2, 0.0, 0.0])


def trotting(start: float, now: float) -> Targets:
    """A plan of a trot on the spot that began at `start`."""
    times = now - start + PERIOD * np.arange(1, 17)
    return Targets(now, PERIOD, walk(Gait(), times, np.tile(TWIST, (16, 1))).targets)


def worst_tilt(walked: float, then: str) -> float:
    """The most that the trunk leans [rad] after a robot that trotted so long [s] is asked to end."""
    body, machine, inbox = EmulatedBody(find_task("t1"), np.random.default_rng(0)), Machine(SETTINGS), Inbox()
    inbox.stand = inbox.arm = True
    command, begun, leans = MotorCommand(), np.inf, 0.0
    for tick in range(round(LONGEST / STEP)):
        state, _ = body.obey(command)
        now = body.time
        inbox.state, inbox.state_time, inbox.pose_time = state, now, now
        if machine.phase == Phase.RUN:
            begun = min(begun, now)
            if now - begun < walked and tick % 20 == 0:
                inbox.plan, inbox.plan_time = trotting(begun, now), now
            inbox.finish = then == "finish" and now - begun >= walked
        if machine.phase in (Phase.PAUSE, Phase.SIT):
            leans = max(leans, tilt(state.quaternion))
        if machine.phase == Phase.OVER:
            assert machine.trip == {"finish": "", "plan lost": "plan_lost"}[then]
            return leans
        if tick % 2 == 0:
            command = machine.step(now, inbox)
    raise AssertionError(f"it never came to an end: {machine.phase.name}")


@pytest.mark.medium
@pytest.mark.parametrize(("then", "walked"), [("finish", 1.08), ("finish", 1.38), ("plan lost", 1.02)])
def test_a_robot_that_walks_puts_its_feet_down_before_it_sits(then: str, walked: float) -> None:
    assert worst_tilt(walked, then) < 0.25
