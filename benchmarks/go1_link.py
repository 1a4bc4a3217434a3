"""The link to a Go1, on an emulated one: time of the codec, reactions to faults, jitter of packets, fuzz.

    python benchmarks/go1_link.py                     all four tables; the jitter for 60 s, 1e6 datagrams
    python benchmarks/go1_link.py codec trips         some of them
    python benchmarks/go1_link.py --seconds 10 jitter

Reactions are measured where it counts: from the fault to the first packet that damps, or holds, at the
emulated robot's socket. The jitter is that of the sender itself, while the planner of T1 runs in the program,
its estimator in a process beside it (mode adaptive), and the emulator in a third.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from rich.console import Console
from rich.table import Table

from amhe_cli.robots.go1.emulator import Emulator, EmulatorOptions, Faults
from amhe_cli.robots.go1.kinematics import HOME
from amhe_cli.robots.go1.link.link import Link
from amhe_cli.robots.go1.link.mail import Phase, Targets
from amhe_cli.robots.go1.link.packets import (
    COMMAND,
    SERVO,
    STATE,
    MotorCommand,
    PacketError,
    RobotState,
    decode_command,
    decode_state,
    encode_command,
    encode_state,
    seal,
)
from amhe_cli.robots.go1.link.process import ROBOT, Clock, take_priority
from amhe_cli.robots.go1.poses.gate import Gate
from amhe_cli.robots.go1.poses.sources import pose_datagram, read_pose
from amhe_cli.robots.go1.settings import Go1Settings, PoseSettings
from amhe_cli.robots.go1.tasks import find_task

#: The trips keep their defaults; only standing up and sitting down are in a hurry.
SETTINGS = {"gain_time": 0.3, "stand_speed": 3.0, "sit_time": 1.0, "damp_time": 0.3, "arm": "auto"}
#: With this many equal packets the targets are at rest, and not at the turn of a sway.
_AT_REST = 4
#: How much slower the robot walks before its cameras freeze, and where the box is then [m].
_SLOW, _PUSHED = 4.0, 0.8
TABLES = ("codec", "trips", "jitter", "fuzz")


def main() -> None:
    """Print the tables that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("tables", nargs="*", default=TABLES, metavar="codec|trips|jitter|fuzz")
    parser.add_argument("--seconds", type=float, default=60.0, help="of the jitter")
    parser.add_argument("--datagrams", type=int, default=1_000_000, help="of the fuzz, for each receiver")
    parser.add_argument("--repeats", type=int, default=5, help="of each trip")
    parser.add_argument("--program", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--plan", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.program:
        return program(given.program, given.plan)
    made = {
        "codec": codec, "trips": lambda: trips(given.repeats), "jitter": lambda: jitter(given.seconds),
        "fuzz": lambda: fuzz(given.datagrams),
    }  # fmt: skip
    for name in given.tables:
        Console(width=110).print(made[name]())


# -- codec -------------------------------------------------------------------------------------------------


def codec() -> Table:
    """Time of one packet."""
    sent, read = _a_command(), _a_state()
    packets = encode_command(sent), encode_state(read)
    table = Table("packet", "median us", "99 % us")
    for name, code in {
        "encode a command": lambda: encode_command(sent),
        "decode a state": lambda: decode_state(packets[1]),
        "decode a command (emulator)": lambda: decode_command(packets[0]),
        "encode a state (emulator)": lambda: encode_state(read),
    }.items():
        times = np.array([_timed(code) for _ in range(20_000)])
        table.add_row(name, *(f"{1e6 * np.quantile(times, share):.1f}" for share in (0.5, 0.99)))
    return table


def _timed(code: Callable[[], object]) -> float:
    begun = time.perf_counter()
    code()
    return time.perf_counter() - begun


# -- trips -------------------------------------------------------------------------------------------------


def trips(repeats: int) -> Table:
    """Reaction to every fault, at the robot's socket."""
    limits = {
        "silence": 50,
        "stale": 50,
        "SIGINT": 20,
        "SIGTERM": 20,
        "SIGKILL": 100,
        "sender hangs": 150,
        "plans stop": 100,
        "poses stop": 200,
        "trunk freezes": 500,
        "box freezes": 1000,
    }
    table = Table("fault", "reaction", "to reach ms", "median ms", "worst ms")
    for fault in (
        "silence",
        "stale",
        "remote",
        "hot",
        "mode",
        "battery",
        "tilt",
        "speed",
        "power",
        "nan",
        "corrupt",
    ):
        changed = Faults(**{fault: 1.0 if fault == "corrupt" else 0.0})
        times = [
            _reaction(lambda robot, changed=changed: robot.emulator.cause(changed), damps)
            for _ in range(repeats)
        ]
        table.add_row(*_row(fault, "damped", limits, times))
    for name in ("SIGINT", "SIGTERM", "SIGKILL"):
        number = getattr(signal, name)
        times = [
            _reaction(lambda robot, number=number: robot.process.send_signal(number), damps)
            for _ in range(repeats)
        ]
        table.add_row(*_row(name, "damped", limits, times))
    for name, pause in (("sender hangs", None), ("sender stalls 40 ms", 0.04)):
        times = [
            _reaction(lambda robot, pause=pause: _stall(robot.sender, pause), damps) for _ in range(repeats)
        ]
        table.add_row(*_row(name, "damped", limits, times))
    for name, number in (("plans stop", signal.SIGSTOP), ("poses stop", signal.SIGUSR1)):
        for reaction, test in (("held", holds), ("sat down, then damped", damps)):
            times = [
                _reaction(lambda robot, number=number: robot.process.send_signal(number), test)
                for _ in range(repeats)
            ]
            table.add_row(*_row(name, reaction, limits if test is holds else {}, times))
    for name, changed in {"trunk freezes": Faults(frozen=0.0), "box freezes": Faults(frozen_box=0.0)}.items():
        table.add_row(*_row(name, "damped", limits, [_walked_on(changed) for _ in range(repeats)]))
    return table


def _stall(sender: int, pause: float | None) -> None:
    """Stop the sender's process for a pause [s]; None: permanently."""
    os.kill(sender, signal.SIGSTOP)
    if pause is not None:
        time.sleep(pause)
        os.kill(sender, signal.SIGCONT)


def _row(fault: str, reaction: str, limits: dict[str, int], times: list[float]) -> list[str]:
    limit = str(limits[fault]) if fault in limits else "-"
    return [fault, reaction, limit, f"{1e3 * np.median(times):.0f}", f"{1e3 * max(times):.0f}"]


class Robot:
    """An emulated robot in a thread, and a program that plays swaying plans to it."""

    def __init__(self, plan: bool = False) -> None:
        self.received: list[tuple[float, MotorCommand]] = []
        options = EmulatorOptions(find_task("t1"), port=0, mocap="none")
        self.emulator = Emulator(options, lambda when, sent: self.received.append((when, sent))).__enter__()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=_serve, args=(self.emulator, self._stop), daemon=True)
        self._thread.start()
        port = str(self.emulator.address[1])
        self.process = subprocess.Popen(
            [sys.executable, __file__, "--program", port, *(["--plan"] if plan else [])],
            stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        assert self.process.stdout is not None
        words = self.process.stdout.readline().split()
        self.runs = "running" in words
        self.sender = int(words[-1]) if self.runs else 0

    def close(self) -> str:
        """End both; returns what the program printed last."""
        self.process.send_signal(signal.SIGCONT)
        self.process.send_signal(signal.SIGTERM)
        words, _ = self.process.communicate()
        self._stop.set()
        self._thread.join()
        self.emulator.__exit__()
        return words


def _serve(emulator: Emulator, stop: threading.Event) -> None:
    # a robot's own computer does nothing else either: what is measured is the sender, not this thread
    take_priority(ROBOT, anywhere=True)
    emulator.serve(stop.is_set)


@contextmanager
def a_robot() -> Iterator[Robot]:
    """A robot that is running; it is started again if a busy computer trips it on the way."""
    robot = Robot()
    while not robot.runs:
        robot.close()
        robot = Robot()
    try:
        yield robot
    finally:
        robot.close()


def _reaction(fault: Callable[[Robot], None], test: Callable[[list[MotorCommand], int], bool]) -> float:
    """From a fault to the first packet that passes a test [s]; the test looks at all packets and an index."""
    with a_robot() as robot:
        time.sleep(0.5)
        while _rests([one for _, one in robot.received[-_AT_REST - 1 :]]):  # no plan has come yet
            time.sleep(0.01)
        first = len(robot.received)
        begun = Clock().now()
        fault(robot)
        while Clock().now() - begun < 10.0:
            commands = [one for _, one in robot.received]
            for index in range(first, len(commands)):
                if test(commands, index):
                    return robot.received[index][0] - begun
            time.sleep(0.05)
    raise RuntimeError("no reaction")


def _walked_on(changed: Faults) -> float:
    """From a fault of the cameras, while T1 pushes its box, to the first packet that damps [s]."""
    received: list[tuple[float, MotorCommand]] = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    slow = Go1Settings(slow=_SLOW)
    options = EmulatorOptions(find_task("t1"), port=0, mocap="udp", mocap_port=port, settings=slow)
    stop, begun, first = threading.Event(), 0.0, 0
    with Emulator(options, lambda when, sent: received.append((when, sent))) as emulator:
        served = threading.Thread(target=_serve, args=(emulator, stop), daemon=True)
        served.start()
        where = f"--host 127.0.0.1 --port {emulator.address[1]} --pose udp --pose-port {port}"
        what = f"run --set go1.slow={_SLOW:g} --task t1 --target go1 --mode baseline -q --set go1.arm=auto"
        what += " --set go1.trips.state_age=0.5 --set go1.trips.plan_age=1"
        with tempfile.TemporaryDirectory() as folder:
            command = f"{sys.executable} -m amhe_cli {what} {where} -o {folder}/run"
            with subprocess.Popen(command.split(), stderr=subprocess.DEVNULL) as program:
                while emulator.body.state.box.position[0] < _PUSHED and program.poll() is None:
                    time.sleep(0.01)
                if program.poll() is not None:
                    raise RuntimeError("it did not come to push: is the computer busy?")
                time.sleep(_SLOW * np.random.default_rng().uniform(0.0, 0.5))  # anywhere in a stride
                begun, first = Clock(_SLOW).now(), len(received)
                emulator.cause(changed)
                program.wait()
        stop.set()
        served.join()
    commands = [sent for _, sent in received]
    return next(received[i][0] for i in range(first, len(commands)) if damps(commands, i)) - begun


def damps(commands: list[MotorCommand], index: int) -> bool:
    """A packet only damps."""
    return commands[index].kp.max() == 0.0 and commands[index].kd.min() > 0.0


def holds(commands: list[MotorCommand], index: int) -> bool:
    """Targets, which sway while plans are played, rest: a packet repeats the one before, and the next do."""
    rest = commands[index - 1 : index + _AT_REST]
    return len(rest) > _AT_REST and _rests(rest)


def _rests(commands: list[MotorCommand]) -> bool:
    return all(np.array_equal(one.position, commands[0].position) for one in commands)


def program(port: int, plan: bool) -> None:
    """Stand up, and play plans that sway a little; with planner and estimator running beside it, unused."""
    stop, poses, work = threading.Event(), [True], Counter[str]()
    signal.signal(signal.SIGTERM, lambda *_: stop.set())
    signal.signal(signal.SIGINT, lambda *_: stop.set())
    signal.signal(signal.SIGUSR1, lambda *_: poses.__setitem__(0, False))
    clock, trip = Clock(), {"plan_age": 1.0, "pose_age": 1.0, "state_age": 0.5} if plan else {}
    settings = Go1Settings.model_validate(SETTINGS | {"trips": trip})
    with Link("127.0.0.1", port, settings, clock) as link:
        link.connect()
        link.stand()
        _wait(link, Phase.READY)
        link.arm()
        _wait(link, Phase.RUN)
        if plan:
            threading.Thread(target=_plan, args=(stop, work), daemon=True).start()
        print("running", link.process.pid, flush=True)
        pose_time = clock.now()
        while not stop.wait(0.02) and link.report.phase == Phase.RUN:
            now = clock.now()
            pose_time = now if poses[0] else pose_time
            sway = 0.02 * np.sin(6.0 * (now + 0.02 * np.arange(16)))
            link.play(Targets(now, 0.02, HOME + sway[:, None]), pose_time)
            link.samples()
    print(link.report.intervals | work)


def _wait(link: Link, phase: Phase) -> None:
    while not link.reached(phase):
        time.sleep(0.005)


def _plan(stop: threading.Event, work: Counter[str]) -> None:
    """T1 again and again, as fast as it goes, the estimator in its own process; counts what both did."""
    from amhe_cli.estimation.online.horizon import Estimate
    from amhe_cli.robots.go1.run import RunOptions, belief_source, open_run, task_and_system

    # by the clock, so that the estimator has a process; on a busy computer it is slow, and does not hang
    chosen = RunOptions("t1", "adaptive", threads=1, settings={"control": {"realtime": True}})
    task, system = task_and_system(chosen)
    while not stop.is_set():
        run = open_run(RunOptions("t1", threads=1))
        believed = belief_source(chosen, task, system, None, slow=10.0)
        episode = replace(run.episode, belief=believed)
        with contextlib.closing(episode.belief):
            for cycle in episode.cycles():
                work.update(plans=1, updates=sum(isinstance(news, Estimate) for news in cycle.news))
                if stop.is_set():
                    return


# -- jitter ------------------------------------------------------------------------------------------------


def jitter(seconds: float) -> Table:
    """Time between the sender's packets."""
    robot = Robot(plan=True)
    assert robot.runs
    time.sleep(seconds)
    words = robot.close().strip().splitlines()[-1]
    arrivals = np.diff([when for when, _ in robot.received])
    sent = eval(words)  # a dictionary of numbers that we printed ourselves
    title = (
        f"{len(arrivals)} packets, {sent['plans']} plans, {sent['updates']} updates of the belief; "
        f"load {os.getloadavg()[0]:.1f}, {os.cpu_count()} cores"
    )
    table = Table("at", "p50 ms", "p99 ms", "p99.9 ms", "max ms", title=title)
    table.add_row("sender", *(str(sent[name]) for name in ("p50_ms", "p99_ms", "p999_ms", "max_ms")))
    shares = (0.5, 0.99, 0.999, 1.0)
    table.add_row("robot's socket", *(f"{1e3 * np.quantile(arrivals, share):.2f}" for share in shares))
    return table


# -- fuzz --------------------------------------------------------------------------------------------------


def fuzz(count: int) -> Table:
    """Random and mutated datagrams into both receivers: what was accepted although it should not."""
    table = Table("receiver", "datagrams", "accepted", "wrongly accepted", "crashes")
    for name, good, decode, form in (
        ("robot's states", encode_state(_a_state()), decode_state, STATE),
        ("commands (emulator)", encode_command(_a_command()), decode_command, COMMAND),
    ):
        rng, accepted, wrong, crashes = np.random.default_rng(0), 0, 0, 0
        for datagram in _mutants(good, count, rng):
            try:
                decode(datagram)
            except PacketError:
                continue
            except Exception:
                crashes += 1
                continue
            accepted += 1
            wrong += not _is_right(datagram, good, form)
        table.add_row(name, f"{count:,}", f"{accepted:,}", str(wrong), str(crashes))
    table.add_row("poses (udp)", f"{count:,}", *_fuzz_poses(count))
    return table


def _fuzz_poses(count: int) -> tuple[str, str, str]:
    """Poses accepted, believed though they are more than 0.1 m off, and crashes; one in 20 is a good one."""
    rng, gate, period = np.random.default_rng(0), Gate(PoseSettings(), "go1", "box"), 0.01
    place, level = np.array([0.3, -0.2, 0.27]), np.array([1.0, 0.0, 0.0, 0.0])
    accepted = wrong = crashes = 0
    for number, datagram in enumerate(_pose_mutants(pose_datagram("go1", 1.0, place, level), count, rng)):
        now = number * period / 20
        try:
            seen = read_pose(pose_datagram("go1", now, place, level) if number % 20 == 0 else datagram)
            if seen is not None and seen.body == "go1":
                accepted += 1
                pose, stamp = (seen.position, seen.orientation), now if seen.stamp is None else seen.stamp
                believed = gate.believes("go1", stamp, pose, now, level, "")
                wrong += believed and float(np.abs(seen.position - place).max()) > 0.1
        except Exception:
            crashes += 1
    return f"{accepted:,}", str(wrong), str(crashes)


_ODD = ("1e300", "-1e9", "NaN", "Infinity", "null", "[]", '"x"', "1e400", "9" * 400, "0.77", "-0", "{}")


def _pose_mutants(good: bytes, count: int, rng: np.random.Generator) -> Iterator[bytes]:
    """Mutants of a datagram of text; in half of them whole numbers are replaced."""
    for mutant in _mutants(good, count, rng):
        if rng.random() < 0.5:
            parts = re.split(rb"(-?\d+\.\d+)", good)
            place = 2 * int(rng.integers(0, len(parts) // 2)) + 1
            parts[place] = _ODD[int(rng.integers(0, len(_ODD)))].encode()
            mutant = b"".join(parts)
        yield mutant


def _mutants(good: bytes, count: int, rng: np.random.Generator) -> Iterator[bytes]:
    kinds = rng.integers(0, 4, count)
    for kind in kinds.tolist():
        if kind == 0:
            yield rng.bytes(int(rng.integers(0, 1200)))
        elif kind == 1:
            yield good[: int(rng.integers(0, len(good)))] + rng.bytes(int(rng.integers(0, 3)))
        else:
            packet = bytearray(good)
            for position in rng.integers(0, len(good), kind - 1 + int(rng.integers(0, 3))).tolist():
                packet[position] ^= 1 << int(rng.integers(0, 8))
            if kind == 3 and rng.random() < 0.5:
                seal(packet)  # a right checksum over a wrong content
            yield bytes(packet)


def _is_right(datagram: bytes, good: bytes, layout: np.dtype) -> bool:
    """Length, head, level and checksum, by other means than the decoder's: a table of divisions."""
    if len(datagram) != layout.itemsize or datagram[:3] != good[:3]:
        return False
    crc = 0xFFFFFFFF
    for byte in np.frombuffer(datagram[: 4 * (len(datagram) // 4 - 1)], "<u4").byteswap().tobytes():
        crc = (crc << 8) & 0xFFFFFFFF ^ _TABLE[crc >> 24 ^ byte]
    sent = int.from_bytes(datagram[-4:], "little")
    if sent == crc:
        return True
    mixed = crc ^ 0xEDCAB9DE
    return len(datagram) == 614 and sent == (mixed >> 8) | ((mixed & 0xFF) << 24)


def _divided(byte: int) -> int:
    crc = byte << 24
    for _ in range(8):
        crc = (crc << 1) ^ 0x104C11DB7 if crc >> 31 else crc << 1
    return crc


_TABLE = [_divided(byte) for byte in range(256)]


def _a_command() -> MotorCommand:
    return MotorCommand(SERVO, np.array(HOME), np.zeros(12), np.ones(12), np.full(12, 60.0), np.full(12, 3.0))


def _a_state() -> RobotState:
    return RobotState(
        7, np.array([1.0, 0, 0, 0]), np.zeros(3), np.ones(3), np.full(12, 10), np.array(HOME), np.ones(12),
        np.ones(12), np.full(12, 30.0), np.ones(4), 80,
    )  # fmt: skip


if __name__ == "__main__":
    main()
