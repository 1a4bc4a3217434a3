"""The unknowns of every drive of a robot (`amhe init --actuators`): 4 for each joint, and one delay."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import mujoco
import numpy as np

from amhe_cli.init.drives import (
    delay,
    drive_numbers,
    gain_scale,
    joint_parameters,
    linear_entry,
    measured_joints,
    moved_by,
    servo_gains,
)
from amhe_cli.init.signals import Guess
from amhe_cli.system.model.couplings import floats

#: Prior sd and largest zero of the encoder of a hinge [rad].
_HINGE = (0.05, 0.3)
#: Prior sd and largest zero of the encoder of a slide [m].
_SLIDE = (0.005, 0.03)


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
        model: The model.
        signals: Signals of the log; every joint that it measures has a drive.
        guessed_gains: Whether `init` added the actuators; then the masses are known better than the gains.
        group: Equal drives share their parameters, all but the zero of the encoder.
        gains: Gain, velocity gain, limit of force and filter of each servo are free, too.
    """
    joints, actuators = measured_joints(model, signals), moved_by(signals)
    guesses = [*joint_parameters(spec, model, joints, group), *zeros(model, joints, signals)]
    free = drive_numbers(model, actuators, guessed_gains)
    guesses += free if gains else _gains(model, actuators, guessed_gains)
    return [*guesses, *(delay(model.opt.timestep) if actuators else ())]


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
            sd, most = _SLIDE if slides else _HINGE
            target = {"signal": signal.name, "set": "bias", "joint": joint, "quantity": "position"}
            entry = linear_entry(0.0, (-most, most), sd, target)
            gravity = "gravity shows it"
            if not _lifts(model, joint):
                gravity = "nothing shows it: gravity's torque does not change with this joint"
            why = f"zero of the encoder of joint {joint}: the log reads angle + offset; {gravity}"
            yield Guess(f"{joint}_offset", entry, why, source="guess")


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


def _gains(model: mujoco.MjModel, actuators: Sequence[str], guessed: bool) -> Iterator[Guess]:
    """Gains that `init` guessed are unknown; those of the model are fixed, and so is the velocity term."""
    gains = [*servo_gains(model, actuators)] if guessed else gain_scale(model, actuators)
    for gain in gains:
        if not guessed:
            why = (
                "fixed: the log shows only the ratio of gains to masses, armatures and frictions, which are "
                "in units of them; prior_sd: 0.1 if the gains are known to 10 %"
            )
            yield Guess(gain.name, gain.entry | {"prior_sd": 0.0}, why)
        elif gain.entry["targets"][0]["set"] == "gain":
            yield gain
        else:
            yield Guess(gain.name, gain.entry | {"prior_sd": 0.0}, f"fixed: {gain.why}", source="guess")
