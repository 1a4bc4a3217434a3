"""What a result folder stands for: the logs and all else that `amhe view` shows, and its system."""

from __future__ import annotations

import json
import logging
import math
import shlex
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from amhe_cli.cli import log_path
from amhe_cli.cli.inputs import Inputs
from amhe_cli.cli.settings import Overrides, gathered
from amhe_cli.core.errors import NOTE, ConfigError
from amhe_cli.core.yaml_file import merged
from amhe_cli.system.description.folders import find_system

if TYPE_CHECKING:
    from amhe_cli.core.belief import Belief
    from amhe_cli.core.curves import TimeCurve
    from amhe_cli.core.log import Log
    from amhe_cli.system.system import System

logger = logging.getLogger(__name__)

#: Options that say how logs are read: those with which a result was made, unless the user gives others.
_READING = ("system", "topics", "msg_path", "start", "end")


@dataclass(frozen=True, slots=True)
class Viewed:
    """Logs, and what belongs to them.

    Args:
        logs: The logs.
        inputs: How they are read.
        overrides: Settings of the system.
        apart: Logs that were held out.
        belief: The belief.yaml of an identification; None: there is none.
        fixed: Parameters that were taken as known.
        recorded: The log with the estimates of an online estimator or the beliefs of a run; None: none.
        first: The belief with which the estimator began, by name; {}: what was recorded may hold it.
        task: Name of the task of a run; None: it is no run.
    """

    logs: tuple[Path, ...]
    inputs: Inputs
    overrides: Overrides
    apart: tuple[Path, ...] = ()
    belief: Path | None = None
    fixed: Mapping[str, float] = field(default_factory=dict)
    recorded: Path | None = None
    first: Mapping[str, float] = field(default_factory=dict)
    task: str | None = None

    def beside(self, system: System, first: Log, known: Belief | None) -> dict[str, Any]:
        """What is shown beside the logs, as arguments of `page_of`.

        Args:
            system: The system.
            first: The first of the logs.
            known: The belief that is shown; None: that at the end of what was recorded.

        Raises:
            LogError: What was recorded cannot be read.
        """
        if self.recorded is None:
            return {"fitted": self.belief is not None, "belief": known}
        from amhe_cli.cli.watching import floor_of
        from amhe_cli.live.recorded import first_belief, recorded_curves
        from amhe_cli.robots.go1.run import as_measured
        from amhe_cli.robots.go1.tasks import find_task

        units = {p.name: p.unit for p in system.space.parameters}
        curves, jumps = recorded_curves(self.recorded, first.start_ns, units)
        begun = self.first or first_belief(self.recorded)
        shown = {
            "curves": curves,
            "events": jumps,
            "first": begun if begun.keys() >= set(system.space.names) else None,
            "belief": _last(system, curves) if known is None else known,
            "known_as": "final belief" if known is None else "given belief",
        }
        if self.task is not None:
            shown["more"] = floor_of(as_measured(find_task(self.task), system))
        return shown


def viewed(source: Path, inputs: Inputs, overrides: Overrides) -> Viewed:
    """What a path stands for: a log, or a result folder.

    A result folder is taken for the user's own: the log, the system and the other files that the command in
    it names are opened. A note names them.

    Raises:
        ConfigError: The folder holds no result that can be viewed, or its logs are gone.
    """
    if not (source / "result.json").is_file():
        return Viewed((source,), inputs, overrides)
    with _result_in(source, "view the log itself") as record:
        version, command = record["schema_version"], record["command"]
        if version != 1 or command not in _VIEWED:
            other = f"of version {version}" if version != 1 else f"of `amhe {command}`"
            raise ConfigError(f"{source}: is a result {other}, which cannot be viewed; view its log itself")
        found = _VIEWED[command](source, record, inputs, overrides)
    for path in (*found.logs, *found.apart):
        try:
            log_path.LOG.convert(path, None, None)
        except click.BadParameter:
            instead = f" with --belief {found.belief}" if found.belief else " itself"
            raise ConfigError(
                f"{path}: this log of the result is not there; run the command where the result was "
                f"made, or view the log{instead}"
            ) from None
    how = found.inputs
    also = [f"messages of {how.msg_path}"] if how.msg_path else []
    system = f"system {how.system}" if how.system else "the system that the log names"
    logger.log(NOTE, "shows %s", ", ".join([*map(str, (*found.logs, *found.apart)), system, *also]))
    return found


def system_of_result(belief: Path) -> System | None:
    """The system of the result of `amhe identify` that a belief lies in, with the settings that it had.

    The folder is taken for the user's own, as by `viewed`: a note names the system that is opened.

    Args:
        belief: The file.

    Returns:
        The system; None where the file is not belief.yaml of such a folder, or the system comes with amhe.

    Raises:
        ConfigError: The folder's result cannot be read, or its system or settings are not where they were.
    """
    from amhe_cli.cli.identify import identify
    from amhe_cli.core.belief import Belief

    if belief.name != "belief.yaml" or not belief.with_name("result.json").is_file():
        return None
    origin, none = Belief.load(belief).provenance, Inputs(None, {}, None, None, None)
    with _result_in(belief.parent, "give the belief's system with --system DIR") as record:
        if (record["schema_version"], record["command"]) != (1, "identify"):
            return None
        given, inputs, overrides = _as_then(identify, origin, none, Overrides({}, {}), needed=("config",))
    if inputs.system is None:
        return None
    also = f", with settings {given['config']}" if given.get("config") else ""
    logger.log(NOTE, "the belief is of system %s%s, says the result beside it", inputs.system, also)
    return inputs.open((), overrides)


