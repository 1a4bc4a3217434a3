"""A ULog as PX4 writes it: formats, subscriptions, data."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray


def write_ulog(path: Path, topics: Mapping[tuple[str, int], Mapping[str, NDArray]], dropout: int = 0) -> Path:
    """Write topics, (name, instance) -> field -> (n,) or (n, k); 'timestamp' [us] is one of the fields."""
    parts = [b"ULog\x01\x125\x01" + struct.pack("<Q", 1000)]

    def message(kind: bytes, body: bytes) -> None:
        parts.append(struct.pack("<H", len(body)) + kind + body)

    for (name, _), fields in {topic[0]: (topic, fields) for topic, fields in topics.items()}.values():
        text = "".join(
            f"{_type(array)}{f'[{array.shape[1]}]' if array.ndim == 2 else ''} {key};"
            for key, array in fields.items()
        )
        message(b"F", f"{name}:{text}".encode())
    for number, (name, instance) in enumerate(topics):
        message(b"A", struct.pack("<BH", instance, number) + name.encode())
    if dropout:
        message(b"O", struct.pack("<H", dropout))
    for number, fields in enumerate(topics.values()):
        for row in zip(*fields.values(), strict=True):
            values = b"".join(np.ascontiguousarray(value).tobytes() for value in row)
            message(b"D", struct.pack("<H", number) + values)
    path.write_bytes(b"".join(parts))
    return path


def _type(array: NDArray) -> str:
    return {"f4": "float", "f8": "double", "u8": "uint64_t", "i4": "int32_t"}[array.dtype.str[1:]]
