"""Unknown numbers of a robot's drives: friction, inertia, gaps and encoders of joints, gains, delays."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from fnmatch import fnmatchcase
from typing import Any

import mujoco
import numpy as np

from amhe_cli.core.errors import ConfigError, one_of
from amhe_cli.init.names import words
from amhe_cli.init.signals import Guess, joint_of, single_joints
from amhe_cli.system.model.elements import (
    commanded,
    driven_joint,
    floats,
    followers,
    holds_position,
    names_of,
)
from amhe_cli.system.model.gaps import add_gaps

#: Numbers of an actuator that are equal where drives are.
_OF_ACTUATOR = ("gaintype", "biastype", "gainprm", "biasprm", "forcelimited", "forcerange", "gear")
#: Prior sd (log scale) and range, as a factor, of a number that the model gives.
_KNOWN = (0.5, 10.0)
#: Prior sd (log scale) and range, as a factor, of a number that the model leaves at zero.
_UNKNOWN = (1.0, 100.0)
#: Prior sd (log scale) of the gains that a model file gives its actuators.
GAIN_SD = 0.1
#: Numbers of a servo: the end of their parameter's name, and their prior sd (log scale) if a model has them.
_OF_SERVO = {
    "gain": ("gain", GAIN_SD),
    "actuator_damping": ("kv", GAIN_SD),
    "force_limit": ("force_limit", 0.2),
    "filter_time_constant": ("filter", 0.5),
}
#: Prior sd (log scale) of a servo's gains that nobody has measured: a factor of 4.5 either way at one sd.
_GUESSED_GAIN = 1.5
#: Delay from a command's stamp to its action [s]: real servos have 5 to 20 ms, and models leave it out.
_DELAY = 0.01
#: Prior sd of that delay [s].
_DELAY_SD = 0.01
#: Upper bound of that delay [s].
_LONGEST_DELAY = 0.1
#: Prior sd and largest zero of the encoder of a hinge [rad].
_ZERO_OF_HINGE = (0.05, 0.3)
#: Prior sd and largest zero of the encoder of a slide [m].
_ZERO_OF_SLIDE = (0.005, 0.03)
#: The same of the zero that a servo's command has beside its encoder's: firmware mostly counts from one, to a
#: few of its encoder's steps. With 10 mrad it passed for the sag of servos that are softer than their file.
_COMMAND_OF_HINGE, _COMMAND_OF_SLIDE = (0.003, 0.1), (0.0003, 0.01)
#: Width of a hinge's gap before a log is read, and its bounds [rad].
_GAP_OF_HINGE = (0.01, 0.0002, 0.1)
#: Width of a slide's gap before a log is read, and its bounds [m].
_GAP_OF_SLIDE = (0.0005, 0.00001, 0.01)
#: Frequency of a link on its locked drive [Hz]: arms with harmonic drives have 5 to 20.
_HERTZ = 10.0
#: Prior sd of the logarithm of a gap's width, and of a stiffness.
_GAP_SD = 1.0
#: Words that tell one of several parts alike.
_SIDES = {
    *("fl", "fr", "rl", "rr", "lf", "rf", "lr", "lh", "rh", "hl", "hr", "bl", "br", "l", "r"),
    *("left", "right", "front", "rear", "hind", "back"),
}
#: Where a servo whose rotor nobody gives is taken to swing [Hz].
SWING = 10.0
#: What is unknown of every joint: its word in `set:`, its field of MjModel, and what it means.
KINDS = (
    ("damping", "dof_damping", "viscous: torque per speed"),
    ("friction_loss", "dof_frictionloss", "dry: torque against any motion"),
    ("armature", "dof_armature", "inertia of rotor and gears, seen at the joint"),
)


def measured_joints(model: mujoco.MjModel, signals: Sequence[Guess]) -> list[str]:
    """Joints that the log measures, without those that follow others."""
    measured = {name for guess in signals for name in guess.entry.get("joints", ())}
    return [name for name in single_joints(model) if name in measured - followers(model).keys()]


def moved_by(signals: Sequence[Guess]) -> list[str]:
    """Actuators that the log commands."""
    return [name for guess in signals for name in guess.entry.get("actuators", ())]


def joint_parameters(
    spec: mujoco.MjSpec, model: mujoco.MjModel, joints: Sequence[str], group: bool
) -> Iterator[Guess]:
    """Armature, viscous and dry friction of joints.

    Args:
        spec: The model's source: it has the classes of joints.
        group: Equal drives share theirs.
    """
    groups = _groups(spec, model, joints) if group else {joint: [joint] for joint in joints}
    for name, alike in groups.items():
        of = f"of joint {alike[0]}" if len(alike) == 1 else f"of {len(alike)} joints alike"
        dofs = [int(model.joint(joint).dofadr[0]) for joint in alike]
        rotor = _rotor(model, dofs)
        added = 0.0 if model.dof_armature[dofs[0]] > 0.0 else rotor  # dof_M0 has what the model gives
        for kind, field, meaning in KINDS:
            value = float(getattr(model, field)[dofs[0]])
            # only the order of magnitude: damping that stops a motion in a second, friction worth 1 rad/s^2
            usual = rotor if kind == "armature" else float(np.median(model.dof_M0[dofs])) + added
            targets = [{"joint": joint, "set": kind} for joint in alike]
            entry = entry_of(value if value > 0.0 else usual, not value > 0.0, targets)
            source, note = "model", ""
            if value <= 0.0:
                source, note = "guess", "; the model has none: of the size of the joint's inertia"
            yield Guess(f"{name}_{kind}", entry, f"{meaning}, {of}{note}", source=source)


def _rotor(model: mujoco.MjModel, dofs: Sequence[int]) -> float:
    """Armature of joints that a model gives none [SI]: that with which their servo swings at SWING.

    A geared servo's rotor is most of its inertia, however light the link: a tenth of the link's is the least.
    """
    at = np.isin(model.actuator_trnid[:, 0], model.dof_jntid[list(dofs)]) & (model.actuator_trntype <= 1)
    stiffness = -model.actuator_biasprm[at, 1] * model.actuator_gear[at, 0] ** 2
    least = 0.1 * float(np.median(model.dof_M0[list(dofs)]))
    return max(least, *(stiffness / (2.0 * np.pi * SWING) ** 2).tolist()) if at.any() else least


def _groups(spec: mujoco.MjSpec, model: mujoco.MjModel, joints: Sequence[str]) -> dict[str, list[str]]:
    """Joints whose drives are equal: of one class, or named alike but for the side, and of equal numbers."""
    alike: dict[tuple[object, ...], list[str]] = {}
    for joint in joints:
        kind = spec.joint(joint).classname.name
        kind_of_drive = kin(joint) if kind == "main" else kind
        alike.setdefault((kind_of_drive, *_numbers(model, joint)), []).append(joint)
    groups: dict[str, list[str]] = {}
    for (kind_of_drive, *_), names in alike.items():
        name = names[0] if len(names) == 1 or str(kind_of_drive) in groups else str(kind_of_drive)
        groups[name] = names
    return groups


def _numbers(model: mujoco.MjModel, joint: str) -> tuple[float, ...]:
    """What a drive's data sheet would say, at six digits."""
    row, dof = model.joint(joint).id, int(model.joint(joint).dofadr[0])
    values = [np.ravel(getattr(model, field)[dof]) for _, field, _ in KINDS] + [model.jnt_type[[row]]]
    for actuator in np.flatnonzero((model.actuator_trnid[:, 0] == row) & (model.actuator_trntype <= 1)):
        values += [np.ravel(getattr(model, f"actuator_{name}")[actuator]) for name in _OF_ACTUATOR]
    return tuple(float(f"{value:.6g}") for value in np.concatenate(values))


