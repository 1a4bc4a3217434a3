"""The model of a first system folder: copied with its files, given actuators if it is a URDF."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

import mujoco

from amhe_cli.init.names import is_command, matched, words
from amhe_cli.init.signals import Topic, gives_pose, guess_signals, single_joints
from amhe_cli.system.export.mjcf import portable
from amhe_cli.system.model.elements import followers
from amhe_cli.system.model.files import compiled

#: Servo that a URDF's joint gets: natural frequency [rad/s] against the joint's inertia, damping ratio.
_SERVO = (30.0, 0.7)

#: What a command topic carries -> the actuators that it needs, and what is to be corrected in them.
_KINDS = {
    "position": ("position servos of guessed gain", "put the data sheet's gains in their place"),
    "velocity": ("velocity servos of guessed gain", "put the data sheet's gains in their place"),
    "effort": ("torque motors", "correct their gains in the model"),
}
#: Name of the floor that a free URDF gets.
_FLOOR = "floor"
#: Depth [m] from which parts that touch lie inside each other.
_OVERLAP = 2e-3


def overlaps(model: mujoco.MjModel) -> list[str]:
    """Parts that lie inside each other where the model starts, a sentence for each pair of bodies."""
    data = mujoco.MjData(model)
    if model.nkey:
        mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    depths: dict[tuple[str, ...], float] = {}
    for contact in data.contact[: data.ncon]:
        flat = model.geom_type[contact.geom] <= int(mujoco.mjtGeom.mjGEOM_HFIELD)  # a floor
        if not flat.any() and contact.dist < -_OVERLAP:
            pair = tuple(model.body(int(model.geom_bodyid[geom])).name or "a body" for geom in contact.geom)
            depths[pair] = max(depths.get(pair, 0.0), -float(contact.dist))
    return [
        f"{first} and {second} overlap by {1e3 * depth:.2g} mm where the model starts, and their contact "
        f'hinders the joints between them: if the robot\'s do not touch, add <exclude body1="{first}" '
        f'body2="{second}"/> to <contact> of the model'
        for (first, second), depth in depths.items()
    ]


def notes_on_urdf(spec: mujoco.MjSpec, model: mujoco.MjModel) -> list[str]:
    """Sentences about what MuJoCo makes of a URDF."""
    notes = [
        f"joint {joint} follows {leader}: it is no unknown" for joint, leader in followers(model).items()
    ]
    if spec.excludes:
        number = len(spec.excludes)
        notes.append(
            f"pairs of links that are joined, or overlap at the zero pose, and do not collide: {number}"
        )
    return notes


def free_root(spec: mujoco.MjSpec, topics: Sequence[Topic]) -> list[str]:
    """Let the root of a URDF move freely, above a floor, if a topic gives its pose; sentences about it."""
    root = spec.worldbody.bodies[0] if len(spec.worldbody.bodies) == 1 else None
    if root is None or len(root.joints):
        return []
    sources = [topic for topic in topics if gives_pose(topic, root.name)]
    moving = spec.copy()
    moving.body(root.name).add_freejoint(name=root.name)
    guesses = guess_signals(compiled(moving), topics) if sources else []
    source = next((guess.entry["topic"] for guess in guesses if guess.entry.get("body") == root.name), None)
    unsaid = f"a URDF does not say whether its root moves: {root.name}"
    if source is None:
        return [f"{unsaid} is fixed to the world, because no topic gives its pose"]
    root.add_freejoint(name=root.name)
    spec.worldbody.add_geom(name=_FLOOR, type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1])
    spec.option.cone, spec.option.impratio = mujoco.mjtCone.mjCONE_ELLIPTIC, 10.0  # feet stick to it
    return [f"{unsaid} is free, because {source} gives its pose; a floor at z = 0 was added"]


def add_servos(spec: mujoco.MjSpec, model: mujoco.MjModel, topics: Sequence[Topic]) -> list[str]:
    """Give a URDF, which has no actuators, one for each joint that a command topic names."""
    notes = ["a URDF has no actuators"]
    led = followers(model)
    joints_alone = [name for name in single_joints(model) if name not in led]
    for topic in topics:
        if not is_command(topic.name, topic.type):
            continue
        joints = matched({name: (name,) for name in joints_alone}, topic.entries)
        if topic.type.endswith("MultiArray") and f"[{len(joints_alone)}]" in topic.entries:
            joints = {name: name for name in joints_alone}
        effort = bool({"effort", "torque", "torques", "efforts"} & set(words(topic.name)))
        kind = "effort" if effort else next((key for key in _KINDS if key in topic.quantities), "position")
        for joint in joints:
            actuator = spec.add_actuator(name=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT, target=joint)
            frequency, ratio = _SERVO
            inertia = float(model.dof_M0[int(model.joint(joint).dofadr[0])])
            kp, kv = frequency**2 * inertia, 2.0 * ratio * frequency * inertia
            if kind == "effort":
                actuator.set_to_motor()
            elif kind == "velocity":
                actuator.set_to_velocity(kv=float(f"{kv:.3g}"))
            else:
                actuator.set_to_position(kp=float(f"{kp:.3g}"), kv=float(f"{kv:.3g}"))
        if joints:
            added, cure = _KINDS[kind]
            notes.append(f"{len(joints)} {added} were added for {topic.name}: {cure}")
            return notes
    return notes


def copy_model(spec: mujoco.MjSpec, path: Path, folder: Path, rewrite: bool) -> str:
    """Copy an MJCF with its files; a URDF, or files spread over folders, are written as a new MJCF."""
    home = path.resolve().parent
    text, assets = portable(spec, path.parent)
    named = () if rewrite else mujoco.mju_getXMLDependencies(str(path.resolve()))
    # MuJoCo misses some files of these, and `portable` those of attached models; what exists is needed
    candidates = (path.resolve(), *((home / name).resolve() for name in named), *assets.values())
    files = [file for file in dict.fromkeys(candidates) if file.is_file()]
    if rewrite or not all(file.is_relative_to(home) for file in files):
        (folder / "model.xml").write_text(text, encoding="utf-8")
        copies = {folder / name: source for name, source in assets.items() if source.is_file()}
    else:
        copies = {folder / file.relative_to(home): file for file in files}
    for place, source in copies.items():
        place.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source, place)
    return path.name if folder / path.name in copies else "model.xml"
