"""DDS and Zenoh on loopback: what one publishes the other gets, bit for bit, with its type."""

from __future__ import annotations

import json
import socket
import time
from contextlib import closing
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from amhe_cli.core.errors import ConfigError
from amhe_cli.core.settings import LogSettings
from amhe_cli.core.signals import Signal
from amhe_cli.logs.containers.raw import Batch
from amhe_cli.logs.live import ros
from amhe_cli.logs.live.messages import LiveSource
from amhe_cli.logs.live.ros import Dds, RosTransport, Zenoh, configuration, dds_type, renamed, ros_type
from amhe_cli.logs.messages.definitions import Definitions
from benchmarks.watch import free_endpoint, router
from examples.ros2_arm import zeros

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
