"""A cell is one run of a study: task, mode, setting, seed. Its name holds the hash of all that decides it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

#: Ends of the settings that hold a parameter at a value that was measured before.
HELD = (".held", ".held_sd")
#: Settings that differ from the defaults, as sorted (path, value) pairs: (("control.samples", 16),).
Setting = tuple[tuple[str, Any], ...]


@dataclass(frozen=True, slots=True)
class Cell:
    """One run of a study.

    Args:
        task, mode, seed: Task, mode and seed, as in `amhe run`.
        setting: Settings that differ from the defaults.
        belief: Content of a belief file that replaces the mode's fixed numbers; None: there is none.
        duration: Longest duration of the run [s].
    """

    task: str
    mode: str
    seed: int
    setting: Setting = ()
    belief: str | None = None
    duration: float = 40.0

    @property
    def title(self) -> str:
        """The cell in words: 't4 adaptive, mhe.samples=8, seed 3'."""
        return ", ".join(filter(None, (f"{self.task} {self.mode}", words(self.setting), f"seed {self.seed}")))

    def plain(self) -> dict[str, Any]:
        """The cell in built-in types, for JSON and for other machines."""
        return asdict(self) | {"setting": dict(self.setting)}

    def file_name(self, code: Mapping[str, str]) -> str:
        """Name of the file of its result under a version of the code: 't4-true-03-5d41402abc4b.json'."""
        text = json.dumps([self.plain(), dict(code)], sort_keys=True)
        return (
            f"{self.task}-{self.mode}-{self.seed:02d}-{hashlib.sha256(text.encode()).hexdigest()[:12]}.json"
        )


def cell_of(plain: Mapping[str, Any]) -> Cell:
    """The cell that `Cell.plain` came from."""
    return Cell(**{**plain, "setting": setting_of(plain["setting"])})


def setting_of(values: Mapping[str, Any]) -> Setting:
    """Sorted pairs of a mapping; lists become tuples, so that settings can be compared and looked up."""
    return tuple((path, _frozen(value)) for path, value in sorted(values.items()))


def _frozen(value: Any) -> Any:
    return tuple(_frozen(item) for item in value) if isinstance(value, (list, tuple)) else value


def words(setting: Setting) -> str:
    """The setting as it is typed: 'mhe.samples=8, mhe.window=0.25'; '' for the defaults.

    The numbers of a robot that was identified before are many: they are a word.
    """
    typed = [f"{path}={json.dumps(value)}" for path, value in setting if not path.endswith(HELD)]
    return ", ".join(typed + ["a known robot"] * (len(typed) < len(setting)))
