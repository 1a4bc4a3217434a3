"""Quantities of a log: states, poses, commands, units and the truth that a simulator adds."""

from __future__ import annotations

import logging
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from mcap.writer import Writer

import amhe_cli as amhe
from amhe_cli.core.bundled import bundled_root
from amhe_cli.core.errors import ConfigError, LogError
from amhe_cli.core.settings import LogSettings
from amhe_cli.core.signals import Signal
from amhe_cli.init.folder import init_system
from amhe_cli.logs import LogWriter, read_signals, read_truth
from tests.logs.log_makers import (
    ARRAY,
    DT,
    JOINTS,
    JS,
    ROS1,
    ROS2,
    SETTINGS,
    SIGNALS,
    T0,
    Message,
    header,
    joint_state,
    make,
    motion,
    odometry,
    posed,
    truth,
    write_bag,
    write_mcap,
    write_rosbag2,
)

N = 50
TURN = (np.cos(0.3), 0.0, 0.0, np.sin(0.3))
g = "geometry_msgs/msg/"


def series(store: Any, topic: str, name: str, content: Callable[[int, int], Any]) -> list[Message]:
    """N messages; content(i, stamp)."""
    stamps = [T0 + i * 10_000_000 for i in range(N)]
    return [Message(topic, name, stamp, content(i, stamp)) for i, stamp in enumerate(stamps)]


def read(path: Path, *signals: Signal, **options: Any) -> Any:
    return read_signals(path, signals, DT, SETTINGS, **options)


def stamped(store: Any, name: str, stamp: int, **fields: Any) -> Any:
    return make(store, name, header=header(store, stamp), **fields)


