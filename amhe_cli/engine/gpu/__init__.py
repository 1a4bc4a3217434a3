"""Rollouts on graphics cards, by mujoco-warp."""

import warp as wp

from amhe_cli.core.errors import SimulationError

wp.config.log_level = wp.LOG_WARNING  # it prints a line for each kernel otherwise


def visible_cards() -> list[str]:
    """Warp's names of the cards that this process can use.

    Raises:
        SimulationError: There is none.
    """
    names = [str(device.alias) for device in wp.get_cuda_devices()]
    if not names:
        raise SimulationError("no graphics card that CUDA can use; take the engine 'cpu'")
    return names
