"""amhe run on an emulated Go1, with faults of its motors and poses."""

from __future__ import annotations

import json
import multiprocessing
import os
import random
import re
import select
import subprocess
import sys
import termios
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock, Mock

import numpy as np
import pytest

from amhe_cli import System, read_log
from amhe_cli.cli import at_the_robot
from amhe_cli.cli.main import run
from amhe_cli.cli.session import Session
from amhe_cli.core.errors import Ending
from amhe_cli.logs import read_metadata, survey
from amhe_cli.robots.go1.link.mail import Phase, SenderReport, StoppedError
from amhe_cli.robots.go1.poses.feed import KINDS
from amhe_cli.robots.go1.probing.motions import STEADY
from tests.robots.go1.stand_ins import SLOW, Emulated, emulating, free_port, repeating, udp

pytestmark = pytest.mark.realtime

ROOT = Path(__file__).parents[2]
#: Little work, quick motions, and patience with a busy machine.
QUICK = [
    *("--set", "control.samples=5"), *("--set", "control.horizon=8"), *("--set", "go1.gain_time=0.2"),
    *("--set", "go1.stand_speed=3"), *("--set", "go1.sit_time=0.3"), *("--set", "go1.damp_time=0.3"),
    *("--set", "go1.trips.plan_age=1"), *("--set", "go1.trips.state_age=0.5"),
    *("--set", "go1.trips.pose_age=1"), *("--set", "go1.place_tolerance=0.3"),
    *("--set", "go1.trips.packet_gap=0.2"), *("--set", "go1.trips.report_age=1"), "--threads", "1", "-q",
]  # fmt: skip
#: Little work in the design of a probe, and in what it tells.
FEW = ["--set=probe.pairs=0", "--set=control.substeps=1", "--set=identify.first_state=never"]
ROBOT = ["run", "--task", "t1", "--target", "go1", "--mode", "baseline"]


def at(emulated: Emulated) -> list[str]:
    here = ["--host", "127.0.0.1", "--port", str(emulated.port)]
    eyes = ["--pose-host", "127.0.0.1", "--pose-port", str(emulated.mocap_port)]
    return [*ROBOT, *here, *eyes, "--set", f"go1.slow={SLOW}", "--set", "go1.arm=auto", *QUICK]


def test_the_choices_are_those_of_the_library() -> None:
    assert at_the_robot.POSES == KINDS


@pytest.fixture(autouse=True)
def _brief(monkeypatch: pytest.MonkeyPatch) -> None:
    """A rehearsal of fewer cycles."""
    monkeypatch.setattr("amhe_cli.robots.go1.link.open._CYCLES", 20)


@pytest.mark.slow
def test_a_robot_is_checked_without_moving_then_runs_and_its_log_is_identified(capsys, monkeypatch) -> None:
    pytest.importorskip("natnet")
    with emulating("--set", f"go1.slow={SLOW}") as emulated:
        assert run([*at(emulated), "--dry-run"]) == 0
        assert "nothing has moved" in capsys.readouterr().out
        assert list(Path().iterdir()) == []
        assert run([*at(emulated), "--duration", "3", "-o", "out"]) == 0, capsys.readouterr().err
    assert run([*ROBOT[:3], "--duration", "0.1", "-o", "sim", *QUICK]) == 0
    record = json.loads(Path("out/result.json").read_text())
    assert (record["target"], record["fell"], record["truth"]) == ("go1", False, {})
    assert record["link"]["trip"] == ""
    assert record["link"]["slow"] == SLOW
    assert record["link"]["packets"]["packets"] > 500
    assert read_metadata(Path("out/log.mcap"))["target"] == "go1"
    real, simulated = survey(Path("out/log.mcap")), survey(Path("sim/log.mcap"))
    assert not real.problems
    topics = [{(topic.name, topic.type) for topic in log.topics} for log in (simulated, real)]
    assert topics[0] - topics[1] == {("/amhe/truth", "sensor_msgs/msg/JointState")}
    assert topics[1] <= topics[0]
    assert run(["inspect", "out/log.mcap"]) == 0
    for setting in ("ITERATIONS=3", "FIRST_STATE=never"):
        monkeypatch.setenv(*f"AMHE_IDENTIFY__{setting}".split("="))
    monkeypatch.setenv("AMHE_CLIPS__COUNT", "6")
    found = {}
    for command in ("identify", "mhe-replay"):
        assert run([command, "out/log.mcap"]) == 0, capsys.readouterr().err
        (record,) = Path("amhe-out").glob(f"{command}-*/result.json")
        parameters = json.loads(record.read_text())["parameters"]
        found[command] = {one["name"]: one["estimate"] for one in parameters}
    # of so short a push only the product is known well: mu m of the emulator's box, 0.6 x 4 kg
    for command, box in found.items():
        product = box["box_mass"] * box["floor_friction"]
        assert product == pytest.approx(2.4, rel=0.15), (command, box)


