"""Decompression with a bound: a log is untrusted, and a kilobyte can unfold into a terabyte."""

from __future__ import annotations

import bz2
from pathlib import Path
from typing import BinaryIO

import lz4.frame
import zstandard

from amhe_cli.core.errors import LogError
from amhe_cli.core.limits import beyond, limits


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
