"""The operator's remote control, as the robot passes it on."""

from __future__ import annotations

from dataclasses import dataclass

#: Bits of the keys.
_KEYS = (
    "R1",
    "L1",
    "start",
    "select",
    "R2",
    "L2",
    "F1",
    "F2",
    "A",
    "B",
    "X",
    "Y",
    "up",
    "right",
    "down",
    "left",
)


@dataclass(frozen=True, slots=True)
class Remote:
    """Keys that are held down, by name."""

    keys: frozenset[str] = frozenset()

    @staticmethod
    def of(raw: bytes) -> Remote:
        """Of the 40 bytes of a state; idle where there is no remote."""
        word = int.from_bytes(raw[2:4], "little")
        return Remote(
            frozenset(name for bit, name in enumerate(_KEYS) if word >> bit & 1) if word else frozenset()
        )

    def raw(self) -> bytes:
        """The inverse."""
        word = sum(1 << _KEYS.index(name) for name in self.keys)
        return bytes(2) + word.to_bytes(2, "little") + bytes(36)

    @property
    def stops(self) -> bool:
        """L2 + B, or select: motors damped at once."""
        return {"L2", "B"} <= self.keys or "select" in self.keys

    @property
    def arms(self) -> bool:
        """R2: the run may begin."""
        return "R2" in self.keys
