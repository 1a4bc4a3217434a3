"""Where the seconds of one command go: when its stages and its calls of an engine began, and what each took.

    python benchmarks/timeline.py identify examples/logs/t1.mcap --engine auto -o amhe-out/demo --force

The clock begins with the process. A line stands behind its end: what began within it stands above it, further
to the right. Calls of an engine show their rollouts, and the steps of the longest. Shorter ones are summed.
The last line has the steps of all predictions.
TIMELINE_PROFILE=GpuEngine.predict shows, of each call by that name, where its time goes.
"""

from __future__ import annotations

import cProfile
import functools
import importlib
import os
import pstats
import sys
import threading
import time
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np

#: What is timed, by module and name.
STAGES = (
    ("amhe_cli.logs", "read_log"),
    ("amhe_cli.estimation.identification", "searched_for"),
    ("amhe_cli.estimation.identification", "_warn"),
    ("amhe_cli.estimation.identification", "concluded"),
    ("amhe_cli.api.identify", "Result.write"),
    ("amhe_cli.engine.open", "_gpu_engine"),
    ("amhe_cli.engine.gpu.engine", "GpuEngine.load"),
    ("amhe_cli.engine.gpu.engine", "GpuEngine.predict"),
    ("amhe_cli.engine.gpu.engine", "GpuEngine.rollout"),
    ("amhe_cli.engine.cpu", "CpuEngine.predict"),
)
#: Shorter ones have no line [s].
SHORT = 0.1


def since_start() -> float:
    """Seconds since this process began (Linux)."""
    ticks = int(Path("/proc/self/stat").read_text().rpartition(")")[2].split()[19])
    return time.clock_gettime(time.CLOCK_BOOTTIME) - ticks / 100.0


def shape(name: str, arguments: tuple[Any, ...]) -> str:
    """Rollouts of a call of an engine, and steps of the longest; of others nothing."""
    if name.endswith(".predict"):
        lengths = arguments[2].lengths
        return f"{len(arguments[1])} x {len(lengths)} rollouts, {int(lengths.max())} steps"
    lengths = arguments[5] if name.endswith(".rollout") else np.empty(0)
    return f"{len(lengths)} rollouts, {int(lengths.max())} steps" if len(lengths) else ""


def main() -> None:
    first, clock = since_start(), time.perf_counter()
    depth, sums, steps = threading.local(), dict[str, list[float]](), list[int]()

    def now() -> float:
        return first + time.perf_counter() - clock

    def timed(call: Callable[..., Any], name: str) -> Callable[..., Any]:
        @functools.wraps(call)
        def wrapper(*arguments: Any, **named: Any) -> Any:
            level = depth.__dict__.setdefault("level", 0)
            depth.level, began, cpu = level + 1, now(), time.process_time()
            if name.endswith(".predict"):
                steps.append(len(arguments[1]) * int(arguments[2].lengths.sum()))
            profile = cProfile.Profile() if os.environ.get("TIMELINE_PROFILE") == name else nullcontext()
            try:
                with profile:
                    return call(*arguments, **named)
            finally:
                depth.level, taken = level, now() - began
                sums.setdefault(name, []).append(taken)
                if taken >= SHORT:
                    apart = "" if threading.current_thread() is threading.main_thread() else " (thread)"
                    print(
                        f"{began:7.2f} s +{taken:6.2f} s, {time.process_time() - cpu:6.2f} CPU s "
                        f"{level * '  '}{name}{apart} {shape(name, arguments)}", file=sys.stderr,
                    )  # fmt: skip
                    if isinstance(profile, cProfile.Profile):
                        pstats.Stats(profile, stream=sys.stderr).sort_stats("cumtime").print_stats(45)

        return wrapper

    for module, name in STAGES:
        owner = importlib.import_module(module)
        *inside, last = name.split(".")
        for part in inside:
            owner = getattr(owner, part)
        setattr(owner, last, timed(getattr(owner, last), name))
    from amhe_cli.cli.main import run

    print(f"{now():7.2f} s loaded", file=sys.stderr)
    code = run(sys.argv[1:])
    print(f"{now():7.2f} s the command ended with {code}", file=sys.stderr)
    for name, each in sums.items():
        print(f"{sum(each):7.2f} s in {len(each)} of {name}", file=sys.stderr)
    print(f"{sum(steps):,} steps", file=sys.stderr)


if __name__ == "__main__":
    main()
