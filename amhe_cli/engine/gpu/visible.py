"""The graphics cards of this computer, seen without the libraries that compute on them."""

import ctypes
import sys

from amhe_cli.core.errors import SimulationError


def visible_cards() -> list[str]:
    """Warp's names of the cards that this process can use.

    Raises:
        SimulationError: There is none.
    """
    if not (count := _counted()):
        raise SimulationError("no graphics card that CUDA can use; take the engine 'cpu'")
    return [f"cuda:{i}" for i in range(count)]


def _counted() -> int:
    """How many cards the driver of NVIDIA shows; 0 where there is no driver."""
    for name in ("nvcuda.dll",) if sys.platform == "win32" else ("libcuda.so.1", "libcuda.so"):
        try:
            driver = ctypes.CDLL(name)
        except OSError:
            continue
        count = ctypes.c_int(0)
        good = driver.cuInit(0) == 0 and driver.cuDeviceGetCount(ctypes.byref(count)) == 0
        return count.value if good else 0
    return 0
