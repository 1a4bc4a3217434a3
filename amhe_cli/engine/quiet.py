"""MuJoCo's warnings go to the log, not into a file where the user stands."""

from __future__ import annotations

import logging

import mujoco


def hush_mujoco() -> None:
    """Send this process's MuJoCo warnings to the log; by default it writes MUJOCO_LOG.TXT."""
    mujoco.set_mju_user_warning(logging.getLogger("amhe_cli.mujoco").debug)