def kin(name: str) -> str:
    """A name without the words and numbers that mark one of several alike: FL_foot and RR_foot are foot."""
    bare = [word for word in words(name) if word not in _SIDES and not word.isdigit()]
    return "_".join(bare) or name


def gain_scale(model: mujoco.MjModel, actuators: Sequence[str]) -> list[Guess]:
    """One factor on the gains of all actuators; none where nothing is commanded."""
    if not actuators:
        return []
    targets: list[dict[str, Any]] = [{"actuator": name, "set": "gain", "mode": "scale"} for name in actuators]
    limited = [target for target in targets if model.actuator(target["actuator"]).forcelimited[0]]
    for target in limited:
        target["carry_limit"] = True
    entry = entry_of(1.0, False, targets, GAIN_SD) | {"unit": "-"}
    why = (
        "factor on all actuator gains: masses and torques are relative to it, and position control does not "
        "determine it; delete it if the gains were measured"
    )
    if limited:
        why += (
            "; carry_limit: limits of force follow it, as with a wrong torque constant; a parameter of its "
            "own with {set: force_limit} makes them unknown"
        )
    return [Guess("gain_scale", entry, why)]


def servo_numbers(
    model: mujoco.MjModel, actuators: Sequence[str], guessed: bool, numbers: Sequence[str] = tuple(_OF_SERVO)
) -> Iterator[Guess]:
    """Stiffness, damping, limit of force and filter of each servo, as far as it has them.

    Args:
        actuators: Its actuators; motors are left out, as their gain is 1 and no guess.
        guessed: Nobody has measured the gains: `init` added the actuators.
        numbers: Words of `set:` of the numbers that are meant.
    """
    for name in actuators:
        row = model.actuator(name).id
        kind, filters = (
            commanded(model, row),
            (int(mujoco.mjtDyn.mjDYN_FILTER), int(mujoco.mjtDyn.mjDYN_FILTEREXACT)),
        )
        values = {
            "gain": model.actuator_gainprm[row, 0],
            "actuator_damping": -model.actuator_biasprm[row, 2] * (kind == "position"),
            "force_limit": model.actuator_forcerange[row, 1] * model.actuator_forcelimited[row],
            "filter_time_constant": model.actuator_dynprm[row, 0] * (model.actuator_dyntype[row] in filters),
        }
        for word in numbers if kind != "effort" else ():
            (suffix, sd), unknown = _OF_SERVO[word], guessed and word in ("gain", "actuator_damping")
            why = "a log determines it beside inertias where the drive saturates, or a mass is known"
            if unknown:
                sd, why = (
                    _GUESSED_GAIN,
                    "of the size of the joint's inertia: put the data sheet's in its place",
                )
            if values[word]:
                entry = entry_of(float(values[word]), unknown, [{"actuator": name, "set": word}], sd)
                source = "guess" if unknown else "model"
                yield Guess(f"{name}_{suffix}", entry, f"{word} of {name}: {why}", source=source)


