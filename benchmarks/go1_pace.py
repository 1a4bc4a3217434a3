"""Tasks against the clock on an emulated Go1: is a run stopped, and with how many rollouts does it plan?

    python benchmarks/go1_pace.py                        T1, T3, T4 and hw1, five runs each; ten minutes
    python benchmarks/go1_pace.py --runs 1 --mode baseline t1

The load of the computer decides: nothing else should run. Exit code 1 where a run was stopped.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

AMHE = [sys.executable, "-m", "amhe_cli"]
#: Only standing up is in a hurry.
QUICK = ["go1.arm=auto", "go1.gain_time=0.5", "go1.stand_speed=2"]
COLUMNS = (
    "task",
    "stopped by",
    "success",
    "done in s",
    "cycle ms, 99 %",
    "rollouts (least)",
    "late",
    "updates",
    "load",
)


def main() -> None:
    """Run, and print a row for each run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("tasks", nargs="*", default=["t1", "t3", "t4", "hw1"])
    parser.add_argument("--runs", type=int, default=5, help="of each task")
    parser.add_argument("--mode", default="adaptive")
    given = parser.parse_args()
    table, stopped = Table(*COLUMNS), 0
    for task in given.tasks:
        for seed in range(given.runs):
            load = os.getloadavg()[0]
            record = run(task, given.mode, seed)
            stopped += record["error"] is not None
            table.add_row(task, *described(record), f"{load:.1f}")
    Console(width=130).print(table)
    sys.exit(bool(stopped))


def run(task: str, mode: str, seed: int) -> dict[str, Any]:
    """One run on an emulator of its own; the content of its result.json."""
    emulate = [*AMHE, "emulate", "--task", task, "--port", "0", "--mocap-port", "0", "--seed", str(seed)]
    with (
        tempfile.TemporaryDirectory() as scratch,
        subprocess.Popen(emulate, stderr=subprocess.PIPE, text=True) as emulator,
    ):
        assert emulator.stderr is not None
        port, mocap_port = re.findall(r"127\.0\.0\.1:(\d+)", emulator.stderr.readline())
        out = Path(scratch) / "out"
        where = ["--host", "127.0.0.1", "--port", port, "--pose-host", "127.0.0.1", "--pose-port", mocap_port]
        settings = [word for setting in QUICK for word in ("--set", setting)]
        command = [*AMHE, "run", "--task", task, "--target", "go1", "--mode", mode, "--seed", str(seed)]
        ended = subprocess.run(
            [*command, *where, *settings, "-q", "-o", str(out)], capture_output=True, text=True, check=False
        )
        emulator.terminate()
        if not (out / "result.json").is_file():  # refused before the robot stood
            return {"cycles": 0, "error": ended.stderr.strip().rpartition("error: ")[2]}
        return json.loads((out / "result.json").read_text())


def described(record: dict[str, Any]) -> tuple[str, ...]:
    """The numbers of a run in words."""
    if not record["cycles"]:  # it was stopped before its first plan
        return (str(record["error"]), "no", "-", "-", "-", "-", "-")
    ms, estimator = record["cycle_ms"], record["estimator"] or {"updates": 0}
    mean = record["rollouts"] / max(1, record["cycles"])
    return (
        record["error"] or "-", "yes" if record["success"] else "no", f"{record['time_s']:.1f}",
        f"{ms['p50']:.0f}, {ms['p99']:.0f}", f"{mean:.1f} ({record['least_rollouts']})",
        f"{record['deadline_misses']} of {record['cycles'] + record['deadline_misses']}",
        str(estimator["updates"]),
    )  # fmt: skip


if __name__ == "__main__":
    main()
