"""What differs from log to log: values that are known for one log, and values of a log's own.

A system has the parameters of its model. A search over several logs has others: a parameter that is known in
every log is not searched, and one of which each log has a value of its own becomes one unknown for each log,
`friction[run1]`. One that changes along a straight line in time, its trend, becomes two, its values at the
ends of that line: `friction[start]` and `friction[end]`.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence

import numpy as np

from amhe_cli.core.arrays import BoolArray, FloatArray
from amhe_cli.core.errors import ConfigError, one_of
from amhe_cli.core.log import Log
from amhe_cli.core.parameters import ParameterSpace, Rows, rows_of

#: Owners of the values at the ends of a trend.
ENDS = ("start", "end")


def named(logs: Sequence[Log]) -> list[Log]:
    """The logs, with names for the values of their own: those of their files, numbered if need be."""
    taken = {owner for log in logs for owner in log.own.values() if owner}
    labelled = []
    for log in logs:
        if "" in log.own.values():
            plain = log.source if log.file is None else log.file.stem
            count = 1
            while (label := plain if count == 1 else f"{plain} {count}") in taken:
                count += 1
            taken.add(label)
            log = log.with_(own={name: owner or label for name, owner in log.own.items()})
        labelled.append(log)
    return labelled


def trended(logs: Sequence[Log], names: Sequence[str]) -> list[Log]:
    """The logs with a trend of some parameters, each log at the middle of its time, by its stamps.

    Raises:
        ConfigError: All logs were made at one time: there is no line.
    """
    first = min((log.start_ns for log in logs), default=0)
    middles = np.array([1e-9 * (log.start_ns - first) + 0.5 * log.duration for log in logs])
    if names and not np.ptp(middles):
        raise ConfigError(f"`trend`: {', '.join(names)}: needs logs, or parts of one, of different times")
    places = ((middles - middles.min()) / (np.ptp(middles) or 1.0)).tolist()
    return [log.with_(trend={name: at for name in names}) for log, at in zip(logs, places, strict=True)]


def searched(space: ParameterSpace, logs: Sequence[Log]) -> ParameterSpace:
    """The unknowns of a search over logs.

    Args:
        space: Parameters of the model, with their prior.
        logs: The logs that are fitted; their own values have names (`named`).

    Returns:
        The parameters that some log does not know, in place of those that logs have as their own one unknown
        for each owner, with the parameter's prior. A prior correlation between two parameters holds for the
        former, and so does what the prior owes to the model.
    """
    columns, parameters = [], []
    for column, parameter in enumerate(space.parameters):
        unknown = [log for log in logs if parameter.name not in log.known]
        owners = dict.fromkeys(log.own[parameter.name] for log in unknown if parameter.name in log.own)
        owners |= dict.fromkeys(ENDS if any(parameter.name in log.trend for log in unknown) else ())
        columns += [-1] * len(owners) if owners else [column] * bool(unknown)
        parameters += [parameter.owned_by(owner) for owner in owners]
        parameters += [parameter] * bool(unknown and not owners)
    if tuple(parameters) == space.parameters:
        return space
    kept = [i for i, column in enumerate(columns) if column >= 0]
    those = [columns[i] for i in kept]
    rows: list[Rows | None] = []
    for given, matrix in (
        (space.prior_correlation, np.eye(len(columns))),
        (space.prior_systematic, np.zeros((len(columns), len(columns)))),
    ):
        if given is not None:
            matrix[np.ix_(kept, kept)] = np.array(given)[np.ix_(those, those)]
        rows.append(None if given is None else rows_of(matrix))
    owed = tuple((name, tuple(e[i] if i >= 0 else 0.0 for i in columns)) for name, e in space.prior_owed)
    return ParameterSpace(tuple(parameters), *rows, prior_owed=owed)


def values_on(log: Log, model: ParameterSpace, space: ParameterSpace, theta: FloatArray) -> FloatArray:
    """Values of the model's parameters on one log.

    Args:
        model: Parameters of the model, d of them.
        space: Unknowns of the search.
        theta: Candidates of the search, shape (p, k).

    Returns:
        Shape (p, d). What the log knows is taken from it. For an owner that no fitted log has, the value is
        the geometric or arithmetic mean of the others'; on a trend, that of both ends by the log's place.
        What is not searched is at its nominal value.
    """
    if space.names == model.names and not log.known:
        return theta
    values = np.empty((len(theta), len(model)))
    for i, (p, columns) in enumerate(zip(model.parameters, _columns(log, model, space), strict=True)):
        if len(columns) > 1:
            at = log.trend.get(p.name)
            weights = np.full(len(columns), 1.0 / len(columns)) if at is None else np.array([1.0 - at, at])
            mean = (np.log(theta[:, columns]) if p.log else theta[:, columns]) @ weights
            values[:, i] = np.exp(mean) if p.log else mean
        else:
            values[:, i] = theta[:, columns[0]] if columns else log.known.get(p.name, p.nominal)
    return values


def averaged(log: Log, model: ParameterSpace, space: ParameterSpace) -> dict[str, list[int]]:
    """Parameters whose value on a log is the mean of others' -> the columns of these; see `values_on`."""
    pairs = zip(model.names, _columns(log, model, space), strict=True)
    return {name: columns for name, columns in pairs if len(columns) > 1 and name not in log.trend}