def geared_joints(model: mujoco.MjModel, actuators: Sequence[str]) -> list[str]:
    """Joints with a gear, as far as a model shows it: of position servos, and motors with a ratio."""
    rows = [model.actuator(name).id for name in actuators]
    joints = [
        model.joint(model.actuator_trnid[row, 0]).name
        for row in rows
        if int(model.actuator_trntype[row]) <= int(mujoco.mjtTrn.mjTRN_JOINTINPARENT)
        and (
            commanded(model, row) == "position"
            or abs(model.actuator_gear[model.actuator_outadr[row], 0]) > 1.0
        )
    ]
    return [name for name in dict.fromkeys(joints) if name in single_joints(model)]


def delay(step: float) -> Iterator[Guess]:
    """The delay of all commands; without it, wrong dampings and gains would explain the lag.

    It is proposed in the middle of a time step [s], because slopes by it have a kink at multiples of one.
    """
    middle = (np.floor(_DELAY / step + 1e-6) + 0.5) * step
    entry = linear_entry(middle, (0.0, _LONGEST_DELAY), _DELAY_SD, {"set": "command_delay"})
    why = "delay of every command [s]: real servos have 5 to 20 ms"
    yield Guess("command_delay", entry, why, source="guess")


def actuator_parameters(
    spec: mujoco.MjSpec,
    model: mujoco.MjModel,
    signals: Sequence[Guess],
    guessed_gains: bool,
    group: bool,
    gains: bool = False,
) -> list[Guess]:
    """Armature, viscous and dry friction and the encoder's zero of each joint, and one delay of all commands.

    Gains are fixed: a log of positions shows only their ratio to masses, armatures and frictions. It shows
    more where a servo saturates, or a load is known.

    Args:
        spec: The model's source: it has the classes of joints.
        signals: Signals of the log; every joint that it measures has a drive.
        guessed_gains: Whether `init` added the actuators; then the masses are known better than the gains.
        group: Equal drives share their parameters, all but the zero of the encoder.
        gains: Gain, velocity gain, limit of force and filter of each servo are free, too.
    """
    joints, actuators = measured_joints(model, signals), moved_by(signals)
    guesses = [*joint_parameters(spec, model, joints, group), *zeros(model, joints, signals)]
    if gains:
        guesses += servo_numbers(model, actuators, guessed_gains)
    elif guessed_gains:  # unknown, but for the velocity terms
        guesses += servo_numbers(model, actuators, True, ("gain",))
        guesses += map(_fixed, servo_numbers(model, actuators, True, ("actuator_damping",)))
    else:
        guesses += map(_fixed, gain_scale(model, actuators))
    return [*guesses, *(delay(model.opt.timestep) if actuators else ())]


