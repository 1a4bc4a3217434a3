"""A real SO-101 arm (docs/real.md): what do friction of gears and servos as they are built buy?

    python benchmarks/so101.py [--jobs 3] [--max-time 420] [--variants 0,3] [--fit figure_eight]
    python benchmarks/so101.py --lifting

Four motions are fitted, and the figure eight is predicted, by the example system and by others that add what
the arm's Feetech STS3215 is at 12 V and gain 32: one set of numbers for all joints; friction joint by joint;
all friction, damping and armature joint by joint, with sag and back-EMF; and the friction model M6 by joint.
Errors are rms over the six joints, as a ratio to those of the maker's MJCF on the same clips; once more where
the arm moves freely, since in a third of the figure eight the gripper touches something (docs/real.md).
`--fit` fits other motions: the figure eight itself shows what its model can reach at best.
`--lifting` shows what friction takes while joints move slowly, with gravity and against it, and how the
joints' errors change where the gripper touches something.
"""

from __future__ import annotations

import argparse
import logging
import shutil
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from common import DATA, PROJECT, over_seeds, show

import amhe_cli as amhe
from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.log import Window
from amhe_cli.engine.open import open_engine
from amhe_cli.estimation.validation.prediction import errors_of, starts

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
FITTED = ("chirp_sweep", "multisine", "prbs_excitation", "friction_gravity")
#: Numbers of the servo's firmware and gear: nominal value, sd and bounds; linear.
SERVO = {
    "load_friction": (0.2, 0.1, [-0.5, 1.5], "joint"),
    "stribeck_friction": (0.05, 0.08, [-0.5, 1.0], "joint"),
    "punch": (0.016, 0.02, [-0.1, 0.2], "actuator"),
    "dead_band": (0.0015, 0.002, [-0.02, 0.03], "actuator"),
}

#: The shoulder's lift [rad] above which the gripper's motion is held up: errors bend there in three joints.
PRESSES = 0.41
#: Stiffness of the servos at 12 V and gain 32 [N m/rad].
GAIN = 28.9
#: A filter of the targets, which the model needs a time constant for.
FILTER = {
    "filter": {
        "nominal": 0.013,
        "prior_sd": 0.7,
        "targets": [{"actuator": "*", "set": "filter_time_constant"}],
    }
}


def _linear(nominal: float, sd: float, bounds: list[float], targets: list[dict[str, str]]) -> dict[str, Any]:
    return {"nominal": nominal, "prior_sd": sd, "bounds": bounds, "scale": "linear", "targets": targets}


def systems() -> dict[str, dict[str, Any]]:
    """Parameters over those of the example, by variant."""
    gains = {f"{joint}_gain": {"nominal": GAIN, "bounds": [3, 300], "prior_sd": 0.3} for joint in JOINTS}
    zeros = {f"{joint}_zero": {"bounds": [-1, 1], "prior_sd": 0.1} for joint in JOINTS[1:4]}
    shared = {
        word: _linear(nominal, sd, bounds, [{kind: "*", "set": word}])
        for word, (nominal, sd, bounds, kind) in SERVO.items()
    }
    each = {
        f"{joint}_{word}": _linear(*SERVO[word][:3], [{"joint": joint, "set": word}])
        for joint in JOINTS
        for word in ("load_friction", "stribeck_friction")
    }
    firmware = {word: shared[word] for word in ("punch", "dead_band")}
    supply = {
        "supply_sag": _linear(0.1, 0.15, [-0.5, 1.5], [{"actuator": "*", "set": "supply_sag"}]),
        "back_emf": _linear(0.0, 0.3, [-2.0, 3.0], [{"actuator": "*", "set": "back_emf"}]),
    }
    m6 = {
        f"{joint}_{word}": _linear(nominal, sd, [-1.0, 1.5], [{"joint": joint, "set": word}])
        for joint in JOINTS
        for word, nominal, sd in (
            ("load_friction_motor", 0.2, 0.1),
            ("load_friction_external", 0.2, 0.1),
            ("stribeck_friction", 0.05, 0.08),
            ("stribeck_load_friction", 0.0, 0.1),
            ("load_friction_quadratic", 0.0, 0.05),
        )
    }
    dry = {
        f"{joint}_{word}": {
            "nominal": 1.0,
            "prior_sd": 0.5,
            "unit": "-",
            "targets": [{"joint": joint, "set": word, "mode": "scale"}],
        }
        for joint in JOINTS
        for word in ("friction_loss", "damping", "armature")
    }
    bus = {
        "delay": {"nominal": 0.05, "prior_sd": 0.5},
        "damping": {"nominal": 0.1, "prior_sd": 1.0},
        "force_limit": {
            "nominal": 5.28,
            "prior_sd": 0.3,
            "targets": [{"actuator": "*", "set": "force_limit"}],
        },
        "kv": {"nominal": 0.1, "prior_sd": 1.0, "targets": [{"actuator": "*", "set": "actuator_damping"}]},
        "back_emf": _linear(1.16, 0.3, [0.0, 4.0], [{"actuator": "*", "set": "back_emf"}]),
    }
    return {
        "constant friction": {},
        "servos as built": gains | zeros | shared,
        "the same, friction joint by joint": gains | zeros | firmware | each,
        "also all other friction by joint, sag, back-EMF": gains | zeros | firmware | each | supply | dry,
        "M6 joint by joint": gains | zeros | firmware | m6,
        "back-EMF and limit of the data sheet, longer delay": gains | zeros | firmware | each | dry | bus,
        "the same, and a filter of targets": gains | zeros | firmware | each | dry | bus | FILTER,
    }


