"""What every log format is reduced to: connections, and batches of messages still in their own encoding.

Compressed pieces are unfolded with a bound: a log is untrusted, and a kilobyte can unfold into a terabyte.
"""

from __future__ import annotations

import bz2
import logging
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Literal

import lz4.frame
import numpy as np
import zstandard
from numpy.typing import NDArray

from amhe_cli.core.arrays import IntArray
from amhe_cli.core.errors import AmheError, LogError
from amhe_cli.core.files import WRITING
from amhe_cli.core.limits import beyond, limits

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


class LogFile:
    """One file of a log.

    `connections`, `problems` and `metadata` are complete once `batches` has been read to its end: the
    content of a file that was never closed is known only then.
    """

    format: str

    def __init__(self) -> None:
        self.connections: list[Connection] = []
        self.problems: list[str] = []
        self.metadata: dict[str, str] = {}

    def batches(self, topics: Collection[str] | None) -> Iterator[Batch]:
        """Yield the messages of the named topics (None: all), skipping and noting what is damaged."""
        raise NotImplementedError

    def read_metadata(self) -> dict[str, str]:
        """The record named 'amhe', without reading any message; {} where the format has no place for it."""
        return self.metadata


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


class Unfolder:
    """Unfolds the pieces of one log within the limits `piece_mib` and `growth`.

    Args:
        size: Size of the log [bytes].
    """

    def __init__(self, size: int) -> None:
        self._left = max(limits().piece, limits().growth * size)

    def unfold(self, kind: str, data: bytes | memoryview, size: int | None = None) -> bytes:
        """Unfold one piece of a log.

        Args:
            kind: 'zstd', 'lz4' (frames), 'bz2', or '' / 'none'.
            data: The compressed bytes.
            size: Size it must have once unfolded [bytes], where known.

        Raises:
            ValueError: If the piece is damaged, of another size, or beyond `piece_mib`.
            LogError: If all pieces together are beyond `growth`.
        """
        bound = limits().piece if size is None else size
        if bound > limits().piece:
            raise ValueError(beyond("piece_mib", f"a piece of {bound / 2**20:.0f} MiB is"))
        try:
            unfolded = _unfold(kind, data, bound)
        except (zstandard.ZstdError, RuntimeError, EOFError, OSError) as error:
            raise ValueError(f"damaged {kind} data: {error}") from error
        if size is None and len(unfolded) > bound:
            raise ValueError(beyond("piece_mib", "a piece is"))
        if size is not None and len(unfolded) != size:
            raise ValueError(f"{kind or 'plain'} data unfold to {len(unfolded)} bytes instead of {size}")
        self._left -= len(unfolded)
        if self._left < 0:
            raise LogError(beyond("growth", "what it unfolds to is, as a multiple of its size,"))
        return unfolded


def check_growth(path: Path, size: int) -> None:
    """Refuse a file whose content is too large for it.

    Args:
        path: The file.
        size: Size of its content, once unfolded [bytes].

    Raises:
        LogError: It is beyond the limits `piece_mib` and `growth`.
    """
    if size > max(limits().piece, limits().growth * path.stat().st_size):
        raise LogError(f"{path}: {beyond('growth', 'what it unfolds to is, as a multiple of its size,')}")


def _unfold(kind: str, data: bytes | memoryview, bound: int) -> bytes:
    if kind in ("", "none"):
        return bytes(data)
    if kind == "zstd":
        declared = zstandard.frame_content_size(data)
        if declared > bound:
            raise ValueError(f"a zstd frame of {declared} bytes where at most {bound} are allowed")
        return zstandard.ZstdDecompressor().decompress(data, max_output_size=bound)
    if kind == "lz4":
        return lz4.frame.LZ4FrameDecompressor().decompress(bytes(data), max_length=bound + 1)
    if kind == "bz2":
        return bz2.BZ2Decompressor().decompress(bytes(data), max_length=bound + 1)
    raise ValueError(f"compression {kind!r} is not known; known are zstd, lz4, bz2")


def unfold_file(source: Path, target: BinaryIO) -> None:
    """Unfold a zstd file into `target`.

    Raises:
        ValueError: If it is damaged.
        LogError: If it unfolds beyond the limits `piece_mib` and `growth`.
    """
    written = 0
    try:
        with source.open("rb") as packed, zstandard.ZstdDecompressor().stream_reader(packed) as stream:
            while piece := stream.read(2**20):
                written += len(piece)
                check_growth(source, written)
                target.write(piece)
    except zstandard.ZstdError as error:
        raise ValueError(f"{source.name}: damaged zstd data: {error}") from error
