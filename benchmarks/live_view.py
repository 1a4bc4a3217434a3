"""What a live page costs the loop that it shows: time of a control cycle with a viewer over that without.

    python benchmarks/live_view.py --rounds 6

Runs of one seed alternate, without a viewer, with one that reads, and with one that hangs. Their
results are the same to the bit. Of each cycle the shortest time of all rounds counts, because other programs
on the machine only make it longer.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from collections import defaultdict
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from amhe_cli.cli.session import Session
from amhe_cli.cli.watching import watching_run
from amhe_cli.engine.cpu import hush_mujoco
from amhe_cli.live.recorder import drive
from amhe_cli.robots.go1.judge import History
from amhe_cli.robots.go1.run import RunOptions, open_run, recorder_of

#: A viewer: asks for the stream of an address, and reads it, or reads nothing of it.
VIEWER = """
import sys, time, urllib.request
with urllib.request.urlopen(sys.argv[1] + "stream") as stream:
    while sys.argv[2] == "reads" and stream.readline(): pass
    time.sleep(1000)
"""


class Quiet(Session):
    """Keeps the address of the page in place of printing it."""

    address = ""

    def say(self, kind: str, text: str) -> None:
        self.address = "http://" + text.partition("http://")[2].partition(";")[0]


def cycles(viewer: str, seconds: float) -> tuple[list[float], np.ndarray]:
    """Durations of the cycles of one run [ms], and the places of its box, shape (n,)."""
    opened = open_run(RunOptions("t4", mode="true", duration=seconds))
    history, took, last = History(opened.task), [], 0.0
    with ExitStack() as stack:
        folder = stack.enter_context(TemporaryDirectory())
        recorder = stack.enter_context(recorder_of(opened, Path(folder) / "log.mcap"))
        watching = None
        if viewer != "none":
            session = Quiet()
            watching = stack.enter_context(watching_run(session, opened))
            process = subprocess.Popen([sys.executable, "-c", VIEWER, session.address, viewer])
            stack.callback(process.wait)
            stack.callback(process.kill)
            time.sleep(1.0)

        def on_cycle(cycle: object, row: dict[str, float]) -> None:
            nonlocal last
            if watching:
                watching(cycle, row)  # type: ignore[arg-type]
            now = time.perf_counter()
            took.append(1e3 * (now - last))
            last = now

        last = time.perf_counter()
        drive(opened.episode, recorder, history, lambda: False, on_cycle)
    return took[1:], history.column("box_x")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=6)
    parser.add_argument("--seconds", type=float, default=2.0)
    chosen = parser.parse_args()
    hush_mujoco()
    rounds: dict[str, list[list[float]]] = defaultdict(list)
    places = []
    for _ in range(chosen.rounds):
        for viewer in ("none", "reads", "hangs"):
            took, place = cycles(viewer, chosen.seconds)
            places.append(place)
            rounds[viewer].append(took)
    assert all(np.array_equal(place, places[0]) for place in places), "a viewer changed the run"
    best = {viewer: np.min(took, axis=0) for viewer, took in rounds.items()}
    for viewer, took in best.items():
        ratio, whole = np.median(took / best["none"]), took.sum() / best["none"].sum()
        shares = f"{ratio:.3f} of that without (median), all cycles {whole:.3f}"
        print(f"viewer {viewer:5}: cycle {np.median(took):.2f} ms, {shares}")


if __name__ == "__main__":
    main()
