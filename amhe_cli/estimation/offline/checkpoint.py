"""Saving a search after every iteration, as plain numbers: no pickle is ever loaded from a file."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, fields
from hashlib import sha256
from pathlib import Path
from typing import Any, get_args

import numpy as np

from amhe_cli.core.each_log import same_values
from amhe_cli.core.errors import ConfigError
from amhe_cli.core.files import write_whole
from amhe_cli.estimation.core.linearise import FirstStates
from amhe_cli.estimation.core.result import Iteration
from amhe_cli.estimation.offline.cma import MEMORY, CmaState, memory_of, restored, start
from amhe_cli.estimation.offline.problem import Problem
from amhe_cli.estimation.offline.search import SearchState, Stage
from amhe_cli.matching.starts import first_index

FORMAT = 3
_STATES = {"linearised": SearchState, "cmaes": CmaState}
#: What reading a file that is no checkpoint may raise.
_FAULTS = (ValueError, OverflowError, LookupError, TypeError, AttributeError, OSError, RecursionError)
#: No number of a search is as large, but costs.
_LARGE = 1e30


class Checkpoint:
    """A JSON file with the search's state; floats are written with all their digits, so resuming is exact.

    Random numbers need no saving: each iteration draws from a generator made of the seed and its number.

    Args:
        path: The file; None saves nothing.
        problem: The problem, whose fingerprint must match on resuming.
        method: The requested method.
    """

    def __init__(self, path: Path | None, problem: Problem, method: str) -> None:
        self._path, self._problem = path, problem
        self._key = _fingerprint(problem, method)

    def save(self, state: SearchState | CmaState) -> None:
        """Replace the file by `state`, whole or not at all."""
        if self._path is None:
            return
        kind = "linearised" if isinstance(state, SearchState) else "cmaes"
        saved = {f.name: _plain(getattr(state, f.name)) for f in fields(state)}
        record = {"format": FORMAT, "problem": self._key, "kind": kind, "state": saved, "sum": _sum(saved)}
        write_whole(self._path, json.dumps(record))

    def load(self) -> SearchState | CmaState | None:
        """The saved state; None where there is none.

        Raises:
            ConfigError: The file is no checkpoint, or one of another problem.
        """
        if self._path is None or not self._path.exists():
            return None
        try:
            saved = json.loads(self._path.read_text())
            if saved["format"] != FORMAT:
                raise ValueError(f"format {saved['format']}")
            if saved["sum"] != _sum(saved["state"]):
                raise ValueError("its content was changed")
            state = _restore(saved["kind"], saved["state"])
            if saved["problem"] == self._key and not _whole(state, self._problem):
                raise ValueError("its content is no search's")
        except _FAULTS as error:
            raise ConfigError(
                f"{self._path}: not a checkpoint of this version ({error}); delete it to start anew"
            ) from None
        if saved["problem"] != self._key:
            raise ConfigError(
                f"{self._path}: a checkpoint of other logs, settings, seed or system; "
                f"repeat that command, or delete it to start anew"
            )
        return state


def _sum(state: dict[str, Any]) -> str:
    """Checksum of a state as it is saved: a changed one must not be taken for a search's own."""
    return sha256(json.dumps(state).encode()).hexdigest()


def _fingerprint(problem: Problem, method: str) -> str:
    """Hash of all that decides the search."""
    system = problem.system
    digest = sha256()
    for text in (
        method,
        str(problem.seed),
        system.spec.to_xml(),
        repr(system.space),
        system.settings.model_dump_json(),
    ):
        digest.update(text.encode())
    for part in problem.pool.parts:
        digest.update(f"{part.start} {part.stop} {part.log.dt} {same_values(part.log)}".encode())
        for key, series in sorted(part.log.series.items()):
            digest.update(key.encode())
            digest.update(series.values.tobytes())
            digest.update(series.sampled.tobytes())
    return digest.hexdigest()


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return {"array": value.ravel().tolist(), "shape": value.shape}
    if isinstance(value, tuple) and value and isinstance(value[0], Iteration):
        return [asdict(i) for i in value]
    if isinstance(value, FirstStates):
        return {"mean": _plain(value.mean), "shape": _plain(value.shape)}
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    return value


def _restore(kind: str, saved: dict[str, Any]) -> SearchState | CmaState:
    values = {k: _array(v) for k, v in saved.items()}
    values["record"] = tuple(Iteration(**{**i, "theta": tuple(i["theta"])}) for i in saved["record"])
    if values.get("first"):
        values["first"] = FirstStates(**values["first"])
    return _STATES[kind](**values)


def _whole(state: SearchState | CmaState, problem: Problem) -> bool:
    """Whether a search may have left this state behind: checksums keep nobody from writing another one."""
    d, c = len(problem.system.space), len(problem.clips)
    nx = first_index(problem.system).size * (problem.settings.identify.first_state != "never")
    checks: dict[str, Callable[[Any], bool]] = {
        "number": _is_count,
        "stage": lambda value: value in get_args(Stage),
        **dict.fromkeys(("done", "settled", "straight"), lambda value: isinstance(value, bool)),
        "z": lambda value: _is_array(value, d),
        "shape": lambda value: _is_array(value, d, d),
        "trail": lambda value: _is_array(value, len(value), d) or value.shape == (0, 0),
        "scale": lambda value: _is_array(np.array([*value.values()]), len(value))
        and min(value.values(), default=1.0) > 0.0,
        "record": lambda value: all(_is_entry(entry, d) for entry in value),
        "first": lambda value: value is None
        or (_is_array(value.mean, c, nx) and _is_array(value.shape, c, nx, min(value.shape.shape[-1], nx))),
        "memory": lambda value: value == {} or _is_memory(value, problem),
    }  # fmt: skip
    sound = all(checks[entry.name](getattr(state, entry.name)) for entry in fields(state))
    return sound and (bool(state.record) or not state.done)


def _is_array(value: Any, *shape: int) -> bool:
    numbers = isinstance(value, np.ndarray) and value.dtype.kind in "if"
    return numbers and value.shape == shape and bool((np.abs(value) < _LARGE).all())


def _is_count(value: Any) -> bool:
    return type(value) is int and 0 <= value < 2**53


def _is_entry(entry: Iteration, d: int) -> bool:
    sound = all(map(_is_count, (entry.number, entry.rollouts, entry.diverged)))
    sound = sound and isinstance(entry.method, str) and isinstance(entry.stage, str)
    sound = sound and isinstance(entry.cost, float) and entry.cost > -np.inf  # it may be infinite
    return sound and _is_array(np.array((*entry.theta, entry.sigma)), d + 1)


def _is_memory(value: dict[str, Any], problem: Problem) -> bool:
    *like, (last, history) = memory_of(restored(problem, start(problem), problem.rng(1, 0, 0))).items()
    sound = len(value) == len(MEMORY) and all(_is_array(value[name], *array.shape) for name, array in like)
    return sound and value[last].shape == history.shape and value[last].dtype == float  # any values


def _array(value: Any) -> Any:
    if not isinstance(value, dict):
        return value
    if set(value) == {"array", "shape"}:
        return np.array(value["array"]).reshape(value["shape"])
    return {k: _array(v) for k, v in value.items()}