def _fixed(guess: Guess) -> Guess:
    why = (
        "fixed: the log shows only the ratio of gains to masses, armatures and frictions, which are in units "
        "of them; prior_sd: 0.1 if the gains are known to 10 %"
    )
    return Guess(guess.name, guess.entry | {"prior_sd": 0.0}, why, source=guess.source)


def ungrouped(parameters: Sequence[Guess]) -> list[str]:
    """A sentence where no two drives are equal, so that no parameter is shared."""
    of_joints = [guess for guess in parameters if "joint" in guess.entry["targets"][0]]
    if any(len(guess.entry["targets"]) > 1 for guess in of_joints):
        return []
    return ["`group`: no two drives are alike (same class or name but for the side, and same numbers)"]


def floating(model: mujoco.MjModel, signals: Sequence[Guess]) -> list[str]:
    """What to do where measured joints hang on a body that nothing holds."""
    loose = [name for name in measured_joints(model, signals) if floats(model, model.joint(name).id)]
    if not loose:
        return []
    body = model.body(model.body_rootid[model.joint(loose[0]).bodyid[0]]).name
    return [
        f"the base is not fixed: body {body} has a free joint. Hang the robot up or bolt it down, and delete "
        f"that joint from the model; else the base's motion and contacts hide what the drives do"
    ]


def zeros(model: mujoco.MjModel, joints: Sequence[str], signals: Sequence[Guess]) -> Iterator[Guess]:
    """The zero of each joint's encoder; commands are in its frame too."""
    for signal in signals:
        for joint in (name for name in signal.entry.get("joints", ()) if name in joints):
            slides = int(model.joint(joint).type[0]) == mujoco.mjtJoint.mjJNT_SLIDE
            sd, most = _ZERO_OF_SLIDE if slides else _ZERO_OF_HINGE
            target = {"signal": signal.name, "set": "bias", "joint": joint, "quantity": "position"}
            entry = linear_entry(0.0, (-most, most), sd, target)
            gravity = "gravity shows it"
            if not _lifts(model, joint):
                gravity = "nothing shows it: gravity's torque does not change with this joint"
            why = f"zero of the encoder of joint {joint}: the log reads angle + offset; {gravity}"
            yield Guess(f"{joint}_offset", entry, why, source="guess")


def command_zeros(model: mujoco.MjModel, signals: Sequence[Guess]) -> Iterator[Guess]:
    """The zero of each position servo's command, in its encoder's frame."""
    for signal in signals:
        for name in signal.entry.get("actuators", ()):
            joint = driven_joint(model, row := model.actuator(name).id)
            if joint is None or not holds_position(model, row):
                continue
            slides = int(model.joint(joint).type[0]) == mujoco.mjtJoint.mjJNT_SLIDE
            sd, most = _COMMAND_OF_SLIDE if slides else _COMMAND_OF_HINGE
            entry = linear_entry(
                0.0, (-most, most), sd, {"signal": signal.name, "set": "bias", "actuator": name}
            )
            why = (
                f"zero of the command of {name}: the servo goes to command - offset, as its encoder shows it"
            )
            yield Guess(f"{name}_command_offset", entry, why, source="guess")


def _lifts(model: mujoco.MjModel, joint: str) -> bool:
    """Whether gravity's forces on the joints change with the position of a joint."""
    data, column, rng = mujoco.MjData(model), int(model.joint(joint).qposadr[0]), np.random.default_rng(0)
    # joints stand somewhere, so that no axis is upright by chance
    for hinge in np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE):
        data.qpos[model.jnt_qposadr[hinge]] += rng.uniform(0.2, 0.4)
    forces = []
    for _ in range(2):
        mujoco.mj_forward(model, data)
        forces.append(data.qfrc_bias.copy())
        data.qpos[column] += 0.3
    return bool(np.abs(forces[1] - forces[0]).max() > 1e-9 * np.abs(forces[0]).max())


