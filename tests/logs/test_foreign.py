"""Files that are no logs: one line says what they are, by content, and what to do."""

from __future__ import annotations

import bz2
import gzip
import io
import json
import lzma
import pickle
import tarfile
import zipfile
from pathlib import Path

import numpy as np
import pytest

from amhe_cli.core.errors import LogError
from amhe_cli.logs import survey

TABLE = b"time,q\n0.0,1.0\n0.1,2.0\n0.2,3.0\n"


def zipped(name: str) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr(name, TABLE)
    return file.getvalue()


def tarred() -> bytes:
    file = io.BytesIO()
    with tarfile.open(fileobj=file, mode="w") as archive:
        about = tarfile.TarInfo("run.csv")
        about.size = len(TABLE)
        archive.addfile(about, io.BytesIO(TABLE))
    return file.getvalue()


FILES = {
    "gzip": (gzip.compress(TABLE), "gunzip -k run.csv"),
    "bzip2": (bz2.compress(TABLE), "bunzip2 -k run.csv"),
    "xz": (lzma.compress(TABLE), "unxz -k run.csv"),
    "zip": (zipped("run.csv"), "unzip run.csv"),
    "Excel": (zipped("xl/workbook.xml"), "save the sheet as CSV"),
    "tar": (tarred(), "tar -xf run.csv"),
    "UTF-16": ("time,q".encode("utf-16"), "save it as UTF-8: iconv -f UTF-16"),
    "video": (b"\x00\x00\x00\x20ftypisom\x00\x00\x02\x00", "give the log that was recorded with it"),
    "picture": (b"\x89PNG\r\n\x1a\n", "give the log that was recorded with it"),
    "pickle": (pickle.dumps({"q": [1.0]}), "np.savez"),
    "rerun": (b"RRF2\x00\x12\x01\x00", "dataframe API"),
    "ArduPilot": (b"\xa3\x95\x80\x80\x59FMT\x00BBnNZ", "mavlogdump.py --format csv --types IMU run.csv"),
    "MATLAB": (b"MATLAB 5.0 MAT-file, Platform: GLNXA64", "writetable"),
    "LCM": (b"\xed\xa1\xda\x01" + bytes(30), "convert it to MCAP"),
    "Git LFS": (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n", "git lfs pull"),
    "web page": (b"<!DOCTYPE html>\n<html></html>", "fetch the file again"),
    "MuJoCo model": (b"\n<mujoco model='arm'>\n</mujoco>", "amhe init run.csv LOG"),
    "URDF model": (b"<robot name='arm'>\n</robot>", "amhe init run.csv LOG"),
    "JSON": (json.dumps([{"time": 0.0, "q": 1.0}]).encode(), "as CSV"),
}


@pytest.mark.parametrize("kind", sorted(FILES))
def test_it_is_named_by_content(kind: str, tmp_path: Path) -> None:
    content, advice = FILES[kind]
    path = tmp_path / "run.csv"
    path.write_bytes(content)
    with pytest.raises(LogError) as caught:
        survey(path)
    text = str(caught.value)
    assert str(path) in text and kind in text and advice in text and "\n" not in text


@pytest.mark.parametrize("header", ["MZ", "RRF_hip", "BZh", "MATLAB", "[deg]"])
def test_a_table_is_not_taken_for_one(header: str, tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    rows = "".join(f"{np.sin(0.1 * i)},{0.1 * i}\n" for i in range(20))
    path.write_text(f"{header},time\n{rows}")
    assert survey(path).topics[0].count == 20
