"""Matching the topics of a log to the parts of a model, by names and types."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import mujoco

from amhe_cli.core.yaml_file import flow
from amhe_cli.init.names import in_motor_order, is_command, joint_paths, matched, names_the_same, words
from amhe_cli.system.model.elements import commanded, driven_joint, followers, names_of

#: Default noise sd [SI]; an estimate from the log replaces it where there is one.
NOISE = {
    "position": 0.002,
    "effort": 0.02,
    "velocity": 0.05,
    "orientation": 0.01,
    "linear_velocity": 0.1,
    "angular_velocity": 0.2,
    "linear_acceleration": 0.5,
}
#: Types that carry a pose, the best first: an odometry has the twist too.
_POSES = ("Odometry", "PoseWithCovarianceStamped", "PoseStamped", "TransformStamped", "Pose", "TFMessage")
#: Foxglove's types that carry what types of ROS do.
_TWINS = {
    "JointStates": "JointState",
    "PoseInFrame": "PoseStamped",
    "FrameTransform": "TransformStamped",
    "FrameTransforms": "TFMessage",
}
#: Packages whose types, where they are not built in, hold no state of joints.
_STATELESS = {
    *("std_msgs", "sensor_msgs", "geometry_msgs", "nav_msgs", "visualization_msgs", "diagnostic_msgs"),
    *("rcl_interfaces", "rosgraph_msgs", "builtin_interfaces", "tf2_msgs", "trajectory_msgs", "action_msgs"),
    *("stereo_msgs", "shape_msgs", "dynamic_reconfigure", "bond", "actionlib_msgs", "lifecycle_msgs"),
    *("foxglove", "foxglove_msgs", "table"),
}


@dataclass(frozen=True, slots=True)
class Topic:
    """One readable topic of a log.

    Args:
        name, type: Name and type, as the log declares them.
        rate: Number of messages per second.
        entries: Names in its messages: joints, child frames; '[n]' for an array of n numbers.
        quantities: Quantities that it carries, keys of QUANTITIES.
        columns: For a part of a table, quantity -> its columns, in the order of `entries`.
        table: The table's name.
        paths: Of a type that is not built in, paths of its numbers -> their count where they are arrays.
        rivals: Of a part of a table, columns that hold the same as others, which were taken.
    """

    name: str
    type: str
    rate: float
    entries: tuple[str, ...]
    quantities: tuple[str, ...]
    columns: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    table: str = ""
    paths: Mapping[str, int | None] = field(default_factory=dict)
    rivals: tuple[str, ...] = ()

    @property
    def kind(self) -> str:
        """Its type without the package; of Foxglove's types, that of the twin in ROS."""
        package, _, kind = self.type.replace("/", ".").rpartition(".")
        return _TWINS.get(kind, kind) if package.startswith("foxglove") else kind


@dataclass
class Guess:
    """One entry of the file to be written.

    Args:
        name: Key of the entry.
        entry: Keys and values of the entry, without its noise.
        why: The guess in one sentence.
        noise: Quantity -> sd; None: it sets the state and is not compared.
        source: Where it is from: 'model', 'log', 'names' (of columns and topics), 'data sheet', or 'guess'.
    """

    name: str
    entry: dict[str, Any]
    why: str
    noise: dict[str, float | None] = field(default_factory=dict)
    source: str = "model"


def guess_signals(model: mujoco.MjModel, topics: Sequence[Topic]) -> list[Guess]:
    """The signals of a log that match parts of a model."""
    guesses = [*_joint_states(model, topics), *_commands(model, topics)]
    guesses += [*_bodies(model, topics), *_imus(model, topics)]
    for index, guess in enumerate(guesses):
        taken = {other.name for other in guesses[:index]}
        base, number = guess.name, 1
        while guess.name in taken:
            number += 1
            guess.name = f"{base}_{number}"
    return guesses


