"""The library of drives: data sheets and firmware formulas, and what `init --drive` makes of them."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, fields, replace
from fnmatch import fnmatchcase
from functools import cache
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import yaml

from amhe_cli.core.errors import AmheError, ConfigError, one_of
from amhe_cli.core.settings import LogSettings
from amhe_cli.core.signals import Signal
from amhe_cli.init.drives import entry_of, linear_entry, zeros
from amhe_cli.init.signals import Guess, Topic, joint_of
from amhe_cli.init.tables import ENABLED
from amhe_cli.logs import read_signals
from amhe_cli.system.model.elements import commanded, names_of
from amhe_cli.system.parameters.servos import SERVOS

_FILE = Path(__file__).with_name("drives.yaml")
#: Names of a column or topic that holds the position gain of a drive.
_GAIN = re.compile(
    r"(^|[_./ ])((position_)?p[_ ]?(gain|coefficient)|(gain|coef)_?p|kp)([_./ \[]|$)|^p$", re.IGNORECASE
)
#: What a log may say of a drive beside its motion -> names of the column.
_TOLD = {"voltage": re.compile(r"volt", re.IGNORECASE), "enabled": ENABLED}
#: Further numbers of a servo that sets a duty: nominal value (None: as delivered), sd, and what it is.
#: Users change punch and dead band; cables and batteries have up to a quarter of a motor's resistance.
_FIRMWARE = {
    "punch": (None, 0.02, "least duty, as a share of the largest"),
    "dead_band": (None, 0.002, "errors that the firmware ignores [rad]"),
    "supply_sag": (0.1, 0.15, "how far the supply sags at full duty"),
}
#: How the friction of hobby servos' gears grows with load, with its sd: 0.1 to 0.3 (arXiv 2410.08650).
_LOAD_FRICTION = (0.2, 0.1)
#: Their dry friction without load, and what is more of it at rest: as a share of the largest torque.
_DRY, _REST = 0.015, 0.01
#: Prior sd of the logarithm: of the duty that a gain gives, of a gain that nobody says, of the back-EMF.
_GAIN_SD, _UNKNOWN_GAIN, _BACK_EMF_SD = 0.1, 1.5, 0.15
#: Where the numbers of a drive of the library are from.
_SHEET = "data sheet"
#: That of a register that is known.
_EXACT = 0.001
#: Prior sd of the logarithm of a mass: who names the drives wants to weigh with them.
_LOAD_SD = 0.7
#: What models of such servos miss of a position [rad]: gears have a degree of play, and uneven teeth.
_MISSED = 0.006


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


@dataclass(frozen=True, slots=True)
class Chosen:
    """Drives that the user names.

    Args:
        drives: Joint, or a pattern -> drive of the library, `maker:type`.
        volts: Their supply [V]; None: that of the data sheet.
        gain_p: Their position gain, in the drive's unit; None: that in the log, else stiffness stays a guess.
    """

    drives: Mapping[str, str]
    volts: float | None = None
    gain_p: float | None = None


def library_parameters(
    spec: mujoco.MjSpec,
    model: mujoco.MjModel,
    parameters: Sequence[Guess],
    signals: Sequence[Guess],
    chosen: Chosen,
    logs: Sequence[Path],
    topics: Sequence[Topic],
    msg_path: Path | None = None,
) -> tuple[list[Guess], list[Guess], list[str]]:
    """The parameters, with those of the chosen drives in place of guesses about the same numbers.

    Args:
        spec: The model's source; its position servos get the gain and the limit of their drives.
        model: The model as it was.
        parameters: Parameters that were guessed.
        signals: Signals of the log.
        chosen: The drives.
        logs: Logs, whose first may hold the gain in a column of
        topics: its tables.
        msg_path: See `read_signals`.

    Returns:
        The parameters, what a table says of the drives' supply and enabling, and sentences about the model.

    Raises:
        ConfigError: A joint or drive is not known, or no actuator moves the joint.
    """
    gain, notes = (chosen.gain_p, []) if chosen.gain_p is not None else _logged_gain(logs, topics, msg_path)
    actuators = {joint: name for name in names_of(model, "actuator") if (joint := joint_of(model, name))}
    made, more = list[Guess](), list[Guess]()
    for joint, one in _drives_of(chosen, list(actuators)).items():
        actuator, servo = actuators[joint], one.servo(chosen.volts, gain)
        if servo.armature is not None:
            target = {"joint": joint, "set": "armature"}
            entry = entry_of(servo.armature, False, [target], servo.armature_sd)
            why = f"rotor of joint {joint}, {one.title}: {one.source}"
            made.append(Guess(f"{joint}_armature", entry, why, source=_SHEET))
        if commanded(model, model.actuator(actuator).id) == "position" and servo.limit is not None:
            told = _told(topics, actuator, len(actuators) == 1)
            quantities = {quantity for guess in told for quantity in guess.entry["columns"]}
            notes.append(_write(spec, model, actuator, one, servo))
            made += _of_servo(model, joint, actuator, one, servo, quantities)
            more += told
        elif servo.limit is not None:
            notes.append(f"the motor {actuator} gives at most about {servo.limit:.3g} N m as {one.name}")
    driven = list(_drives_of(chosen, list(actuators)))
    made += [g for g in zeros(model, driven, signals) if g.name not in {p.name for p in parameters}]
    known = {_number(target) for guess in made for target in guess.entry["targets"]}
    left = [kept for guess in parameters if (kept := _without(guess, known)) is not None]
    for guess in left:
        if {target["set"] for target in guess.entry["targets"]} == {"mass"}:
            guess.entry["prior_sd"] = _LOAD_SD
            guess.why += "; prior wide, as of a load to be weighed"
    return [*left, *made], more, notes


def _drives_of(chosen: Chosen, joints: Sequence[str]) -> dict[str, LibraryDrive]:
    """The drive of each joint that the user means.

    Raises:
        ConfigError: There is no such drive, or no such joint.
    """
    found = dict[str, LibraryDrive]()
    for pattern, name in chosen.drives.items():
        meant = [joint for joint in joints if fnmatchcase(joint, pattern)]
        if not meant:
            raise ConfigError(f"`drive`: {one_of('driven joint', pattern, joints)}")
        found |= dict.fromkeys(meant, drive(name, chosen.volts))
    return found


def expect_less(signals: Sequence[Guess], chosen: Chosen) -> None:
    """Where a hobby servo is among the drives: declare what models miss of positions, compare no speeds."""
    if all(drive(name, chosen.volts).gains != "counts" for name in chosen.drives.values()):
        return
    for guess in signals:
        if guess.noise.get("position") and "joints" in guess.entry:
            if float(guess.noise["position"] or 0.0) < _MISSED:
                guess.noise["position"] = _MISSED
                guess.why += "; its noise is what models of such gears miss"
            guess.entry["compare"] = ["position"]  # such drives hold and round their speeds


def _write(
    spec: mujoco.MjSpec, model: mujoco.MjModel, actuator: str, one: LibraryDrive, servo: ServoNumbers
) -> str:
    """Give a position servo of the model its drive's numbers, and say so."""
    written, row = spec.actuator(actuator), model.actuator(actuator).id
    kp, kv = float(servo.kp or model.actuator_gainprm[row, 0]), -float(model.actuator_biasprm[row, 2])
    kv = 0.0 if servo.kv is not None else kv  # the back-EMF is beyond the firmware
    written.set_to_position(kp=float(f"{kp:.4g}"), kv=kv)
    written.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
    written.forcerange = [-float(f"{servo.limit:.4g}"), float(f"{servo.limit:.4g}")]
    firmware = (one.punch, one.dead_band, None, servo.kv, servo.volts)
    SERVOS.add(spec, [actuator], np.array([number or 0.0 for number in firmware]))
    return f"the model's {actuator} is a {one.name} now: {kp:.3g} N m/rad, at most {servo.limit:.3g} N m"


