"""Reading a log, against rosbags: 100 k JointState (12 joints) and 100 k Odometry in a zstd MCAP.

    python benchmarks/read_log.py [--messages N] [--repetitions R]

Prints one table of ratios: each repetition runs both readers one after the other, so that a busy machine
slows both; the median of the ratios counts.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from rosbags.highlevel import AnyReader

from amhe_cli.core.settings import LogSettings
from amhe_cli.core.signals import Signal
from amhe_cli.logs import LogWriter, read_signals, survey

DT = 0.002
SIGNALS = (
    Signal("joints", "/joint_states", ("position", "velocity", "effort")),
    Signal("base", "/odom", ("position", "orientation", "linear_velocity", "angular_velocity")),
)


def write(path: Path, count: int) -> None:
    """A log of `count` messages on each of two topics."""
    rng = np.random.default_rng(0)
    names = [f"joint_{i}" for i in range(12)]
    joints = rng.normal(size=(64, 3, 12))
    with LogWriter(path, {}) as log:
        for i in range(count):
            stamp = 10**18 + round(i * DT * 1e9)
            turn = i * DT
            log.joint_state("/joint_states", stamp, names, *joints[i % 64])
            quaternion = (np.cos(turn / 2), 0.0, 0.0, np.sin(turn / 2))
            position, velocity = joints[i % 64, 0, :3], joints[i % 64, 1, :3]
            log.odometry("/odom", stamp, position, quaternion, velocity)


def with_rosbags(path: Path) -> None:
    """Deserialise every message, keep nothing: less work than a trajectory."""
    with AnyReader([path]) as reader:
        for connection, _, raw in reader.messages():
            reader.deserialize(raw, connection.msgtype)


def seconds(work: Callable[[Path], object], path: Path) -> float:
    start = time.perf_counter()
    work(path)
    return time.perf_counter() - start


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--messages", type=int, default=100_000, help="messages on each topic")
    parser.add_argument("--repetitions", type=int, default=5)
    options = parser.parse_args()
    tasks: dict[str, Callable[[Path], object]] = {
        "read_signals": lambda path: read_signals(path, SIGNALS, DT, LogSettings()),
        "survey": survey,
    }
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.mcap"
        write(path, options.messages)
        print(f"{2 * options.messages} messages, {path.stat().st_size / 1e6:.1f} MB, zstd")
        print(
            f"{'':16} {'ours [s]':>9} {'rosbags [s]':>12} {'times faster':>13} {'lowest':>7} {'highest':>8}"
        )
        for name, task in tasks.items():
            pairs = [(seconds(task, path), seconds(with_rosbags, path)) for _ in range(options.repetitions)]
            ours, theirs = np.median(pairs, axis=0)
            ratios = [b / a for a, b in pairs]
            print(
                f"{name:16} {ours:9.2f} {theirs:12.2f} {np.median(ratios):13.1f}"
                f" {min(ratios):7.1f} {max(ratios):8.1f}"
            )


if __name__ == "__main__":
    main()
