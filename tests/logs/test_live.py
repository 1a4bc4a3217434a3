"""Messages as they come: their decoding and the transports."""

from __future__ import annotations

import json
import os
import socket
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from amhe_cli.core.errors import ConfigError
from amhe_cli.core.log import Samples
from amhe_cli.core.settings import LogSettings
from amhe_cli.core.signals import Signal
from amhe_cli.logs.containers.raw import Batch, Connection, batch_of
from amhe_cli.logs.live import messages, ros
from amhe_cli.logs.live.messages import LiveSource, Transport
from amhe_cli.logs.live.ros import Dds, RosTransport, Zenoh, configuration, dds_type, renamed, ros_type
from amhe_cli.logs.live.sources import Lines, listening
from amhe_cli.logs.messages.definitions import Definitions
from benchmarks.watch import free_endpoint, router
from examples.ros2_arm import zeros

pytestmark = pytest.mark.flaky(reruns=2)

JOINTS = Signal("joints", "/joints", ("position",), "sensor_msgs/msg/JointState", ("a", "b"))
SECOND = 10**9


class Fed(Transport):
    """Brings the batches that a test puts in."""

    def __init__(self) -> None:
        super().__init__("a test")
        self.waiting: list[Batch] = []

    def receive(self) -> list[Batch]:
        found, self.waiting = self.waiting, []
        return found


def line(stamp: float, position: Sequence[float] = (1.0, 2.0), names: Sequence[str] = ("a", "b")) -> bytes:
    content = {"topic": "/joints", "stamp": stamp, "name": list(names), "position": list(position)}
    return json.dumps(content).encode()


def source(transport: Transport, *signals: Signal) -> LiveSource:
    return LiveSource(transport, signals or (JOINTS,), Definitions(), LogSettings())


@pytest.fixture
def fed(monkeypatch: pytest.MonkeyPatch) -> tuple[LiveSource, Callable[..., Samples]]:
    """A source, and a function that hands it JSON messages with their stamps, as if they came at once."""
    transport = Fed()
    made = source(transport)
    monkeypatch.setattr(messages, "STEP", 0.0)

    def feed(stamps: Sequence[float], arrival: float | None = None, **how: Any) -> Samples:
        connection = Connection("/joints", "sensor_msgs/msg/JointState", "json", "", "")
        arrivals = [round(((stamps[-1] if arrival is None else arrival) + 100.0) * SECOND)] * len(stamps)
        lines = [line(stamp, **how) for stamp in stamps]
        transport.waiting.append(batch_of(connection, arrivals, arrivals, lines))
        return made.wait()

    return made, feed


def times_of(samples: Samples) -> list[float]:
    return samples["joints.position"][0].round(6).tolist() if samples else []


def test_times_count_from_the_first_stamp_and_columns_are_those_of_the_system(fed) -> None:
    made, feed = fed
    found = feed([50.0, 50.01], names=["b", "a"])
    assert times_of(found) == [0.0, 0.01]
    np.testing.assert_array_equal(found["joints.position"][1], [[2.0, 1.0]] * 2)
    assert (made.now, made.stamp_ns(0.01)) == (pytest.approx(0.01), round(50.01 * SECOND))
    assert made.events() == []


def test_what_is_out_of_order_is_sorted_within_a_look_and_dropped_after_it(fed) -> None:
    made, feed = fed
    assert times_of(feed([0.1, 0.12, 0.11, 0.12])) == [0.0, 0.01, 0.02]
    assert times_of(feed([0.115, 0.13])) == [0.03]
    assert made.topics["/joints"].dropped == 2  # a repeated one, and a late one


def test_one_stamp_that_is_far_off_costs_one_message(fed) -> None:
    made, feed = fed
    feed([1.0])
    assert times_of(feed([1.01, 2e9, 1.02], arrival=1.02)) == [0.01, 0.02]
    assert (made.topics["/joints"].dropped, made.epoch, made.events()) == (1, 0, [])


def test_a_clock_that_is_set_back_begins_anew_later_than_all_before(fed, monkeypatch) -> None:
    made, feed = fed
    monkeypatch.setattr(messages, "_SETTLING", 0.0)
    for i in range(20):
        feed([100.0 + 0.01 * i])
    newest = made.now
    for i in range(12):
        feed([5.0 + 0.01 * i], arrival=100.2 + 0.01 * i)
    assert made.epoch == 1
    (event,) = made.events()
    assert "'/joints': its clock was set 95" in event and "back" in event
    found = feed([6.0, 6.1], arrival=101.3)
    assert times_of(found)[0] > newest + LogSettings().max_gap, "no window may bridge it"
    assert made.stamp_ns(times_of(found)[1]) == pytest.approx(6.1 * SECOND, abs=1000)


