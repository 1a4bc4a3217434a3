"""The online estimator's options, shared by the commands that run it."""

from __future__ import annotations

from functools import wraps
from typing import Any

import click

from amhe_cli.cli import completion, options


def _weights(ctx: click.Context, param: click.Parameter, value: tuple[str, ...]) -> dict[str, float]:
    """NAME=W, repeated, as a dictionary."""
    weights = {}
    for text in value:
        name, _, number = text.partition("=")
        try:
            weights[name] = float(number)
        except ValueError:
            weights[name] = -1.0
        if not (name and 0.0 <= weights[name] < float("inf")):
            raise click.BadParameter(f"{text!r} is not of the form NAME=W, W a number from 0 on", ctx, param)
    return weights


#: Options of the online estimator, by the setting `mhe....` that each of them is.
_ESTIMATOR = {
    "method": click.option(
        "--method",
        type=click.Choice(["linearised", "logrank"]),
        help="Update of the estimator: ours, or the paper's.  [default: linearised]",
    ),
    "window": click.option(
        "--window",
        type=options.Number(min=0, min_open=True),
        metavar="S",
        help="Time that one update looks back.  [default: 0.5; of go1_push 0.4]",
    ),
    "update_period": click.option(
        "--update-period",
        type=options.Number(min=0, min_open=True),
        metavar="S",
        help="Time between two updates.  [default: 0.2; of go1_push 0.1]",
    ),
    "samples": click.option(
        "--samples",
        type=options.WholeNumber(min=4),
        metavar="B",
        help="Rollouts of one iteration; linearised takes two for each unknown, or more, and one at the "
        "mean.  [default: 8 for linearised, 32 for logrank]",
    ),
    "iterations": click.option(
        "--iterations",
        type=options.WholeNumber(min=1),
        metavar="L",
        help="Iterations of one update, at most.  [default: 3 for linearised, 4 for logrank; 1 for "
        "linearised where first states are taken as recorded, as for go1_push]",
    ),
    "learning_rate": click.option(
        "--learning-rate",
        type=options.Number(min=0, min_open=True, max=1),
        metavar="A",
        help="How far an iteration of logrank moves mean and variance.  [default: 0.5]",
    ),
    "prior_weight": click.option(
        "--prior-weight",
        multiple=True,
        callback=_weights,
        metavar="NAME=W",
        shell_complete=completion.parameters("="),
        help="How firmly a parameter is held at its last estimate; repeat for more.  "
        "[default: 0; of go1_push box_inertia_scale=30]",
    ),
}


def estimator(function: options.F) -> options.F:
    """The estimator's options, handed on among the `assignments` of --set, which they overrule."""

    @wraps(function)
    def command(*args: Any, assignments: tuple[str, ...], **values: Any) -> Any:
        chosen = []
        for name in _ESTIMATOR:
            value = values.pop(name)
            if isinstance(value, dict):
                given = [f"mhe.{name}.{key}={number!r}" for key, number in value.items()]
            else:
                given = [] if value is None else [f"mhe.{name}={value}"]
            if given and values.get("mode", "adaptive") != "adaptive":
                flag = f"--{name.replace('_', '-')}"
                raise click.UsageError(f"{flag} is for the online estimator, which only --mode adaptive runs")
            chosen += given
        return function(*args, assignments=(*assignments, *chosen), **values)

    for option in reversed(_ESTIMATOR.values()):
        command = option(command)
    return command  # type: ignore[return-value]
