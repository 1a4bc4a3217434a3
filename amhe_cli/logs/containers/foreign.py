"""Files that are no logs, or not yet: what they are, by their content, and what makes a log of them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from zipfile import BadZipFile, ZipFile

_AS_TABLE = "save its numbers as a table: np.savez('run.npz', time=t, q=q)"
_VIDEO = "a video; amhe reads numbers: give the log that was recorded with it"
_PICTURE = "a picture; amhe reads numbers: give the log that was recorded with it"
_UTF16 = "text in UTF-16; save it as UTF-8: iconv -f UTF-16 -t UTF-8 {name} > run.csv"
_PICKLE = f"a Python pickle, which is not opened, because it can run any code; {_AS_TABLE}"
_RERUN = "a rerun recording (.rrd), which is not read; export it to CSV or parquet by rerun's dataframe API"
_MATLAB = "a MATLAB file; in MATLAB: writetable(table(time, q), 'run.csv')"
#: First bytes -> what it is, and what to do; {name} is the file's name.
_STARTS: Mapping[bytes, str] = {
    b"\x1f\x8b": "packed with gzip; unpack it: gunzip -k {name}",
    b"\xfd7zXZ\x00": "packed with xz; unpack it: unxz -k {name}",
    b"7z\xbc\xaf\x27\x1c": "a 7z archive; unpack it: 7z x {name}",
    b"Rar!": "a rar archive; unpack it: unrar x {name}",
    b"\x04\x22\x4d\x18": "packed with lz4; unpack it: lz4 -dk {name}",
    b"\xff\xfe": _UTF16,
    b"\xfe\xff": _UTF16,
    b"%PDF": "a PDF document; give the log itself",
    b"\x89PNG": _PICTURE,
    b"\xff\xd8\xff": _PICTURE,
    b"GIF8": _PICTURE,
    b"\x1aE\xdf\xa3": _VIDEO,
    b"\x7fELF": "a program (ELF); give the log that it writes",
    b"MZ\x90\x00": "a Windows program; give the log that it writes",
    b"\x80\x02": _PICKLE,
    b"\x80\x03": _PICKLE,
    b"\x80\x04": _PICKLE,
    b"\x80\x05": _PICKLE,
    b"RRF0": _RERUN,
    b"RRF1": _RERUN,
    b"RRF2": _RERUN,
    b"\xa3\x95": "an ArduPilot log (.bin), which is not read; export a message type as CSV with pymavlink: "
    "mavlogdump.py --format csv --types IMU {name} > imu.csv",
    b"FMT, 128": "an ArduPilot log as text, which is not read; give the columns of one message type as CSV",
    b"\xed\xa1\xda\x01": "an LCM log, which is not read; convert it to MCAP, or save its numbers as CSV",
    b"MATLAB 5.0 MAT": _MATLAB,
    b"MATLAB 7.3 MAT": _MATLAB,
    b"version https://git-lfs": "a pointer of Git LFS, not the file itself; fetch it: git lfs pull",
    b"<!DOCTYPE": "a web page, perhaps in place of a download that needs a login; fetch the file again",
    b"<html": "a web page, perhaps in place of a download that needs a login; fetch the file again",
    b"<mujoco": "a MuJoCo model, no log; for a system from model and log: amhe init {name} LOG",
    b"<robot": "a URDF model, no log; for a system from model and log: amhe init {name} LOG",
    b"<?xml": "an XML file, no log; for a system from a model and a log: amhe init MODEL LOG",
    b"\x93NUMPY": f"one numpy array; {_AS_TABLE}",
    b"ARROW1": "a feather (Arrow) file; with pandas: pandas.read_feather(PATH).to_parquet('run.parquet')",
    b"{": "JSON text, which is read in an MCAP file only; save its numbers as CSV, or as .npz",
    b"[": "JSON text, which is read in an MCAP file only; save its numbers as CSV, or as .npz",
    b"%YAML": "a YAML file, no log",
}  # fmt: skip


def foreign(path: Path, head: bytes) -> str | None:
    """What a file is that is no log, and what to do, in words; None where it may be one.

    Args:
        path: The file.
        head: Its first 512 bytes, or more.
    """
    if head[4:8] == b"ftyp" or (head.startswith(b"RIFF") and head[8:12] == b"AVI "):
        return _VIDEO
    if head[:3] == b"BZh" and head[4:10] == b"1AY&SY":
        return f"packed with bzip2; unpack it: bunzip2 -k {path.name}"
    if head[257:262] == b"ustar":
        return f"a tar archive; unpack it: tar -xf {path.name}"
    if head.startswith(b"PK\x03\x04"):
        return _zipped(path)
    text = head.removeprefix(b"\xef\xbb\xbf").lstrip()
    if text.startswith(b"[") and b"\n" in text and b'"' not in text and b"{" not in text:
        return None  # '[deg]' may begin the header of a table
    found = next((about for start, about in _STARTS.items() if text.startswith(start)), None)
    return found and found.replace("{name}", path.name)


def _zipped(path: Path) -> str | None:
    try:
        with ZipFile(path) as file:
            names = file.namelist()
    except (BadZipFile, OSError, ValueError, NotImplementedError):
        return "a zip file that is damaged or cut; copy it again"
    if any(name.startswith("xl/") for name in names):
        return "an Excel workbook; save the sheet as CSV"
    if any(name.endswith(".npy") for name in names):
        return None
    return f"a zip archive; unpack it: unzip {path.name}"
