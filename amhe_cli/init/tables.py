"""What the columns of a table hold, by their names: joint states, commands and poses, as topics would."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

from amhe_cli.init.names import COMMANDS, KINDS, words
from amhe_cli.init.signals import Guess, Topic

#: Words of a column's name -> the quantity of joints that it holds.
_QUANTITIES = {
    word: quantity
    for quantity, names in {
        "position": "position positions pos q qpos angle angles theta joint_pos deg rad",
        "velocity": "velocity velocities vel qd dq qvel speed speeds omega dtheta thetadot qdot",
        "effort": "effort efforts torque torques tau trq force forces load current currents",
    }.items()
    for word in names.split()
}
#: Words that only say that a number was measured, the best first; any other word ranks behind them.
_MEASURED = ("", "measured", "meas", "actual", "act", "state", "raw", "filtered", "filt")
#: Words in the name of a column that holds commands, or what a model computed.
_COMMANDED = {*COMMANDS, "con", "des", "soll", "cmptd", "computed", "calc", "calculated", "ff"}
#: Words in the name of a column that holds what a drive was given, if it is not that of its supply.
_DRIVING, _SUPPLY = {"voltage", "voltages", "volt", "volts", "duty", "pwm", "u"}, {"battery", "supply", "bus"}
#: A column of a pose: whose, a position or a quaternion, and the axis; `px`, `cube_x`, `cube.orientation.w`.
_POSE = re.compile(
    r"(.*?)[_. ]?(p|pos|position|q|quat|quaternion|rot|orientation)?[_. ]?([wxyz])", re.IGNORECASE
)
#: A column that says whether a drive's torque is on.
ENABLED = re.compile(r"enabled?([_./ ]|$)|(^|[_./ ])torque_on", re.IGNORECASE)
#: How LeRobot calls the measured and the commanded positions of joints.
_LEROBOT = re.compile(r"^(observation\.state|action)(\.|$|\[)")


@dataclass(frozen=True, slots=True)
class _Meaning:
    """Interpretation of a column; `entry` is the joint's name or number, `count` the numbers in a cell."""

    column: str
    quantity: str
    command: bool
    rank: int
    entry: str
    count: int

    @property
    def kind(self) -> tuple[int, str]:
        """Columns of one kind differ in their joint only."""
        lerobot = _LEROBOT.match(self.column)
        return self.rank, lerobot.group(1) if lerobot else re.sub(r"\d+", "#", self.column)

    @property
    def plain(self) -> bool:
        """Whether it has a joint's number and nothing else: TorqueCur1 is not, where Torque1 is there."""
        return self.entry.isdigit()


def topics_in(
    table: Topic, joints: Sequence[str], drives: Mapping[str, tuple[str, str]], alone: bool
) -> list[Topic]:
    """Joint states, joint commands and poses that a table holds, each as a topic with its columns.

    Args:
        table: The table: its columns are its entries.
        joints: Single joints of the model, in its order.
        drives: Actuator -> its joint, and the quantity that it takes.
        alone: The log has no other table: its name means nothing, and measured torques of joints whose
            actuators take torques may be all that drives the model.
    """
    named = "" if alone else table.name
    own = {_bare(name): one for name, one in drives.items() if _bare(name) not in map(_bare, joints)}
    columns = [column for column in table.entries if not ENABLED.search(column)]
    meanings = [m for column in columns if (m := _meaning(named, column, joints, own)) is not None]
    actuated = [joint for joint in joints if joint in {of for of, _ in drives.values()}]
    driven = any(takes == "effort" for _, takes in drives.values())
    head = named or "the table"
    states = _topic(head, table, [m for m in meanings if not m.command], joints, alone)
    given, name = [m for m in meanings if m.command], f"{head} command"
    commands = _topic(name, table, given, actuated, alone) or _topic(name, table, given, joints, alone)
    if commands is None and states is not None and alone and driven and "effort" in states.columns:
        effort = {"effort": states.columns["effort"]}
        commands = replace(states, name=f"{head} command", quantities=("effort",), columns=effort)
    return [topic for topic in (states, commands) if topic is not None] + _poses(head, table)