def free_error(system: amhe.System, log: amhe.Log, z: np.ndarray) -> float:
    """Mean square error of z (d,) after half a second where the arm moves freely [rad^2]."""
    free = log["joints.position"].values[:, 1] < PRESSES
    edges = np.flatnonzero(np.diff(np.concatenate(([0], free.astype(int), [0])))).reshape(-1, 2).tolist()
    parts = [Window(log, first, last - first) for first, last in edges]
    found = errors_of(system, starts(system, parts, 0.5), open_engine(system, threads=1), z)
    return float(np.mean([np.nanmean(one.errors[0] ** 2) for one in found]))


def trial(number: int, fitted: Sequence[str], most: float) -> dict[str, Any]:
    """Identify by some motions with one variant, for at most so long [s]."""
    logging.disable(logging.WARNING)
    name, parameters = list(systems().items())[number]
    with tempfile.TemporaryDirectory() as folder:
        shutil.copytree(PROJECT / "examples" / "systems" / "so101", folder, dirs_exist_ok=True)
        if "filter" in parameters:
            scene = Path(folder) / "scene.xml"
            scene.write_text(scene.read_text().replace("<position ", '<position timeconst="0.013" '))
        system = amhe.System.load(folder, {"parameters": parameters}, warn=False)
    logs = [amhe.read_log(DATA / "so101" / motion, system) for motion in fitted]
    # of no file: `identify` refuses to judge by one that it fits, which `--fit` may ask for
    held_out = replace(amhe.read_log(DATA / "so101" / "figure_eight", system), file=None)
    began = time.process_time()
    result = amhe.identify(system, logs, held_out=held_out, threads=1, max_time=most)
    assert result.found.held_out is not None
    errors: dict[str, list[float]] = {}
    for one in result.found.held_out.horizons:
        at = errors.setdefault("end" if one.to_end else f"{one.horizon:g} s", [0.0, 0.0])
        at[0] += one.initial**2 / len(JOINTS)
        at[1] += one.identified**2 / len(JOINTS)
    space = system.space
    found = space.z_of(np.array([result.parameters[name].estimate for name in space.names]))
    errors["0.5 s, free"] = [free_error(system, held_out, z) for z in (np.zeros_like(found), found)]
    print(name, {at: np.degrees(np.sqrt(pair)).round(3).tolist() for at, pair in errors.items()}, flush=True)
    return {
        "name": name,
        "errors": {at: np.degrees(np.sqrt(pair)).tolist() for at, pair in errors.items()},
        "values": {n: [p.estimate, p.sd, p.verdict] for n, p in result.parameters.items()},
        "cpu_seconds": time.process_time() - began,
    }


def errors_and_speeds(motion: str) -> tuple[amhe.System, FloatArray, FloatArray, FloatArray]:
    """The system; the angles of a motion (n, 6), the targets less these [rad], and their speeds [deg/s]."""
    system = amhe.System.load(PROJECT / "examples" / "systems" / "so101", warn=False)
    log = amhe.read_log(DATA / "so101" / motion, system)
    rows = np.flatnonzero(log["joints.position"].sampled)
    angles, targets = (log[f"{name}.position"].values[rows] for name in ("joints", "targets"))
    smooth = [np.convolve(np.pad(angle, 7, mode="edge"), np.full(15, 1 / 15), "valid") for angle in angles.T]
    return (
        system,
        angles,
        targets - angles,
        np.degrees(np.gradient(np.transpose(smooth), rows * log.dt, axis=0)),
    )


