"""Parameters of drives that the user names (`amhe init --drive`), from the library instead of a guess."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from amhe_cli.core.errors import AmheError, ConfigError, one_of
from amhe_cli.core.settings import LogSettings
from amhe_cli.core.signals import Signal
from amhe_cli.init.drive_library import LibraryDrive, drive
from amhe_cli.init.drives import entry_of, linear_entry
from amhe_cli.init.signals import Guess, Topic, joint_of
from amhe_cli.logs import read_signals
from amhe_cli.system.model.elements import commanded, names_of

#: Names of a column or topic that holds the position gain of a drive.
_GAIN = re.compile(
    r"(^|[_./ ])((position_)?p[_ ]?(gain|coefficient)|(gain|coef)_?p|kp)([_./ \[]|$)|^p$", re.IGNORECASE
)
#: What a log may say of a drive beside its motion -> names of the column.
_TOLD = {
    "voltage": re.compile(r"volt", re.IGNORECASE),
    "enabled": re.compile(r"enabled?([_./ ]|$)|(^|[_./ ])torque_on", re.IGNORECASE),
}
#: Prior sd of a punch and of a dead band [rad] that a maker's table has: users change them.
_PUNCH_SD, _BAND_SD = 0.02, 0.002
#: A supply that sags, with its sd: cables and batteries have up to a quarter of a motor's resistance.
_SAG = (0.1, 0.15)
#: How friction of a gear grows with load, with its sd: hobby servos have 0.1 to 0.3 (arXiv 2410.08650).
_LOAD_FRICTION = (0.1, 0.1)


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
    model: mujoco.MjModel,
    parameters: Sequence[Guess],
    chosen: Chosen,
    logs: Sequence[Path],
    topics: Sequence[Topic],
    msg_path: Path | None = None,
) -> tuple[list[Guess], list[Guess], list[str]]:
    """The parameters, with those of the chosen drives in place of guesses about the same numbers.

    Args:
        model: The model.
        parameters: Parameters that were guessed.
        chosen: The drives.
        logs: Logs, whose first may hold the gain in a column of
        topics: its tables.
        msg_path: See `read_signals`.

    Returns:
        The parameters, what a table says of the drives' supply and enabling, and sentences about the gain.

    Raises:
        ConfigError: A joint or drive is not known, or no actuator moves the joint.
    """
    gain, notes = (chosen.gain_p, []) if chosen.gain_p is not None else _logged_gain(logs, topics, msg_path)
    actuators = {joint: name for name in names_of(model, "actuator") if (joint := joint_of(model, name))}
    made, signals = list[Guess](), list[Guess]()
    for pattern, name in chosen.drives.items():
        joints = [joint for joint in actuators if fnmatchcase(joint, pattern)]
        if not joints:
            raise ConfigError(f"`drive`: {one_of('driven joint', pattern, list(actuators))}")
        for joint in joints:
            one, row = drive(name, chosen.volts), model.actuator(actuators[joint]).id
            made += _of_drive(model, joint, actuators[joint], one, chosen.volts, gain)
            limit = one.servo(chosen.volts).limit
            if commanded(model, row) == "position" and model.actuator_forcelimited[row]:
                told = _told(topics, actuators[joint], len(actuators) == 1)
                signals += told
                made += _of_firmware(
                    joint,
                    actuators[joint],
                    one,
                    chosen.volts,
                    {quantity for one in told for quantity in one.entry["columns"]},
                )
            elif limit is not None and not model.actuator_forcelimited[row]:
                notes.append(
                    f"the actuator {actuators[joint]} has no limit: {one.name} has about {limit:.3g} N m; "
                    f'give it forcerange="-{limit:.3g} {limit:.3g}" if the log may reach that'
                )
    known = {_number(target) for guess in made for target in guess.entry["targets"]}
    left = [kept for guess in parameters if (kept := _without(guess, known)) is not None]
    return [*left, *made], signals, notes


def _of_drive(
    model: mujoco.MjModel,
    joint: str,
    actuator: str,
    one: LibraryDrive,
    volts: float | None,
    gain_p: float | None,
) -> list[Guess]:
    row, servo = model.actuator(actuator).id, one.servo(volts, gain_p)
    at = f"{one.title}{f' at {volts:g} V' if volts else ''}"
    source = f"of joint {joint}, {at}: {one.source}{f' ({one.note})' if one.note else ''}"
    found = [("armature", servo.armature, servo.armature_sd, {"joint": joint, "set": "armature"}, "rotor")]
    if commanded(model, row) == "position":
        found += [
            (
                "gain",
                servo.kp,
                servo.kp_sd,
                {"actuator": actuator, "set": "gain"},
                f"stiffness at gain {gain_p}",
            ),
        ]
        word = "back_emf" if model.actuator_forcelimited[row] else "actuator_damping"
        kind = "kv" if word == "actuator_damping" else word
        found.append((kind, servo.kv, servo.torque_sd, {"actuator": actuator, "set": word}, "back-EMF"))
    if model.actuator_forcelimited[row]:
        target = {"actuator": actuator, "set": "force_limit"}
        found.append(("force_limit", servo.limit, servo.torque_sd, target, "torque at full duty"))
    return [
        Guess(f"{joint}_{kind}", entry_of(value, False, [target], sd), f"{what} {source}")
        for kind, value, sd, target, what in found
        if value is not None
    ]


def _of_firmware(
    joint: str, actuator: str, one: LibraryDrive, volts: float | None, told: Set[str]
) -> list[Guess]:
    """What a limited servo has beside a gain, and its gear."""
    servo = {"actuator": actuator}
    made = [
        ("punch", one.punch, _PUNCH_SD, servo, "least duty, as a share of the largest"),
        ("dead_band", one.dead_band, _BAND_SD, servo, "errors that the firmware ignores"),
        ("supply_sag", None if "voltage" in told else _SAG[0], _SAG[1], servo, "how far the supply sags"),
        (
            "load_friction",
            _LOAD_FRICTION[0],
            _LOAD_FRICTION[1],
            {"joint": joint},
            "of the torque in the gear",
        ),
    ]
    guesses = [
        Guess(
            f"{joint}_{word}",
            linear_entry(value, (value - 10.0 * sd, value + 10.0 * sd), sd, {**target, "set": word}),
            f"{what}, of joint {joint}: {one.title}",
        )
        for word, value, sd, target, what in made
        if value is not None
    ]
    if "voltage" in told and (supply := volts or one.volts):
        entry = {"nominal": supply, "prior_sd": 0.0, "targets": [{**servo, "set": "supply"}]}
        guesses.append(
            Guess(f"{joint}_supply", entry, "supply at which gain and force limit hold; the log has its own")
        )
    return guesses


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
                found.append(Guess(name, place | entry, f"from the column {columns[0]}, judged by its name"))
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
    return Guess(guess.name, {**guess.entry, "targets": kept}, guess.why) if kept else None


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
