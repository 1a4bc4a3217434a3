"""What every log format is reduced to: connections, and batches of messages still in their own encoding."""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from amhe_cli.core.arrays import IntArray
from amhe_cli.core.errors import AmheError, LogError
from amhe_cli.core.files import WRITING

logger = logging.getLogger(__name__)

DefinitionFormat = Literal["ros2msg", "ros2idl", "ros1msg", ""]


@dataclass(frozen=True, slots=True)
class Connection:
    """A topic as one publisher declared it.

    Args:
        topic: Name of the topic.
        type: Message type, always in the form 'pkg/msg/Type'.
        encoding: 'cdr' (ROS 2), 'ros1', 'json', 'protobuf', 'table', or one that is not read.
        definition: Text of the message definition that the log carries; may be empty. A protobuf descriptor
            set, which is binary, as latin-1.
        definition_format: Language of that text.
        digest: The recorder's own hash of the definition; '' where there is none.
    """

    topic: str
    type: str
    encoding: str
    definition: str
    definition_format: DefinitionFormat
    digest: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Batch:
    """Messages of one connection, in file order; message i is buffer[starts[i] : starts[i] + lengths[i]].

    Args:
        connection: Connection of the messages.
        log_ns: Times at which the recorder received them [ns], shape (n,).
        publish_ns: Times at which they were sent [ns], shape (n,); log_ns where the format lacks them.
        buffer: Bytes, shape (b,).
        starts, lengths: Position and size of each message in `buffer`, shape (n,).
    """

    connection: Connection
    log_ns: IntArray
    publish_ns: IntArray
    buffer: NDArray[np.uint8]
    starts: IntArray
    lengths: IntArray

    def payloads(self) -> Iterator[bytes]:
        """The bytes of each message."""
        for start, length in zip(self.starts.tolist(), self.lengths.tolist(), strict=True):
            yield self.buffer[start : start + length].tobytes()


class LogFile(Protocol):
    """One file of a log.

    `connections`, `problems` and `metadata` are complete once `batches` has been read to its end: the
    content of a file that was never closed is known only then.
    """

    format: str
    connections: list[Connection]
    problems: list[str]
    metadata: dict[str, str]

    def batches(self, topics: Collection[str] | None) -> Iterator[Batch]:
        """Yield the messages of the named topics (None: all), skipping and noting what is damaged."""
        ...

    def read_metadata(self) -> dict[str, str]:
        """The record named 'amhe', without reading any message."""
        ...


def batch_of(
    connection: Connection, log_ns: Sequence[int], publish_ns: Sequence[int], payloads: Sequence[bytes]
) -> Batch:
    """Make a batch of separate payloads."""
    lengths = np.fromiter(map(len, payloads), np.int64, len(payloads))
    return Batch(
        connection,
        stamps(log_ns),
        stamps(publish_ns),
        np.frombuffer(b"".join(payloads), np.uint8),
        np.cumsum(lengths) - lengths,
        lengths,
    )


def stamps(values: Sequence[int]) -> IntArray:
    """Stamps [ns] as int64; the unsigned ones that do not fit wrap round and are dropped as wild later."""
    return np.array(values, dtype=np.uint64).astype(np.int64)


def messages(count: int) -> str:
    """'1 message', '2 messages'."""
    return f"{count} message" + "s" * (count != 1)


def normal_type(name: str) -> str:
    """Write a type as 'pkg/msg/Type', however the log spells it ('pkg/Type', 'pkg::msg::Type')."""
    parts = name.replace("::", "/").split("/")
    return f"{parts[0]}/msg/{parts[1]}" if len(parts) == 2 else "/".join(parts)


@contextmanager
def readable(path: Path) -> Iterator[None]:
    """Turn any exception that a broken or hostile file causes in a library into one line with its path."""
    try:
        yield
    except AmheError as error:
        if str(path) in str(error):
            raise
        raise type(error)(f"{path}: {error}") from error
    except Exception as error:
        if isinstance(error, OSError) and error.errno in WRITING:  # the log is fine: what is written is not
            raise
        logger.debug("%s: unreadable", path, exc_info=True)
        reason = str(error).split("\n")[0] or type(error).__name__
        raise LogError(f"{path}: cannot be read: {reason}") from error
