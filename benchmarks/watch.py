"""`amhe watch` beside simulated arms that publish on loopback: jumps, errors, delays, false alarms.

Each arm (`examples/ros2_arm.py`) and each watch is a process of its own, on a domain of its own. All numbers
are those of somebody who listens to the topics that the watch publishes. A payload is put on half of the
arms; the others never change.

    python benchmarks/watch.py --arms 4 --seconds 120 [--transport zenoh]
"""

from __future__ import annotations

import argparse
import json
import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from rosbags.typesys import Stores, get_typestore

from amhe_cli.logs.live.messages import Transport
from amhe_cli.logs.live.ros import Dds, Zenoh
from amhe_cli.logs.messages.definitions import Definitions

PROJECT = Path(__file__).resolve().parent.parent
PAYLOAD, BEFORE, AFTER = 0.8, 0.4, 1.2  # what is put on, and the load before and after it [kg]
FIRST_DOMAIN = 100
#: A watch has found the mass after so long; jumps until so long after the payload are of it [s].
SETTLED = TOLD = 5.0


@dataclass
class Heard:
    """What a watch published.

    Args:
        rows: Topic -> stamp, delay until it was heard [s], load mass and its sd [kg], of each message.
        memory: Resident memory of the watch, ten times [MiB].
        load: CPU time of the watch over the time that it was listened to.
    """

    rows: dict[str, list[tuple[float, float, float, float]]] = field(
        default_factory=lambda: defaultdict(list)
    )
    memory: list[float] = field(default_factory=list)
    load: float = 0.0


def watched(number: int, seconds: float, at: float, endpoint: str) -> tuple[Heard, float]:
    """Run an arm and its watch; what was heard, and when the payload was put on, infinite if it was not."""
    domain, python = str(FIRST_DOMAIN + number), [sys.executable, "-u"]
    env = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join((str(PROJECT), *sys.path))}
    arm = [*python, str(PROJECT / "examples" / "ros2_arm.py"), "--domain", domain, "--seed", str(number)]
    arm += ["--seconds", str(seconds + 60.0), "--at", str(at), "--payload", str(PAYLOAD)]
    watch = [*python, "-m", "amhe_cli", "watch", "--system", "pendulum", "--source", "ros2", "-q"]
    watch += ["--domain", domain, "--set", "live.interface=127.0.0.1"]
    if endpoint:
        arm += ["--transport", "zenoh", "--connect", endpoint]
        watch[watch.index("ros2")] = "zenoh"
        watch += ["--connect", endpoint]
    with (
        tempfile.TemporaryDirectory() as folder,
        subprocess.Popen(arm, stdout=subprocess.PIPE, text=True, env=env) as robot,
        subprocess.Popen([*watch, "-o", f"{folder}/out"], env=env, stdout=subprocess.DEVNULL) as process,
    ):
        heard = listened(int(domain), process.pid, seconds, endpoint)
        process.send_signal(signal.SIGTERM)
        process.wait(60.0)
        robot.terminate()
        said = re.search(r"put on at ([\d.]+)", robot.stdout.read() if robot.stdout else "")
    return heard, float(said[1]) if said else np.inf


def listened(domain: int, pid: int, seconds: float, endpoint: str) -> Heard:
    """Listen to the watch of a process for so long."""
    store, heard = get_typestore(Stores.LATEST), Heard()
    topics = {"/amhe/params", "/amhe/jump"}
    if endpoint:
        transport: Transport = Zenoh(topics, Definitions(), domain, endpoint)
    else:
        transport = Dds(topics, Definitions(), domain, "127.0.0.1")
    begun = time.monotonic()
    spent = 0.0
    while (passed := time.monotonic() - begun) < seconds:
        for batch in transport.receive():
            for start, length in zip(batch.starts, batch.lengths, strict=True):
                cdr = batch.buffer[start : start + length].tobytes()
                message = store.deserialize_cdr(cdr, batch.connection.type)
                stamp = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
                row = stamp, time.time() - stamp, float(message.position[0]), float(message.effort[0])
                heard.rows[batch.connection.topic].append(row)
        if len(heard.memory) < 10.0 * passed / seconds:
            family = [pid, *children(pid)]
            heard.memory.append(sum(resident(one) for one in family))
            spent = sum(cpu_seconds(one) for one in family)
        time.sleep(0.005)
    transport.close()
    heard.load = spent / seconds
    return heard


def free_endpoint() -> str:
    """Where a router of Zenoh can listen."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{free.getsockname()[1]}"


@contextmanager
def router(where: str) -> Iterator[None]:
    """A router of Zenoh at an endpoint."""
    import zenoh

    config = zenoh.Config()
    chosen = {"mode": "router", "listen/endpoints": [where], "scouting/multicast/enabled": False}
    for key, value in chosen.items():
        config.insert_json5(key, json.dumps(value))
    with zenoh.open(config):
        yield


def children(pid: int) -> list[int]:
    found = [int(text) for text in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    return found + [each for child in found for each in children(child)]


def resident(pid: int) -> float:
    found = re.search(r"VmRSS:\s+(\d+)", Path(f"/proc/{pid}/status").read_text())
    return int(found[1]) / 1024.0 if found else 0.0


def cpu_seconds(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def judged(heard: Heard, put_on: float) -> dict[str, float]:
    """One row of the table."""
    stamp, delay, mass, sd = np.array(heard.rows["/amhe/params"]).T
    jumps = np.array([row[:2] for row in heard.rows["/amhe/jump"]]).reshape(-1, 2)
    own = (jumps[:, 0] >= put_on) & (jumps[:, 0] < put_on + TOLD)
    before, after = (stamp > stamp[0] + SETTLED) & (stamp < put_on), stamp > put_on + TOLD
    truth = np.where(stamp < put_on, BEFORE, AFTER)
    holds = np.abs(np.log(mass / truth)) < 1.645 * sd / mass  # the mass has a log scale
    found = {"minutes": (stamp[-1] - stamp[0]) / 60.0, "false alarms": float(np.sum(~own))}
    found |= {"held before, %": 100.0 * holds[before].mean()}
    if after.any():
        found |= {"told after, s": float(jumps[own].sum(axis=1).min() - put_on) if own.any() else np.inf}
        found |= {
            "error, %": 100.0 * abs(mass[after][0] / AFTER - 1.0),
            "held after, %": 100.0 * holds[after].mean(),
        }
    found |= {"delay p50, s": float(np.median(delay)), "p99, s": float(np.quantile(delay, 0.99))}
    return found | {"MiB at first": heard.memory[2], "at the end": heard.memory[-1], "cores": heard.load}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--arms", type=int, default=4)
    parser.add_argument("--seconds", type=float, default=120.0)
    parser.add_argument("--transport", choices=("dds", "zenoh"), default="dds")
    chosen = parser.parse_args()
    ends = [chosen.seconds / 2.0 if number % 2 else 1e9 for number in range(chosen.arms)]
    endpoint = free_endpoint() if chosen.transport == "zenoh" else ""
    with ThreadPoolExecutor(chosen.arms) as pool, router(endpoint) if endpoint else nullcontext():
        seconds, where = ([one] * chosen.arms for one in (chosen.seconds, endpoint))
        found = list(pool.map(watched, range(chosen.arms), seconds, ends, where))
    table = [judged(*one) for one in found]
    for row in table:
        print(", ".join(f"{name} {value:.3g}" for name, value in row.items()))
    minutes, alarms = (sum(row[name] for row in table) for name in ("minutes", "false alarms"))
    print(f"{minutes:.1f} minutes, {alarms:.0f} false alarms")


if __name__ == "__main__":
    main()