@pytest.mark.slow
def test_a_fault_before_the_run_damps_fails_and_keeps_a_readable_log(capsys) -> None:
    """Faults in the run are below."""
    pytest.importorskip("natnet")
    with emulating("--set", f"go1.slow={SLOW}", "--fault", "hot=0.1") as emulated:
        assert run([*at(emulated), "-o", "out"]) == 1
    assert capsys.readouterr().err.count("deg C hot") == 1
    record = json.loads(Path("out/result.json").read_text())
    assert (record["link"]["trip"], record["cycles"]) == ("temperature", 0)
    assert not survey(Path("out/log.mcap")).problems
    assert Path("out/report.html").exists()


KEY = SenderReport(Phase.DAMP, "order", "key")
HOT = SenderReport(Phase.DAMP, "temperature", "FR_hip_joint is 76 deg C hot")
LATE = SenderReport(Phase.PAUSE, "plan_lost", "no plan for 92 ms")


@pytest.mark.parametrize(
    ("report", "begun", "ending"),
    [
        (KEY, True, (True, None)),
        (HOT, True, (False, "trip temperature: FR_hip_joint is 76 deg C hot")),
        (HOT, False, None),
    ],
)
def test_a_robot_that_is_stopped_on_the_way_has_an_ending(monkeypatch, report, begun, ending) -> None:
    monkeypatch.setattr(at_the_robot, "ready", Mock(side_effect=report.stop))
    target = Mock(begun=begun, report=report)
    if ending is None:
        with pytest.raises(StoppedError):
            at_the_robot.attended(target, Mock(), Mock())
        return
    found = at_the_robot.attended(target, Mock(), Mock())
    assert (found.interrupted, found.error and str(found.error)) == ending


@pytest.mark.parametrize("stop", [None, KEY.stop, HOT.stop])
def test_ctrl_c_while_a_robot_is_let_down_keeps_the_run(monkeypatch, stop) -> None:
    monkeypatch.setattr(at_the_robot, "ready", Mock(side_effect=KeyboardInterrupt))
    found = at_the_robot.attended(Mock(begun=True, stop=stop), Mock(), Mock())
    assert found == (Ending(error=stop) if isinstance(stop, StoppedError) else Ending(interrupted=True))
    with pytest.raises(KeyboardInterrupt):
        at_the_robot.attended(Mock(begun=False), Mock(), Mock())


@pytest.mark.parametrize(
    ("report", "line"),
    [
        (LATE, "error: trip plan_lost: no plan for 92 ms; the robot sits down, then its motors are damped"),
        (HOT, "error: trip temperature: FR_hip_joint is 76 deg C hot; motors are damped"),
        (KEY, "stopped by the operator: key; motors are damped"),
        (SenderReport(Phase.DAMP, "remote", "L2+B"), "stopped by the operator: L2+B; motors are damped"),
        (SenderReport(Phase.RUN), None),
    ],
)
def test_what_stopped_a_robot_is_said_before_it_is_let_down(capsys, report, line) -> None:
    before: list[str] = []
    target = MagicMock(report=report, stop=report.stop if report.trip else None)
    target.check.return_value = {}
    target.__exit__ = Mock(side_effect=lambda *_: before.append(capsys.readouterr().err), return_value=None)
    with at_the_robot.ready(target, Session()):
        pass
    assert before == ["" if line is None else f"amhe: {line}\n"]


@pytest.mark.slow
@pytest.mark.usefixtures("hangs_up")
def test_at_a_terminal_enter_arms_and_one_that_is_closed_damps_and_keeps_what_there_is() -> None:
    port = str(free_port())
    keys, terminal = os.openpty()
    with (
        emulating("--set", f"go1.slow={SLOW}", "--mocap", "udp", "--mocap-port", port) as emulated,
        os.fdopen(keys, "r+b", 0) as screen,
    ):
        eyes = ["--pose", "udp", "--pose-host", "127.0.0.1", "--pose-port", port]
        where = ["--host", "127.0.0.1", "--port", str(emulated.port), *eyes, "--set", f"go1.slow={SLOW}"]
        command = [sys.executable, "-c", _FOREGROUND, "-m", "amhe_cli", *ROBOT, *where, *QUICK, "-o", "out"]
        command.remove("-q")
        with subprocess.Popen(
            command, env=os.environ | {"PYTHONPATH": str(ROOT)}, stdin=terminal, stdout=terminal,
            stderr=terminal, start_new_session=True,
        ) as process:  # fmt: skip
            os.close(terminal)
            shown = b""
            while b". Enter, or R2" not in shown:
                shown += screen.read(1024)
            screen.write(b"\n")
            while b"m from the goal" not in shown:
                shown += screen.read(1024)
            screen.close()  # the kernel sends SIGHUP
            process.wait(60)
    assert process.returncode == 143
    record = json.loads(Path("out/result.json").read_text())
    assert (record["interrupted"], record["link"]["trip"]) == (True, "order")
    assert not survey(Path("out/log.mcap")).problems


