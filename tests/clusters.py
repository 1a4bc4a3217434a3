"""Executors to test with: a cluster on this machine, and work to send to it."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from pathlib import Path


class Cluster:
    """A real scheduler and workers of this machine, each a process of its own.

    Args:
        folder: Folder of its log.
        options: Options of all of its processes, such as those of TLS.
    """

    def __init__(self, folder: Path, options: tuple[str, ...] = (), protocol: str = "tcp") -> None:
        self._folder, self._options = folder, options
        self._processes: list[subprocess.Popen[bytes]] = []
        ready = folder / "scheduler.json"
        self._start(
            "scheduler",
            "--protocol",
            protocol,
            "--port",
            "0",
            "--no-dashboard",
            "--scheduler-file",
            str(ready),
            "--host",
            "127.0.0.1",
        )
        deadline = time.monotonic() + 60.0
        found = None
        while not found and time.monotonic() < deadline:  # the file is there before its text is
            time.sleep(0.1)
            found = ready.exists() and re.search(r'"address": "([^"]+)"', ready.read_text())
        assert found, "the scheduler gave no address"
        self.address = found[1]

    def worker(self) -> subprocess.Popen[bytes]:
        options = ("--nthreads", "1", "--no-dashboard", "--no-nanny", "--host", "127.0.0.1")
        return self._start("worker", self.address, *options)

    def __enter__(self) -> Cluster:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        for process in self._processes:
            process.kill()
            process.wait()

    def _start(self, what: str, *options: str) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "distributed.cli.dask_" + what, *options, *self._options]
        root = str(Path(__file__).parents[1])
        log = (self._folder / "log.txt").open("ab")
        process = subprocess.Popen(
            command, cwd=self._folder, env=os.environ | {"PYTHONPATH": root}, stdout=log, stderr=log
        )
        self._processes.append(process)
        return process


def square(number: int) -> int:
    return number * number


def reciprocal(number: int) -> float:
    return 1.0 / number


def forgetful(place: str) -> str:
    """Die the first time, as a worker does that is killed; live the second."""
    if not Path(place).exists():
        Path(place).touch()
        os._exit(9)
    return "alive"


def deadly(number: int) -> int:
    if number == 0:
        time.sleep(0.5)  # long enough to be seen running
        os._exit(9)
    return number


def slow(seconds: float) -> float:
    time.sleep(seconds)
    return seconds


def process_id_after(request: tuple[str, float]) -> int:
    """Write down the process that does it, then take so long [s]."""
    place, seconds = request
    with Path(place).open("a", encoding="utf-8") as file:
        file.write(f"{os.getpid()}\n")
    time.sleep(seconds)
    return os.getpid()
