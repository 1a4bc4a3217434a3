"""Options of commands that estimate: the belief before, what is unknown, the online estimator."""

from __future__ import annotations

from collections.abc import Callable

import click

from amhe_cli.cli import completion, options, parsing

belief_anyway = click.option(
    "--belief-anyway",
    is_flag=True,
    help="Take a belief about another model too, and only warn of what has changed.",
)


def believed(about: str) -> Callable[[parsing.F], parsing.F]:
    """A belief to start from, and whether it may be about another model."""
    return parsing.stacked(
        click.option("--belief", type=parsing.EXISTING_FILE, metavar="FILE", help=about),
        belief_anyway,
    )


narrowing = parsing.stacked(
    click.option(
        "--fix",
        metavar="NAME=VALUE",
        shell_complete=completion.parameters("="),
        multiple=True,
        callback=parsing.pairs(float),
        help="Take a parameter as known; it is not estimated. Repeat for more.",
    ),
    click.option(
        "--only",
        metavar="NAME,NAME",
        shell_complete=completion.parameters(),
        multiple=True,
        callback=lambda ctx, param, given: list(parsing.listed(ctx, param, given)) or None,
        help="Estimate these parameters (names, or patterns such as 'left_*') and fix all others.",
    ),
)

method = options.setting(
    "mhe.method",
    type=click.Choice(["linearised", "logrank"]),
    help="Update of the estimator: ours, or the paper's.  [default: linearised]",
)

#: The online estimator's settings that have options.
estimator = parsing.stacked(
    method,
    options.setting(
        "mhe.window",
        type=parsing.Number(min=0, min_open=True),
        metavar="S",
        help="Time that one update looks back.  [default: 0.5; of go1_push 0.4]",
    ),
    options.setting(
        "mhe.update_period",
        type=parsing.Number(min=0, min_open=True),
        metavar="S",
        help="Time between two updates.  [default: 0.2; of go1_push 0.1]",
    ),
    options.setting(
        "mhe.samples",
        type=parsing.WholeNumber(min=4),
        metavar="B",
        help="Rollouts of one iteration; linearised takes two for each unknown, or more, and one at the "
        "mean.  [default: 8 for linearised, 32 for logrank]",
    ),
    options.setting(
        "mhe.iterations",
        type=parsing.WholeNumber(min=1),
        metavar="L",
        help="Iterations of one update, at most.  [default: 3 for linearised, 4 for logrank; 1 for "
        "linearised where first states are taken as recorded, as for go1_push]",
    ),
    options.setting(
        "mhe.learning_rate",
        type=parsing.Number(min=0, min_open=True, max=1),
        metavar="A",
        help="How far an iteration of logrank moves mean and variance.  [default: 0.5]",
    ),
    options.setting(
        "mhe.prior_weight",
        multiple=True,
        metavar="NAME=W",
        shell_complete=completion.parameters("="),
        help="How firmly a parameter is held at its last estimate; repeat for more.  "
        "[default: 0; of go1_push box_inertia_scale=30]",
    ),
)
