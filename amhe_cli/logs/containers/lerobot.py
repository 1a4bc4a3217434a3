"""LeRobot datasets on disk, versions 2 and 3: each episode is a log, addressed as `dataset#3`.

A version 2 dataset has a parquet file for each episode; version 3 has files of many episodes, and says in
meta/episodes which file holds which. An entry of the state and of the action is a column of its own, called
by the names in meta/info.json: `observation.state.elbow_flex.pos`.
"""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from amhe_cli.core.errors import ConfigError, LogError
from amhe_cli.core.files import check_regular
from amhe_cli.core.limits import beyond, limits
from amhe_cli.logs.containers.arrow_file import parquet_arrays
from amhe_cli.logs.containers.table_file import TableFile
from amhe_cli.logs.containers.table_formats import in_memory, needed

logger = logging.getLogger(__name__)

#: Features whose numbers are joint angles on most robots.
_ANGLES = ("observation.state", "action")
#: Features that count frames.
_COUNTERS = {"index", "frame_index", "episode_index", "task_index"}
#: Angles beyond a turn [rad] are not in radians; LeRobot's normalised units end at 100, degrees at a turn.
_TURN, _NORMALISED, _DEGREES = 2.0 * np.pi + 0.1, 100.5, 400.0
#: What a damaged description raises.
_WRONG = (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError)
_UNITS = {"deg": "deg", "degree": "deg", "degrees": "deg", "rad": "rad", "radian": "rad", "radians": "rad"}


@dataclass(frozen=True, slots=True, eq=False)
class Dataset:
    """A dataset as its meta/info.json describes it.

    Args:
        folder: The dataset.
        version: Major version of its format.
        episodes: Number of episodes.
        info: The content of meta/info.json.
    """

    folder: Path
    version: int
    episodes: int
    info: Mapping[str, Any]


def is_dataset(path: Path) -> bool:
    """Whether a folder is a LeRobot dataset."""
    return (path / "meta" / "info.json").is_file()


def episode_paths(path: Path) -> list[Path]:
    """The logs that a path names: all episodes of `dataset`, those of `dataset#3:10`; else the path itself.

    Raises:
        ConfigError: There is no such episode.
        LogError: The dataset cannot be read.
    """
    folder, episodes = _address(path)
    if folder is None:
        return [path]
    count = open_dataset(folder).episodes
    if not (match := re.fullmatch(r"(\d*)(:?)(\d*)", episodes)):
        raise ConfigError(f"{path}: name an episode, {folder}#3, or a range of them, {folder}#3:10")
    first = int(match.group(1) or 0)
    last = int(match.group(3) or count) if match.group(2) or not episodes else first + 1
    if not 0 <= first < last <= count:
        raise ConfigError(f"{path}: the dataset has the episodes 0 to {count - 1}")
    return [Path(f"{folder}#{number}") for number in range(first, last)]


def open_episode(path: Path) -> TableFile | None:
    """One episode as a log; None if the path is of no dataset.

    Raises:
        ConfigError: There is no such episode, or the path names several.
        LogError: It cannot be read.
    """
    folder, _ = _address(path)
    if folder is None:
        return None
    found = episode_paths(path)
    if len(found) > 1:
        raise ConfigError(f"{path}: each episode of a dataset is a log; name one, such as {found[0]}")
    number = int(str(found[0]).rpartition("#")[2])
    dataset = open_dataset(folder)
    needed(folder, "pyarrow", "a LeRobot dataset")
    arrays = _columns(dataset, _rows(dataset, number))
    return TableFile(path, f"LeRobot v{dataset.version}", in_memory(path, folder.resolve().name, arrays))


def open_dataset(folder: Path) -> Dataset:
    """Read meta/info.json.

    Raises:
        LogError: It is damaged, or of a version that is not read.
    """
    file = folder / "meta" / "info.json"
    check_regular(file, folder)
    try:
        info = json.loads(_described(file))
        version = int(re.findall(r"\d+", str(info["codebase_version"]))[0])
        episodes, features = int(info["total_episodes"]), info["features"]
        usable = all(isinstance(feature, dict) for feature in features.values()) and episodes < 1_000_000
    except (*_WRONG, AttributeError, IndexError) as error:
        raise LogError(f"{file}: no description of a LeRobot dataset ({error!r})") from None
    if not usable:
        raise LogError(f"{file}: no description of a LeRobot dataset (its features)")
    if version not in (2, 3):
        raise LogError(f"{folder}: a LeRobot dataset of version {version}; versions 2 and 3 are read")
    return Dataset(folder, version, episodes, info)


def _described(file: Path) -> str:
    """The text of a description.

    Raises:
        LogError: It is beyond the limit `yaml_mib`.
    """
    if file.stat().st_size > limits().yaml:
        raise LogError(f"{file}: {beyond('yaml_mib', f'its {file.stat().st_size} bytes are')}")
    return file.read_text(encoding="utf-8")


def _address(path: Path) -> tuple[Path | None, str]:
    """Folder of the dataset that a path names, None if it names none, and the part behind '#'."""
    if is_dataset(path):
        return path, ""
    base, mark, episodes = str(path).rpartition("#")
    folder = Path(base)
    return (folder, episodes) if mark and not path.exists() and is_dataset(folder) else (None, "")


def _rows(dataset: Dataset, number: int) -> dict[str, np.ndarray]:
    """The numbers of one episode, feature by feature."""
    file = _file_of(dataset, number)
    wanted = [name for name, kind in _kinds(dataset).items() if kind not in ("video", "image", "string")]
    found = parquet_arrays(file, wanted, number)
    if not any(array.size for array in found.values()):
        raise LogError(f"{dataset.folder}#{number}: {file.name} has no frame of this episode")
    return found


