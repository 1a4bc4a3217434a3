"""Decompression with a bound: a log is untrusted, and a kilobyte can unfold into a terabyte."""

from __future__ import annotations

import bz2
from pathlib import Path
from typing import BinaryIO

import lz4.frame
import zstandard

#: Largest piece of a log [bytes] that is unfolded into memory at once.
LIMIT = 2**30


def decompress(kind: str, data: bytes | memoryview, size: int | None = None) -> bytes:
    """Unfold one piece of a log.

    Args:
        kind: 'zstd', 'lz4' (frames), 'bz2', or '' / 'none'.
        data: The compressed bytes.
        size: Size it must have once unfolded [bytes], where known.

    Raises:
        ValueError: If the piece is damaged, of another size, or larger than LIMIT.
    """
    bound = LIMIT if size is None else size
    if bound > LIMIT:
        raise ValueError(f"a piece of {bound / 2**30:.1f} GiB exceeds the limit of {LIMIT / 2**30:.0f} GiB")
    try:
        unfolded = _unfold(kind, data, bound)
    except (zstandard.ZstdError, RuntimeError, EOFError, OSError) as error:
        raise ValueError(f"damaged {kind} data: {error}") from error
    if len(unfolded) > bound or (size is not None and len(unfolded) != size):
        raise ValueError(f"{kind or 'plain'} data unfold to {len(unfolded)} bytes instead of {bound}")
    return unfolded


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


def decompress_start(kind: str, data: bytes, size: int) -> bytes:
    """Unfold as much as possible, and at most `size` bytes, of a piece whose end is missing.

    Raises:
        ValueError: If what is there is damaged, or of a kind that cannot be read in part.
    """
    if size > LIMIT:
        raise ValueError(f"a piece of {size / 2**30:.1f} GiB exceeds the limit of {LIMIT / 2**30:.0f} GiB")
    try:
        if kind in ("", "none"):
            return data[:size]
        if kind == "zstd":
            with zstandard.ZstdDecompressor().stream_reader(data) as stream:
                return stream.read(size)
        if kind == "lz4":
            return lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size)
    except (zstandard.ZstdError, RuntimeError, EOFError, OSError) as error:
        raise ValueError(f"damaged {kind} data: {error}") from error
    raise ValueError(f"compression {kind!r} cannot be read in part")


def unfold_file(source: Path, target: BinaryIO) -> None:
    """Unfold a zstd file into `target`.

    Raises:
        ValueError: If it is damaged, or unfolds to more than LIMIT or 100 times its size.
    """
    bound = max(LIMIT, 100 * source.stat().st_size)
    written = 0
    try:
        with source.open("rb") as packed, zstandard.ZstdDecompressor().stream_reader(packed) as stream:
            while piece := stream.read(2**20):
                written += len(piece)
                if written > bound:
                    raise ValueError(f"{source.name} unfolds to more than {bound} bytes")
                target.write(piece)
    except zstandard.ZstdError as error:
        raise ValueError(f"{source.name}: damaged zstd data: {error}") from error
