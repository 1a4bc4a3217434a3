"""Robots that amhe can drive, each one a room of its own."""
