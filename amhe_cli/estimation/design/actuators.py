"""What of a system can be driven, and how far."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amhe_cli.core.arrays import FloatArray, IntArray
from amhe_cli.core.errors import ConfigError
from amhe_cli.engine.states import home
from amhe_cli.system.system import System


@dataclass(frozen=True, slots=True, eq=False)
class Drives:
    """Commanded controls of a system.

    Args:
        columns: Theirs in the engine's input vector, shape (n,).
        rest: Controls at the home state, shape (n,).
        lower, upper: Their limits, shape (n,).
        home: The whole input vector there, shape (nu,).
    """

    columns: IntArray
    rest: FloatArray
    lower: FloatArray
    upper: FloatArray
    home: FloatArray


def drives_of(system: System) -> Drives:
    """The controls that the system's signals command.

    Raises:
        ConfigError: There are none, one has no limits, or they carry a body that nothing holds.
    """
    model = system.model
    columns = np.array([c for i in system.inputs if i.delayed for c in i.columns], dtype=np.int64)
    if not columns.size:
        raise ConfigError(f"{system.name}: no signal commands an actuator, so there is nothing to drive")
    # controls stand first in the input vector: a column is the address of a control
    rows = [int(np.flatnonzero(model.actuator_ctrladr == column)[0]) for column in columns]
    for row in rows:
        name = model.actuator(row).name
        if not model.actuator_ctrllimited[row]:
            raise ConfigError(f"{system.name}: give actuator {name!r} a ctrlrange: a probe stays within it")
        if _floats(system, row):
            raise ConfigError(
                f"{system.name}: actuator {name!r} moves a body that nothing holds: a robot on legs needs a "
                f"controller, which only go1_push has"
            )
    _, rest = home(model, system.keyframe, system.input_spec)
    limits = model.actuator_ctrlrange[rows]
    return Drives(columns, rest[columns], limits[:, 0], limits[:, 1], rest)


def _floats(system: System, actuator: int) -> bool:
    """Whether an actuated joint hangs on a free body."""
    model = system.model
    body = int(model.jnt_bodyid[model.actuator_trnid[actuator, 0]])
    first = int(model.body_jntadr[model.body_rootid[body]])
    return first >= 0 and int(model.jnt_type[first]) == 0  # mjJNT_FREE
