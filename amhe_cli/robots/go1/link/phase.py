"""The phases of a robot's day."""

from __future__ import annotations

from enum import IntEnum


class Phase(IntEnum):
    """What the sender is doing; only later ones follow."""

    CONNECT = 0
    """Packets that do nothing, so that states come."""
    HOLD = 1
    """Gains rise about the joints' present angles."""
    STAND = 2
    """Slowly by the folded pose to standing."""
    READY = 3
    """Stands, and waits for the operator."""
    RUN = 4
    """Plays plans."""
    PAUSE = 5
    """Plan or poses are lost: stands still where it is."""
    SIT = 6
    """Slowly to the folded pose."""
    DAMP = 7
    """Motors only damp."""
    OVER = 8
    """The last packet that does nothing is sent."""
