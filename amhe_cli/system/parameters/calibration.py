"""Calibration of signals: what stands between a quantity of the model and the number in the log.

    reading = scale * R'(true - origin) + bias,     averaged over what the sensor's band lets it remember

R and origin are the log's frame in the model's. Each number is fixed in the signal's entry, or a parameter
whose target names the signal. A joint's bias is the zero of its encoder: it moves the model's own coordinate,
so that position commands are in the encoder's frame too.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import mujoco
import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.system.parameters.cells import Cells
from amhe_cli.system.parameters.edits import ScalarEdit


@dataclass(frozen=True, slots=True)
class CalibrationNumber(Cells):
    """One number of the calibration, which a parameter may set like a number of the model; it has a name."""

    own: float = 0.0
    name: str = ""

    def of(self, model: mujoco.MjModel) -> FloatArray:
        """The number as the signal's entry gives it."""
        return np.array([self.own])


@dataclass(frozen=True, slots=True)
class Reading:
    """Rows, among the calibration's numbers, of those of one channel; None and () where there is none.

    Args:
        scale: Rows of the scale of each column.
        bias: Rows of the bias of each column.
        frame: Rows of x, y, z, roll, pitch, yaw of the log's frame.
        origin: The frame's origin counts too, not its rotation alone.
        band: Row of its band [Hz].
        memory: Time that the sensor remembers at its lowest band [s].
        sign: -1 where the log has the force on the other side.
    """

    scale: tuple[int, ...] = ()
    bias: tuple[int, ...] = ()
    frame: tuple[int, ...] = ()
    origin: bool = False
    band: int | None = None
    memory: float = 0.0
    sign: float = 1.0

    def of(self, column: int | None) -> Reading:
        """The reading of one column; None: of all."""
        one = slice(None) if column is None else slice(column, column + 1)
        return replace(self, scale=self.scale[one], bias=self.bias[one])


@dataclass(frozen=True, eq=False)
class SignalCalibration:
    """Calibration of all channels of a system.

    Args:
        own: The numbers as the signals' entries give them, shape (n,).
        edits: How parameters are written into them.
        readings: Key of a channel -> its reading.
    """

    own: FloatArray = field(default_factory=lambda: np.empty(0))
    edits: tuple[ScalarEdit, ...] = ()
    readings: Mapping[str, Reading] = field(default_factory=dict)

    @property
    def set_rows(self) -> frozenset[int]:
        """Rows of the numbers that parameters set."""
        return frozenset(cells.row for edit in self.edits for cells in edit.cells)

    def biased(self, widths: Mapping[str, int]) -> SignalCalibration:
        """The same with a bias, 0 where there was none, for each column of some channels.

        Args:
            widths: Key of a channel -> its number of columns.
        """
        numbers, readings = list(self.own), dict(self.readings)
        for key, width in widths.items():
            reading = readings.get(key, Reading())
            if not reading.bias:
                readings[key] = replace(reading, bias=tuple(range(len(numbers), len(numbers) + width)))
                numbers += [0.0] * width
        return replace(self, own=np.array(numbers), readings=readings)

    def numbers(self, theta: FloatArray) -> FloatArray:
        """All numbers under values (p, d) of all parameters, fixed ones too, shape (p, n)."""
        numbers = np.tile(self.own, (len(theta), 1))
        for edit in self.edits:
            edit.write({"calibration": numbers}, theta)
        return numbers


class ZeroEdit:
    """The zeros of joints' encoders: coordinate and mechanical stops of each joint move by its bias.

    Args:
        calibration: Has the biases.
        rows: Joint -> row of its bias.
        model: The model.
    """

    def __init__(
        self, calibration: SignalCalibration, rows: Mapping[int, int], model: mujoco.MjModel
    ) -> None:
        self._calibration = calibration
        self._rows = {joint: (int(model.jnt_qposadr[joint]), row) for joint, row in rows.items()}

    @property
    def columns(self) -> tuple[int, ...]:
        """None of its own: the calibration's edits have them."""
        return ()

    @property
    def cells(self) -> tuple[Cells, ...]:
        """See `Edit.cells`."""
        zeros = [Cells(name, at) for at, _ in self._rows.values() for name in ("qpos0", "qpos_spring")]
        return (*zeros, *(Cells("jnt_range", joint, (0, 1)) for joint in self._rows))

    def write(self, arrays: Mapping[str, FloatArray], theta: FloatArray) -> None:
        """See `Edit.write`."""
        numbers = self._calibration.numbers(theta)
        for joint, (address, row) in self._rows.items():
            arrays["qpos0"][:, address] += numbers[:, row]
            arrays["qpos_spring"][:, address] += numbers[:, row]
            arrays["jnt_range"][:, joint] += numbers[:, row, None]


class ForceEdit:
    """Scale and bias of a logged force that drives the model: its actuators take (reading - bias) / scale.

    Args:
        calibration: Has the numbers.
        rows: Actuator -> rows of its scale and of its bias.
    """

    def __init__(self, calibration: SignalCalibration, rows: Mapping[int, tuple[int, int]]) -> None:
        self._calibration, self._rows = calibration, dict(rows)

    @property
    def columns(self) -> tuple[int, ...]:
        """None of its own: the calibration's edits have them."""
        return ()

    @property
    def cells(self) -> tuple[Cells, ...]:
        """See `Edit.cells`."""
        return tuple(
            cell
            for actuator in self._rows
            for cell in (Cells("actuator_gainprm", actuator, (0,)), Cells("actuator_biasprm", actuator, (0,)))
        )

    def write(self, arrays: Mapping[str, FloatArray], theta: FloatArray) -> None:
        """See `Edit.write`."""
        numbers = self._calibration.numbers(theta)
        for actuator, (scale, bias) in self._rows.items():
            arrays["actuator_gainprm"][:, actuator, 0] = 1.0 / numbers[:, scale]
            arrays["actuator_biasprm"][:, actuator, 0] = -numbers[:, bias] / numbers[:, scale]