def notes_on(
    model: mujoco.MjModel, topics: Sequence[Topic], guesses: Sequence[Guess], *, efforts: bool = False
) -> list[str]:
    """Sentences about what was not found, and which topics were not used.

    Args:
        topics: Topics of the log.
        guesses: The signals.
        efforts: Efforts are matched, whatever commands the joints.
    """
    measured = {name for guess in guesses for name in guess.entry.get("joints", ())}
    led = {follower for follower, leader in followers(model).items() if leader in measured}
    lost = [name for name in single_joints(model) if name not in measured | led]
    notes = [f"no topic measures joint {', '.join(lost)}: each clip starts it at zero"] if lost else []
    if efforts:
        pass
    elif not any("actuators" in guess.entry for guess in guesses):
        idle = "the actuators hold the control 0" if model.nactuator else "nothing drives the joints"
        notes += [f"no command topic was found: {idle}"] if measured else []
        measured_by = [guess for guess in guesses if "joints" in guess.entry]
        notes += [note for guess in measured_by if (note := _torques(model, guess, topics))]
    else:
        notes += [note for guess in guesses if (note := _efforts(guess, topics))]
    free = {guess.entry.get("body") for guess in guesses}
    notes += [
        f"no topic gives the pose of free body {body}" for body in free_bodies(model) if body not in free
    ]
    used = {guess.entry["topic"] for guess in guesses}
    notes += _proposals(model, [topic for topic in topics if topic.name not in used], guesses)
    for guess in guesses:
        topic = next(topic for topic in topics if topic.name == guess.entry["topic"])
        taken = guess.entry.get("quantity", topic.quantities[0])
        spare = [name for q, names in topic.columns.items() if q != taken for name in names]
        left = [*topic.rivals, *(spare if "actuators" in guess.entry else ())]
        if left:
            notes.append(f"not used: {', '.join(left)}: other columns were taken in their place")
    return notes + [f"not used: {_named(topic)}" for topic in topics if topic.name not in used]


def _efforts(guess: Guess, topics: Sequence[Topic]) -> str:
    """What to do with efforts of a table that are neither compared nor a command; empty: there are none."""
    topic = next((t for t in topics if t.name == guess.entry["topic"]), None)
    if topic is None or "joints" not in guess.entry or "effort" in guess.noise:
        return ""
    if not (columns := topic.columns.get("effort")):
        return ""
    return (
        f"not compared: the efforts {', '.join(columns)}; to compare them, add effort: "
        f"[{', '.join(columns)}] to columns of {guess.name}, and effort to its noise; where they are "
        f"currents, a parameter with {{signal: {guess.name}, set: scale, quantity: effort, joint: NAME}} "
        f"is a joint's torque constant"
    )


def _named(topic: Topic) -> str:
    """A topic with its type; a table's part with its columns."""
    if not topic.type.startswith("table/"):
        return f"{topic.name} ({topic.type})"
    return ", ".join(column for several in topic.columns.values() for column in several) or topic.name


def _proposals(model: mujoco.MjModel, unused: Sequence[Topic], guesses: Sequence[Guess]) -> Iterator[str]:
    """Signals for forces and mocap bodies, which no name decides."""
    site = next(iter(names_of(model, "site")), "SITE")
    body = next(iter(free_bodies(model)), "BODY")
    for topic in unused:
        name = "_".join(words(topic.name))
        if topic.kind in ("Wrench", "WrenchStamped"):
            yield (
                f"{topic.name} holds forces. To compare them with the model's at a site, add "
                f"{name}: {{topic: {topic.name}, site: {site}, noise: {{force: 0.5, torque: 0.05}}}}; if "
                f"they drive a body, {name}: {{topic: {topic.name}, force_on: {body}}}"
            )
    driven = {guess.entry.get("mocap") for guess in guesses}
    source = next((topic.name for topic in unused if topic.kind in _POSES), "TOPIC")
    for mocap in names_of(model, "body"):
        if model.body(mocap).mocapid[0] >= 0 and mocap not in driven:
            yield (
                f"no topic is named like the mocap body {mocap}. Add the signal "
                f"{mocap}: {{topic: {source}, mocap: {mocap}}}"
            )


def measured_as(guess: Guess) -> dict[str, str]:
    """Joints of a signal -> their names in the log."""
    named = guess.entry["joints"]
    return dict(named) if isinstance(named, Mapping) else {joint: joint for joint in named}


