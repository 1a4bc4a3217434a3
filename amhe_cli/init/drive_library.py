"""The library of drives: data sheets and firmware formulas, and what they say about a model's servo."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path
from typing import Any

import yaml

from amhe_cli.core.errors import ConfigError, one_of

_FILE = Path(__file__).with_name("drives.yaml")


@dataclass(frozen=True, slots=True)
class ServoNumbers:
    """What a drive is at one supply and gain; None: no public source says.

    Args:
        volts: Supply [V], and
        gain_p: position gain, in the drive's own unit.
        kp: Stiffness [N m/rad].
        kv: Torque by speed of the back-EMF [N m s/rad].
        limit: Largest torque of the motor [N m].
        torque_sd: Sd of the log of all torques.
        armature: [kg m^2], and
        armature_sd: sd of its log.
    """

    volts: float | None
    gain_p: float | None
    kp: float | None
    kv: float | None
    limit: float | None
    torque_sd: float
    armature: float | None
    armature_sd: float


@dataclass(frozen=True, slots=True)
class LibraryDrive:
    """A drive of the library; drives.yaml describes each number."""

    name: str
    title: str
    source: str
    torque_sd: float
    note: str | None = None
    gear: float | None = None
    volts: float | None = None
    stall_torque: float | None = None
    no_load_speed: float | None = None
    torque_per_volt: float | None = None
    gains: str | None = None
    duty_per_count: float | None = None
    max_duty: float | None = None
    max_torque: float | None = None
    punch: float | None = None
    dead_band: float | None = None
    armature: float | None = None
    armature_sd: float | None = None
    above: dict[str, Any] | None = None

    def servo(self, volts: float | None = None, gain_p: float | None = None) -> ServoNumbers:
        """The servo that it is with a supply [V] and a position gain in the drive's own unit.

        Raises:
            ConfigError: The gain's meaning is not public, or the drive has none.
        """
        if gain_p is not None and self.gains is None:
            raise ConfigError(f"{self.name}: {self.note or 'it has no position gain'}: leave out `gain_p`")
        supply = volts or self.volts
        per_volt = self.torque_per_volt
        if per_volt is None and self.stall_torque is not None and self.volts:
            per_volt = self.stall_torque / self.volts
        full = per_volt * supply if per_volt is not None and supply else None
        limit = self.max_torque if full is None else full * (self.max_duty or 1.0)
        kp = gain_p
        if gain_p is not None and self.duty_per_count is not None:
            kp = gain_p * self.duty_per_count * full if full is not None else None
        kv = None
        if per_volt is not None and self.volts and self.no_load_speed:
            kv = per_volt * self.volts / self.no_load_speed
        return ServoNumbers(
            supply, gain_p, kp, kv, limit, self.torque_sd, self.armature, self.armature_sd or self.torque_sd
        )


@cache
def library() -> dict[str, LibraryDrive]:
    """All drives by name, `maker:type`."""
    entries = yaml.safe_load(_FILE.read_text(encoding="utf-8"))
    known = {field.name for field in fields(LibraryDrive)}
    for name, entry in entries.items():
        assert set(entry) < known, f"{_FILE.name}: {name}: {sorted(set(entry) - known)}"
    return {name: LibraryDrive(name, **entry) for name, entry in entries.items()}


def drive(name: str, volts: float | None = None) -> LibraryDrive:
    """The drive of this name; some makers sell several under one name, which the supply [V] tells apart.

    Raises:
        ConfigError: There is none.
    """
    drives = library()
    if name not in drives:
        raise ConfigError(one_of("drive", name, list(drives)))
    found = drives[name]
    if found.above and volts is not None and volts > found.above["volts"]:
        return drives[found.above["use"]]
    return found
