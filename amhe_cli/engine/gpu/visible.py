"""The graphics cards of this computer, seen without the libraries that compute on them."""

import ctypes
import sys
from pathlib import Path

from amhe_cli.core.errors import SimulationError


def visible_cards() -> list[str]:
    """Warp's names of the cards that this process can use.

    Raises:
        SimulationError: There is none.
    """
    if not (count := _counted()):
        raise SimulationError("no graphics card that CUDA can use; take the engine 'cpu'")
    return [f"cuda:{i}" for i in range(count)]


def look_for_cards() -> None:
    """Refuse a computer without a card; the driver, whose start takes half a second, is asked in doubt alone.

    Raises:
        SimulationError: There is none.
    """
    if _driver() is None or not any(Path("/dev").glob("nvidia[0-9]*")):
        visible_cards()


def _counted() -> int:
    """How many cards the driver of NVIDIA shows; 0 where there is no driver."""
    driver, count = _driver(), ctypes.c_int(0)
    if driver is None or driver.cuInit(0) or driver.cuDeviceGetCount(ctypes.byref(count)):
        return 0
    return count.value


def _driver() -> ctypes.CDLL | None:
    """The library of NVIDIA's driver, which does not start it."""
    for name in ("nvcuda.dll",) if sys.platform == "win32" else ("libcuda.so.1", "libcuda.so"):
        try:
            return ctypes.CDLL(name)
        except OSError:
            continue
    return None
