"""A first system folder from a model and logs; every guess has a comment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import yaml

from amhe_cli.core import rotations
from amhe_cli.core.corrections import resolution
from amhe_cli.core.errors import AmheError, ConfigError
from amhe_cli.core.files import filling
from amhe_cli.core.settings import LogSettings
from amhe_cli.core.signals import Series
from amhe_cli.core.yaml_file import merged
from amhe_cli.init.drive_library import Chosen, expect_less, library_parameters
from amhe_cli.init.drives import (
    actuator_parameters,
    floating,
    gap_parameters,
    geared_joints,
    moved_by,
    ungrouped,
)
from amhe_cli.init.efforts import effort_parameters, effort_signal
from amhe_cli.init.model import add_servos, copy_model, free_root, notes_on_urdf, overlaps
from amhe_cli.init.parameters import guess_parameters, guessed_masses
from amhe_cli.init.signals import (
    NOISE,
    Guess,
    Topic,
    fields_example,
    foreign,
    guess_signals,
    joint_of,
    notes_on,
    single_joints,
)
from amhe_cli.init.tables import is_measured, topics_in, with_columns
from amhe_cli.init.text import system_text
from amhe_cli.logs import read_signals, survey
from amhe_cli.logs.containers.table_file import TYPE as TABLE
from amhe_cli.system.description.doubts import doubts_of
from amhe_cli.system.description.folders import FILE_NAME
from amhe_cli.system.description.targets import IN_NO_FILE
from amhe_cli.system.model.elements import commanded, names_of
from amhe_cli.system.model.files import compiled, read_spec
from amhe_cli.system.model.urdf import UrdfOptions, is_urdf
from amhe_cli.system.system import System

#: Names in the log that an error lists.
_SHOWN = 30
#: Seconds of log that the noise is estimated from.
_NOISE_SECONDS = 60.0


@dataclass(eq=False)
class Proposal:
    """What `init` makes of a model and logs.

    Args:
        spec: The model, with what was added to it.
        rewrite: Whether it has more than its file says.
        guesses: The signals, whose noise is an estimate where the logs have one.
        parameters: The unknowns.
        notes: Sentences for the user.
        skeletons: Signals to complete by hand.
        spare: Unknowns that may be added.
        match: What is compared with the logs, 'motion' or 'effort'.
        settings: Settings over the defaults.
    """

    spec: mujoco.MjSpec
    rewrite: bool
    guesses: list[Guess]
    parameters: list[Guess]
    notes: list[str]
    skeletons: list[list[str]]
    spare: list[Guess]
    match: str = "motion"
    settings: Mapping[str, Any] = field(default_factory=dict)

    @property
    def sentences(self) -> list[str]:
        """Each guess with its reason, and the notes."""
        return [*(f"{one.name}: {one.why}" for one in (*self.guesses, *self.parameters)), *self.notes]

    def system(self, name: str, settings: Mapping[str, Any] | None = None) -> System:
        """The system, which needs no folder; `settings` may be of its signals and parameters, too."""
        settings = merged(self.settings, settings or {})
        parameters = {guess.name: guess.entry for guess in self.parameters}
        parameters = merged(parameters, settings.pop("parameters", {}))
        signals = {
            guess.name: guess.entry | ({"noise": guess.noise} if guess.noise else {})
            for guess in self.guesses
        }
        signals = merged(signals, settings.pop("signals", {}))
        return System.from_model(
            self.spec,
            parameters=parameters,
            signals=signals,
            settings=settings,
            name=name,
            match=self.match,
            warn=False,
        )


def proposed_as(model_path: Path, system: System, urdf: UrdfOptions | None = None) -> Proposal:
    """A proposal with another model, and of a system the signals, and parameters that no model file has."""
    description = yaml.safe_load(system.text)
    guesses = [
        Guess(name, {k: v for k, v in entry.items() if k != "noise"}, "", entry.get("noise") or {})
        for name, entry in description["signals"].items()
    ]
    settings = description.get("settings") or {}
    parameters = [
        Guess(name, entry, "")
        for name, entry in description["parameters"].items()
        if all(target["set"] in IN_NO_FILE for target in entry["targets"])
    ]
    spec = read_spec(model_path, urdf)
    return Proposal(spec, is_urdf(model_path), guesses, parameters, [], [], [], system.match, settings)


def proposed(
    model_path: Path,
    logs: Sequence[Path],
    msg_path: Path | None = None,
    urdf: UrdfOptions | None = None,
    actuators: bool = False,
    group: bool = False,
    gains: bool = False,
    backlash: Sequence[str] = (),
    elastic: Sequence[str] = (),
    drives: Chosen | None = None,
    efforts: bool = False,
) -> Proposal:
    """What to write into a system folder; arguments and errors as of `init_system`.

    `efforts`: measured torques are compared also where commands are known.
    """
    spec, rewrite, notes = read_spec(model_path, urdf), is_urdf(model_path), list[str]()
    topics = _with_tables(found := _topics(logs, msg_path), compiled(spec))
    added = rewrite and _complete(spec, topics, notes)
    model = compiled(spec)
    guesses = guess_signals(model, topics)
    twice = {topic.name for topic in topics if is_measured(topic, topics)}
    measured = [
        g for g in guesses if "actuators" not in g.entry or not (efforts or g.entry["topic"] in twice)
    ]
    matched = None if actuators or drives else effort_signal(model, topics, measured, logs[0], msg_path)
    if matched:
        guesses, topics = measured, [topic for topic in topics if topic.name not in twice]
        parameters = list(effort_parameters(model, matched[1]))
        notes += matched[2]
    elif actuators:
        parameters = actuator_parameters(spec, model, guesses, guessed_gains=added, group=group, gains=gains)
        notes += floating(model, guesses) + (ungrouped(parameters) if group else [])
    else:
        parameters = guess_parameters(spec, model, guesses, guessed_gains=added)
    told = list[Guess]()
    if drives is not None:
        known = spec, model, parameters, guesses, drives, logs, found, msg_path
        parameters, told, of_drives = library_parameters(*known)
        rewrite, notes, model = True, notes + of_drives, compiled(spec)
    notes += overlaps(model)
    _refuse_nothing(model, topics, guesses, parameters)
    for joints in (backlash, elastic):
        if joints:
            rewrite, kind = True, joints is elastic
            parameters += gap_parameters(spec, compiled(spec), guesses, parameters, joints, elastic=kind)
    notes += notes_on(model, topics, guesses, efforts=matched is not None)
    for guess in guesses:
        with_columns(guess, topics, alone=len({topic.table for topic in topics if topic.columns}) == 1)
    skeletons = _skeletons(model, topics, guesses)
    guesses = [*guesses, *told, *(matched or ())[:1]]
    spare, match = guessed_masses(model, guesses) if actuators else [], "effort" if matched else "motion"
    made = Proposal(spec, rewrite, guesses, parameters, notes, skeletons, spare, match)
    while declared := _declare_units(made, logs[0], msg_path):
        notes += declared
    notes[:0] = _estimate_noise(made, logs[0], topics, msg_path)
    if drives is not None:
        expect_less(guesses, drives)
    return made


def _complete(spec: mujoco.MjSpec, topics: Sequence[Topic], notes: list[str]) -> bool:
    """Give a URDF what logs say that it lacks, with notes; whether it got servos."""
    model = compiled(spec)
    notes += notes_on_urdf(spec, model) + free_root(spec, topics)
    if not model.nactuator:
        notes += add_servos(spec, model, topics)
    return not model.nactuator


def _skeletons(model: mujoco.MjModel, topics: Sequence[Topic], guesses: Sequence[Guess]) -> list[list[str]]:
    """Signals to complete by hand, one for each type that is not built in, while joints lack a state."""
    stated = {name for guess in guesses for name in guess.entry.get("joints", ())}
    unread = [] if stated.issuperset(single_joints(model)) else foreign(topics)
    return [fields_example(model, topic) for topic in unread]


def init_system(
    model_path: Path, logs: Sequence[Path], out: Path, *, force: bool = False, **how: Any
) -> Proposal:
    """Write a system folder that `amhe identify` can use at once.

    Args:
        model_path: MJCF or URDF; it is copied with its files.
        logs: Logs of the robot; the noise is estimated from the first one.
        out: Folder to write; it appears whole or not at all.
        force: Write into a folder that is not empty.
        how: What follows.
        msg_path: Folder of `.msg` files for types that the logs do not define.
        urdf: How to read a URDF.
        actuators: The unknowns are those of all drives, and nothing else.
        group: With `actuators`: equal drives share their parameters.
        gains: With `actuators`: gain, velocity gain, limit of force and filter of each servo are free, too.
        backlash: Joints, by names or patterns, that get a gap between drive and link, of unknown width.
        elastic: Joints likewise, whose drives are elastic, as harmonic drives are, of unknown stiffness.
        drives: Drives of the library, for gains, limits and armatures.

    Returns:
        What was proposed, and written.

    Raises:
        ConfigError: The model cannot be read, or nothing in the logs is a part of it.
        LogError: A log cannot be read.
    """
    for name in ("group", "gains"):
        if how.get(name) and not how.get("actuators"):
            raise ConfigError(f"`{name}` is for the drives of `actuators`: give both")
    if out.exists() and not force and any(out.iterdir()):
        raise ConfigError(f"{out}: is not empty; choose another folder, or give `force=True`")
    made = proposed(model_path, logs, **how)
    with filling(out) as folder:
        name = copy_model(made.spec, model_path, folder, rewrite=made.rewrite)
        head = (name, model_path.name, [str(log) for log in logs])
        geared = geared_joints(compiled(made.spec), moved_by(made.guesses))
        rest = made.notes, made.skeletons, made.spare, geared, made.match
        text = system_text(*head, made.guesses, made.parameters, *rest)
        (folder / FILE_NAME).write_text(text)
        System.load(folder, warn=False)  # what is written is valid, or it is not written
    return made


def _topics(logs: Sequence[Path], msg_path: Path | None) -> list[Topic]:
    """Topics that can be read in every log, as they are in the first one, without what amhe computed."""
    surveys = [survey(log, msg_path=msg_path).topics for log in logs]
    # a table that is a log by itself has no name: run1.csv and run2.csv hold the same table
    surveys = [
        [replace(topic, name="table") if len(seen) == 1 and topic.type == TABLE else topic for topic in seen]
        for seen in surveys
    ]
    common = set.intersection(*({topic.name for topic in seen} for seen in surveys))
    return [
        Topic(seen.name, seen.type, seen.rate, seen.entries, seen.quantities, paths=seen.paths)
        for seen in surveys[0]
        if seen.name in common
        and seen.problem is None
        and seen.rate > 0.0
        and not seen.name.startswith("/amhe/")
    ]


def _with_tables(topics: Sequence[Topic], model: mujoco.MjModel) -> list[Topic]:
    """The topics, with tables replaced by the joint states and commands that their columns hold."""
    tables = [topic for topic in topics if topic.type == TABLE]
    joints, alone = single_joints(model), len(tables) == 1
    drives = {
        actuator: (joint, commanded(model, model.actuator(actuator).id))
        for actuator in names_of(model, "actuator")
        if (joint := joint_of(model, actuator)) in joints
    }
    held = [part for table in tables for part in topics_in(table, joints, drives, alone) or [table]]
    return [*(topic for topic in topics if topic.type != TABLE), *held]


def _refuse_nothing(
    model: mujoco.MjModel, topics: Sequence[Topic], guesses: Sequence[Guess], parameters: Sequence[Guess]
) -> None:
    measured = any("joints" in guess.entry or "body" in guess.entry for guess in guesses)
    if measured and parameters:
        return
    unread = foreign(topics)
    joints = single_joints(model)
    others = (  # joint states in which no name resembles one of these joints
        topic.kind == "JointState"
        and not any(n in joint or joint in n for n in topic.entries for joint in joints)
        for topic in topics
    )
    if unread and not measured and joints and not any(others):
        raise ConfigError(_needs_fields(model, unread))
    entries = sorted({entry for topic in topics for entry in topic.entries})
    if len(entries) > _SHOWN:
        entries = [*entries[:_SHOWN], f"and {len(entries) - _SHOWN} more"]
    raise ConfigError(
        "nothing in the log matches this model: the model has the joints "
        f"{', '.join(single_joints(model)) or '(none)'}; the log names {', '.join(entries) or '(nothing)'}; "
        "rename the model's joints or bodies to the names in the log"
    )


def _needs_fields(model: mujoco.MjModel, topics: Sequence[Topic]) -> str:
    """Advice for logs in which only message types that are not built in can hold the joints' positions."""
    named = ", ".join(f"{topic.name} ({topic.type})" for topic in topics)
    return "\n".join(
        (
            f"no topic gives joint positions; {named} needs fields: where the numbers are in its messages",
            f"write a {FILE_NAME} by hand (docs/systems.md), with a signal such as this and the true paths:",
            *(f"  {line}" for line in fields_example(model, topics[0])),
        )
    )