def _of_servo(
    model: mujoco.MjModel, joint: str, actuator: str, one: LibraryDrive, servo: ServoNumbers, told: Set[str]
) -> Iterator[Guess]:
    """What is unknown of a position servo whose model has the drive's gain and limit."""
    here, at = {"actuator": actuator}, f"of joint {joint}, {one.title}"
    assert servo.limit is not None
    scaled = [{**here, "set": "gain", "mode": "scale", "carry_limit": True}]
    if servo.kv is not None:
        scaled.append({**here, "set": "back_emf", "mode": "scale"})
        entry = entry_of(servo.kv, False, [{**here, "set": "back_emf"}], _BACK_EMF_SD)
        why = f"torque lost by speed {at}: by its no-load speed"
        yield Guess(f"{joint}_back_emf", entry, why, source=_SHEET)
    entry = entry_of(1.0, False, scaled, one.torque_sd) | {"unit": "-"}
    why = f"factor on all torque {at}: {one.source}{f' ({one.note})' if one.note else ''}"
    yield Guess(f"{joint}_torque_scale", entry, why, source=_SHEET)
    kp, sd = (servo.kp, _GAIN_SD) if servo.kp else (float(model.actuator(actuator).gainprm[0]), _UNKNOWN_GAIN)
    why = f"stiffness {at}" + ("" if servo.kp else "; the model's, since no gain is known: give `gain_p`")
    entry = entry_of(kp, False, [{**here, "set": "gain"}], sd)
    yield Guess(f"{joint}_gain", entry, why, source=_SHEET if servo.kp else "model")
    if servo.gain_p is not None:  # nearly exact, and not fixed, so that a data set can know it of each log
        entry = entry_of(1.0, False, [{**here, "set": "gain", "mode": "scale"}], _EXACT) | {"unit": "-"}
        why = f"position gain over {servo.gain_p:g}; a log at half of it: known: {{{joint}_gain_ratio: 0.5}}"
        yield Guess(f"{joint}_gain_ratio", entry, why, source=_SHEET)
    entry = entry_of(_DRY * servo.limit, True, [{"joint": joint, "set": "friction_loss"}])
    yield Guess(f"{joint}_friction_loss", entry, f"dry friction without load {at}", source="guess")
    linear = {
        "load_friction": (*_LOAD_FRICTION, {"joint": joint}, "friction, as a share of the torque in the gear")
    }
    rest = _REST * servo.limit
    linear["stribeck_friction"] = (rest, 1.5 * rest, {"joint": joint}, "more dry friction at rest")
    if one.gains == "counts":
        for word, (value, spread, what) in _FIRMWARE.items():
            value = getattr(one, word) if value is None else value
            if value is not None and not (word == "supply_sag" and "voltage" in told):  # that has sagged
                linear[word] = (value, spread, here, what)
    for word, (value, spread, target, what) in linear.items():
        entry = linear_entry(
            value, (value - 10.0 * spread, value + 10.0 * spread), spread, {**target, "set": word}
        )
        yield Guess(f"{joint}_{word}", entry, f"{what}, {at}", source="guess")
    if "voltage" in told:
        fixed = {"nominal": servo.volts, "prior_sd": 0.0, "targets": [{**here, "set": "supply"}]}
        why = "supply at which the limit holds; the log has its own"
        yield Guess(f"{joint}_supply", fixed, why, source=_SHEET)