def torque_entry(model: mujoco.MjModel, guess: Guess, topics: Sequence[Topic]) -> dict[str, Any]:
    """A signal of the torques that were measured beside a signal's joints; {} where there are none.

    Where the model has actuators, joints without one are passive: no torque drives them.
    """
    topic = next(topic for topic in topics if topic.name == guess.entry["topic"])
    names = measured_as(guess)
    driven = {joint_of(model, actuator) for actuator in names_of(model, "actuator")} or set(names)
    names = {str(joint): logged for joint, logged in names.items() if joint in driven}
    if not names or (topic.columns and "effort" not in topic.columns):
        return {}
    entry: dict[str, Any] = {"topic": topic.name, "joint_force": _plain_names(names)}
    if topic.columns:
        columns = dict(zip(topic.entries, topic.columns["effort"], strict=True))
        several = len({other.table for other in topics if other.columns}) > 1
        entry = {"topic": topic.table} if several else {}
        entry |= {
            "columns": {"effort": [columns[logged] for logged in names.values()]},
            "joint_force": list(names),
        }
    return entry


def _torques(model: mujoco.MjModel, guess: Guess, topics: Sequence[Topic]) -> str:
    """How to drive the model by measured torques, in YAML to be pasted; empty where there are none."""
    if not (entry := torque_entry(model, guess, topics)):
        return ""
    topic = next(topic for topic in topics if topic.name == guess.entry["topic"])
    text = flow({"torque": entry})
    return f"if {topic.name} holds the motors' torques, they can drive the model. Add the signal {text[1:-1]}"


def foreign(topics: Sequence[Topic]) -> list[Topic]:
    """Topics of message types that are neither built in nor of a common package: they may hold the state."""
    unread = [topic for topic in topics if not topic.quantities]
    return [topic for topic in unread if re.split(r"[/.]", topic.type)[0] not in _STATELESS]


def fields_example(model: mujoco.MjModel, topic: Topic) -> list[str]:
    """Lines of a signal that takes joint positions from a foreign type, to be corrected by hand."""
    joints = in_motor_order(single_joints(model), topic.type)
    templates = joint_paths(topic.paths, len(joints)) or {"position": "PATH[{}].TO.POSITION"}
    fields = ", ".join(
        f"{key}: [{', '.join(repr(template.format(i)) for i in range(len(joints)))}]"
        for key, template in templates.items()
    )
    compared = NOISE["position"]
    return [
        "states:",
        f"  topic: {topic.name}",
        f"  type: {topic.type}",
        f"  joints: [{', '.join(joints)}]",
        f"  fields: {{{fields}}}",
        f"  noise: {{position: {compared}{', velocity: null' if 'velocity' in templates else ''}}}",
    ]


def single_joints(model: mujoco.MjModel) -> list[str]:
    """Names of hinge and slide joints."""
    single = {int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)}
    return [name for name in names_of(model, "joint") if int(model.joint(name).type[0]) in single]


def free_bodies(model: mujoco.MjModel) -> list[str]:
    """Names of bodies with a free joint."""
    free = int(mujoco.mjtJoint.mjJNT_FREE)
    rows = (int(model.jnt_bodyid[row]) for row in range(model.njnt) if int(model.jnt_type[row]) == free)
    return [name for name in (model.body(row).name for row in rows) if name]


def joint_of(model: mujoco.MjModel, actuator: str) -> str | None:
    """The joint that an actuator drives."""
    return driven_joint(model, model.actuator(actuator).id)


def _joint_states(model: mujoco.MjModel, topics: Sequence[Topic]) -> Iterator[Guess]:
    """The fewest topics that between them measure the most joints."""
    left = {name: (name,) for name in single_joints(model)}
    states = [t for t in topics if t.kind == "JointState" and not is_command(t.name, t.type)]
    states = [topic for topic in states if {"position", "velocity"} & set(topic.quantities)]
    while left and states:
        matches = {topic.name: matched(left, topic.entries) for topic in states}
        best = max(states, key=lambda topic: len(matches[topic.name]))
        names = matches[best.name]
        if not names:
            return
        states.remove(best)
        left = {name: aliases for name, aliases in left.items() if name not in names}
        entry = {"topic": best.name, "type": best.type, "joints": _plain_names(names)}
        why = f"{best.name} names {len(names)} of the model's {len(single_joints(model))} joints"
        noise = {key: NOISE[key] if key in best.quantities else None for key in ("position", "velocity")}
        yield Guess("joints", entry, why, noise, "log")


