"""Damaged tables: one line that names the file, or numbers; never a traceback of ours, and bounded memory."""

from __future__ import annotations

import resource
from pathlib import Path

import h5py
import numpy as np
import pyarrow
import pyarrow.parquet
import pytest

from amhe_cli.core.errors import AmheError
from amhe_cli.core.settings import LogSettings
from amhe_cli.core.signals import Signal
from amhe_cli.logs import read_signals, survey
from tests.logs.ulog_maker import write_ulog

SIGNAL = Signal("joints", "", ("position",), columns={"position": ("q",)})
#: Mutated files of each format.
TRIES = 60
#: A wild time makes a long clock of it: `logs.tracks` stops at 10 million rows.
_MEMORY = 400 * 2**20


def written(folder: Path, suffix: str) -> Path:
    path, arrays = folder / f"log.{suffix}", {"time": 0.01 * np.arange(300), "q": np.sin(np.arange(300.0))}
    if suffix == "csv":
        np.savetxt(path, np.column_stack(list(arrays.values())), delimiter=",", header="time,q", comments="")
    elif suffix == "npz":
        np.savez(path, **arrays)
    elif suffix == "ulg":
        stamps = np.round(1e6 * arrays["time"]).astype(np.uint64)
        write_ulog(path, {("log", 0): {"timestamp": stamps, "q": arrays["q"]}})
    elif suffix == "h5":
        with h5py.File(path, "w") as file:
            for name, array in arrays.items():
                file[name] = array
    else:
        write = pyarrow.parquet.write_table
        write(pyarrow.table(arrays), path)
    return path


def mutated(content: bytes, rng: np.random.Generator) -> bytes:
    """Cut, overwritten, doubled or spliced somewhere."""
    place = int(rng.integers(len(content)))
    kind = int(rng.integers(5))
    if kind == 0:
        return content[:place]
    if kind == 1:
        end = place + int(rng.integers(1, 40))
        return content[:place] + rng.bytes(end - place) + content[end:]
    if kind == 2:
        return content[:place] + content[max(place - 200, 0) :]
    if kind == 3:
        flipped = bytearray(content)
        for spot in rng.integers(len(content), size=8):
            flipped[spot] ^= 1 << int(rng.integers(8))
        return bytes(flipped)
    return content[:place] + b"9" * 400 + content[place:]


@pytest.mark.parametrize("suffix", ["csv", "npz", "h5", "parquet", "ulg"])
def test_damage_is_reported_in_one_line(suffix: str, tmp_path: Path) -> None:
    content = written(tmp_path, suffix).read_bytes()
    rng = np.random.default_rng(7)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for number in range(TRIES):
        path = tmp_path / f"{number}.{suffix}"
        path.write_bytes(mutated(content, rng))
        for read in (lambda p: read_signals(p, [SIGNAL], 0.01, LogSettings()), survey):
            try:
                read(path)
            except AmheError as error:
                assert str(path) in str(error)
                assert "\n" not in str(error)
        path.unlink()
    assert 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) < _MEMORY