def gap_parameters(
    spec: mujoco.MjSpec,
    model: mujoco.MjModel,
    signals: Sequence[Guess],
    parameters: Sequence[Guess],
    wanted: Sequence[str],
    elastic: bool = False,
) -> list[Guess]:
    """Give joints a gap or an elastic drive, and move what `parameters` say of their drives to these.

    Args:
        spec: The model's source, which is changed.
        model: The model as it was.
        signals: Signals of the log; only joints that it measures and actuators move can have one.
        parameters: Their targets are changed.
        wanted: Joints, by names or patterns.
        elastic: Springs, not gaps.

    Returns:
        A parameter for the width of each gap, or the stiffness of each drive.

    Raises:
        ConfigError: No such joint is measured and moved by an actuator.
    """
    word = "elastic" if elastic else "backlash"
    moved = {joint_of(model, actuator) for actuator in names_of(model, "actuator")}
    joints = [joint for joint in measured_joints(model, signals) if joint in moved]
    for pattern in wanted:
        if not any(fnmatchcase(joint, pattern) for joint in joints):
            raise ConfigError(f"`{word}`: {one_of('joint that is measured and driven', pattern, joints)}")
    chosen = [joint for joint in joints if any(fnmatchcase(joint, pattern) for pattern in wanted)]
    entries = {joint: _elastic(model, joint) if elastic else _gap(model, joint) for joint in chosen}
    drives = add_gaps(spec, {joint: entry["nominal"] for joint, entry in entries.items()}, elastic)
    kinds = {kind for kind, _, _ in KINDS}
    for guess in parameters:
        for target in guess.entry["targets"]:
            if target["set"] in kinds and target.get("joint") in drives:
                target["joint"] = drives[target["joint"]]
    what = "stiffness between" if elastic else "free motion between"
    return [
        Guess(
            f"{joint}_{'drive_stiffness' if elastic else 'backlash'}",
            entry,
            f"{what} joint {joint} and its drive. The log is taken to measure the link: if the "
            f"encoder is on the motor, write joints: {{{drives[joint]}: {joint}}}",
            source="guess",
        )
        for joint, entry in entries.items()
    ]


def _gap(model: mujoco.MjModel, joint: str) -> dict[str, Any]:
    slides = int(model.joint(joint).type[0]) == mujoco.mjtJoint.mjJNT_SLIDE
    width, lower, upper = _GAP_OF_SLIDE if slides else _GAP_OF_HINGE
    entry = entry_of(width, True, [{"joint": joint, "set": "backlash"}], _GAP_SD)
    return entry | {"bounds": [lower, upper]}


def _elastic(model: mujoco.MjModel, joint: str) -> dict[str, Any]:
    inertia = float(model.dof_M0[model.joint(joint).dofadr[0]])
    stiffness = (2.0 * np.pi * _HERTZ) ** 2 * inertia
    return entry_of(stiffness, True, [{"joint": joint, "set": "drive_stiffness"}], _GAP_SD)


def entry_of(
    nominal: float, unknown: bool, targets: list[dict[str, Any]], sd: float | None = None
) -> dict[str, Any]:
    """A parameter on the log scale; `unknown`: the model has no value, and the prior is wide."""
    own_sd, factor = _UNKNOWN if unknown else _KNOWN
    return {
        "nominal": short(nominal),
        "bounds": [short(nominal / factor), short(nominal * factor)],
        "scale": "log",
        "prior_sd": sd or own_sd,
        "targets": targets,
    }


def linear_entry(
    nominal: float, bounds: tuple[float, float], sd: float, target: dict[str, Any]
) -> dict[str, Any]:
    """A parameter on the linear scale, which sets one number."""
    return {
        "nominal": short(nominal),
        "bounds": [short(bound) for bound in bounds],
        "scale": "linear",
        "prior_sd": short(sd),
        "targets": [target],
    }


def short(value: float) -> float:
    """The number at three digits."""
    return float(f"{value:.3g}")
