"""What is wrong with a log at first sight, before anything is fitted: half a second a log."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from fnmatch import fnmatchcase

import numpy as np

from amhe_cli.core.log import Log
from amhe_cli.engine.states import controls
from amhe_cli.estimation.explain.inputs import mended
from amhe_cli.estimation.offline.clips import whole
from amhe_cli.system.system import System


def first_look(
    system: System, log: Log, columns: Sequence[str] = (), rng: np.random.Generator | None = None
) -> Iterator[str]:
    """Sentences about a log that was read for a system; what contradicts itself is said on reading it.

    Args:
        system: The system.
        log: Its log.
        columns: Columns of the log's table; empty for other formats.
        rng: Generator of the signs of blocks; None: the same in each call.
    """
    model = system.model
    place = controls(model, system.input_spec) or slice(0, 0)
    given = {at - place.start for source in system.inputs for at in source.columns}
    idle = [
        model.actuator(row).name or f"actuator {row}"
        for row in range(model.nactuator)
        if int(model.actuator_ctrladr[row]) not in given and system.match != "effort"
    ]
    read = [name for signal in system.signals for names in signal.columns.values() for name in names]
    read = [name.split("[")[0].split("{")[0] + "*" * ("{" in name) for name in read]  # patterns, roughly
    left = [name for name in columns if not any(fnmatchcase(name.split("[")[0], one) for one in read)]
    left = [name for name in left if read and not name.lower().startswith(("time", "stamp")) and name != "t"]
    if idle:
        yield f"{', '.join(idle)}: no command in the log; held at 0, it acts"
    if left:
        yield f"columns that no signal reads: {', '.join(left[:12])}{' ...' * (len(left) > 12)}"
    for key, series in log.series.items():
        names = next((s.names for s in system.signals if key.startswith(f"{s.name}.")), ())
        values = series.values[series.valid]
        still = np.flatnonzero(np.ptp(values, axis=0) == 0.0) if len(values) else []
        for column in still if not series.derived else ():
            name = names[column] if column < len(names) else f"number {column}"
            yield f"{key} of {name} never changes: it is {values[0, column]:.4g} throughout"
    for wrong in mended(system, [whole(log)], rng or np.random.default_rng(0))[:1]:
        yield wrong.sentence