def _declare_units(made: Proposal, log: Path, msg_path: Path | None) -> list[str]:
    """Declare units and wrapping encoders that the log's numbers show, a sentence for each.

    Commands can be judged only by positions that are right: what was declared may reveal more.
    """
    system = made.system("")
    try:
        seen = read_signals(
            log, system.signals, system.dt, LogSettings(), end=_NOISE_SECONDS, msg_path=msg_path, warn=False
        )
    except AmheError:
        return []  # what cannot be read is a note of the noise
    entries, notes = {guess.name: guess.entry for guess in made.guesses}, list[str]()
    for doubt in doubts_of(system, seen):
        entry = entries[doubt.signal]
        new = {key: value for key, value in doubt.remedy.items() if key not in entry}
        if new:
            entry.update(new)
            notes.append(f"{doubt}; it is declared")
    return notes


def _estimate_noise(made: Proposal, log: Path, topics: Sequence[Topic], msg_path: Path | None) -> list[str]:
    """Set each signal's noise to an estimate from the log; a signal that cannot be read keeps the guess."""
    rates = {topic.table or topic.name: topic.rate for topic in topics}
    unread: list[str] = []
    signals = {signal.name: signal for signal in made.system("").signals}
    for guess in made.guesses:
        signal = signals[guess.name]
        compared = tuple(key for key, sd in guess.noise.items() if sd is not None)
        if not compared:
            continue
        try:
            dt = 1.0 / rates[signal.topic or next(iter(rates))]
            wanted = replace(signal, quantities=compared)
            held = replace(wanted, name=f"{signal.name} held", is_input=True)  # its steps, not interpolated
            both = read_signals(
                log, [wanted, held], dt, LogSettings(), end=_NOISE_SECONDS, msg_path=msg_path, warn=False
            )
        except AmheError as error:
            unread.append(f"{guess.name}: its noise is a guess, because {error}")
            continue
        for key in compared:
            guess.noise[key] = _noise(key, both[wanted.key(key)], both[held.key(key)])
    return unread


