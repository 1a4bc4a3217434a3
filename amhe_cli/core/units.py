"""Units that logs have, and angles that wrap."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from amhe_cli.core.arrays import FloatArray

#: Unit -> factor to SI, in any case of letters.
FACTORS: Mapping[str, float] = {
    "deg": np.pi / 180.0, "degree": np.pi / 180.0, "degrees": np.pi / 180.0, "°": np.pi / 180.0,
    "deg/s": np.pi / 180.0, "deg/sec": np.pi / 180.0, "degrees/s": np.pi / 180.0, "dps": np.pi / 180.0,
    "°/s": np.pi / 180.0, "rpm": np.pi / 30.0, "mrad": 1e-3, "mm": 1e-3, "cm": 1e-2, "mm/s": 1e-3,
    "mNm": 1e-3, "Ncm": 1e-2, "mA": 1e-3, "mV": 1e-3, "turn": 2.0 * np.pi,
    **{f"1/{2**bits} turn": 2.0 * np.pi / 2**bits for bits in range(8, 21)},
}  # fmt: skip


def unwrapped(angles: FloatArray) -> FloatArray:
    """Angles (n, k) [rad] without jumps of a turn; what is not finite stays so and is passed over."""
    whole = np.array(angles)
    for column in whole.T:
        finite = np.isfinite(column)
        column[finite] = np.unwrap(column[finite])
    return whole
