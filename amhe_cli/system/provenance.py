"""The record of how a result was made, so that others can repeat it."""

from __future__ import annotations

import hashlib
import os
import platform
from collections.abc import Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

from amhe_cli import __version__
from amhe_cli.core.files import plain
from amhe_cli.core.log import Log
from amhe_cli.system.description.folders import bundled_systems
from amhe_cli.system.system import System

#: Files of a system folder that decide what the system is.
SYSTEM_SUFFIXES = frozenset(
    {".yaml", ".yml", ".xml", ".urdf", ".obj", ".stl", ".msh", ".dae", ".png", ".msg"}
)


def provenance(
    command_line: str,
    seed: int,
    method: str,
    system: System,
    logs: Sequence[Path | Log],
    held_out: Sequence[Path | Log],
) -> dict[str, object]:
    """Versions, hashes of all files, seed and command of one identification, as plain values.

    Args:
        command_line: The command or the call that made the result.
        seed: Seed of the random numbers.
        method: Name of the estimation method.
        logs: Logs that were fitted; one that was made from arrays is hashed by its values.
        held_out: Logs that were used only for validation.
    """
    return {
        "created": now(),
        "command": command_line,
        "method": method,
        "seed": seed,
        "versions": versions(),
        "system_folder": _own_folder(system),
        "system_files": system_files(system),
        "logs": hashes(logs),
        "held_out_logs": hashes(held_out),
    }


def inputs_record(system: System, logs: Sequence[Log], held_out: Sequence[Log] = ()) -> dict[str, object]:
    """What a result was made from, as plain values with which `amhe view` opens it all again.

    Args:
        logs, held_out: See `provenance`; of those that were read from files, the arguments of `read_log`.

    Returns:
        `system` (name or folder; None: it was made by `from_model`), `settings` over those of its
        `system.yaml`, and `logs`.
    """
    readings: list[dict[str, object]] = []
    for log in (*logs, *held_out):
        if log.reading and not any(earlier.items() >= log.reading.items() for earlier in readings):
            readings.append({**log.reading, "held_out": log in held_out})
    name = _own_folder(system) or (system.folder and system.name)
    return plain({"system": name, "settings": system.given, "logs": readings})


def _own_folder(system: System) -> str | None:
    """Path of a system's folder; None for those that come with amhe, which their name finds."""
    bundled = system.folder is None or bundled_systems().get(system.folder.name) == system.folder
    return None if bundled else str(system.folder)


def system_files(system: System) -> dict[str, str]:
    """Hash of each file of a system folder; of its texts where the system has no folder."""
    if system.folder is None:
        texts = {"model.xml": system.original.to_xml(), "system.yaml": system.text}
        return {name: hashlib.sha256(text.encode()).hexdigest() for name, text in texts.items()}
    return {
        str(path.relative_to(system.folder)): sha256(path)
        for path in _files(system.folder)
        if path.suffix.lower() in SYSTEM_SUFFIXES
    }


def estimator_provenance(
    command_line: str, seed: int, method: str, system: System, inputs: Sequence[Path]
) -> dict[str, object]:
    """The record of a command that fits nothing offline; `inputs` are its logs and beliefs."""
    origin = provenance(command_line, seed, method, system, inputs, ())
    return origin | {"inputs": origin.pop("logs")}


def attachments(system: System) -> dict[str, str]:
    """Texts that are attached to each log that we write: its settings and its system, by file name."""
    return {
        "settings.yaml": system.settings.model_dump_json(indent=2) + "\n",  # JSON is YAML too
        "system.yaml": system.text,
    }


def now() -> str:
    """Current time (UTC), to the second, as ISO 8601."""
    return datetime.now(UTC).isoformat(timespec="seconds")


def machine() -> dict[str, str]:
    """Hardware and operating system of this machine, without its name."""
    return {
        "processor": _processor(),
        "cores": str(os.cpu_count()),
        "system": platform.system(),
        "python": platform.python_version(),
    }


def _processor() -> str:
    """Name of the processor: from Linux where it has one, else from Python."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    named = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return named[0] if named else platform.processor() or platform.machine()


def versions() -> dict[str, str]:
    """Versions of the software that the numbers depend on."""
    return {
        "amhe": __version__,
        "mujoco": version("mujoco"),
        "numpy": version("numpy"),
        "python": platform.python_version(),
    }


def sha256(path: Path) -> str:
    """SHA-256 of a file's content, as hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def hashes(logs: Sequence[Path | Log]) -> dict[str, str]:
    """Hash of each log, by its path or name; a folder contributes every file in it."""
    digests: dict[str, str] = {}
    files: dict[Path, None] = {}
    for log in logs:
        if isinstance(log, Path):
            files |= dict.fromkeys(_log_files(log))
        elif log.file is not None and log.file.exists():
            files |= dict.fromkeys(_log_files(log.file))
        else:
            again = sum(name.partition(" #")[0] == log.source for name in digests)
            digests[f"{log.source} #{again + 1}" if again else log.source] = log.digest()
    return digests | {str(file): sha256(file) for file in files}


def _log_files(path: Path) -> list[Path]:
    """Files of a log; those of an episode, `dataset#3`, are the dataset's, without its videos."""
    if not path.exists() and "#" in str(path):
        folder = Path(str(path).rpartition("#")[0])
        return [file for file in _files(folder) if file.suffix in (".parquet", ".json", ".jsonl")]
    return _files(path) if path.is_dir() else [path]


def _files(folder: Path) -> list[Path]:
    """Files below a folder in sorted order, without hidden ones."""
    return sorted(
        path
        for path in folder.rglob("*")
        if path.is_file() and not any(part.startswith(".") for part in path.relative_to(folder).parts)
    )
