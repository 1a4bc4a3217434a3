"""Saving a search after every iteration, as plain numbers: no pickle is ever loaded from a file."""

from __future__ import annotations

import json
from dataclasses import asdict, fields
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from amhe_cli.core.each_log import same_values
from amhe_cli.core.errors import ConfigError
from amhe_cli.core.files import write_whole
from amhe_cli.estimation.core.linearise import FirstStates
from amhe_cli.estimation.core.result import Iteration
from amhe_cli.estimation.offline.cma import CmaState
from amhe_cli.estimation.offline.problem import Problem
from amhe_cli.estimation.offline.search import SearchState

FORMAT = 3
_STATES = {"linearised": SearchState, "cmaes": CmaState}


class Checkpoint:
    """A JSON file with the search's state; floats are written with all their digits, so resuming is exact.

    Random numbers need no saving: each iteration draws from a generator made of the seed and its number.

    Args:
        path: The file; None saves nothing.
        problem: The problem, whose fingerprint must match on resuming.
        method: The requested method.
    """

    def __init__(self, path: Path | None, problem: Problem, method: str) -> None:
        self._path = path
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
        except (ValueError, LookupError, TypeError, AttributeError, OSError, RecursionError) as error:
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


def _array(value: Any) -> Any:
    if not isinstance(value, dict):
        return value
    if set(value) == {"array", "shape"}:
        return np.array(value["array"]).reshape(value["shape"])
    return {k: _array(v) for k, v in value.items()}
