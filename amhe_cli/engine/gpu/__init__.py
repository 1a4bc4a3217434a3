"""Rollouts on graphics cards, by mujoco-warp."""

import warp as wp

wp.config.log_level = wp.LOG_WARNING  # it prints a line for each kernel otherwise
