"""What a system is made of, and where the series of a log meet its model."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import mujoco

from amhe_cli.core.parameters import ParameterSpace
from amhe_cli.core.settings import Settings
from amhe_cli.core.signals import Signal
from amhe_cli.system.parameters.calibration import SignalCalibration
from amhe_cli.system.parameters.model_edits import ModelEdits

#: What stands between a series and the column of it that is a channel of its own.
PART = " of "


@dataclass(frozen=True, slots=True)
class Channel:
    """One series of a log, and where the model predicts it.

    Args:
        key: Key of the series in the log, `signal.quantity`.
        kind: 'linear' residuals are differences, 'rotation' residuals the rotation logarithm.
        source: Array of the rollout that predicts it.
        columns: Columns of that array, in the order of the series' columns (4 for a quaternion).
        noise: Measurement noise sd [SI] of one column; None: unknown.
        units: Unit of the residual; where joints turn and others slide, that of each column.
        compared: Rollouts are held against it; else it only sets the state that they start from.
        part: The one column of the series that it is; None: all of them.
        slope: For a velocity: at a window's start it is the slope of the positions that were measured within
            this time before and after [s]; 0: as recorded.
    """

    key: str
    kind: Literal["linear", "rotation"]
    source: Literal["qpos", "qvel", "sensordata", "effort"]
    columns: tuple[int, ...]
    noise: float | None
    units: tuple[str, ...]
    compared: bool = True
    slope: float = 0.0
    part: int | None = None

    @property
    def series(self) -> str:
        """Key of its series in the log."""
        return self.key if self.part is None else self.key.partition(PART)[0]

    @property
    def quantity(self) -> str:
        """What it measures."""
        return self.series.rsplit(".", 1)[1]

    def parts(self, names: Sequence[str]) -> Iterator[Channel]:
        """Each column as a channel of its own.

        Args:
            names: What the columns are called.
        """
        for i, (column, name) in enumerate(zip(self.columns, names, strict=True)):
            units = self.units[i:][:1] if len(self.units) > 1 else self.units
            yield replace(self, key=f"{self.key}{PART}{name}", columns=(column,), part=i, units=units)

    @property
    def unit(self) -> str:
        """Unit of the residual; 'rad or m' where joints turn and others slide."""
        return " or ".join(dict.fromkeys(self.units))

    @property
    def integral(self) -> str:
        """For a velocity: the series that it is the derivative of."""
        signal, quantity = self.key.rsplit(".", 1)
        return f"{signal}." + ("orientation" if quantity == "angular_velocity" else "position")

    @property
    def sets_state(self) -> bool:
        """Whether the series gives part of the state that a rollout starts from."""
        return self.source in ("qpos", "qvel")


@dataclass(frozen=True, slots=True)
class Input:
    """One series of a log that drives the model.

    Args:
        key: Key of the series in the log.
        columns: Columns of the engine's input vector that it fills, in the series' column order.
        delayed: It commands actuators, and acts late where a parameter says so.
        frame: x, y, z, roll, pitch, yaw of the log's frame in the model's, where a pose is brought into it.
        arm: Where a force drives by its moment: series of the point where it acts and of the origin about
            which (None: that of the frame).
        units: Unit of each column, or of all; (): they have none.
    """

    key: str
    columns: tuple[int, ...]
    delayed: bool
    frame: tuple[float, ...] = ()
    arm: tuple[str, str | None] | None = None
    units: tuple[str, ...] = ()

    @property
    def keys(self) -> tuple[str, ...]:
        """All series that it needs."""
        return (self.key, *(key for key in self.arm or () if key is not None))


@dataclass(frozen=True, eq=False)
class SystemData:
    """A model, its unknown parameters, and how logged signals relate to it; `System` can do more with them.

    Args:
        name: Name of the folder or of the model.
        folder: The system folder; None: the system was made by `from_model`.
        text: Text of `system.yaml`; of a system without a folder, its arguments as JSON.
        original: MuJoCo spec of the model as it was given.
        spec: MuJoCo spec of the estimation model, sensors of the measured quantities added.
        model: `spec` compiled, at the nominal parameters.
        space: The unknown parameters.
        edits: How parameters are written into the model.
        signals: What to read from a log.
        channels: How those signals meet the model's state and sensors.
        inputs: How those signals drive the model.
        input_spec: mjtState bits of the engine's input vector (ctrl, qfrc_applied, xfrc_applied, mocap).
        settings: The system's own settings over the defaults.
        calibration: What stands between the model's quantities and the log's numbers.
        keyframe: Keyframe that holds the state of everything that no signal gives; None: the model's own.
        match: What is compared with the logs: the motion under recorded commands, or the joints' efforts
            along the recorded motion.
        given: Settings in place of those in the folder's `system.yaml`, as `System.load` takes them.
    """

    name: str
    folder: Path | None
    text: str
    original: mujoco.MjSpec
    spec: mujoco.MjSpec
    model: mujoco.MjModel
    space: ParameterSpace
    edits: ModelEdits
    signals: tuple[Signal, ...]
    channels: tuple[Channel, ...]
    inputs: tuple[Input, ...]
    input_spec: int
    settings: Settings
    keyframe: int | None = None
    calibration: SignalCalibration = field(default_factory=SignalCalibration)
    given: Mapping[str, Any] = field(default_factory=dict)
    match: Literal["motion", "effort", "both"] = "motion"
