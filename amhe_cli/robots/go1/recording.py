"""What a run writes while it goes on: the log and the film."""

from __future__ import annotations

import json
from pathlib import Path

from amhe_cli import __version__
from amhe_cli.core.errors import ConfigError
from amhe_cli.live.recorder import Recorder
from amhe_cli.robots.go1.run import Run, measured
from amhe_cli.robots.go1.video import Film, check_encoder
from amhe_cli.system.provenance import attachments


def recorder_of(run: Run, path: Path) -> Recorder:
    """The recorder of a run's log, with all that tells what the log is of."""
    options = run.options
    metadata = {
        "system": run.system.name,
        "seed": str(options.seed),
        "task": options.task,
        "mode": options.mode,
        "target": options.target,
        "version": __version__,
    }
    if measured(run.task):  # so that whoever reads the log has the same model
        metadata["overrides"] = json.dumps(measured(run.task))
    if run.first_truth and not run.task.changes:  # what changes has no one true value; /amhe/truth tells it
        metadata["truth"] = json.dumps(run.first_truth)
    period = run.system.settings.control.period
    return Recorder(path, run.task, metadata, attachments(run.system), period)


def film_of(run: Run) -> Film:
    """The camera of a run's film.

    Raises:
        ConfigError: A film cannot be drawn, or not be encoded.
    """
    if run.plant is None:
        raise ConfigError("--video films a simulated plant; leave it out with --target go1")
    check_encoder()
    return Film(run.plant.model, run.task.floor)