def is_measured(commands: Topic, topics: Sequence[Topic]) -> bool:
    """Whether the torques of some commands are those that were measured, which might drive motors."""
    own = commands.columns.get("effort")
    return "position" not in commands.columns and any(
        "position" in other.columns and other.columns.get("effort") == own for other in topics if own
    )


def _poses(head: str, table: Topic) -> list[Topic]:
    """Poses that have a column for each axis, and for each number of their quaternion."""
    found: dict[str, dict[str, dict[str, str]]] = {}
    for column in table.entries:
        if match := _POSE.fullmatch(column):
            whose, what, axis = (part or "" for part in match.groups())
            quantity = "orientation" if what.lower()[:1] in ("q", "r", "o") and what else "position"
            found.setdefault(whose, {}).setdefault(quantity, {})[axis.lower()] = column
    topics = []
    for whose, axes in found.items():
        columns = {"position": "xyz", "orientation": "wxyz"}
        if all(set(wanted) <= axes.get(quantity, {}).keys() for quantity, wanted in columns.items()):
            own = {q: tuple(axes[q][axis] for axis in wanted) for q, wanted in columns.items()}
            name, kind = f"{head} {whose} pose".replace("  ", " "), "table/msg/PoseStamped"
            entries = (whose,) if whose else ()
            topics.append(Topic(name, kind, table.rate, entries, tuple(own), own, table.name))
    return topics


def with_columns(guess: Guess, topics: Sequence[Topic], alone: bool) -> None:
    """Let a guessed signal name the columns of its table in place of a topic and a type."""
    topic = next(topic for topic in topics if topic.name == guess.entry["topic"])
    if not topic.columns:
        return
    entry, names = guess.entry, guess.entry.get("joints") or guess.entry.get("actuators") or {}
    logged = list(names.values()) if isinstance(names, dict) else list(names)
    wanted = guess.noise or {entry.get("quantity", topic.quantities[0])}
    place = {entry: i for i, entry in enumerate(topic.entries)}
    columns = {
        quantity: [topic.columns[quantity][place[name]] for name in logged] or [*topic.columns[quantity]]
        for quantity in topic.quantities
        if quantity in wanted
    }
    rest = {key: value for key, value in entry.items() if key not in ("topic", "type", "quantity")}
    if names and isinstance(names, dict):
        rest["actuators" if "actuators" in entry else "joints"] = list(names)
    taken = "; ".join(f"{quantity} from {', '.join(names)}" for quantity, names in columns.items())
    guess.why, guess.source = f"{taken}: judged by the names of the columns", "names"
    guess.entry = ({} if alone else {"topic": topic.table}) | {"columns": columns} | rest


def _meaning(
    table: str, column: str, joints: Sequence[str], drives: Mapping[str, tuple[str, str]]
) -> _Meaning | None:
    name, _, count = column.removesuffix("]").partition("[")
    parts = [w for word in words(name) for w in re.findall(r"[a-z]+|\d+", word)]
    if _bare(name) in drives:  # an actuator's name is its command
        joint, quantity = drives[_bare(name)]
        return _Meaning(name, quantity, True, 0, _bare(joint), int(count or 0))
    quantity = next((_QUANTITIES[word] for word in parts if word in _QUANTITIES), None)
    lerobot = _LEROBOT.match(name)
    driving = bool(_DRIVING & set(parts)) and not _SUPPLY & set(parts)
    if quantity is None and driving:
        quantity = "effort"
    if quantity is None and (lerobot or _COMMANDED & set(parts) or "_".join(parts) in map(_bare, joints)):
        quantity = "position"  # as of `elbow_cmd`, or `elbow`
    if quantity is None or "time" in parts:
        return None
    if lerobot:
        parts = [lerobot.group(1).split(".")[-1], *parts[2 if "." in lerobot.group(1) else 1 :]]
    rest = [word for word in parts if word not in _QUANTITIES]
    desired = parts[0] != "d" and any(word.isdigit() for word in parts)  # tau_J_d_1, but neither d_q1 nor q_d
    wanted = _COMMANDED | ({"d"} if desired else set())
    command = driving or bool(wanted & set(rest)) or bool(COMMANDS & set(words(table)))
    measured = [word for word in rest if word not in wanted | _DRIVING and word in _MEASURED]
    rank, entry = _MEASURED.index(measured[0] if measured else ""), _whose(rest, wanted)
    if command and entry in drives:  # as of `command_effort_left_motor`
        entry = _bare(drives[entry][0])
    return _Meaning(name, quantity, command, rank, entry, int(count or 0))


