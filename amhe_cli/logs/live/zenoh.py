"""Topics of ROS 2 over Zenoh, as rmw_zenoh names them (package `eclipse-zenoh`), without a ROS install.

A topic is the key DOMAIN/NAME/TYPE/HASH; a message's attachment has its number, its time and its sender.
Whoever publishes is announced by a liveliness token. docs/watch.md says which releases were tried.
"""

from __future__ import annotations

import json
import struct
import time
from collections import deque
from collections.abc import Collection, Iterator
from contextlib import suppress
from itertools import count
from typing import Any
from uuid import uuid4

from amhe_cli.core.errors import ConfigError
from amhe_cli.logs.containers.raw import Batch, Connection, batch_of
from amhe_cli.logs.live.ros import RosTransport, dds_type, ros_type
from amhe_cli.logs.messages.definitions import Definitions

#: Bytes of messages that wait for us; what comes when there are more is dropped.
_HELD = 64 * 2**20
#: The router is waited for so long [ms].
_PATIENCE = 5000
#: Time between two looks for it [s], and the time that one takes at most where it has gone [ms].
_LOOK, _STEP = 2.0, 300
#: Their number, likewise.
_MOST = 10_000
#: Where all are announced: DOMAIN/SESSION/NODE/ENTITY/KIND/ENCLAVE/NAMESPACE/NAME/TOPIC/TYPE/HASH/QOS.
_TOKENS = "@ros2_lv"


class Zenoh(RosTransport):
    """The topics behind a Zenoh router.

    Args:
        topics: Topics that are wanted; None: all.
        definitions: Definitions of message types.
        domain: ROS_DOMAIN_ID.
        connect: Endpoint of the router.

    Raises:
        ConfigError: The package is missing, or there is no router.
    """

    def __init__(
        self, topics: Collection[str] | None, definitions: Definitions, domain: int, connect: str
    ) -> None:
        try:
            import zenoh  # pyright: ignore[reportMissingImports]
        except ImportError:
            raise ConfigError("`source=zenoh` needs eclipse-zenoh: pip install 'amhe[zenoh]'") from None
        super().__init__(f"zenoh {connect}, domain {domain}, not signed", topics, definitions)
        self._domain, self._connect, self._gid = domain, connect, uuid4().bytes
        self._waiting: deque[tuple[str, int, int, bytes]] = deque(maxlen=_MOST)
        self._held = 0
        self._keys: dict[str, tuple[str, Iterator[int]]] = {}
        try:
            self._open(_PATIENCE)
        except zenoh.ZError as error:
            why = str(error).split(" at ")[0]
            raise ConfigError(
                f"`source=zenoh`: no router at {connect} ({why}); start one with `ros2 run rmw_zenoh_cpp "
                "rmw_zenohd`, or name another with `connect`"
            ) from None

    def _open(self, patience: int) -> None:
        """Reach the router within so long [ms], and listen."""
        import zenoh  # pyright: ignore[reportMissingImports]

        config = zenoh.Config()
        chosen = {
            "mode": "client", "connect/endpoints": [self._connect], "connect/timeout_ms": patience,
            "scouting/multicast/enabled": False, "transport/link/rx/max_message_size": _HELD // 4,
        }  # fmt: skip
        for key, value in chosen.items():
            config.insert_json5(key, json.dumps(value))
        self._session: Any = zenoh.open(config)
        self._looked_at = time.monotonic()
        keys = ["**"] if self._topics is None else [f"{topic.strip('/')}/*/*" for topic in self._topics]
        live, tokens = self._session.liveliness(), f"{_TOKENS}/{self._domain}/**"
        self._declared = [
            self._session.declare_subscriber(f"{self._domain}/{key}", self._take) for key in keys
        ]
        self._declared += [live.declare_subscriber(tokens, self._take, history=True)]
        self._keys.clear()  # publishers are announced again

    def _look(self) -> None:
        """Where the router has gone, reach it again: a client does not by itself."""
        self._looked_at = time.monotonic()
        if self._session.is_closed() or not self._session.info.routers_zid():
            self.note(f"{self.about}: the router is gone; waiting for it")
            with suppress(Exception):  # zenoh's own error, while there is none
                self._session.close()
                self._open(_STEP)

    def receive(self) -> list[Batch]:
        """See `Transport`."""
        if time.monotonic() - self._looked_at > _LOOK:
            self._look()
        found: dict[str, list[tuple[int, int, bytes]]] = {}
        for _ in range(len(self._waiting)):
            key, arrival, sent, message = self._waiting.popleft()
            self._held -= len(message)
            found.setdefault(key, []).append((arrival, sent, message))
        batches = []
        for key, rows in found.items():
            connection = self._connection(key.split("/"))
            if connection is not None and not key.startswith(_TOKENS):
                batches.append(batch_of(connection, *map(list, zip(*rows, strict=True))))
        return batches

    def publish(self, topic: str, msgtype: str, message: bytes) -> None:
        """See `Transport`; while the router is gone, nothing is sent."""
        if self._session.is_closed():
            return
        if topic not in self._keys:
            kind, digest = dds_type(msgtype), self.definitions.described(msgtype)[1]
            self._keys[topic] = f"{self._domain}/{topic.strip('/')}/{kind}/{digest}", count(1)
            publisher = f"{self._session.zid()}/0/{len(self._keys)}/MP/%/%/amhe/{topic.replace('/', '%')}"
            token = f"{_TOKENS}/{self._domain}/{publisher}/{kind}/{digest}/::,10:,:,:,,"  # QoS: defaults
            self._declared.append(self._session.liveliness().declare_token(token))
        key, numbers = self._keys[topic]
        about = struct.pack("<qqB", next(numbers), time.time_ns(), len(self._gid)) + self._gid
        self._session.put(key, message, attachment=about)

    def close(self) -> None:
        """See `Transport`."""
        self._session.close()

    def _take(self, sample: Any) -> None:
        """Hold a message, or a token; called in a thread of Zenoh's."""
        message, arrival = sample.payload.to_bytes(), time.time_ns()
        if self._held + len(message) > _HELD or len(self._waiting) == _MOST:
            self.note(f"{self.about}: messages come faster than they are read, and are dropped")
            return
        self._held += len(message)
        about = sample.attachment.to_bytes() if sample.attachment else b""
        sent = struct.unpack_from("<q", about, 8)[0] if len(about) >= 16 else arrival
        self._waiting.append((str(sample.key_expr), arrival, max(sent, 0), message))

    def _connection(self, parts: list[str]) -> Connection | None:
        """Of a message's key, or of the token of a publisher."""
        if parts[0] != _TOKENS and len(parts) > 3:
            return self.offered(f"/{'/'.join(parts[1:-2])}", ros_type(parts[-2]), parts[-1])
        if parts[0] == _TOKENS and len(parts) > 11 and parts[5] == "MP":
            return self.offered(parts[9].replace("%", "/"), ros_type(parts[10]), parts[11])
        return None