def lifting() -> None:
    """Medians in the slow motion: the torque that `GAIN` makes, and gravity's by the masses of the MJCF."""
    system, angles, errors, speeds = errors_and_speeds("friction_gravity")
    model, data = system.model, mujoco.MjData(system.model)
    joints = [model.joint(name) for name in JOINTS]
    places, dofs = [int(one.qposadr[0]) for one in joints], [int(one.dofadr[0]) for one in joints]
    gravity = np.empty_like(angles)
    for i, angle in enumerate(angles):
        data.qpos[places] = angle
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_rne(model, data, 0, data.qfrc_bias)
        gravity[i] = data.qfrc_bias[dofs]
    up, weight, slow = np.sign(gravity), abs(gravity), (abs(speeds) > 2.0) & (abs(speeds) < 6.0)
    motor, table = up * GAIN * errors, []
    for j, name in enumerate(JOINTS):
        ways = [(slow & (way * up * speeds > 0.0))[:, j] for way in (1.0, -1.0)]
        found = [np.median(weight[slow[:, j], j]), *(np.median(motor[at, j]) for at in ways)]
        found += [np.median(abs(motor - weight)[at, j]) for at in ways]
        found += [np.median(0.2 + 0.5 * abs(motor + weight)[at, j]) for at in ways]
        table.append((name, *(f"{one:.2f}" for one in found)))
    columns = ("joint", "gravity", "motor, lifting", "lowering", "friction, lifting", "lowering")
    show("slow motion of an SO-101 [N m]", (*columns, "0.2 + 0.5 (load - motor)", "lowering"), table)


def touching() -> None:
    """Medians of the figure eight: targets less angles by where the shoulder's lift is, and which way."""
    _, angles, errors, speeds = errors_and_speeds("figure_eight")
    lift, spans = (
        np.degrees(angles[:, 1]),
        ((14.0, 20.0), (20.0, np.degrees(PRESSES)), (26.0, 28.0), (28.0, 30.0)),
    )
    table = [
        (
            f"{way}, {low:.0f}° to {high:.0f}°",
            *(f"{one:+.1f}°" for one in np.degrees(np.median(errors[at], axis=0))),
        )
        for way, sign in (("up", 1.0), ("down", -1.0))
        for low, high in spans
        if (at := (lift > low) & (lift <= high) & (sign * speeds[:, 1] > 0.5)).any()
    ]
    show("figure eight of an SO-101, targets less angles", ("the lift moves", *JOINTS), table)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--jobs", type=int, default=3, help="processes")
    parser.add_argument("--max-time", type=float, default=420.0, help="of each search [s]")
    every = range(len(systems()))
    parser.add_argument(
        "--variants", type=lambda text: [int(one) for one in text.split(",")], default=every, metavar="I,..."
    )
    parser.add_argument("--fit", nargs="+", default=FITTED, metavar="MOTION", help="the motions to fit")
    parser.add_argument(
        "--lifting", action="store_true", help="friction in the slow motion, nothing identified"
    )
    given = parser.parse_args()
    if given.lifting:
        lifting()
        touching()
        return
    name, fitted = f"so101-{given.max_time:g}", tuple(given.fit)
    name += "" if fitted == FITTED else "-" + "-".join(fitted)
    fit = partial(trial, fitted=fitted, most=given.max_time)
    done = over_seeds(name, fit, sorted({0, *given.variants}), given.jobs)
    maker = {at: initial for at, (initial, _) in done[0]["errors"].items()}
    rows = [("maker's MJCF", *(f"{error:.2f}°" for error in maker.values()), "", "")]
    for one in done:
        found = [f"{error:.2f}°, {error / maker[at]:.2f}" for at, (_, error) in one["errors"].items()]
        claimed = sum(verdict in ("identified", "conditional") for _, _, verdict in one["values"].values())
        rows.append(
            (one["name"], *found, f"{claimed} of {len(one['values'])}", f"{one['cpu_seconds']:.0f} s")
        )
    show("held-out error of an SO-101", ("after", *maker, "claimed", "CPU"), rows)


if __name__ == "__main__":
    main()