def _kinds(dataset: Dataset) -> dict[str, str]:
    return {str(name): str(feature.get("dtype")) for name, feature in dataset.info["features"].items()}


def _file_of(dataset: Dataset, number: int) -> Path:
    folder, size = dataset.folder, dataset.info.get("chunks_size") or 1000
    places: dict[str, int] = {"episode_index": number, "episode_chunk": number // int(size)}
    usual = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
    if dataset.version == 3:
        usual = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
        places |= _place_in_v3(folder, number)
    pattern = str(dataset.info.get("data_path"))
    plain = set(re.findall(r"\{(\w+):0\dd\}", pattern)) <= set(places)
    whole = re.fullmatch(r"([^{}]|\{\w+:0\dd\})+", pattern)
    name = (pattern if plain and whole and pattern.endswith(".parquet") else usual).format(**places)
    file = folder / name
    if ".." in Path(name).parts or not file.is_file():
        raise LogError(f"{folder}#{number}: its file {name} is missing")
    check_regular(file, folder)
    return file


def _place_in_v3(folder: Path, number: int) -> dict[str, int]:
    keys, episodes = ("data/chunk_index", "data/file_index"), folder / "meta" / "episodes"
    check_regular(episodes, folder)
    for file in sorted(episodes.rglob("*.parquet")):
        check_regular(file, folder)
        found = parquet_arrays(file, keys, number)
        if len(found) == len(keys) and found[keys[0]].size:
            return {key.removeprefix("data/"): int(found[key][0]) for key in keys}
    raise LogError(f"{folder}#{number}: meta/episodes does not list it")


def _columns(dataset: Dataset, arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """One column for each named number, with its unit."""
    unit = _unit(dataset.folder, (dataset.folder / "meta" / "info.json").stat().st_mtime_ns)
    columns: dict[str, np.ndarray] = {}
    for name, array in arrays.items():
        if name in _COUNTERS or name.startswith("next."):
            continue
        entries = _entries(dataset, name)
        if name == "timestamp":
            columns["timestamp [s]"] = array.reshape(-1)
        elif array.ndim == 2 and len(entries) == array.shape[1]:
            for place, entry in enumerate(entries):
                own = f" [{unit}]" if unit and name in _ANGLES and _turns(entry) else ""
                columns[f"{name}.{entry}{own}"] = array[:, place]
        else:
            columns[f"{name} [{unit}]" if unit and name in _ANGLES else name] = array
    return columns


def _entries(dataset: Dataset, feature: str) -> tuple[str, ...]:
    """Names of the numbers of a feature, from a list or from {'motors': [...]}; none if they repeat."""
    names = dataset.info["features"].get(feature, {}).get("names")
    if isinstance(names, dict):
        names = next((value for value in names.values() if isinstance(value, list)), None)
    found = tuple(map(str, names)) if isinstance(names, list) else ()
    return found if len(set(found)) == len(found) else ()


def _turns(entry: str) -> bool:
    """Whether an entry is an angle: LeRobot gives a gripper in percent."""
    return "gripper" not in entry.lower()


@lru_cache(maxsize=64)
def _unit(folder: Path, changed_ns: int) -> str:
    """'deg' if the angles are degrees, else ''; says once what was found.

    Args:
        folder: The dataset.
        changed_ns: When its description was written: a dataset may grow.
    """
    dataset = open_dataset(folder)
    for name in _ANGLES:
        feature = dataset.info["features"].get(name, {})
        named = _UNITS.get(str(feature.get("unit") or feature.get("units") or "").lower())
        if named:
            return "deg" if named == "deg" else ""
    largest = _largest(dataset)
    if _NORMALISED < largest <= _DEGREES:
        logger.warning(
            "%s: angles up to %.0f are degrees; they are converted to radians, a gripper's numbers are not",
            folder,
            largest,
        )
        return "deg"
    if _TURN < largest <= _NORMALISED:
        logger.warning(
            "%s: joint values up to %.0f are LeRobot's normalised units (-100 to 100 of each joint's range) "
            "or degrees, and not converted. If they are degrees, add 'unit': 'deg' to observation.state in "
            "meta/info.json; if not, record with use_degrees=true",
            folder, largest,
        )  # fmt: skip
    return ""


def _largest(dataset: Dataset) -> float:
    """The largest angle of states and actions in the dataset's statistics; 0 where they are not known."""
    largest = 0.0
    for statistics in _statistics(dataset.folder):
        for name in _ANGLES:
            entries = _entries(dataset, name)
            for bound in ("min", "max"):
                try:
                    values = np.abs(np.array(statistics[name][bound], dtype=np.float64)).reshape(-1)
                except (KeyError, TypeError, ValueError):
                    continue
                turning = [_turns(entry) for entry in entries]
                values = values[turning] if len(turning) == values.size else values
                largest = max(largest, float(np.max(values, initial=0.0, where=np.isfinite(values))))
    return largest


def _statistics(folder: Path) -> Sequence[Mapping[str, Any]]:
    """Of the whole dataset, or of each episode (version 2.1)."""
    whole, each = folder / "meta" / "stats.json", folder / "meta" / "episodes_stats.jsonl"
    for file in (whole, each):
        check_regular(file, folder)
    try:
        if whole.is_file():
            return [json.loads(_described(whole))]
        if each.is_file():
            lines = _described(each).splitlines()
            return [json.loads(line)["stats"] for line in lines if line]
    except _WRONG as error:
        logger.warning("%s: its statistics are damaged: units are not checked (%s)", folder, error)
    return []