@contextmanager
def _result_in(folder: Path, instead: str) -> Iterator[dict[str, Any]]:
    """The content of a folder's result.json, and one line for whatever is wrong with it in the block."""
    path = folder / "result.json"
    try:
        yield json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        raise ConfigError(f"{path}: is no result of amhe; {instead}") from None


def _identified(folder: Path, record: Mapping[str, Any], inputs: Inputs, overrides: Overrides) -> Viewed:
    """A result of `amhe identify`."""
    from amhe_cli.cli.identify import identify
    from amhe_cli.core.belief import Belief

    belief = folder / "belief.yaml"
    given, inputs, overrides = _as_then(identify, Belief.load(belief).provenance, inputs, overrides)
    logs = given.get("logs") or tuple(map(Path, record["logs"]))
    apart, fixed = log_path.each_episode(given.get("held_out") or ()), record.get("fixed") or {}
    return Viewed(log_path.each_episode(logs), inputs, overrides, apart, belief, fixed)


def _replayed(folder: Path, record: Mapping[str, Any], inputs: Inputs, overrides: Overrides) -> Viewed:
    """A result of `amhe mhe-replay`."""
    from amhe_cli.cli.mhe_replay import mhe_replay

    origin = record.get("provenance") or {"system_folder": record["system"]}  # earlier versions wrote none
    _, then, overrides = _as_then(mhe_replay, dict(origin), inputs, overrides)
    whole = replace(then, start=inputs.start, end=inputs.end)  # estimates of a part stand in all of the log
    estimates, first = folder / "estimates.mcap", {p["name"]: float(p["start"]) for p in record["parameters"]}
    if not all(map(math.isfinite, first.values())):
        raise ValueError
    return Viewed(
        (Path(record["log"]),), whole, overrides, fixed=record["fixed"], recorded=estimates, first=first
    )


def _run(folder: Path, record: Mapping[str, Any], inputs: Inputs, overrides: Overrides) -> Viewed:
    """A result of `amhe run`."""
    log = folder / "log.mcap"
    return Viewed((log,), inputs, overrides, recorded=log, task=record["task"])


def _as_then(
    command: click.Command,
    origin: Mapping[str, Any],
    inputs: Inputs,
    overrides: Overrides,
    needed: Sequence[str] = ("config", "held_out", "msg_path"),
) -> tuple[dict[str, Any], Inputs, Overrides]:
    """The options with which a command made a result, and how its logs are read: as they were then.

    What the user gives now wins. Of a result that the library made only the system's folder is known.

    Raises:
        ConfigError: The system or another file is not where it was.
    """
    line, given = shlex.split(str(origin.get("command", ""))), {"system": origin.get("system_folder")}
    if line[:1] == ["amhe"] and command.name in line:
        line.remove(command.name)  # options that stand before it are options of the command too
        with command.make_context(command.name, line[1:], resilient_parsing=True) as context:
            given = dict(context.params)
            for name in needed:
                named = context.get_parameter_source(name) is ParameterSource.COMMANDLINE
                if named and given.get(name) is None and not getattr(inputs, name, None):
                    raise ConfigError(
                        f"what --{name.replace('_', '-')} of this result names is not there; run the command "
                        "where the result was made, or view its log"
                    )
    if not inputs.system and (system := given.get("system")):
        try:
            find_system(system)
        except ConfigError:
            where = f"{system}: the system of this result is not there; give its folder with --system DIR"
            raise ConfigError(where) from None
    chosen = {name: getattr(inputs, name) or given.get(name) for name in _READING if given.get(name)}
    before = gathered(given.get("config"), {}, given.get("assignments") or ())
    found = Overrides(overrides.shared, merged(before.all, overrides.chosen))
    return given, replace(inputs, **chosen), found


def _last(system: System, curves: Sequence[TimeCurve]) -> Belief | None:
    """The belief at the end of curves; None where they lack a parameter."""
    import numpy as np

    from amhe_cli.core.belief import belief_of
    from amhe_cli.core.statistics import Z90

    ends = {
        curve.name: np.append(
            curve.values[-1:], curve.values[[-1, -1]] if curve.band is None else curve.band[:, -1]
        )
        for curve in curves
        if curve.group == "parameters"
    }
    if not ends.keys() >= set(system.space.names):
        return None
    value, low, high = (
        system.space.z_of(end) for end in np.array([ends[name] for name in system.space.names]).T
    )
    return belief_of(system, value, np.diag(((high - low) / (2.0 * Z90)) ** 2))


#: Results that can be viewed, by the command that wrote them.
_VIEWED = {"identify": _identified, "mhe-replay": _replayed, "run": _run}
