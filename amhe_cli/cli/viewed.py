"""What a result folder stands for: the logs and all else that `amhe view` shows, and its system."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from pydantic import BaseModel, FiniteFloat

from amhe_cli.cli.inputs import Inputs
from amhe_cli.cli.settings import Overrides
from amhe_cli.core.errors import NOTE, ConfigError
from amhe_cli.core.yaml_file import merged
from amhe_cli.system.description.folders import bundled_systems, find_system

if TYPE_CHECKING:
    from amhe_cli.core.belief import Belief
    from amhe_cli.core.log import Log
    from amhe_cli.system.system import System

logger = logging.getLogger(__name__)

#: What a command's result holds of what was recorded: estimates of an online estimator, beliefs of a run.
_RECORDED = {"mhe-replay": "estimates.mcap", "run": "log.mcap"}
#: What to do with a result that cannot be opened.
_INSTEAD = "view its log, or give the system of its belief with --system DIR"


class _Reading(BaseModel):
    """A log of a result, and the arguments of `read_log` with which it was read."""

    path: Path
    topics: dict[str, str] = {}
    start: FiniteFloat | None = None
    end: FiniteFloat | None = None
    msg_path: Path | None = None
    held_out: bool = False


class _Made(BaseModel):
    """What a result was made from, see `system.provenance.inputs_record`."""

    system: str | None = None
    settings: dict[str, Any] = {}
    logs: list[_Reading]


class _Found(BaseModel):
    """What is read of a parameter of a result."""

    name: str
    verdict: str | None = None
    start: float | None = None


class _Body(BaseModel):
    """What is read of a number of a body."""

    name: str
    unit: str
    prior: float | None
    estimate: float | None
    lower: float | None
    upper: float | None
    verdict: str


class _Record(BaseModel):
    """What is read of a result.json."""

    schema_version: Literal[1]
    command: str
    inputs: _Made | None = None
    fixed: dict[str, float] = {}
    parameters: list[_Found] = []
    bodies: list[_Body] = []
    noise_scale: dict[str, float | None] = {}
    task: str | None = None


@dataclass(frozen=True, slots=True)
class Viewed:
    """Logs, and what belongs to them.

    Args:
        folder: The result folder; of a log, the log.
        record: What result.json says.
        made: The logs.
        inputs: The system that they are about, its settings, and what the user says of how they are read.
    """

    folder: Path
    record: _Record
    made: _Made
    inputs: Inputs

    @property
    def belief(self) -> Path | None:
        """The belief.yaml of an identification."""
        return self.folder / "belief.yaml" if self.record.command == "identify" else None

    def open(self) -> System:
        """The system, boxes in place of missing meshes; a note names the files that a result chooses.

        Raises:
            ConfigError: The result was made from arrays, or its system cannot be opened.
        """
        logs, system = self.made.logs, self.inputs.system
        if not logs:
            raise ConfigError(f"{self.folder}: no log of this result is a file: it was made from arrays")
        if self.record.command:
            files = [*(str(log.path) for log in logs), f"system {system}" if system else "the log's system"]
            messages = {
                f"messages of {path}" for log in logs if (path := self.inputs.msg_path or log.msg_path)
            }
            logger.log(NOTE, "shows %s", ", ".join([*files, *sorted(messages)]))
        return self.inputs.open([log.path for log in logs])

    def read(self, system: System) -> tuple[list[Log], list[Log]]:
        """The logs for a system: those that were fitted, and those that were held out.

        Raises:
            LogError: A log cannot be read, or lacks what the system needs.
        """
        logs: tuple[list[Log], list[Log]] = ([], [])
        now = self.inputs
        for then in self.made.logs:
            how = replace(
                now,
                msg_path=now.msg_path or then.msg_path,
                start=then.start if now.start is None else now.start,
                end=then.end if now.end is None else now.end,
            )
            for log in how.read(system.reading({**then.topics, **now.topics}), [then.path]):
                logs[then.held_out or log.held_out].append(log)
        return logs

    def beside(self, system: System, first: Log, known: Belief | None) -> dict[str, Any]:
        """What is shown beside the logs, as arguments of `view_of`.

        Args:
            first: The first of the logs.
            known: The belief that is shown; None: that at each time of what was recorded.

        Raises:
            LogError: What was recorded cannot be read.
        """
        if self.record.command not in _RECORDED:
            verdicts = {p.name: p.verdict for p in self.record.parameters if p.verdict}
            told = {"verdicts": verdicts, "bodies": [one.model_dump() for one in self.record.bodies]}
            return {"fitted": self.belief is not None, "belief": known, **told}
        from amhe_cli.cli.watching import floor_of
        from amhe_cli.live.recorder import first_belief, recorded_curves
        from amhe_cli.robots.go1.run import as_measured
        from amhe_cli.robots.go1.tasks import find_task

        recorded = self.folder / _RECORDED[self.record.command]
        units = {p.name: p.unit for p in system.space.parameters}
        curves, jumps = recorded_curves(recorded, first.start_ns, units)
        begun = {p.name: p.start for p in self.record.parameters} or first_belief(recorded)
        shown = {
            "curves": curves,
            "events": jumps,
            "first": begun if begun.keys() >= set(system.space.names) else None,
            "belief": known,
        }
        if self.record.task is not None:
            shown["more"] = floor_of(as_measured(find_task(self.record.task), system))
        return shown


def viewed(source: Path, inputs: Inputs) -> Viewed:
    """What a path stands for: a log, or a result folder.

    A result folder is taken for the user's own: the log, the system and the other files that it names are
    opened. What the user gives now wins over what the result says.

    Raises:
        ConfigError: The folder holds no result that can be viewed, or its system is not where it was.
    """
    path = source / "result.json"
    if not path.is_file():
        alone = _Made(logs=[_Reading(path=source)])
        return Viewed(source, _Record(schema_version=1, command=""), alone, inputs)
    try:
        record = _Record.model_validate_json(path.read_bytes())
    except (OSError, ValueError):
        raise ConfigError(f"{path}: is no result of this amhe; {_INSTEAD}") from None
    if record.command == "run":
        return Viewed(source, record, _Made(logs=[_Reading(path=source / "log.mcap")]), inputs)
    if record.command not in ("identify", "mhe-replay"):
        raise ConfigError(f"{source}: is a result of `amhe {record.command}`, which has no view; {_INSTEAD}")
    if (made := record.inputs) is None:
        again = f"run `amhe {record.command}` again, or {_INSTEAD}"
        raise ConfigError(f"{path}: an earlier amhe wrote it, without what it was made from; {again}")
    made.logs = [log.model_copy(update={"path": _from(source, log.path)}) for log in made.logs]
    if made.system is not None and made.system not in bundled_systems():
        made.system = str(_from(source, Path(made.system)))
    if record.command == "mhe-replay":  # estimates of a part of a log stand in the whole log
        made.logs = [log.model_copy(update={"start": None, "end": None}) for log in made.logs]
    given = inputs.overrides
    overrides = Overrides(merged(given.shared, made.settings), given.chosen)
    inputs = replace(inputs, system=inputs.system or made.system, overrides=overrides)
    if inputs.system is None:
        raise ConfigError(f"{path}: its system has no folder; make one, and give it with --system DIR")
    try:
        find_system(inputs.system)
    except ConfigError:
        gone = f"{inputs.system}: the system of this result is not there; give its folder with --system DIR"
        raise ConfigError(gone) from None
    return Viewed(source, record, made, inputs)


def _from(folder: Path, path: Path) -> Path:
    """A path of a result, which was relative to where the command ran: here, or above the result's folder."""
    if path.is_absolute() or path.exists():
        return path
    above = (parent / path for parent in folder.resolve().parents)
    return next((there for there in above if there.exists()), path)


def system_of_result(belief: Path) -> System | None:
    """The system of the result of `amhe identify` that a belief lies in, with the settings that it had.

    The folder is taken for the user's own, as by `viewed`: a note names the system that is opened.

    Args:
        belief: The file.

    Returns:
        The system; None where the file is not belief.yaml of such a folder, or the system comes with amhe.

    Raises:
        ConfigError: See `viewed`.
    """
    if belief.name != "belief.yaml" or not belief.with_name("result.json").is_file():
        return None
    found = viewed(belief.parent, Inputs())
    if found.belief is None or found.inputs.system in bundled_systems():
        return None
    logger.log(NOTE, "the belief is of system %s, says the result beside it", found.inputs.system)
    return found.inputs.open(())
