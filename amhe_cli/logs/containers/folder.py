"""From a path to the files of a log, recognised by their first bytes, never by their names."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path, PurePath
from tempfile import NamedTemporaryFile
from typing import Any
from zipfile import BadZipFile, ZipFile

from amhe_cli.core.errors import ConfigError, LogError
from amhe_cli.core.files import check_regular
from amhe_cli.core.limits import beyond, limits
from amhe_cli.core.yaml_file import YamlFile
from amhe_cli.logs.containers import bag_file, lerobot, mcap_file, sqlite_file
from amhe_cli.logs.containers.raw import Batch, Connection, LogFile, Unfolder, batch_of, readable, unfold_file
from amhe_cli.logs.containers.table_file import TableFile
from amhe_cli.logs.containers.table_formats import open_tables

_ZSTD = b"\x28\xb5\x2f\xfd"
_BATCH_BYTES = 2**25
#: Endings of the tables that make a folder a log; a single file may have any name.
_TABLES = (".csv", ".tsv", ".npz", ".parquet", ".h5", ".hdf5")


_READERS: tuple[tuple[bytes, Callable[[Path], LogFile]], ...] = (
    (mcap_file.MAGIC, mcap_file.McapFile),
    (b"SQLite format 3\0", sqlite_file.SqliteFile),
    (bag_file.MAGIC, bag_file.BagFile),
)


@dataclass(frozen=True)
class StoredLog:
    """All files of one recording, read one after the other.

    Args:
        path: The path that the user gave.
        files: Parts of the log, in order.
        notes: Defects of the folder, in words.
        packed: Each message is compressed by itself (rosbag2's compression mode 'message').
        size: Size of its files [bytes].
        watch: Called with each batch before it is yielded.
    """

    path: Path
    files: tuple[LogFile, ...]
    notes: tuple[str, ...] = ()
    packed: bool = False
    size: int = 0
    watch: Callable[[Batch], None] | None = None

    @property
    def format(self) -> str:
        """Name of the format, for people."""
        formats = " + ".join(dict.fromkeys(file.format for file in self.files))
        paths = {file.path for file in self.files if isinstance(file, TableFile)}
        parts = "tables" if len(paths) == 1 else "files"
        return f"{formats} ({len(self.files)} {parts})" if len(self.files) > 1 else formats

    def batches(self, topics: Collection[str] | None) -> Iterator[Batch]:
        """Yield the messages of the named topics (None: all)."""
        unfolder, counts = Unfolder(self.size), Counter[str]()
        for file in self.files:
            for batch in file.batches(topics):
                _check_topics(file)
                counts[batch.connection.topic] += batch.starts.size
                if counts[batch.connection.topic] > limits().messages:
                    topic = batch.connection.topic
                    raise LogError(beyond("messages", f"the {counts[topic]} messages of topic {topic!r} are"))
                if self.watch is not None:
                    self.watch(batch)
                if self.packed:
                    yield from _unpacked(batch, unfolder)
                else:
                    yield batch
            _check_topics(file)

    @property
    def connections(self) -> list[Connection]:
        """Every declared connection; complete once `batches` has been read to its end."""
        return list(dict.fromkeys(connection for file in self.files for connection in file.connections))

    @property
    def problems(self) -> list[str]:
        """What was damaged, in words; complete once `batches` has been read to its end."""
        return [*self.notes, *(problem for file in self.files for problem in file.problems)]

    @property
    def metadata(self) -> dict[str, str]:
        """The `amhe` metadata record, of all files merged."""
        return {key: value for file in self.files for key, value in file.metadata.items()}


def open_log(path: Path) -> StoredLog:
    """Open a file, or a rosbag2 folder with all its parts.

    Raises:
        ConfigError: If there is no such path.
        LogError: If it is not a log.
    """
    if (episode := lerobot.open_episode(path)) is not None:
        return StoredLog(path, (episode,))
    if not path.exists():
        raise ConfigError(f"{path}: no such file or folder")
    if path.suffix.lower() in (".yaml", ".yml") and path.is_file():
        raise LogError(f"{path}: a YAML file is no log; as a data set it lists logs: name one of them")
    if not path.is_dir():
        check_regular(path)
        return StoredLog(path, tuple(_open_tables(path)) or (_open_file(path),))
    metadata = path / "metadata.yaml"
    check_regular(metadata, path)
    if not metadata.exists():
        return _open_bare_folder(path)
    return _open_folder(path, _information(metadata))


def _open_tables(path: Path) -> list[LogFile]:
    """The tables of a file, or of a folder; an empty list where there is none."""
    if not path.is_file():
        files = sorted(file for file in path.iterdir() if file.suffix.lower() in _TABLES and file.is_file())
        for file in files:
            check_regular(file, path)
        return [table for file in files for table in _open_tables(file)]
    with path.open("rb") as file:
        head = file.read(512)
    magics = (_ZSTD, *(magic for magic, _ in _READERS))
    if any(head.startswith(magic) or magic.startswith(head) for magic in magics):
        return []
    if (about := foreign(path, head)) is not None:
        raise LogError(f"{path}: {about}")
    return [*open_tables(path)]


def _open_file(path: Path) -> LogFile:
    check_regular(path)
    with path.open("rb") as file:
        head = file.read(16)
    if not head:
        raise LogError(f"{path}: the file is empty")
    if head.startswith(_ZSTD):
        with NamedTemporaryFile(prefix="amhe-", suffix=path.stem) as unfolded:
            unfold_file(path, unfolded.file)  # type: ignore[arg-type]
            unfolded.flush()
            # The readers keep the file open, so that its name may go away at once.
            return _open_file(Path(unfolded.name))
    for magic, reader in _READERS:
        if head.startswith(magic):
            return reader(path)
    if any(magic.startswith(head) for magic, _ in _READERS):
        raise LogError(f"{path}: the file ends after {len(head)} bytes")
    raise LogError(
        f"{path}: begins with the bytes {head[:8].hex(' ')}, which is no log that is known: MCAP, rosbag2 "
        ".db3, ROS 1 .bag, ULog, CSV, npz, parquet, HDF5; save its numbers as one of these"
    )


def _open_bare_folder(path: Path) -> StoredLog:
    inner = [file for file in path.iterdir() if re.search(r"\.(mcap|db3)(\.zstd)?$", file.name)]
    if not inner:
        if tables := _open_tables(path):
            return StoredLog(path, tuple(tables))
        raise LogError(f"{path}: a folder without metadata.yaml, .mcap, .db3 or .csv file is no log")
    inner.sort(key=lambda file: [int(n) for n in re.findall(r"\d+", file.name)])
    note = f"the folder has no metadata.yaml: {', '.join(file.name for file in inner)} taken as its parts"
    return _open_parts(path, inner, [note], packed=False)


def _open_folder(path: Path, information: dict[str, Any]) -> StoredLog:
    parts = [path / PurePath(name).name for name in information["relative_file_paths"]]
    present = [part for part in parts if part.exists()]
    if not present:
        raise LogError(f"{path}: none of the files that metadata.yaml names is there: {parts[0].name}, ...")
    notes = [f"{part.name} is missing: its messages are lost" for part in parts if part not in present]
    packed = str(information.get("compression_mode") or "").lower() == "message"
    return _open_parts(path, present, notes, packed)


def _open_parts(path: Path, parts: list[Path], notes: list[str], packed: bool) -> StoredLog:
    files: list[LogFile] = []
    for part in parts:
        check_regular(part, path)
        try:
            with readable(part):
                files.append(_open_file(part))
        except LogError as error:
            if len(parts) == 1:
                raise
            notes.append(str(error))
    if not files:
        raise LogError(f"{path}: none of its files can be read: {notes[-1]}")
    return StoredLog(path, tuple(files), tuple(notes), packed, sum(part.stat().st_size for part in parts))


def _information(metadata: Path) -> dict[str, Any]:
    try:
        information = YamlFile(metadata, patient=True).own["rosbag2_bagfile_information"]
        files = information["relative_file_paths"]
    except (ConfigError, KeyError, TypeError) as error:
        why = f" ({str(error).removeprefix(f'{metadata}:')})" if isinstance(error, ConfigError) else ""
        raise LogError(
            f"{metadata}: not a rosbag2 metadata.yaml{why}; remove it to read the files beside it as they are"
        ) from error
    if not isinstance(files, list) or not files or not all(isinstance(name, str) for name in files):
        raise LogError(f"{metadata}: it names no file")
    return information


def _check_topics(file: LogFile) -> None:
    if len(file.connections) > limits().topics:
        raise LogError(beyond("topics", f"{len(file.connections)} topics are"))


def _unpacked(batch: Batch, unfolder: Unfolder) -> Iterator[Batch]:
    """The batch with its messages unfolded, in as many batches as it then takes."""
    ends = batch.starts + batch.lengths
    begin, payloads, size = 0, [], 0
    for i, (start, end) in enumerate(zip(batch.starts.tolist(), ends.tolist(), strict=True), start=1):
        payloads.append(unfolder.unfold("zstd", batch.buffer[start:end].tobytes()))
        size += len(payloads[-1])
        if size > _BATCH_BYTES or i == ends.size:
            stamped = {"log_ns": batch.log_ns[begin:i], "publish_ns": batch.publish_ns[begin:i]}
            yield replace(batch_of(batch.connection, [], [], payloads), **stamped)
            begin, payloads, size = i, [], 0


_SEEN = "amhe reads numbers: give the log that was recorded with it"
_AS_TABLE = "save its numbers as a table: np.savez('run.npz', time=t, q=q)"
#: What is no log, and what to do, {name} being the file's name -> its first bytes.
_FOREIGN: Mapping[str, tuple[bytes, ...]] = {
    "packed with gzip; unpack it: gunzip -k {name}": (b"\x1f\x8b",),
    "packed with xz; unpack it: unxz -k {name}": (b"\xfd7zXZ\x00",),
    "packed with lz4; unpack it: lz4 -dk {name}": (b"\x04\x22\x4d\x18",),
    "text in UTF-16; save it as UTF-8: iconv -f UTF-16 -t UTF-8 {name} > run.csv": (b"\xff\xfe", b"\xfe\xff"),
    f"a picture; {_SEEN}": (b"\x89PNG", b"\xff\xd8\xff"),
    f"a video; {_SEEN}": (b"\x1aE\xdf\xa3",),
    f"a Python pickle, which is not opened, because it can run any code; {_AS_TABLE}": (
        b"\x80\x02", b"\x80\x03", b"\x80\x04", b"\x80\x05",
    ),
    "a rerun recording (.rrd), which is not read; export it to CSV or parquet by rerun's dataframe API": (
        b"RRF0", b"RRF1", b"RRF2",
    ),
    "an ArduPilot log (.bin), which is not read; export a message type as CSV with pymavlink: "
    "mavlogdump.py --format csv --types IMU {name} > imu.csv": (b"\xa3\x95",),
    "an ArduPilot log as text, which is not read; give the columns of one message type as CSV": (
        b"FMT, 128",
    ),
    "an LCM log, which is not read; convert it to MCAP, or save its numbers as CSV": (b"\xed\xa1\xda\x01",),
    "a MATLAB file; in MATLAB: writetable(table(time, q), 'run.csv')": (
        b"MATLAB 5.0 MAT", b"MATLAB 7.3 MAT",
    ),
    "a pointer of Git LFS, not the file itself; fetch it: git lfs pull": (b"version https://git-lfs",),
    "a web page, perhaps in place of a download that needs a login; fetch the file again": (
        b"<!DOCTYPE", b"<html",
    ),
    "a MuJoCo model, no log; for a system from model and log: amhe init {name} LOG": (b"<mujoco",),
    "a URDF model, no log; for a system from model and log: amhe init {name} LOG": (b"<robot",),
    "an XML file, no log; for a system from a model and a log: amhe init MODEL LOG": (b"<?xml",),
    f"one numpy array; {_AS_TABLE}": (b"\x93NUMPY",),
    "a feather (Arrow) file; with pandas: pandas.read_feather(PATH).to_parquet('run.parquet')": (b"ARROW1",),
    "JSON text, which is read in an MCAP file only; save its numbers as CSV, or as .npz": (b"{", b"["),
}  # fmt: skip


def foreign(path: Path, head: bytes) -> str | None:
    """What a file is that is no log, and what to do, in words; None where it may be one.

    Args:
        path: The file.
        head: Its first 512 bytes, or more.
    """
    if head[4:8] == b"ftyp" or (head.startswith(b"RIFF") and head[8:12] == b"AVI "):
        return f"a video; {_SEEN}"
    if head[:3] == b"BZh" and head[4:10] == b"1AY&SY":
        return f"packed with bzip2; unpack it: bunzip2 -k {path.name}"
    if head[257:262] == b"ustar":
        return f"a tar archive; unpack it: tar -xf {path.name}"
    if head.startswith(b"PK\x03\x04"):
        return _zipped(path)
    text = head.removeprefix(b"\xef\xbb\xbf").lstrip()
    if text.startswith(b"[") and b"\n" in text and b'"' not in text and b"{" not in text:
        return None  # '[deg]' may begin the header of a table
    found = next((about for about, starts in _FOREIGN.items() if text.startswith(starts)), None)
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
