"""Rollouts of many candidate parameters at once."""
