"""Calibration of signals: what stands between a quantity of the model and the number in the log.

    reading = scale * R'(true - origin) + bias,     averaged over what the sensor's band lets it remember

R and origin are the log's frame in the model's. Each number is fixed in the signal's entry, or a parameter
whose target names the signal. A joint's bias is the zero of its encoder: it moves the model's own coordinate,
so that position commands are in the encoder's frame too.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from amhe_cli.core.arrays import FloatArray


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
        own: The numbers as the signals' entries give them, shape (n,); `ModelEdits.numbers` has them under
            parameters.
        readings: Key of a channel -> its reading.
    """

    own: FloatArray = field(default_factory=lambda: np.empty(0))
    readings: Mapping[str, Reading] = field(default_factory=dict)

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
        return SignalCalibration(np.array(numbers), readings)
