"""An emulator in a process of its own, on ports that are free."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[4]


@dataclass
class Emulated:
    """Where to find it."""

    port: int
    mocap_port: int
    process: subprocess.Popen[str]
    stderr: str = ""


@contextmanager
def emulating(*arguments: str) -> Iterator[Emulated]:
    """Run `amhe emulate` until the end of the block; its stderr is in `stderr` then."""
    command = [sys.executable, "-m", "amhe_cli", "emulate", "--port", "0"]
    if "--mocap-port" not in arguments:
        command += ["--mocap-port", "0"]
    with subprocess.Popen(
        [*command, *arguments], stderr=subprocess.PIPE, text=True, env=os.environ | {"PYTHONPATH": str(ROOT)}
    ) as process:
        assert process.stderr is not None
        try:
            first = process.stderr.readline()
            ports = [int(port) for port in re.findall(r"127\.0\.0\.1:(\d+)", first)]
            assert ports, first
            emulated = Emulated(ports[0], ports[-1], process)
            yield emulated
            process.send_signal(signal.SIGINT)
            emulated.stderr = process.stderr.read()
            process.wait(10)
        finally:
            process.kill()
