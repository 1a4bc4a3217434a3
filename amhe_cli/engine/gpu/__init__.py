"""Rollouts on graphics cards, by mujoco-warp."""