def acting(log: Log, model: ParameterSpace, space: ParameterSpace) -> BoolArray:
    """Which unknowns of a search have an effect on one log, shape (k,); see `values_on`."""
    acts = np.zeros(len(space), dtype=bool)
    acts[[column for columns in _columns(log, model, space) for column in columns]] = True
    return acts


def _columns(log: Log, model: ParameterSpace, space: ParameterSpace) -> list[list[int]]:
    """For each parameter of the model the unknowns whose mean it is on one log; none where it is fixed."""
    columns: dict[str, dict[str, int]] = {name: {} for name in model.names}  # parameter -> owner -> column
    for i, unknown in enumerate(space.parameters):
        columns.get(unknown.of_model, {})[unknown.owner] = i
    return [[] if name in log.known else _of(log.own.get(name, ""), columns[name]) for name in model.names]


def _of(owner: str, columns: Mapping[str, int]) -> list[int]:
    """Columns of an owner's value: its own, that of all logs, or those of all owners."""
    alone = next((columns[whose] for whose in (owner, "") if whose in columns), None)
    return list(columns.values()) if alone is None else [alone]


def same_values(log: Log) -> tuple[object, ...]:
    """What is equal for logs on which the model has the same values."""
    return tuple(tuple(sorted(given.items())) for given in (log.known, log.own, log.trend))


def mistakes_of(
    known: Mapping[str, float], own: Iterable[str], space: ParameterSpace, fixed: Collection[str] = ()
) -> Iterator[tuple[tuple[str, ...], str]]:
    """What a log states of its parameters and a system does not allow.

    Args:
        known, own: See `Log`.
        space: Parameters of the system that are free.
        fixed: Names of those that are not.

    Yields:
        The place of the statement, such as ('known', 'gain') or ('own',), and what is wrong.
    """
    parameters = {p.name: p for p in space.parameters}

    def missing(name: str) -> str:
        fix = f"{name} is fixed in the system, and a log cannot change it; leave out one of them"
        return fix if name in fixed else one_of("parameter", name, parameters)

    for name, value in known.items():
        if name not in parameters:
            yield ("known", name), missing(name)
        elif not (p := parameters[name]).lower <= value <= p.upper:
            yield ("known", name), f"{name} is {value:g}; between {p.lower:g} and {p.upper:g} would be valid"
    for name in own:
        if name not in parameters:
            yield ("own",), missing(name)
        elif name in known:
            yield ("own",), f"{name} is known in this log, and has no value to search"


def check_logs(
    logs: Sequence[Log], held_out: Sequence[Log], space: ParameterSpace, fixed: Collection[str] = ()
) -> None:
    """Refuse logs that state what the system, with free parameters `space`, does not allow.

    Raises:
        ConfigError: A name or value is wrong, a held-out log lacks a value that every fitted log knows, only
            some fitted logs have a value of their own, or nothing is left to search.
    """
    for log in (*logs, *held_out):
        for (key, *_), text in mistakes_of(
            log.known, [*log.own, *(log.trend.keys() - log.known)], space, fixed
        ):
            raise ConfigError(f"{log.source}: `{key}`: {text}")
    for name in space.names:
        _check_own(logs, name)
        if all(name in log.known for log in logs):
            for log in held_out:
                if name not in log.known:
                    raise ConfigError(
                        f"{log.source}: `known`: {name} is known in every fitted log; give its value here too"
                    )
    if not len(searched(space, named(logs))):
        raise ConfigError(f"{logs[0].source}: `known`: the logs know every parameter: leave one unknown")


def _check_own(logs: Sequence[Log], name: str) -> None:
    """Refuse a value of their own, or a trend, that only some logs have, and one owner: it has no spread.

    Raises:
        ConfigError: That is so.
    """
    unknown = [log for log in logs if name not in log.known]
    on_trend = [log for log in unknown if name in log.trend]
    owning = [log for log in unknown if name in log.own]
    places = {log.trend.get(name) for log in unknown}
    if on_trend and (owning or None in places or len(places) < 2):
        raise ConfigError(
            f"{on_trend[0].source}: `trend`: {name} needs two places or more on its trend, one for each "
            "fitted log that does not know it, and no `own` beside them"
        )
    if not owning:
        return
    for log in unknown:
        if name not in log.own:
            raise ConfigError(
                f"{log.source}: `own`: {name} is {owning[0].source}'s own; give it to every fitted log that "
                f"does not know its value"
            )
    if len({log.own[name] or id(log) for log in owning}) < 2:
        raise ConfigError(
            f"{owning[0].source}: `own`: {name} has one owner, and needs two or more to differ; leave it out"
        )


def fixing(logs: Sequence[Log], names: Collection[str], stated: Mapping[str, float]) -> tuple[Log, ...]:
    """The logs where some parameters are not searched.

    Args:
        names: The parameters; no log has a value of its own of them.
        stated: Those of them of which only some logs know the value -> the value of the others.
    """
    return tuple(
        log.with_(
            known=dict(stated) | dict(log.known),
            own={name: owner for name, owner in log.own.items() if name not in names},
            trend={name: at for name, at in log.trend.items() if name not in names},
        )
        for log in logs
    )
