"""Rollouts on graphics cards, by mujoco-warp."""

import ctypes
import sys

import warp as wp

from amhe_cli.core.errors import SimulationError

wp.config.log_level = wp.LOG_WARNING  # it prints a line for each kernel otherwise


def visible_cards() -> list[str]:
    """Warp's names of the cards that this process can use.

    Raises:
        SimulationError: There is none.
    """
    names = [str(device.alias) for device in wp.get_cuda_devices()] if _has_driver() else []
    if not names:
        raise SimulationError("no graphics card that CUDA can use; take the engine 'cpu'")
    return names


def _has_driver() -> bool:
    """Whether this computer has a driver of NVIDIA; without one, warp prints a warning."""
    for name in ("nvcuda.dll",) if sys.platform == "win32" else ("libcuda.so.1", "libcuda.so"):
        try:
            ctypes.CDLL(name)
        except OSError:
            continue
        return True
    return False