def _topic(
    name: str, table: Topic, meanings: Sequence[_Meaning], joints: Sequence[str], alone: bool
) -> Topic | None:
    """The best columns of each quantity as one topic of joints, or None."""
    columns: dict[str, tuple[str, ...]] = {}
    names: tuple[str, ...] = ()
    for quantity in ("position", "velocity", "effort"):
        alike = [m for m in meanings if m.quantity == quantity]
        kinds = {m.kind: not m.plain for m in alike}
        for kind in sorted(kinds, key=lambda kind: (kinds[kind], kind)):
            group = [m for m in alike if m.kind == kind]
            if named := _named(group, [m for m in alike if m.rank == kind[0]], joints, alone):
                names, columns[quantity] = named
                break
    if not columns:
        return None
    taken = {column.partition("[")[0] for several in columns.values() for column in several}
    rivals = tuple(m.column for m in meanings if m.quantity in columns and m.column not in taken)
    kind = "table/msg/JointState"
    return Topic(name, kind, table.rate, names, tuple(columns), columns, table.name, rivals=rivals)


def _named(
    group: Sequence[_Meaning], alike: Sequence[_Meaning], joints: Sequence[str], alone: bool
) -> tuple[tuple[str, ...], tuple[str, ...]] | None:
    """Names of joints and their columns: numbers count the model's joints, in its order.

    A column that names something else is that of a single joint only in a log of one table (`alone`).
    """
    if len(group) == 1 and group[0].count:
        count, column = group[0].count, group[0].column
        if count == len(joints):
            return tuple(joints), tuple(f"{column}[{i}]" for i in range(count))
        return None
    # a joint's name may have the words that say what a column holds
    bare = {_whose(_bare(joint).split("_"), _COMMANDED): joint for joint in reversed(joints)}
    bare |= {_bare(joint): joint for joint in joints}
    first = 1 if "0" in {m.entry for m in group} and "0" not in bare else 0  # q_0 is joint1
    entries = [(str(int(m.entry) + first) if m.plain else m.entry, m.column) for m in alike]
    found = {bare[entry]: column for entry, column in entries if entry and entry in bare}
    by_name = {joint: found[joint] for joint in joints if joint in found}
    if by_name:
        return tuple(by_name), tuple(by_name.values())
    listed = all(re.search(r"\d", m.entry) or _LEROBOT.match(m.column) for m in group)
    if len(group) == len(joints) and (listed or (len(joints) == 1 and (alone or not group[0].entry))):
        ordered = sorted(group, key=lambda m: [int(n) for n in re.findall(r"\d+", m.column)])
        return tuple(joints), tuple(m.column for m in ordered)
    return None


def _whose(parts: Sequence[str], commanded: Collection[str]) -> str:
    """What the words of a column's or joint's name leave of it, without those that say what it holds."""
    others = (_QUANTITIES, commanded, _DRIVING, _MEASURED, KINDS, ("j",))
    return "_".join(word for word in parts if not any(word in some for some in others))


def _bare(joint: str) -> str:
    return "_".join(w for word in words(joint) for w in re.findall(r"[a-z]+|\d+", word) if w not in KINDS)