def test_a_counter_of_milliseconds_is_the_clock_of_messages_without_a_stamp(monkeypatch) -> None:
    """A starved sender writes 40 messages each 80 ms, then its counter begins again, then it sets none."""
    monkeypatch.setattr(messages, "STEP", 0.0)
    kind, fields = "unitree_go/msg/LowState", {"position": ("motor_state[0].q",)}
    transport, signal = Fed(), Signal("joints", "/low", ("position",), kind, ("a",), fields=fields)
    made, connection = source(transport, signal), Connection("/low", kind, "json", "", "")

    def feed(ticks: Sequence[int], seconds: float) -> list[float]:
        sent = [round((100.0 + seconds) * SECOND) + i for i in range(len(ticks))]
        lines = [json.dumps({"tick": tick, "motor_state": [{"q": 1.0}]}).encode() for tick in ticks]
        transport.waiting.append(batch_of(connection, sent, sent, lines))
        return times_of(made.wait())

    bursts = [feed(range(5000 + 80 * i, 5080 + 80 * i, 2), 0.08 * (i + 1)) for i in range(50)]
    times = [time for burst in bursts for time in burst]
    np.testing.assert_allclose(np.diff(times), 0.002, atol=2e-6)
    again = feed(range(2, 82, 2), 4.58) + feed(range(82, 162, 2), 4.66)
    np.testing.assert_allclose(np.diff(again), 0.002, atol=2e-6)
    assert 0.4 < again[0] - times[-1] < 0.6
    assert made.events() == [] and made.epoch == 0
    assert feed([0, 0], 6.0) == []


def test_angles_that_wrap_go_on_across_looks(monkeypatch) -> None:
    monkeypatch.setattr(messages, "STEP", 0.0)
    wrapping = Signal(
        "joints", "/joints", ("position",), "sensor_msgs/msg/JointState", ("a", "b"), wraps=True
    )
    transport = Fed()
    made, connection = source(transport, wrapping), Connection("/joints", wrapping.type or "", "json", "", "")
    found = []
    for i, angle in enumerate((3.0, 3.1, -3.1, -3.0)):
        transport.waiting.append(batch_of(connection, [i + 1], [i + 1], [line(1.0 + 0.01 * i, (angle, 0.0))]))
        found.append(made.wait()["joints.position"][1][0, 0])
    np.testing.assert_allclose(found, [3.0, 3.1, 2 * np.pi - 3.1, 2 * np.pi - 3.0])


def test_a_sensor_that_stops_is_said_within_a_second_and_that_it_goes_on(fed, monkeypatch) -> None:
    made, feed = fed
    for i in range(30):
        feed([0.01 * i])
    stopped = time.monotonic()
    while not (events := made.events()) and time.monotonic() < stopped + 1.0:
        made.wait()
        time.sleep(0.01)
    assert len(events) == 1 and events[0].startswith("topic '/joints' has stopped: nothing for 0.")
    assert made.topics["/joints"].silent
    feed([1.0])
    assert made.events() == ["topic '/joints' goes on again"]


def test_an_absent_topic_is_named_with_the_closest_that_exists(monkeypatch) -> None:
    monkeypatch.setattr(messages, "_ABSENT", 0.0)
    transport = Fed()
    transport.connections.append(Connection("/joint", "sensor_msgs/msg/JointState", "cdr", "", ""))
    made = source(transport)
    for _ in range(3):
        made.wait()
    (event,) = made.events()
    assert event.startswith("no topic '/joints' (did you mean '/joint'?)") and event.endswith("; waiting")


@pytest.mark.parametrize(
    ("names", "position", "said"),
    [(("a", "c"), (1.0, 2.0), "joint 'b'"), (("a", "b"), (1.0, 1e300), "impossible position")],
)
def test_what_is_wrong_is_one_line(fed, names, position, said: str) -> None:
    made, feed = fed
    for i in range(20):
        feed([0.01 * i], names=names, position=position)
    (event,) = made.events()
    assert said in event


def test_what_decoders_remember_is_bounded(fed, monkeypatch) -> None:
    """A sender that names other joints in each message."""
    made, feed = fed
    monkeypatch.setattr(messages, "_FRESH", 50)
    for i in range(400):
        feed([0.01 * i], names=["a", f"x{i}"])
    topic = made.topics["/joints"]
    assert len(topic.decoders[0][1]._seen) <= 52
    assert len(made._said) < 5 and len(topic.arrivals) <= messages._ARRIVALS


@settings(max_examples=60)
@given(st.lists(st.binary(max_size=80), min_size=1, max_size=4))
def test_any_bytes_in_cdr_end_nothing(payloads: list[bytes]) -> None:
    transport = Fed()
    made = source(transport)
    connection = Connection("/joints", "sensor_msgs/msg/JointState", "cdr", "", "ros2msg")
    now = [time.time_ns()] * len(payloads)
    transport.waiting.append(batch_of(connection, now, now, payloads))
    made.wait()
    assert len(made.events()) <= 3


