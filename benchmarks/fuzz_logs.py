"""Mutated logs of every format: each must be read, or refused in one line, in bounded memory and time.

    PYTHONPATH=. python benchmarks/fuzz_logs.py [--cases N] [--seed S] [FORMAT ...]

A case is a small log with flipped bits, a cut, a piece moved or repeated, or a length that lies. It is
inspected for a system and so read twice, in a process of its own with 4 GiB of address space and 60 s.
"""

from __future__ import annotations

import argparse
import logging
import os
import re
import resource
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
from mcap.writer import CompressionType

from amhe_cli.core.errors import AmheError
from amhe_cli.logs import inspect_log
from tests.logs.log_makers import ROS1, ROS2, write_bag, write_mcap
from tests.logs.test_every_format import FORMATS, SYSTEM, TABLE, messages
from tests.logs.test_hostile_logs import STAMP, write_records
from tests.logs.test_tables import dataset


def _arrays(path: Path) -> Path:
    """A CSV with arrays in quotes."""
    rows = [
        f'{time:.3f},"[{", ".join(map(repr, numbers))}]"'
        for time, *numbers in zip(*TABLE.values(), strict=True)
    ]
    path.write_text("\n".join(["time,q", *rows]) + "\n")
    return path


def _groups(path: Path) -> Path:
    """An HDF5 file of groups in groups, each with a table."""
    with h5py.File(path, "w") as file:
        for depth in range(1, 20):
            for name, values in TABLE.items():
                file["/".join(["g"] * depth) + f"/{name}"] = values[:50]
    return path


MAKERS: dict[str, Callable[[Path], Path]] = {
    **FORMATS,
    "mcap, lz4": lambda folder: write_mcap(
        folder / "log.mcap", messages(ROS2), compression=CompressionType.LZ4
    ),
    "mcap, no chunks": lambda folder: write_mcap(folder / "log.mcap", messages(ROS2), use_chunking=False),
    "bag, lz4": lambda folder: write_bag(folder / "log.bag", messages(ROS1), "lz4"),
    "csv, arrays": lambda folder: _arrays(folder / "log.csv"),
    "hdf5, groups": lambda folder: _groups(folder / "log.h5"),
    "ulog, nested": lambda folder: write_records(
        folder / "log.ulg", "l0:l1 a;", "l1:double x;", f"{STAMP}l0 x;", topics=3
    ),
    "lerobot 2": lambda folder: dataset(folder, "v2.1"),
    "lerobot 3": lambda folder: dataset(folder, "v3.0"),
}
MEMORY, SECONDS = 4 * 2**30, 60
READ, REFUSED, TRACEBACK = 0, 1, 2


def mutated(content: bytes, rng: np.random.Generator) -> bytes:
    """The content with one to four faults."""
    data = bytearray(content)
    for _ in range(int(rng.integers(1, 5)) if content else 0):
        at, other = (int(place) for place in rng.integers(0, max(len(data) - 8, 1), 2))
        size = int(rng.integers(1, 200))
        fault = int(rng.integers(6))
        if fault == 0:
            data[at] ^= 1 << int(rng.integers(8))
        elif fault == 1:
            data[at : at + 4] = int(rng.choice([0, 2**31 - 1, 2**32 - 1, 2**16, 2**24])).to_bytes(4, "little")
        elif fault == 2:
            data[at : at + size] = rng.bytes(size)
        elif fault == 3:
            data[at:at] = data[other : other + size]
        elif fault == 4:
            del data[at + 1 : at + size]
        elif rng.random() < 0.3:
            del data[at + 1 :]
    return bytes(data)


def guarded(read: Callable[[], object]) -> int:
    """Read something hostile; runs in a process of its own."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    signal.alarm(SECONDS)
    try:
        read()
    except AmheError as error:
        return REFUSED if "\n" not in re.sub(r"\n\S*:\d+:\d+: ", " ", str(error)) else TRACEBACK
    except BaseException:
        traceback.print_exc()
        return TRACEBACK
    return READ


def forked(task: Callable[[], int]) -> tuple[int, float, float]:
    """Exit code (negative: killed by that signal), peak memory [MiB] and time [s] of a task in a fork."""
    begun = time.monotonic()
    child = os.fork()
    if not child:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        code = TRACEBACK
        try:
            code = task()
        finally:
            os._exit(code)
    _, status, usage = os.wait4(child, 0)
    return os.waitstatus_to_exitcode(status), usage.ru_maxrss / 1024, time.monotonic() - begun


#: Head of the table.
HEAD = """| kind | cases | read | refused | tracebacks | killed | peak [MiB] | longest [s] |
|---|---:|---:|---:|---:|---:|---:|---:|"""


def row(name: str, cases: int, case: Callable[[], Callable[[], object]]) -> None:
    """Print the row of one kind: `case` makes a hostile file, and says how it is read."""
    found, peak, longest = Counter[int](), 0.0, 0.0
    for number in range(cases):
        read = case()
        code, memory, seconds = forked(lambda read=read: guarded(read))
        if code not in (READ, REFUSED):
            print(f"{name}, case {number}: ended with {code}", file=sys.stderr)
        found[min(max(code, -1), 2)] += 1
        peak, longest = max(peak, memory), max(longest, seconds)
    counts = [found[kind] for kind in (READ, REFUSED, TRACEBACK, -1)]
    print(
        "| " + " | ".join(map(str, [name, sum(counts), *counts, round(peak), round(longest, 1)])) + " |",
        flush=True,
    )


def main() -> None:
    """Print a row for each format."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("formats", nargs="*", default=list(MAKERS), metavar="FORMAT")
    parser.add_argument("--cases", type=int, default=3000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    logging.disable(logging.WARNING)
    print(HEAD, flush=True)
    for number, (name, maker) in enumerate(MAKERS.items()):
        if name not in options.formats:
            continue
        rng = np.random.default_rng((options.seed, number))
        with tempfile.TemporaryDirectory() as folder:
            forked(lambda maker=maker, folder=folder: bool(not maker(Path(folder))))
            path = next(Path(folder).iterdir())
            path = Path(f"{path}#0") if (path / "meta").is_dir() else path
            files = sorted(file for file in Path(folder).rglob("*") if file.is_file())
            originals = [file.read_bytes() for file in files]

            def case(path=path, files=files, originals=originals, rng=rng) -> Callable[[], object]:
                for file, content in zip(files, originals, strict=True):
                    file.write_bytes(content)
                chosen = int(rng.integers(len(files)))
                files[chosen].write_bytes(mutated(originals[chosen], rng))
                return lambda: inspect_log(path, SYSTEM)

            row(name, options.cases // len(MAKERS), case)


if __name__ == "__main__":
    main()
