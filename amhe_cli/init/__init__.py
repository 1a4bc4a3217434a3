"""Writes a first system folder from a model and its logs."""