def _noise(quantity: str, series: Series, held: Series) -> float:
    """Noise sd of a series, from its third differences, which are nearly zero for smooth motion.

    Velocities count three times: most logs filter or differentiate them, and they would outweigh poses.
    A sensor that counts steps errs by their uniform distribution, also where the differences are none;
    `held` are its samples as they came.
    The result is at least a quarter of the usual noise: no model is better than that.
    """
    values, valid = series.values, series.valid
    if quantity == "orientation":
        steps = rotations.difference(values[1:], values[:-1])
        third = np.diff(steps, 2, axis=0)
    else:
        third = np.diff(values, 3, axis=0)
    whole = np.lib.stride_tricks.sliding_window_view(valid, 4).all(axis=-1) if valid.size >= 4 else valid[:0]
    usual = NOISE[quantity]
    if not whole.any():
        return usual
    # 1.4826: sd from the median of a normal distribution; 20 = 1 + 9 + 9 + 1; 1.2: interpolation has averaged
    sd = 1.2 * 1.4826 * float(np.median(np.abs(third[whole]))) / np.sqrt(20.0)
    sd *= 3.0 if "velocity" in quantity else 1.0
    sd = max(sd, *(_rounding(column) for column in held.values[held.valid].T))
    return float(f"{np.clip(sd, usual / 4.0, usual * 100.0):.2g}")


def _rounding(values: np.ndarray) -> float:
    """Sd of the rounding of samples (n,); 0 if they have no steps, or only those of a steady motion."""
    size = resolution(values)
    steps = np.round(np.diff(values) / size) if size else values[:0]
    steady = (steps[1:] == steps[:-1])[steps[1:] != 0.0]
    return size / np.sqrt(12.0) if steady.size and steady.mean() < 0.5 else 0.0
