"""LeRobot datasets on disk, versions 2 and 3: each episode is a log, addressed as `dataset#3`.

A version 2 dataset has a parquet file for each episode; version 3 has files of many episodes, and says in
meta/episodes which file holds which. An entry of the state and of the action is a column of its own, called
by the names in meta/info.json: `observation.state.elbow_flex.pos`.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, BeforeValidator, Field, ValidationError

from amhe_cli.core.errors import ConfigError, LogError
from amhe_cli.core.files import check_regular
from amhe_cli.core.limits import beyond, limits
from amhe_cli.logs.containers.table_file import TableFile
from amhe_cli.logs.containers.table_formats import in_memory, needed, parquet_arrays

#: Features that count frames.
_COUNTERS = {"index", "frame_index", "episode_index", "task_index"}
#: Where an episode's file is, by the version of the dataset, unless its description says so.
_USUAL = {
    2: "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
    3: "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
}


class _Feature(BaseModel):
    dtype: str = ""
    names: Any = None

    @property
    def entries(self) -> tuple[str, ...]:
        """Names of its numbers, from a list or from {'motors': [...]}; none if they repeat."""
        given = self.names
        if isinstance(given, dict):
            given = next((value for value in given.values() if isinstance(value, list)), None)
        found = tuple(map(str, given)) if isinstance(given, list) else ()
        return found if len(set(found)) == len(found) else ()


class _Info(BaseModel):
    """A dataset as its meta/info.json describes it."""

    codebase_version: Annotated[
        int, BeforeValidator(lambda v: int(re.findall(r"\d+", str(v))[0]))
    ]  # 2 of v2.1
    total_episodes: Annotated[int, Field(lt=1_000_000)]
    features: dict[str, _Feature]
    chunks_size: int = 1000
    data_path: str = ""


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
    count = _info(folder).total_episodes
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
    number, info = int(str(found[0]).rpartition("#")[2]), _info(folder)
    needed(folder, "pyarrow", "a LeRobot dataset")
    file = _file_of(folder, info, number)
    wanted = [n for n, feature in info.features.items() if feature.dtype not in ("video", "image", "string")]
    arrays = parquet_arrays(file, wanted, number)
    if not any(array.size for array in arrays.values()):
        raise LogError(f"{folder}#{number}: {file.name} has no frame of this episode")
    format = f"LeRobot v{info.codebase_version}"
    return TableFile(path, format, in_memory(path, folder.resolve().name, _columns(info, arrays)))


def _info(folder: Path) -> _Info:
    """The content of meta/info.json.

    Raises:
        LogError: It is damaged, too large, or of a version that is not read.
    """
    file = folder / "meta" / "info.json"
    check_regular(file, folder)
    if file.stat().st_size > limits().yaml:
        raise LogError(f"{file}: {beyond('yaml_mib', f'its {file.stat().st_size} bytes are')}")
    try:
        info = _Info.model_validate(json.loads(file.read_text(encoding="utf-8")))
    except (OSError, ValueError, IndexError, OverflowError, RecursionError) as error:
        why = error.errors()[0]["msg"] if isinstance(error, ValidationError) else repr(error)
        raise LogError(f"{file}: no description of a LeRobot dataset ({why})") from None
    if info.codebase_version not in _USUAL:
        version = info.codebase_version
        raise LogError(f"{folder}: a LeRobot dataset of version {version}; versions 2 and 3 are read")
    return info


def _address(path: Path) -> tuple[Path | None, str]:
    """Folder of the dataset that a path names, None if it names none, and the part behind '#'."""
    if is_dataset(path):
        return path, ""
    base, mark, episodes = str(path).rpartition("#")
    folder = Path(base)
    return (folder, episodes) if mark and not path.exists() and is_dataset(folder) else (None, "")


def _file_of(folder: Path, info: _Info, number: int) -> Path:
    places = {"episode_index": number, "episode_chunk": number // max(info.chunks_size, 1)}
    if info.codebase_version == 3:
        places |= _place_in_v3(folder, number)
    plain = re.fullmatch(r"([^{}]|\{\w+:0\dd\})+\.parquet", info.data_path)  # no other code of a format
    known = set(re.findall(r"\{(\w+)", info.data_path)) <= set(places)
    name = (info.data_path if plain and known else _USUAL[info.codebase_version]).format(**places)
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


def _columns(info: _Info, arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """One column for each named number."""
    columns: dict[str, np.ndarray] = {}
    for name, array in arrays.items():
        entries = info.features[name].entries
        if name == "timestamp":
            columns["timestamp [s]"] = array.reshape(-1)
        elif array.ndim == 2 and len(entries) == array.shape[1]:
            columns |= {f"{name}.{entry}": array[:, place] for place, entry in enumerate(entries)}
        elif name not in _COUNTERS and not name.startswith("next."):
            columns[name] = array
    return columns