_FOREGROUND = """
import fcntl, os, sys, termios
fcntl.ioctl(0, termios.TIOCSCTTY, 0)
os.execv(sys.executable, [sys.executable, *sys.argv[1:]])
"""


def test_keys_that_mean_something_to_a_terminal_come_as_keys(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-Z, Ctrl-backslash, Ctrl-S, Ctrl-Q: whoever presses one of them wants the robot to stop."""
    keys, terminal = os.openpty()
    with os.fdopen(terminal) as stdin:
        monkeypatch.setattr(sys, "stdin", stdin)
        before = termios.tcgetattr(terminal)
        with at_the_robot._unseen_keys():
            for key in (b"\x1a", b"\x1c", b"\x13", b"\x11", b" "):
                os.write(keys, key)
                assert select.select([terminal], [], [], 10.0)[0], key
                assert os.read(terminal, 8) == key
            within = termios.tcgetattr(terminal)
            assert within[3] & termios.ISIG  # Ctrl-C still is a signal, also to a program that hangs
            assert within[6][termios.VINTR] == b"\x03"
        assert termios.tcgetattr(terminal) == before
    os.close(keys)


@pytest.mark.parametrize("mode", ["baseline", pytest.param("adaptive", marks=pytest.mark.slow)])
def test_a_robot_that_is_not_there_is_one_line_and_leaves_no_process(capfd, mode: str) -> None:
    with udp() as deaf:
        deaf.bind(("127.0.0.1", 0))
        port = str(deaf.getsockname()[1])
        where = ["--host", "127.0.0.1", "--port", port, "--pose", "udp", "--pose-port", port]
        arguments = [*ROBOT[:-1], mode, *where, "--set", "go1.connect_time=0.3", *QUICK]
        assert run(arguments) == 1
    assert multiprocessing.active_children() == []  # the estimator's, that is
    err = capfd.readouterr().err
    assert f"nothing answers from 127.0.0.1:{port}" in err
    assert len(err.splitlines()) == 1
    assert list(Path().glob("*/*/log.mcap")) == []


@pytest.mark.slow
def test_a_probe_is_planned_first_and_then_done_on_the_robot(capsys, monkeypatch) -> None:
    pytest.importorskip("natnet")
    monkeypatch.setattr("amhe_cli.robots.go1.probing.probe.MOTIONS", (STEADY,))
    few = ["--for", "2", *FEW]
    with emulating("--set", f"go1.slow={SLOW}") as emulated:
        probe = ["probe", *at(emulated)[1:], *few]
        for option in ("--mode", "baseline"):
            probe.remove(option)
        assert run([*probe, "--dry-run"]) == 0
        assert "nothing has moved" in capsys.readouterr().out
        assert list(Path().iterdir()) == []
        assert run([*probe, "-o", "out"]) == 0, capsys.readouterr().err
    record = json.loads(Path("out/result.json").read_text())
    assert (record["target"], record["error"], record["link"]["trip"]) == ("go1", None, "")
    assert record["link"]["packets"]["packets"] > 500
    metadata = read_metadata(Path("out/probe.mcap"))
    assert metadata["target"] == "go1"
    assert "truth" not in metadata
    log = survey(Path("out/probe.mcap"))
    assert not log.problems
    assert log.duration == pytest.approx(2.0, abs=0.3)


@pytest.mark.medium
def test_a_probe_without_its_robot_keeps_its_plan(capfd, monkeypatch) -> None:
    monkeypatch.setattr("amhe_cli.robots.go1.probing.probe.MOTIONS", (STEADY,))  # one rehearsal is enough
    with udp() as deaf:
        deaf.bind(("127.0.0.1", 0))
        port = str(deaf.getsockname()[1])
        where = ["--host", "127.0.0.1", "--port", port, "--pose", "udp", "--pose-port", port]
        few = ["--for", "2", *FEW, "-o", "out"]
        probe = ["probe", "--target", "go1", *where, *few, "--set", "go1.connect_time=0.3", *QUICK]
        assert run(probe) == 1
    err = capfd.readouterr().err
    assert f"nothing answers from 127.0.0.1:{port}" in err
    assert len(err.splitlines()) == 1
    assert sorted(path.name for path in Path("out").iterdir()) == ["plan.json", "result.json"]


#: Makes the datagrams that are passed on in place of a pose; called with the number of poses since it walks.
Forge = Callable[[int, dict[str, Any]], list[dict[str, Any]]]
#: A robot that has come so far ahead walks [m].
WALKS = 0.03
#: From this pose on it pushes the box.
_PUSHING = 200

#: What is said of poses that froze: by legs that move, or by cameras whose noise is gone.
FROZEN = "cameras and legs contradict each other|its cameras were never so still"


@contextmanager
def relay(to: int, forge: Forge) -> Iterator[int]:
    """Passes the poses of the emulated cameras on, and forges them once the robot walks; yields its port."""
    start, number = None, 0

    def pass_on() -> None:
        nonlocal start, number
        try:
            pose = json.loads(end.recv(2048))
        except TimeoutError:
            return
        if pose["body"] == "go1":
            start = pose["position"][0] if start is None else start
            number += pose["position"][0] - start > WALKS
        for one in forge(number, pose) if number else [pose]:
            end.sendto(json.dumps(one).encode(), ("127.0.0.1", to))

    with udp() as end:
        end.bind(("127.0.0.1", 0))
        end.settimeout(0.1)
        with repeating(0.0, pass_on):
            yield end.getsockname()[1]


def held(body: str, noise: float) -> Forge:
    """Shows a body where it was when it had begun to push; its times go on."""
    kept: list[dict[str, Any]] = []
    chance = random.Random(0)

    def forge(number: int, pose: dict[str, Any]) -> list[dict[str, Any]]:
        if number < _PUSHING or pose["body"] != body:
            return [pose]
        kept.append(kept[0] if kept else pose)
        place = [x + chance.gauss(0.0, noise) for x in kept[0]["position"]]
        return [kept[0] | {"time": pose["time"], "position": place}]

    return forge


def walked(tmp_path: Path, forge: Forge, seconds: float) -> tuple[int, str, dict[str, Any]]:
    """A run with forged poses: its exit code, what it printed, and its result.json."""
    port = free_port()
    with relay(port, forge) as cameras_port:
        cameras = ["--mocap", "udp", "--mocap-port", str(cameras_port)]
        with emulating("--set", f"go1.slow={SLOW}", *cameras) as emulated:
            eyes = ["--pose", "udp", "--pose-port", str(port)]
            where = ["--host", "127.0.0.1", "--port", str(emulated.port), *eyes, "--set", f"go1.slow={SLOW}"]
            more = ["--set", "go1.arm=auto", *QUICK, "--duration", str(seconds), "-o", str(tmp_path / "out")]
            ended = subprocess.run(
                [sys.executable, "-m", "amhe_cli", *ROBOT, *where, *more], check=False, timeout=120,
                stderr=subprocess.PIPE, text=True, env=os.environ | {"PYTHONPATH": str(ROOT)},
            )  # fmt: skip
    record = tmp_path / "out/result.json"
    assert record.exists(), ended.stderr
    return ended.returncode, ended.stderr, json.loads(record.read_text())


@pytest.mark.slow
def test_a_pose_that_freezes_damps_the_motors(tmp_path: Path) -> None:
    """It stays, but for 1 um of noise, and its times go on; other bodies and ways are in test_witness.py.

    Single ones before that cannot be true, or are not numbers, change nothing.
    """
    wrong = {5: {"position": [1e300, 0.0, 0.0]}, 20: {"time": 1e9}, 35: {"position": [float("nan")] * 3}}
    hold = held("go1", 1e-6)

    def forge(number: int, pose: dict[str, Any]) -> list[dict[str, Any]]:
        more = [pose | wrong.pop(number)] if pose["body"] == "box" and number in wrong else []
        return hold(number, pose) + more

    code, printed, record = walked(tmp_path, forge, 8.0)
    assert not wrong
    assert (code, record["link"]["trip"], record["link"]["dropped_poses"]) == (1, "pose_false", 2), printed
    assert record["diverged"] == 0
    assert re.search(FROZEN, printed), printed
    log = read_log(tmp_path / "out/log.mcap", System.load("go1_push"))
    seen = log.series["trunk.position"]
    ahead = seen.values[seen.valid, 0]
    stays = log.dt * (np.abs(ahead - ahead[-1]) < 1e-3).sum()
    assert 0.05 < stays < 0.5
