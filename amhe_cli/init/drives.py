"""Unknown numbers of a robot's drives: friction and inertia of joints, gains, delays, zeros of encoders."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import mujoco
import numpy as np

from amhe_cli.init.names import words
from amhe_cli.init.signals import Guess, single_joints
from amhe_cli.system.model.couplings import followers
from amhe_cli.system.model.elements import commanded

#: Numbers of an actuator that are equal where drives are.
_OF_ACTUATOR = ("gaintype", "biastype", "gainprm", "biasprm", "forcelimited", "forcerange", "gear")
#: Prior sd (log scale) and range, as a factor, of a number that the model gives.
_KNOWN = (0.5, 10.0)
#: Prior sd (log scale) and range, as a factor, of a number that the model leaves at zero.
_UNKNOWN = (1.0, 100.0)
#: Prior sd (log scale) of the gains that a model file gives its actuators.
GAIN_SD = 0.1
#: Prior sd (log scale) of a limit of force that a model file gives.
_LIMIT_SD = 0.2
#: Prior sd (log scale) of a servo's gains that nobody has measured: a factor of 4.5 either way at one sd.
_GUESSED_GAIN = 1.5
#: Delay from a command's stamp to its action [s]: real servos have 5 to 20 ms, and models leave it out.
_DELAY = 0.01
#: Prior sd of that delay [s].
_DELAY_SD = 0.01
#: Upper bound of that delay [s].
_LONGEST_DELAY = 0.1
#: Words that tell one of several parts alike.
_SIDES = {
    *("fl", "fr", "rl", "rr", "lf", "rf", "lr", "lh", "rh", "hl", "hr", "bl", "br", "l", "r"),
    *("left", "right", "front", "rear", "hind", "back"),
}
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
        model: The model.
        joints: The joints.
        group: Equal drives share theirs.
    """
    groups = _groups(spec, model, joints) if group else {joint: [joint] for joint in joints}
    for name, alike in groups.items():
        of = f"of joint {alike[0]}" if len(alike) == 1 else f"of {len(alike)} joints alike"
        dofs = [int(model.joint(joint).dofadr[0]) for joint in alike]
        for kind, field, meaning in KINDS:
            value = float(getattr(model, field)[dofs[0]])
            # only the order of magnitude: damping that stops a motion in a second, friction worth 1 rad/s^2,
            # a tenth of the inertia in the rotor
            usual = (0.1 if kind == "armature" else 1.0) * float(np.median(model.dof_M0[dofs]))
            targets = [{"joint": joint, "set": kind} for joint in alike]
            entry = entry_of(value if value > 0.0 else usual, not value > 0.0, targets)
            source, note = "model", ""
            if value <= 0.0:
                source, note = "guess", "; the model has none: of the size of the joint's inertia"
            yield Guess(f"{name}_{kind}", entry, f"{meaning}, {of}{note}", source=source)


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
    """A name without the words and numbers that tell one of several alike: FL_foot and RR_foot are foot."""
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


def servo_gains(model: mujoco.MjModel, actuators: Sequence[str]) -> Iterator[Guess]:
    """Stiffness and damping of each servo; a motor's gain is 1 and no guess."""
    for name in actuators:
        row = model.actuator(name).id
        if commanded(model, row) == "effort":
            continue
        note = "of the size of the joint's inertia: put the drive's data sheet in its place"
        gains = (
            ("gain", float(model.actuator_gainprm[row, 0]), f"the servo's kp, {note}"),
            (
                "actuator_damping",
                float(-model.actuator_biasprm[row, 2]),
                f"the servo's kv, {note}; the log shows only the sum of it and the joint's damping, unless "
                "it saturates",
            ),
        )
        gains = gains[:1] if commanded(model, row) == "velocity" else gains
        for kind, nominal, why in gains:
            entry = entry_of(nominal, True, [{"actuator": name, "set": kind}], _GUESSED_GAIN)
            yield Guess(f"{name}_{'gain' if kind == 'gain' else 'kv'}", entry, why, source="guess")


def drive_numbers(model: mujoco.MjModel, actuators: Sequence[str], guessed: bool) -> Iterator[Guess]:
    """Gain, velocity gain, limit of force and filter of each servo, as far as it has them."""
    why = "the model's; a log determines it beside inertias where the drive saturates, or a mass is known"
    for name in actuators:
        row = model.actuator(name).id
        if commanded(model, row) == "effort":
            continue
        filtered = int(model.actuator_dyntype[row]) in (
            int(mujoco.mjtDyn.mjDYN_FILTER),
            int(mujoco.mjtDyn.mjDYN_FILTEREXACT),
        )
        gain = (_GUESSED_GAIN if guessed else GAIN_SD), True
        for word, suffix, (sd, has) in (
            ("gain", "gain", gain),
            (
                "actuator_damping",
                "kv",
                (gain[0], commanded(model, row) == "position" and model.actuator_biasprm[row, 2]),
            ),
            ("force_limit", "force_limit", (_LIMIT_SD, model.actuator_forcelimited[row])),
            ("filter_time_constant", "filter", (_KNOWN[0], filtered)),
        ):
            if has:
                entry = {"scale": "log", "prior_sd": sd, "targets": [{"actuator": name, "set": word}]}
                yield Guess(f"{name}_{suffix}", entry, f"{word} of {name}; {why}")


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
        "prior_sd": sd,
        "targets": [target],
    }


def short(value: float) -> float:
    """The number at three digits."""
    return float(f"{value:.3g}")