# -- lines ----------------------------------------------------------------------------------------------


def test_datagrams_of_lines_are_read_and_the_rest_is_left_out() -> None:
    with listening("127.0.0.1", 0) as end, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        transport = Lines("udp", end, [JOINTS])
        hostile = [
            b"",
            b"{",
            b"[1]",
            b'{"topic": 3}',
            b'{"topic": {}}',
            b"\xff",
            b"[" * 5000,
            b'{"topic": "/other"}',
        ]
        for datagram in (*hostile, line(1.0) + b"\n" + line(1.1)):
            out.sendto(datagram, end.getsockname())
        (batch,) = transport.receive()
        assert (batch.connection.topic, batch.starts.size) == ("/joints", 2)
        assert not transport.over and len(transport.notes()) == 2 and transport.notes() == []


def test_lines_of_a_pipe_may_come_in_pieces_and_end_with_it() -> None:
    ours, theirs = os.pipe()
    transport = Lines("pipe", ours, [JOINTS])
    whole = line(1.0) + b"\n" + line(1.1)
    os.write(theirs, whole[:30])
    assert transport.receive() == []
    os.write(theirs, whole[30:])
    assert [batch.starts.size for batch in transport.receive()] == [1]
    os.close(theirs)
    assert [batch.starts.size for batch in transport.receive()] == [1]
    assert transport.over
    os.close(ours)


KIND = "sensor_msgs/msg/JointState"


def joint_state() -> bytes:
    store = get_typestore(Stores.LATEST)
    stamp = store.types["builtin_interfaces/msg/Time"](sec=12, nanosec=34)
    header = store.types["std_msgs/msg/Header"](stamp=stamp, frame_id="base")
    two, none = np.full(2, 1.5), np.zeros(0)
    message = store.types[KIND](header=header, name=["a", "bc"], position=two, velocity=none, effort=two)
    return bytes(store.serialize_cdr(message, KIND))


def exchanged(sender: Any, receiver: Any, seconds: float = 10.0) -> list[Batch]:
    """Batches that arrive while one message is sent again and again."""
    end = time.monotonic() + seconds
    found: list[Batch] = []
    while not found and time.monotonic() < end:
        sender.publish("/arm/joint_states", KIND, joint_state())
        time.sleep(0.02)
        found = receiver.receive()
    return found


def check(found: list[Batch]) -> None:
    (batch,) = found
    assert (batch.connection.topic, batch.connection.type) == ("/arm/joint_states", KIND)
    assert "string[] name" in batch.connection.definition
    start, length = int(batch.starts[0]), int(batch.lengths[0])
    payload = joint_state()
    assert batch.buffer[start : start + length].tobytes().rstrip(b"\0") == payload.rstrip(b"\0")
    assert abs(int(batch.log_ns[0]) - time.time_ns()) < 10 * 10**9


def test_dds_brings_what_is_published() -> None:
    pytest.importorskip("cyclonedds")
    transport = Dds({"/arm/joint_states"}, Definitions(), 79, "127.0.0.1")
    try:
        transport.announce("/amhe/jump", "sensor_msgs/msg/JointState")
        check(exchanged(transport, transport))
        assert transport.notes() == []
        assert {one.topic for one in transport.connections} == {"/arm/joint_states"}  # its own is no offer
    finally:
        transport.close()


def test_the_low_state_of_a_unitree_robot_is_read_without_its_definitions() -> None:
    pytest.importorskip("cyclonedds")
    kind, definitions = "unitree_go/msg/LowState", Definitions()
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(definitions.described(kind)[0], kind))
    state = zeros(store, kind)
    for k, motor in enumerate(state.motor_state):
        motor.q = float(k)
    message = bytes(store.serialize_cdr(state, kind))
    fields = {"position": tuple(f"motor_state[{k}].q" for k in range(12))}
    legs = Signal("legs", "/lowstate", ("position",), kind, tuple(map(str, range(12))), fields=fields)
    transport = Dds({"/lowstate"}, definitions, 79, "127.0.0.1")
    source = LiveSource(transport, (legs,), definitions, LogSettings())
    end = time.monotonic() + 10.0
    try:
        while not (samples := source.wait()) and time.monotonic() < end:
            transport.publish("/lowstate", kind, message)
    finally:
        transport.close()
    np.testing.assert_array_equal(samples["legs.position"][1][0], np.arange(12))
    assert source.events() == []


@pytest.mark.slow
def test_a_router_that_is_gone_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("zenoh")

    monkeypatch.setattr(ros, "_LOOK", 0.2)
    with router(where := free_endpoint()):
        transport = Zenoh({"/arm/joint_states"}, Definitions(), 3, where)
        found = exchanged(transport, transport)
    try:
        assert found
        end = time.monotonic() + 10.0
        while not (notes := transport.notes()) and time.monotonic() < end:
            transport.receive()
            time.sleep(0.05)
        assert "the router is gone" in notes[0]
        with router(where):
            assert exchanged(transport, transport, 20.0)
    finally:
        transport.close()


