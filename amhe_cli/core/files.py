"""Files and folders that appear whole or not at all, and values that any JSON reader understands."""

from __future__ import annotations

import errno
import glob
import json
import math
import os
import shutil
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

from amhe_cli.core.errors import AmheError, ConfigError

#: Errors of writing alone: a full disk, a quota, a limit on the size of files.
WRITING = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def check_regular(path: Path, folder: Path | None = None) -> None:
    """Refuse a pipe or a device, on which reading may wait for ever, and a link that leads out of a folder.

    Args:
        path: The file.
        folder: The folder of a log, whose files are its own; None: any link is followed.

    Raises:
        ConfigError: There is such a thing at `path`.
    """
    if folder is not None and not path.resolve().is_relative_to(folder.resolve()):
        raise ConfigError(f"{path}: a link that leads out of {folder}; put the file itself in its place")
    try:
        other = path.exists() and not path.is_file() and not path.is_dir()
    except OSError as error:  # a name that no file can have
        raise ConfigError(f"{path.name[:40]} ...: {error.strerror}; give another name") from None
    if other:
        raise ConfigError(f"{path}: a pipe or a device, no file; save its content in a file")


@contextmanager
def whole(path: Path, keep: bool = False) -> Iterator[BinaryIO]:
    """Open a scratch file that takes the place of `path` once the block has ended well.

    Nobody ever reads half a file. If the block raises, `path` stays as it was.

    Args:
        path: The file.
        keep: Keep as `path` what was written before the file could not be written any more.

    Raises:
        OSError: The file cannot be written, as on a full disk.
    """
    scratch = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        with scratch.open("wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        scratch.replace(path)
    except OSError as error:
        if keep and scratch.exists():
            scratch.replace(path)
        if error.errno and str(error.filename or scratch) == str(scratch):  # that of a write names no file
            error.filename = str(path)
        raise
    finally:
        scratch.unlink(missing_ok=True)


@contextmanager
def filling(folder: Path, keep: bool = False, force: bool = True) -> Iterator[Path]:
    """Yield an empty scratch folder; its files move into `folder` at the end, or are deleted on an error.

    A new folder appears in one rename; in an existing one, which may be a file system of its own, each file
    is replaced in one rename.

    Args:
        keep: Move the files also if one of them could not be written, as on a full disk.
        force: Write into a folder that is not empty.

    Raises:
        AmheError: It is not empty at the end, and `force` is not given: another command wrote it meanwhile.
            The files are in a folder beside it, which the text names.
    """
    folder = Path(os.path.abspath(folder))  # noqa: PTH100 -- resolve() would follow a link that is to stay
    folder.parent.mkdir(parents=True, exist_ok=True)
    beside = folder if folder.exists() else folder.parent
    scratch = beside / f".{folder.name}.{os.getpid()}-{uuid.uuid4().hex[:8]}.partial"
    scratch.mkdir()
    try:
        yield scratch
        if not force and folder.exists() and any(path != scratch for path in folder.iterdir()):
            aside = fresh(folder)
            scratch.rename(aside)
            raise AmheError(
                f"{folder}: another command has written it meanwhile; these results are in {aside}"
            )
        _move(scratch, folder)
    except OSError as error:
        if error.errno in WRITING and error.filename is None:  # as that of a write
            error.filename = str(folder)
        if keep and any(scratch.iterdir()):
            _move(scratch, folder)
            if error.filename:
                error.filename = str(error.filename).replace(str(scratch), str(folder))
        raise
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def fresh(path: Path, suffix: str = "") -> Path:
    """A path that does not exist: this one, or the first free of `path-2`, `path-3`, ...; and a suffix."""
    candidate, number = path.with_name(path.name + suffix), 1
    while candidate.exists():
        number += 1
        candidate = path.with_name(f"{path.name}-{number}{suffix}")
    return candidate


def _move(scratch: Path, folder: Path) -> None:
    """Move all files into a folder, in one rename where it is new."""
    if not folder.exists():
        scratch.rename(folder)
        return
    for file in sorted(path for path in scratch.rglob("*") if path.is_file()):
        place = folder / file.relative_to(scratch)
        place.parent.mkdir(parents=True, exist_ok=True)
        file.replace(place)


def abandoned(folder: Path) -> list[Path]:
    """Scratch folders of `filling(folder)` whose process was killed; what it wrote is in them."""
    folder = Path(os.path.abspath(folder))  # noqa: PTH100 -- as in `filling`
    pattern = f".{glob.escape(folder.name)}.*.partial"
    folders = [*folder.parent.glob(pattern), *folder.glob(pattern)]
    return [path for path in sorted(folders) if not _lives(path.name.split(".")[-2].split("-")[0])]


def _lives(process: str) -> bool:
    """Whether there is a process of a number."""
    try:
        os.kill(int(process), 0)
    except (ProcessLookupError, ValueError, OverflowError):
        return False
    except PermissionError:
        return True
    return True


def write_whole(path: Path, text: str) -> None:
    """Write a text file (UTF-8) whole or not at all; see `whole`."""
    with whole(path) as file:
        file.write(text.encode())


def plain(value: Any) -> Any:
    """Built-in types only; NaN and infinity, which JSON lacks, become None."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if hasattr(value, "tolist"):  # numpy's arrays and numbers; the command's completion must not load it
        return plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def json_text(record: object) -> str:
    """The content of a JSON file for people and programs: indented, without NaN or infinity."""
    return json.dumps(record, indent=2, allow_nan=False) + "\n"
