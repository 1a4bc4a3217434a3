"""`amhe explain`: what a model lacks, or a log has wrong, from a result."""

from __future__ import annotations

from amhe_cli.cli import options
from amhe_cli.cli.command import Given, argument, command
from amhe_cli.cli.kinds import FOLDER
from amhe_cli.cli.session import Session


@command(
    "What a model lacks, or a log has wrong.",
    argument("source", FOLDER, metavar="RESULT"),
    options.where,
    options.seed,
    options.tuning,
    options.page,
)
def explain(session: Session, given: Given) -> None:
    """Name what explains the motion that the model of a RESULT does not.

    RESULT is the folder that `amhe identify` wrote; its logs must still be where they were. Some hundred
    causes are tried, in the log (signs, order, units, delays) and in the model (springs, friction, gains,
    limits, loads, what repeats). One is named if it explains more than chance on parts that were not fitted.
    """
    from dataclasses import replace

    import numpy as np

    from amhe_cli.cli.viewed import viewed
    from amhe_cli.core.each_log import named, searched
    from amhe_cli.core.errors import ConfigError
    from amhe_cli.estimation.core.result import Missing
    from amhe_cli.estimation.explain.explain import explain as run
    from amhe_cli.estimation.offline.clips import whole
    from amhe_cli.estimation.uncertainty.misfit import ASKED
    from amhe_cli.report.missing import missing_page, missing_record, print_missing

    given.refuse_existing()
    found = viewed(given.source, given.inputs)
    if found.belief is None:
        raise ConfigError(f"{given.source}: is no result of `amhe identify`")
    # from the prior: the fitted values make up for what is missing, and hide it
    opened = found.open().fixing(found.record.fixed)
    logs = named([log for group in found.read(opened) for log in group])
    space = searched(opened.space, logs)
    system = replace(opened, space=space)
    scales = [scale or 0.0 for scale in found.record.noise_scale.values()]
    if scales and max(scales) <= ASKED:  # what is left is so small that details of the smoothing decide
        missing = Missing(untested=f"the model misses no channel by more than {ASKED:g} times its noise")
    else:
        parts, rng = [whole(log) for log in logs], np.random.default_rng(given.seed)
        missing = run(system, parts, np.zeros(len(space)), rng)
    record = session.record(missing=missing_record(missing))
    if not session.gave(record):
        print_missing(missing, session.console())
    given.write_out(record, lambda: missing_page(given.source.resolve().name, missing, session.command_line))