@pytest.fixture(scope="module", params=["mcap", "db3", "bag"])
def zoo(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One log with every built-in type."""
    store = ROS1 if request.param == "bag" else ROS2
    vectors, imu = ((1, 2, 3), (4, 5, 6)), "sensor_msgs/msg/Imu"
    turn = posed((), TURN)[1]

    def moved(i: int, s: int, child: str) -> dict[str, Any]:
        """A TransformStamped."""
        at = posed((i * DT, 2, 3), TURN)
        return {"header": header(store, s), "child_frame_id": child, "transform": at}

    fields: dict[str, tuple[str, Callable[[int, int], dict[str, Any]]]] = {
        "/pose": (f"{g}PoseStamped", lambda i, s: {"pose": posed((i * DT, 2, 3), TURN)}),
        "/posecov": (
            f"{g}PoseWithCovarianceStamped",
            lambda i, s: {"pose": {"pose": posed((i * DT, 2, 3), TURN)}},
        ),
        "/transform": (f"{g}TransformStamped", lambda i, s: moved(i, s, "box")),
        "/twist": (f"{g}TwistStamped", lambda i, s: {"twist": vectors}),
        "/wrench": (f"{g}WrenchStamped", lambda i, s: {"wrench": vectors}),
        "/imu": (
            imu,
            lambda i, s: {
                "orientation": turn, "angular_velocity": (4, 5, 6), "linear_acceleration": (0, 0, 9.81)
            },
        ),
        "/array": (ARRAY, lambda i, s: {"data": (i, 2.0 * i)}),
        "/number": ("std_msgs/msg/Float64", lambda i, s: {"data": i}),
    }  # fmt: skip
    if store is ROS2:  # rosbags has no ROS 1 TFMessage to write
        both = lambda i, s: {"transforms": [moved(2 * i, s, "arm"), moved(i, s, "box")]}  # noqa: E731
        fields["/tf"] = ("tf2_msgs/msg/TFMessage", both)
    kinds = {
        topic: (
            kind,
            lambda i, s, kind=kind, of=of: make(store, kind, **{"header": header(store, s)} | of(i, s)),
        )
        for topic, (kind, of) in fields.items()
    }
    messages = [m for topic, (kind, content) in kinds.items() for m in series(store, topic, kind, content)]
    messages.sort(key=lambda message: message.stamp_ns)
    folder = tmp_path_factory.mktemp("zoo")
    if request.param == "mcap":
        return write_mcap(folder / "zoo.mcap", messages)
    return (
        write_bag(folder / "zoo.bag", messages) if store is ROS1 else write_rosbag2(folder / "zoo", messages)
    )


@pytest.mark.parametrize("topic", ["/pose", "/posecov", "/transform", "/tf"])
def test_poses(zoo: Path, topic: str) -> None:
    if topic == "/tf" and zoo.suffix == ".bag":
        pytest.skip("rosbags cannot write a ROS 1 TFMessage")
    child = "box" if topic == "/tf" else None
    quantities = ("position", "orientation", "linear_velocity", "angular_velocity")
    trajectory = read(zoo, Signal("b", topic, quantities, child_frame=child))
    steps = np.arange(N) * DT
    np.testing.assert_allclose(trajectory["b.position"].values[:, 0], steps, atol=1e-9)
    np.testing.assert_allclose(trajectory["b.orientation"].values, np.tile(TURN, (N, 1)), atol=1e-12)
    np.testing.assert_allclose(trajectory["b.linear_velocity"].values, np.tile((1, 0, 0), (N, 1)), atol=1e-6)
    np.testing.assert_allclose(trajectory["b.angular_velocity"].values, 0.0, atol=1e-9)
    assert trajectory["b.orientation"].columns == ("w", "x", "y", "z")


def test_sensors_and_numbers(zoo: Path) -> None:
    trajectory = read(
        zoo,
        Signal("twist", "/twist", ("linear_velocity", "angular_velocity")),
        Signal("ft", "/wrench", ("force", "torque")),
        Signal("imu", "/imu", ("orientation", "angular_velocity", "linear_acceleration")),
        Signal("u", "/array", ("value",), is_input=True),
        Signal("x", "/number", ("value",)),
    )
    expected = {
        "twist.linear_velocity": (1, 2, 3),
        "twist.angular_velocity": (4, 5, 6),
        "ft.force": (1, 2, 3),
        "ft.torque": (4, 5, 6),
        "imu.orientation": TURN,
        "imu.angular_velocity": (4, 5, 6),
        "imu.linear_acceleration": (0, 0, 9.81),
        "u.value": (7, 14),
        "x.value": (7,),
    }
    for key, row in expected.items():
        np.testing.assert_allclose(trajectory[key].values[7], row, atol=1e-9, err_msg=key)
        assert trajectory[key].valid.all()


CONTAINERS: dict[str, Callable[[Path, list[Message]], Path]] = {
    "mcap": lambda at, messages: write_mcap(at / "a", messages),
    "db3": lambda at, messages: next(write_rosbag2(at / "a", messages).glob("*.db3")),
    "bag": lambda at, messages: write_bag(at / "a.bag", messages),
    "bag_lz4": lambda at, messages: write_bag(at / "a.bag", messages, "lz4"),
    "bag_bz2": lambda at, messages: write_bag(at / "a.bag", messages, "bz2"),
    "folder_mcap": lambda at, messages: write_rosbag2(at / "a", messages, "mcap"),
    "file_zstd": lambda at, messages: write_rosbag2(at / "a", messages, "sqlite3", "file"),
    "message_zstd": lambda at, messages: write_rosbag2(at / "a", messages, "sqlite3", "message"),
    "mcap_message": lambda at, messages: write_rosbag2(at / "a", messages, "mcap", "message"),
}


@pytest.mark.parametrize("kind", CONTAINERS)
def test_the_same_motion_from_every_container(
    kind: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = CONTAINERS[kind](tmp_path, motion(ROS1 if kind.startswith("bag") else ROS2, N))
    trajectory = read(path, *SIGNALS)
    assert trajectory.steps == N and trajectory.start_ns == T0 and trajectory.source == str(path)
    for key, values in truth(np.arange(N) * DT).items():
        np.testing.assert_allclose(trajectory[key].values, values, atol=1e-12, err_msg=key)
        assert trajectory[key].sampled.all()
    assert trajectory["joints.position"].columns == JOINTS
    assert not caplog.records


def test_joints_are_taken_by_name_whatever_their_order(tmp_path: Path) -> None:
    def content(i: int, stamp: int) -> Any:
        names = ("a", "b", "c") if i % 2 else ("c", "x", "a", "b")
        values = {"a": 1.0 + i, "b": 2.0, "c": 3.0, "x": 9.0}
        return joint_state(ROS2, stamp, names, [values[name] for name in names])

    path = write_mcap(tmp_path / "a", series(ROS2, "/js", JS, content))
    trajectory = read(path, Signal("j", "/js", ("position",), names=("b", "a")))
    np.testing.assert_allclose(trajectory["j.position"].values[:, 1], 1.0 + np.arange(N))
    np.testing.assert_allclose(trajectory["j.position"].values[:, 0], 2.0)
    everything = read(path, Signal("j", "/js", ("position",)))
    assert everything["j.position"].columns == ("c", "x", "a", "b")
    assert everything["j.position"].valid[:-1].all(), "x is interpolated where a message lacks it"
    assert everything["j.position"].sampled.sum() == N // 2
    with pytest.raises(LogError, match="no joint 'd'.*there is: a, b, c, x"):
        read(path, Signal("j", "/js", ("position",), names=("d",)))


def test_two_drivers_sharing_a_topic(tmp_path: Path) -> None:
    def content(i: int, stamp: int) -> Any:
        return joint_state(ROS2, stamp, ("arm",) if i % 2 else ("hand",), [float(i)])

    path = write_mcap(tmp_path / "a", series(ROS2, "/js", JS, content))
    trajectory = read(path, Signal("j", "/js", ("position", "velocity"), names=("arm", "hand")))
    position = trajectory["j.position"]
    assert position.valid[1:-1].all()
    np.testing.assert_allclose(position.values[1:-1], np.arange(N)[1:-1, None] * [1.0, 1.0])
    np.testing.assert_allclose(trajectory["j.velocity"].values[1:-1], 1 / DT, rtol=1e-6)


def test_empty_velocity_is_differentiated_and_empty_effort_refused(tmp_path: Path) -> None:
    t = np.arange(N) * DT

    def content(i: int, stamp: int) -> Any:
        return joint_state(ROS2, stamp, ("a",), [np.sin(5 * t[i])])

    path = write_mcap(tmp_path / "a", series(ROS2, "/js", JS, content))
    velocity = read(path, Signal("j", "/js", ("velocity",)))["j.velocity"]
    assert velocity.derived
    np.testing.assert_allclose(velocity.values[3:-3, 0], 5 * np.cos(5 * t[3:-3]), atol=0.02)
    with pytest.raises(LogError, match="carries no effort"):
        read(path, Signal("j", "/js", ("effort",)))


def test_trajectory_points_act_after_their_delay_until_the_next_command(tmp_path: Path) -> None:
    name = "trajectory_msgs/msg/JointTrajectory"

    def points(i: int) -> list[Any]:
        delays = (20_000_000, 500_000_000)
        return [{"positions": (10.0 * k, i), "time_from_start": (0, delay)} for k, delay in enumerate(delays)]

    messages = series(
        ROS2, "/cmd", name, lambda i, s: stamped(ROS2, name, s, joint_names=["b", "a"], points=points(i))
    )
    path = write_mcap(tmp_path / "a", messages)
    command = read(path, Signal("u", "/cmd", ("position",), names=("a", "b"), is_input=True))["u.position"]
    np.testing.assert_allclose(command.values[:N, 0], np.arange(N))
    np.testing.assert_allclose(command.values[: N - 1, 1], 0.0)
    np.testing.assert_allclose(command.values[-1], (N - 1, 10.0))  # nothing superseded the last message


def custom_log(path: Path, definitions: bool, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A type that ROS does not have."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.LATEST)
    store.register(get_types_from_msg("float32 q\nfloat32 dq\nstring name", "go_msgs/msg/Motor"))
    store.register(get_types_from_msg("uint32 tick\nMotor[3] motorState\nfloat64[] u", "go_msgs/msg/Low"))
    monkeypatch.setattr("tests.logs.log_makers.ROS2", store)

    def content(i: int, stamp: int) -> Any:
        motors = [{"q": k + i, "dq": -k, "name": "m" * (i % 3)} for k in range(3)]
        return make(store, "go_msgs/msg/Low", (i, motors, (1.0, i)))

    return write_mcap(path, series(store, "/low", "go_msgs/msg/Low", content), definitions=definitions)


FIELDS = {
    "position": ("motorState[2].q", "motorState[0].q"),
    "velocity": ("motorState[2].dq",),
    "value": ("u",),
}


def test_fields_of_foreign_types(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = custom_log(tmp_path / "a", True, monkeypatch)
    trajectory = read(path, Signal("m", "/low", ("position", "velocity", "value"), fields=FIELDS))
    np.testing.assert_allclose(trajectory["m.position"].values, np.arange(N)[:, None] + [2.0, 0.0])
    np.testing.assert_allclose(trajectory["m.velocity"].values, -2.0)
    np.testing.assert_allclose(trajectory["m.value"].values[5], (1, 5))
    assert trajectory["m.position"].columns == FIELDS["position"]
    with pytest.raises(LogError, match=r"no number field 'motorState\[3\].q' \(did you mean"):
        read(path, Signal("m", "/low", ("value",), fields={"value": ("motorState[3].q",)}))
    with pytest.raises(LogError, match="not built in; name its fields"):
        read(path, Signal("m", "/low", ("value",)))


@pytest.mark.parametrize("layout", ["go_msgs/msg", "go_msgs"])
def test_definitions_from_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, layout: str) -> None:
    path = custom_log(tmp_path / "a", False, monkeypatch)
    signal = Signal("m", "/low", ("value",), fields={"value": ("motorState[1].q",)})
    with pytest.raises(LogError, match="no definition of go_msgs/msg/Low.*`msg_path`"):
        read(path, signal)
    folder = tmp_path / "defs" / layout
    folder.mkdir(parents=True)
    (folder / "Motor.msg").write_text("float32 q\nfloat32 dq\nstring name\n")
    (folder / "Low.msg").write_text("uint32 tick\nMotor[3] motorState\nfloat64[] u\n")
    for root in (tmp_path / "defs", tmp_path / "defs" / "go_msgs"):
        trajectory = read(path, signal, msg_path=root)
        np.testing.assert_allclose(trajectory["m.value"].values[:, 0], 1.0 + np.arange(N))
    with pytest.raises(ConfigError, match=r"no \.msg file"):
        read(path, signal, msg_path=tmp_path / "nowhere")


def test_bundled_definitions_stand_in_for_missing_ones(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a", motion(ROS2, N), definitions=False)
    assert read(path, *SIGNALS).steps == N


def test_lost_quaternions_take_their_positions_along(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    def content(i: int, stamp: int) -> Any:
        lost = {10: (0, 0, 0, 0), 11: (np.nan,) * 4, 12: (3, 0, 0, 0)}
        place = (0, 0, 0) if i in lost else (1, 1, 1)
        return stamped(ROS2, f"{g}PoseStamped", stamp, pose=posed(place, lost.get(i, TURN)))

    path = write_mcap(tmp_path / "a", series(ROS2, "/p", f"{g}PoseStamped", content))
    with caplog.at_level(logging.WARNING):
        position = read(path, Signal("p", "/p", ("position",)))["p.position"]
    np.testing.assert_allclose(position.values, 1.0)
    assert position.valid.all() and (~position.sampled).sum() == 3
    assert "3 messages without a valid quaternion" in caplog.text


def test_unknown_imu_orientation_is_not_data(tmp_path: Path) -> None:
    unknown = np.array([-1.0, *np.zeros(8)])

    def content(i: int, stamp: int) -> Any:
        turn = {"orientation": (0, 0, 0, 1), "orientation_covariance": unknown}
        return stamped(ROS2, "sensor_msgs/msg/Imu", stamp, angular_velocity=(200, 0, 0), **turn)

    path = write_mcap(tmp_path / "a", series(ROS2, "/imu", "sensor_msgs/msg/Imu", content))
    with pytest.raises(LogError, match="carries no orientation"):
        read(path, Signal("i", "/imu", ("orientation",)))


def test_what_is_absent_is_named_with_what_there_is(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a", motion(ROS2, N))
    with pytest.raises(LogError, match=r"no topic '/odm' \(did you mean '/odom'\?\); there is: /odom \(nav"):
        read(path, Signal("b", "/odm", ("position",), type="nav_msgs/msg/Odometry"))
    with pytest.raises(LogError, match="carries nav_msgs/msg/Odometry, not geometry_msgs/msg/PoseStamped"):
        read(path, Signal("b", "/odom", ("position",), type=f"{g}PoseStamped"))
    with pytest.raises(LogError, match="no quantity 'force'"):
        read(path, Signal("b", "/odom", ("force",)))
    with pytest.raises(ConfigError, match="no such file"):
        read(tmp_path / "nothing.mcap", *SIGNALS)


def test_child_frames(tmp_path: Path) -> None:
    name = "tf2_msgs/msg/TFMessage"

    def content(i: int, stamp: int) -> Any:
        child = {"child_frame_id": "box", "transform": posed((1, 2, 3), TURN)}
        return make(ROS2, name, transforms=[{"header": header(ROS2, stamp), **child}])

    path = write_mcap(tmp_path / "a", series(ROS2, "/tf", name, content))
    assert read(path, Signal("b", "/tf", ("position",), child_frame="/box"))["b.position"].valid.all()
    with pytest.raises(LogError, match="no child frame 'bix'.*'box'"):
        read(path, Signal("b", "/tf", ("position",), child_frame="bix"))
    with pytest.raises(ConfigError, match="name the child_frame.*box"):
        read(path, Signal("b", "/tf", ("position",)))


def test_a_twist_in_the_wrong_frame_is_noticed(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    t = np.arange(200) * DT
    true = truth(t)

    def content(i: int, stamp: int) -> Any:
        row = {key: value[i] for key, value in true.items()}
        world = row["body.linear_velocity"]
        turn = row["body.orientation"]
        return odometry(ROS2, stamp, row["body.position"], turn, world, row["body.angular_velocity"])

    name = "nav_msgs/msg/Odometry"
    stamps = [T0 + round(s * 1e9) for s in t]
    messages = [Message("/odom", name, stamp, content(i, stamp)) for i, stamp in enumerate(stamps)]
    signal = Signal("b", "/odom", ("linear_velocity",))
    read(write_mcap(tmp_path / "a", messages), signal)
    assert "better as a velocity in the world frame" in caplog.text
    caplog.clear()
    read(write_mcap(tmp_path / "b", motion(ROS2)), signal)
    assert not caplog.records


def test_idl_definitions(tmp_path: Path) -> None:
    idl = """module tiny { module msg {
      struct Reading { builtin_interfaces::msg::Time stamp; double level; sequence<float> parts; };
    }; };"""
    path = tmp_path / "a"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2")
        schema = writer.register_schema("tiny/msg/Reading", "ros2idl", idl.encode())
        channel = writer.register_channel("/r", "cdr", schema)
        for i in range(10):
            stamp = 5 + i / 100
            body = struct.pack("<iId", 5, i * 10_000_000, float(i)) + struct.pack("<Iff", 2, i, -i)
            writer.add_message(channel, round(stamp * 1e9), b"\0\1\0\0" + body, round(stamp * 1e9))
        writer.finish()
    signal = Signal("r", "/r", ("value",), fields={"value": ("level", "parts[1]")})
    values = read(path, signal)["r.value"].values
    np.testing.assert_allclose(values, np.arange(10)[:, None] * [1.0, -1.0])


ARM = """<mujoco><compiler angle="radian"/><option timestep="0.01"/><worldbody>
  <body><joint name="pan" axis="0 0 1" armature="0.01" range="-3 3"/><geom size="0.1"/></body></worldbody>
  <actuator><position name="pan" joint="pan" kp="5" kv="1"/></actuator></mujoco>"""
TIMES = np.arange(0.0, 4.0, 0.01)
SWING = 2.5 * np.sin(2.0 * TIMES)


def recorded(folder: Path, angles: np.ndarray, commands: np.ndarray) -> Path:
    (folder / "arm.xml").write_text(ARM)
    rows = np.stack([TIMES, angles, commands], axis=1)
    header = "time,position_pan,command_position_pan"
    np.savetxt(folder / "log.csv", rows, delimiter=",", header=header, comments="", fmt="%.9f")
    return folder / "log.csv"


def test_init_declares_degrees_of_positions_and_commands(tmp_path: Path) -> None:
    log = recorded(tmp_path, np.rad2deg(SWING), np.rad2deg(SWING))
    notes = init_system(tmp_path / "arm.xml", [log], tmp_path / "system").sentences
    system = amhe.System.load(tmp_path / "system")
    read = amhe.read_log(log, system)
    np.testing.assert_allclose(read["joints.position"].values[:, 0], SWING, atol=1e-6)
    np.testing.assert_allclose(read["command.position"].values[:, 0], SWING, atol=1e-6)
    np.testing.assert_allclose(read["joints.velocity"].values[:, 0], 5.0 * np.cos(2.0 * TIMES), atol=0.05)
    assert any(
        "looks like degrees (pan); unit: deg in system.yaml converts a file; it is" in note for note in notes
    )


def test_init_declares_an_encoder_that_wraps_and_it_is_unwrapped(tmp_path: Path) -> None:
    turning = 2.0 * SWING
    log = recorded(tmp_path, np.mod(turning + np.pi, 2.0 * np.pi) - np.pi, turning)
    init_system(tmp_path / "arm.xml", [log], tmp_path / "system")
    read = amhe.read_log(log, amhe.System.load(tmp_path / "system"))
    np.testing.assert_allclose(read["joints.position"].values[:, 0], turning, atol=1e-6)
    np.testing.assert_allclose(read["joints.velocity"].values[:, 0], 10.0 * np.cos(2.0 * TIMES), atol=0.1)


def test_radians_stay_as_they_are(tmp_path: Path) -> None:
    log = recorded(tmp_path, SWING, SWING)
    init_system(tmp_path / "arm.xml", [log], tmp_path / "system")
    text = (tmp_path / "system" / "system.yaml").read_text()
    assert "unit: deg" not in text and "unit: {" not in text and "wraps" not in text


@pytest.mark.parametrize(
    ("keys", "error"),
    [
        ({"unit": "furlong"}, "no unit 'furlong'"),
        ({"unit": {"speed": "deg"}}, "no quantity 'speed'"),
        ({"hold": False}, "hold is for what drives the model"),
        ({"joints": None, "topic": "/x", "wraps": True}, "wraps is for joints"),
    ],
)
def test_units_that_do_not_exist_are_refused(keys: dict, error: str) -> None:
    signal = {"joints": ["pan"], "noise": {"position": 0.01}} | keys
    with pytest.raises(amhe.AmheError, match=error):
        amhe.System.from_model(
            mujoco.MjSpec.from_string(ARM),
            parameters={"a": {"targets": [{"joint": "pan", "set": "armature"}]}},
            signals={"joints": signal},
        )


SECOND = 10**9


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """Mass 2 from 10 s on, 3 from 11 s on."""
    path = tmp_path / "log.mcap"
    with LogWriter(path, {}) as writer:
        for tenth in range(100, 121):
            mass = 2.0 if tenth < 110 else 3.0
            writer.joint_state("/amhe/truth", tenth * SECOND // 10, ["mass", "friction"], [mass, 0.5])
    return path


def test_a_value_holds_until_the_next_one(log: Path) -> None:
    stamps = np.array([10.0, 10.95, 11.0, 12.0]) * SECOND
    truth = read_truth(log, stamps.astype(np.int64), LogSettings())
    assert list(truth) == ["mass", "friction"]
    np.testing.assert_array_equal(truth["mass"], [2.0, 2.0, 3.0, 3.0])
    np.testing.assert_array_equal(truth["friction"], 0.5)


def test_nothing_is_true_before_the_first_value_and_the_last_holds(log: Path) -> None:
    truth = read_truth(log, np.array([9 * SECOND, 15 * SECOND]), LogSettings())
    np.testing.assert_array_equal(truth["mass"], [np.nan, 3.0])


def test_a_truth_that_is_stated_seldom_holds_and_is_no_loss(tmp_path: Path, caplog) -> None:
    with LogWriter(tmp_path / "log.mcap", {}) as writer:
        for tenth in [*range(100, 110), *range(150, 160)]:
            writer.joint_state("/amhe/truth", tenth * SECOND // 10, ["mass"], [2.0])
    truth = read_truth(tmp_path / "log.mcap", np.array([13 * SECOND]), LogSettings())
    np.testing.assert_array_equal(truth["mass"], [2.0])
    assert not caplog.records


def test_a_log_that_tells_no_truth_has_none() -> None:
    path = bundled_root() / "examples" / "logs" / "pendulum.mcap"
    assert read_truth(path, np.array([0]), LogSettings()) == {}
