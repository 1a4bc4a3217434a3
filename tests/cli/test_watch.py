"""`amhe watch` and `amhe record` from the outside: files, streams, what a jump runs, how they end."""

import csv
import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from urllib.request import urlopen

import pytest

from amhe_cli.cli.command import from_ros
from amhe_cli.cli.main import run
from amhe_cli.core.belief import Belief
from amhe_cli.logs import read_log, survey
from amhe_cli.system.system import System
from tests.cli.conftest import names

pytestmark = pytest.mark.flaky(reruns=2)


def rows(out: str) -> list[dict[str, str]]:
    with (Path(out) / "estimates.csv").open() as file:
        return list(csv.DictReader(file))


@pytest.mark.slow
def test_a_payload_is_a_jump_an_alarm_and_a_command(jumping: Path, tmp_path: Path, capsys) -> None:
    script = tmp_path / "on_jump.py"
    script.write_text(
        f"import os; open({str(tmp_path / 'ran')!r}, 'a').write(os.environ['AMHE_ESTIMATE'] + '\\n')"
    )
    command = f"{sys.executable} {script}"
    vendor = str(Path(__file__).parents[2] / "models" / "pendulum" / "scene.xml")  # says 0.4 kg
    given = ["--alarm", "load_mass>1.0", "--on-jump", command, "--against", vendor, "--json", "-q"]
    assert run(["watch", "--source", str(jumping), *given, "-o", "out"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result == json.loads(Path("out/result.json").read_text())
    mass = result["parameters"][0]
    claim = next(line for line in result["audit"]["numbers"] if line["of"] == "load")
    assert (claim["what"], claim["file"], claim["verdict"]) == ("mass", 0.4, "contradicted")
    assert claim["log"] == pytest.approx(mass["estimate"], rel=0.1)
    found = rows("out")
    assert any(row["mark"] == "jump" and float(row["time"]) > 4.0 for row in found)
    assert names("out") == ["belief.yaml", "estimates.csv", "estimates.mcap", "result.json"]
    topics = {topic.name: topic.count for topic in survey(Path("out/estimates.mcap")).topics}
    assert topics["/amhe/params"] == topics["/amhe/covariance"] == len(found)
    assert topics["/amhe/jump"] >= 1 and topics["/diagnostics"] >= 3
    ran = json.loads((tmp_path / "ran").read_text().splitlines()[0])
    assert ran["parameters"][0]["name"] == "load_mass" and ran["jumps"] == 1
    belief = Belief.load("out/belief.yaml", System.load("pendulum"))
    assert belief.estimate[0] == pytest.approx(mass["estimate"])


@pytest.mark.slow
def test_resume_goes_on_from_the_belief_and_adds_to_the_files(pendulum_log: Path) -> None:
    given = ["watch", "--source", str(pendulum_log), "--speed", "2", "-q", "-o", "out"]
    assert run(given) == 0
    first = rows("out")
    assert run(given) == 2, "a folder that is not empty"
    assert run([*given, "--resume"]) == 0
    both = rows("out")
    assert len(both) > len(first) and both[: len(first)] == first
    assert float(both[len(first)]["load_mass"]) == pytest.approx(float(first[-1]["load_mass"]), abs=0.15)
    assert "estimates-2.mcap" in names("out")


def serving(*arguments: str) -> subprocess.Popen[str]:
    here = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}
    command = [sys.executable, "-m", "amhe_cli", *arguments]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=here)


def free_port(kind: int = socket.SOCK_DGRAM) -> int:
    with socket.socket(socket.AF_INET, kind) as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


def sent(port: int, begun: float, seconds: float) -> None:
    """Lines of a pendulum that hangs still."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        end = time.time() + seconds
        while time.time() < end:
            stamp = time.time() - begun + 1.0
            for topic in ("/joint_states", "/joint_commands"):
                line = {
                    "topic": topic,
                    "stamp": stamp,
                    "name": ["hinge"],
                    "position": [0.0],
                    "velocity": [0.0],
                }
                out.sendto(json.dumps(line).encode(), ("127.0.0.1", port))
            time.sleep(0.01)


@pytest.mark.slow
def test_a_signal_ends_it_well() -> None:
    """Rubbish and a sensor that stops end nothing before; metrics are served meanwhile."""
    port, web = free_port(), free_port(socket.SOCK_STREAM)
    where = ["--system", "pendulum", "--source", f"udp://127.0.0.1:{port}"]
    process = serving("watch", *where, "--metrics", str(web), "-o", "out")
    assert process.stderr is not None
    assert "metrics are at" in process.stderr.readline()
    begun = time.time()
    deadline = begun + 150.0  # a busy machine takes long to start
    while time.time() < deadline:
        sent(port, begun, 0.3)
        text = urlopen(f"http://127.0.0.1:{web}/metrics").read().decode()
        if "amhe_windows_total{mark=" in text:
            break
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        out.sendto(b"rubbish", ("127.0.0.1", port))
    time.sleep(0.9)
    assert 'amhe_parameter_estimate{name="load_mass",unit="kg"} 0.' in text
    process.terminate()
    out, said = process.communicate(timeout=20)
    assert process.returncode == 0, said
    assert "lines that are no JSON object" in said and "'/joint_states' has stopped" in said
    assert "load_mass" in out and Path("out/belief.yaml").exists()
    assert not survey(Path("out/estimates.mcap")).problems


@pytest.mark.slow
def test_record_writes_a_log_that_is_read_for_the_system() -> None:
    port = free_port()
    where = ["--system", "pendulum", "--source", f"udp://127.0.0.1:{port}"]
    process = serving("record", *where, "-o", "run.mcap", "--json")
    begun = time.time()
    for _ in range(500):
        sent(port, begun, 0.25)
        if Path(".run.mcap").exists() or list(Path().glob(".run.mcap*")):
            break
    sent(port, begun, 1.0)
    process.send_signal(signal.SIGINT)
    out, said = process.communicate(timeout=20)
    assert process.returncode == 0, said
    counts = json.loads(out)["topics"]
    log = read_log("run.mcap", System.load("pendulum"))
    assert log.metadata["system"] == "pendulum"
    assert log.duration > 0.8 and counts["/joint_states"] >= 30


@pytest.mark.medium
@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["watch", "--source", "ros2"], "--system NAME|DIR"),
        (["watch", "--system", "pendulum", "--source", "mcap"], "--source mcap and --follow go together"),
        (["watch", "--system", "pendulum", "--source", "udp://x"], "names no port"),
        (["watch", "--system", "pendulum", "--source", "nothing"], "is no file; there is: ros2"),
        (["watch", "--system", "pendulum", "--source", "-", "--alarm", "mass>1"], "no parameter 'mass'"),
        (["record", "--source", "-"], "-o OUT.mcap"),
    ],
)
def test_mistakes_are_one_line(arguments: list[str], said: str, capsys) -> None:
    assert run(arguments) == 2
    text = capsys.readouterr().err
    assert said in text and text.count("\n") == 1


def test_arguments_of_ros_are_settings() -> None:
    ros = ["--ros-args", "-r", "/a:=/b", "--remap", "__ns:=/arm", "-p", "use_sim_time:=true", "--"]
    rules = ["--set", "live.remap=/a:=/b,__ns:=/arm", "--set", "live.sim_time=true"]
    assert from_ros(["watch", *ros, "-q"]) == ["watch", *rules, "-q"]
    assert from_ros(["watch", "--ros-args"]) == ["watch"]
