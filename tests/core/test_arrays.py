"""Arrays that nobody can change."""

from __future__ import annotations

import numpy as np
import pytest

from amhe_cli.core.arrays import sealed


def test_what_can_still_be_written_to_is_copied() -> None:
    values = np.arange(6.0)
    part = values[2:]
    part.setflags(write=False)  # its memory is that of `values`
    for given in (values, part, np.broadcast_to(values, (2, 6)), [1.0, 2.0], np.arange(3)):
        found = sealed(given)
        assert not np.shares_memory(found, values)
        assert found.dtype == np.float64
        with pytest.raises(ValueError, match="read-only"):
            found[...] = 0.0
    assert sealed(values > 1.0, np.bool_).dtype == np.bool_


def test_what_was_handed_over_is_not_copied() -> None:
    values, mask = np.arange(6.0), np.ones(3, dtype=bool)
    for one in (values, mask):
        one.setflags(write=False)
    assert sealed(values) is values
    assert sealed(mask, np.bool_) is mask
    assert np.shares_memory(sealed(values[2:]), values)
    assert sealed(sealed([1.0, 2.0])).base is None
