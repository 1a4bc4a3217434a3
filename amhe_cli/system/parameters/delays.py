"""Delays of commands: what stands between the stamp of a command and the instant at which it acts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase

import mujoco
import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.errors import ConfigError, one_of
from amhe_cli.system.parameters.cells import Cells
from amhe_cli.system.parameters.edits import ScalarEdit


@dataclass(frozen=True, slots=True)
class DelayNumber(Cells):
    """Delay of one column of the engine's input vector; `name` is its actuator where others differ."""

    name: str = ""

    def of(self, model: mujoco.MjModel) -> FloatArray:
        """Commands act at once where no parameter says otherwise."""
        return np.zeros(1)


@dataclass(frozen=True, eq=False)
class CommandDelays:
    """Delays [s] of the columns of the engine's input vector.

    Args:
        commands: Actuator that a signal commands -> the columns of its controls.
        width: Columns of the input vector; 1 where nothing is commanded, for all that there are.
        edits: How parameters are written into the delays.
    """

    commands: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    width: int = 1
    edits: tuple[ScalarEdit, ...] = ()

    def numbers(self, theta: FloatArray) -> FloatArray:
        """All delays under values (p, d) of all parameters, fixed ones too, shape (p, width)."""
        delays = np.zeros((len(theta), self.width))
        for edit in self.edits:
            edit.write({"command_delay": delays}, theta)
        return np.maximum(delays, 0.0)  # nothing acts before it was commanded

    def with_edits(self, edits: Sequence[ScalarEdit]) -> CommandDelays:
        """The same commands with further edits."""
        return replace(self, edits=(*self.edits, *edits))

    @property
    def cells(self) -> tuple[DelayNumber, ...]:
        """The delays of all commands, which one parameter may set together."""
        return tuple(DelayNumber("command_delay", at) for columns in self.commands.values() for at in columns)

    def cells_of(self, actuator: str | None) -> list[DelayNumber]:
        """The delays of an actuator's commands.

        Args:
            actuator: Its name, or a pattern for several; None: all that are commanded.

        Raises:
            ConfigError: No signal commands such an actuator.
        """
        if actuator is None:
            return list(self.cells)
        names = [name for name in self.commands if fnmatchcase(name, actuator)]
        if not names:
            raise ConfigError(one_of("actuator that a signal commands", actuator, self.commands))
        return [DelayNumber("command_delay", at, name=name) for name in names for at in self.commands[name]]