def _told(topics: Sequence[Topic], actuator: str, alone: bool) -> list[Guess]:
    """What a table says of a servo's supply, and whether its torque is on.

    The column has the servo's name in its own, or the servo is `alone`.
    """
    found = list[Guess]()
    for topic in (topic for topic in topics if topic.type.startswith("table/")):
        for quantity, names in _TOLD.items():
            columns = [name for name in topic.entries if names.search(name) and (alone or actuator in name)]
            if len(columns) == 1:
                entry = {"columns": {quantity: columns}, "actuators": [actuator]}
                place = {} if topic.name == "table" else {"topic": topic.name}
                name = quantity if alone else f"{actuator}_{quantity}"
                why = f"from the column {columns[0]}, judged by its name"
                found.append(Guess(name, place | entry, why, source="names"))
    return found


def _number(target: Mapping[str, Any]) -> tuple[str, str]:
    """What a target sets: an element's name and a word."""
    return str(target.get("actuator", target.get("joint"))), str(target["set"])


def _without(guess: Guess, known: set[tuple[str, str]]) -> Guess | None:
    """A guess without the targets that a drive of the library sets; None if none is left."""
    targets = guess.entry["targets"]
    kept = [target for target in targets if _number(target) not in known]
    if len(kept) == len(targets):
        return guess
    return replace(guess, entry={**guess.entry, "targets": kept}) if kept else None


def _logged_gain(
    logs: Sequence[Path], topics: Sequence[Topic], msg_path: Path | None
) -> tuple[float | None, list[str]]:
    """The position gain that a log itself holds in a column, and a sentence about it."""
    for topic in topics:
        columns = [name for name in topic.entries if _GAIN.search(name)]
        if not columns or not topic.type.startswith("table/"):
            continue
        wanted = Signal(
            "gain", topic.name if topic.name != "table" else "", ("value",), columns={"value": (columns[0],)}
        )
        try:
            log = read_signals(logs[0], [wanted], 1.0 / topic.rate, LogSettings(), msg_path=msg_path)
        except AmheError as error:
            return None, [f"the gain in column {columns[0]} cannot be read: {error}"]
        values = np.unique(log["gain.value"].values[log["gain.value"].valid])
        if values.size != 1:
            span = f"{values.min():g} to {values.max():g}" if values.size else "no value"
            return None, [f"column {columns[0]} holds a gain of {span}: give each gain a log of its own"]
        return float(values[0]), [f"the drives' gain is {values[0]:g}, by the log's column {columns[0]}"]
    return None, []
