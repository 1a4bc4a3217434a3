"""The model of a first system folder: copied with its files, given actuators if it is a URDF."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

import mujoco

from amhe_cli.init.names import is_command, matched, words
from amhe_cli.init.signals import Topic, single_joints
from amhe_cli.system.export import portable

#: Servo that a URDF's joint gets: natural frequency [rad/s] against the joint's inertia, damping ratio.
_SERVO = (30.0, 0.7)


def add_servos(spec: mujoco.MjSpec, model: mujoco.MjModel, topics: Sequence[Topic]) -> list[str]:
    """Give a URDF, which has no actuators, one for each joint that a command topic names."""
    notes = ["a URDF has no actuators, and MuJoCo fixes its root to the world"]
    for topic in topics:
        if not is_command(topic.name, topic.type):
            continue
        joints = matched({name: (name,) for name in single_joints(model)}, topic.entries)
        if topic.type.endswith("MultiArray") and f"[{len(single_joints(model))}]" in topic.entries:
            joints = {name: name for name in single_joints(model)}
        torque = bool({"effort", "torque", "torques", "efforts"} & set(words(topic.name)))
        for joint in joints:
            actuator = spec.add_actuator(name=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT, target=joint)
            if torque:
                actuator.set_to_motor()
                continue
            frequency, ratio = _SERVO
            inertia = float(model.dof_M0[int(model.joint(joint).dofadr[0])])
            kp, kv = frequency**2 * inertia, 2.0 * ratio * frequency * inertia
            actuator.set_to_position(kp=float(f"{kp:.3g}"), kv=float(f"{kv:.3g}"))
        if joints:
            kind = "torque motors" if torque else "position servos of guessed gain"
            better = (
                "correct their gains in the model" if torque else "put the data sheet's gains in their place"
            )
            notes.append(f"{len(joints)} {kind} were added for {topic.name}: {better}")
            return notes
    return notes


def copy_model(spec: mujoco.MjSpec, path: Path, folder: Path, rewrite: bool) -> str:
    """Copy an MJCF with its files; a URDF, or files spread over folders, are written as a new MJCF."""
    home = path.resolve().parent
    text, assets = portable(spec, path.parent)
    named = (Path(name) for name in mujoco.mju_getXMLDependencies(str(path.resolve())))
    included = [(home / name).resolve() for name in named if name.suffix == ".xml"]
    files = list(dict.fromkeys((path.resolve(), *included, *assets.values())))
    if rewrite or not all(file.is_relative_to(home) and file.is_file() for file in files):
        (folder / "model.xml").write_text(text)
        copies = {folder / name: source for name, source in assets.items()}
    else:
        copies = {folder / file.relative_to(home): file for file in files}
    for place, source in copies.items():
        place.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source, place)
    return path.name if folder / path.name in copies else "model.xml"
