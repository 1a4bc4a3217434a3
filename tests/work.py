"""Work for executors that costs nothing."""

from __future__ import annotations

import os
import time
from pathlib import Path


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
