"""How long `amhe view` takes for an hour of a Go1's log: joints at 500 Hz, poses at 100, commands at 50.

    python benchmarks/view_hour.py --log hour.mcap [--joints 100]

The log is `example:t4` again and again, with noise on the joints: 2.7 million messages, 1.3 with joints
at 100 Hz. It is made if it does not exist, and viewed into a page as often as --rounds says.
"""

from __future__ import annotations

import argparse
import resource
import struct
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from mcap.reader import make_reader
from mcap.writer import Writer

import amhe_cli as amhe
from amhe_cli.core.log import sampled
from amhe_cli.logs import LogWriter, read_metadata
from amhe_cli.logs.messages.writer import write_samples

SOURCE = Path(__file__).parents[1] / "examples" / "logs" / "t4.mcap"
HOUR_NS, NOISE = 3600 * 10**9, 1e-3


def make_part(path: Path, step: float) -> int:
    """Write the messages that the hour repeats, joints at a step [s]; return their time [ns]."""
    system, rng = amhe.System.load("go1_push"), np.random.default_rng(0)
    log = amhe.read_log(SOURCE, system)
    times, samples = np.arange(0.0, log.duration + 0.5 * step, step), dict(sampled(log))
    for key in ("joints.position", "joints.velocity"):
        values = log[key].values[(times / log.dt).astype(int)]
        samples[key] = times, values + rng.normal(0.0, NOISE, values.shape)
    with LogWriter(path, {}) as file:
        write_samples(file, system.signals, samples, lambda time: round(1e9 * (1.0 + time)))
    return round(1e9 * step * times.size)


def make(path: Path, step: float) -> None:
    """Write the log, joints at a step [s]."""
    with TemporaryDirectory() as folder, path.open("wb") as file:
        span = make_part(part := Path(folder) / "part.mcap", step)
        with part.open("rb") as source:
            messages = list(make_reader(source).iter_messages())
        writer, numbers = Writer(file), dict[str, int]()
        writer.start()
        writer.add_metadata("amhe", {"system": read_metadata(SOURCE)["system"]})
        for later in range(0, HOUR_NS, span):
            for schema, channel, message in messages:
                if channel.topic not in numbers and schema:
                    about = writer.register_schema(schema.name, schema.encoding, schema.data)
                    numbers[channel.topic] = writer.register_channel(channel.topic, "cdr", about)
                stamp, data = message.log_time + later, bytearray(message.data)
                struct.pack_into("<iI", data, 4, *divmod(stamp, 10**9))  # of the header
                writer.add_message(numbers[channel.topic], stamp, bytes(data), stamp)
        writer.finish()


def main() -> None:
    """Make the log, and time the command."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--log", type=Path, required=True, help="the log; made where it does not exist")
    parser.add_argument("--joints", type=float, default=500.0, help="rate of the joints [Hz]")
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_args()
    if not options.log.exists():
        make(options.log, 1.0 / options.joints)
    options.log.read_bytes()  # what a disk needs is not measured
    with TemporaryDirectory() as folder:
        page = Path(folder) / "page.html"
        for _ in range(options.rounds):
            page.unlink(missing_ok=True)
            start = time.perf_counter()
            subprocess.run(
                [sys.executable, "-m", "amhe_cli", "view", options.log, "--out", page, "-q"], check=True
            )
            print(f"{time.perf_counter() - start:.1f} s, page {page.stat().st_size / 1e6:.1f} MB", flush=True)
    print(f"memory {resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1e6:.2f} GB")


if __name__ == "__main__":
    main()