def test_zenoh_brings_what_is_published_and_names_what_is_offered() -> None:
    pytest.importorskip("zenoh")
    with router(where := free_endpoint()):
        wanted = (), {"/arm/joint_states"}, {"/other"}
        sender, receiver, other = (Zenoh(topics, Definitions(), 3, where) for topics in wanted)
        with closing(sender), closing(receiver), closing(other):
            check(exchanged(sender, receiver))
            end = time.monotonic() + 5.0
            while not other.connections and time.monotonic() < end:
                assert other.receive() == []
                time.sleep(0.02)
            assert [one.topic for one in other.connections] == ["/arm/joint_states"]


def test_without_a_router_there_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("zenoh")

    monkeypatch.setattr(ros, "_PATIENCE", 100)
    with pytest.raises(ConfigError, match=r"^`source=zenoh`: no router at tcp/127.0.0.1:1 .*rmw_zenohd"):
        Zenoh((), Definitions(), 0, "tcp/127.0.0.1:1")


def test_types_are_named_as_dds_names_them() -> None:
    assert dds_type(KIND) == "sensor_msgs::msg::dds_::JointState_"
    assert ros_type(dds_type(KIND)) == KIND


@pytest.mark.parametrize(
    ("kind", "digest", "said"),
    [(KIND, "RIHS01_" + 64 * "0", "another version"), ("a_msgs/msg/B", "", "not defined here")],
)
def test_a_type_of_another_version_or_an_unknown_one_is_not_read(kind: str, digest: str, said: str) -> None:
    transport = RosTransport("a test", None, Definitions())
    assert transport.offered("/x", kind, digest) is None
    assert transport.offered("/x", kind, digest) is None
    (note,) = transport.notes()
    assert said in note


def test_the_hash_of_a_type_is_that_of_ros() -> None:
    _, digest = Definitions().described("std_msgs/msg/String")
    assert digest == "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"


def test_foxglove_sees_what_is_published() -> None:
    from websockets.sync.client import connect

    from amhe_cli.logs.live.foxglove import FoxgloveServer

    with closing(FoxgloveServer(0, Definitions())) as server:
        server.publish("/amhe/params", KIND, joint_state())  # before anyone listens
        with connect(server.address, subprotocols=["foxglove.sdk.v1"]) as client:
            heard: dict[str, Any] = {}
            while "advertise" not in heard:
                said = json.loads(client.recv(timeout=10))
                heard[said["op"]] = said
            (channel,) = heard["advertise"]["channels"]
            assert (channel["topic"], channel["schemaName"], channel["encoding"]) == (
                "/amhe/params",
                KIND,
                "cdr",
            )
            assert "string[] name" in channel["schema"]
            subscription = {"id": 1, "channelId": channel["id"]}
            client.send(json.dumps({"op": "subscribe", "subscriptions": [subscription]}))
            end, payload = time.monotonic() + 10.0, b""
            while not payload and time.monotonic() < end:
                server.publish("/amhe/params", KIND, joint_state())
                try:
                    frame = client.recv(timeout=0.05)
                except TimeoutError:
                    continue
                payload = frame[13:] if isinstance(frame, bytes) else b""
    assert payload == joint_state()


def test_a_port_that_is_taken_is_one_line() -> None:
    from amhe_cli.logs.live.foxglove import FoxgloveServer

    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(ConfigError, match=rf"^`live.foxglove`: port {port} cannot be served"):
            FoxgloveServer(port, Definitions())


def test_topics_are_renamed_as_ros_does() -> None:
    signals = [Signal(name, f"/{name}", ("position",)) for name in ("joints", "commands")]
    found = renamed(signals, ["/joints:=/x/joint_states", "__ns:=/arm/"])
    assert [one.topic for one in found] == ["/x/joint_states", "/arm/commands"]
    assert renamed(signals, []) == signals
    with pytest.raises(ConfigError, match=r"^`live.remap`: '/a=/b' is no rule"):
        renamed(signals, ["/a=/b"])


@pytest.mark.parametrize(
    ("interface", "peers", "found_by_multicast"),
    [("127.0.0.1", (), False), ("10.0.0.2", (), True), ("10.0.0.2", ("10.0.0.1",), False)],
)
def test_participants_are_found_by_multicast_but_on_loopback_or_among_peers(
    interface: str, peers: tuple[str, ...], found_by_multicast: bool
) -> None:
    given = configuration(interface, peers)
    assert ("<AllowMulticast>true<" in given) == found_by_multicast
    assert ("<Peer " in given) != found_by_multicast