def _commands(model: mujoco.MjModel, topics: Sequence[Topic]) -> Iterator[Guess]:
    left = {name: (name, joint_of(model, name) or name) for name in names_of(model, "actuator")}
    for topic in topics:
        if not left or not is_command(topic.name, topic.type):
            continue
        if topic.type.endswith("MultiArray") and f"[{len(left)}]" in topic.entries:
            names, quantity = {name: name for name in left}, "value"
            why = f"{topic.name} has as many numbers as there are actuators, taken in the model's order"
        elif topic.kind in ("JointState", "JointTrajectory"):
            names = matched(left, topic.entries)
            quantity = commanded(model, model.actuator(next(iter(names))).id) if names else ""
            why = f"{topic.name} holds commands, judging by its name or type; its {quantity} is used"
        else:
            continue
        if quantity in topic.quantities:
            left = {name: aliases for name, aliases in left.items() if name not in names}
            entry = {"topic": topic.name, "type": topic.type, "actuators": _plain_names(names)}
            several = len(topic.quantities) > 1
            quantity_of = {"quantity": quantity} if several else {}
            yield Guess("command", entry | quantity_of, why, source="names")


def _bodies(model: mujoco.MjModel, topics: Sequence[Topic]) -> Iterator[Guess]:
    """Poses of free bodies, of mocap bodies, and of bodies whose name is in that of a topic."""
    poses = [
        (topic, frame)
        for kind in _POSES
        for topic in topics
        if topic.kind == kind and not is_command(topic.name, topic.type)
        for frame in (topic.entries if kind == "TFMessage" else (None,))
    ]
    free = free_bodies(model)
    for body in [*free, *(name for name in names_of(model, "body") if name not in free)]:
        named = [pose for pose in poses if names_the_same(body, _pose_words(*pose))]
        stamped = [pose for pose in poses if pose[1] is None]
        alone = len(free) == 1 and len({topic.name for topic, _ in stamped}) == 1
        chosen = named or (stamped if body in free and alone else [])
        if body == "world" or not chosen:
            continue
        topic, frame = chosen[0]
        poses = [pose for pose in poses if pose not in ((topic, frame), (topic, None))]
        yield _pose_guess(model, body, body in free, topic, frame, bool(named))


def gives_pose(topic: Topic, body: str) -> bool:
    """Whether a topic gives the pose of a body that may move: by name, or as the robot's odometry."""
    if topic.kind not in _POSES or is_command(topic.name, topic.type) or "static" in words(topic.name):
        return False
    frames = topic.entries if topic.kind == "TFMessage" else (None,)
    return topic.kind == "Odometry" or any(
        names_the_same(body, _pose_words(topic, frame)) for frame in frames
    )


def _pose_words(topic: Topic, frame: str | None) -> list[str]:
    return (
        words(frame) if frame else [*words(topic.name), *(w for entry in topic.entries for w in words(entry))]
    )


def _pose_guess(
    model: mujoco.MjModel, body: str, free: bool, topic: Topic, frame: str | None, named: bool
) -> Guess:
    kind = "mocap" if model.body(body).mocapid[0] >= 0 else "body"
    entry = {"topic": topic.name, "type": topic.type, kind: body}
    if frame:
        entry["child_frame"] = frame
    why = f"{topic.name} is {'named like' if named else 'the only pose, so probably that of'} body {body}"
    source = "names" if named else "guess"
    if kind == "mocap":
        return Guess(body, entry, why, source=source)
    noise: dict[str, float | None] = {key: NOISE[key] for key in ("position", "orientation")}
    if free:
        twist = "linear_velocity" in topic.quantities
        noise |= {key: NOISE[key] if twist else None for key in ("linear_velocity", "angular_velocity")}
    return Guess(body, entry, why, noise, source)


def _imus(model: mujoco.MjModel, topics: Sequence[Topic]) -> Iterator[Guess]:
    """An IMU whose name is in that of a site, or the only IMU if there is only one site."""
    imus = [topic for topic in topics if topic.kind == "Imu"]
    sites = [name for name in names_of(model, "site") if "imu" in words(name)]
    for topic in imus:
        alike = [
            site for site in sites if len(imus) == len(sites) == 1 or names_the_same(site, words(topic.name))
        ]
        if len(alike) == 1:
            noise: dict[str, float | None] = {
                k: NOISE[k] for k in ("angular_velocity", "linear_acceleration")
            }
            entry = {"topic": topic.name, "type": topic.type, "site": alike[0]}
            why = f"{topic.name} is probably the IMU at site {alike[0]}"
            yield Guess("imu", entry, why, noise, "guess")


def _plain_names(names: dict[str, str]) -> Iterable[str]:
    """A list where model and log agree on every name, else a mapping."""
    return list(names) if all(name == logged for name, logged in names.items()) else names
