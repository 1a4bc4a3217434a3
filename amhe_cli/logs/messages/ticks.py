"""A counter in a sender's messages as their clock, where they have no stamp."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from amhe_cli.core.arrays import IntArray

#: Messages of which the one that was delayed least gives the counter's offset: a few seconds, in which two
#: clocks drift apart by no more than a millisecond.
_NEAR = 2000
#: A counter whose offset changes by more at once [ns] has begun again.
_AGAIN = 10**9


class TickClock:
    """Moves a counter onto the clock by which its messages were sent, while they come.

    The counter is regular, and a busy sender is not: what was delayed least says how far they are apart.
    """

    def __init__(self) -> None:
        self._near = np.empty(0, dtype=np.int64)

    def stamps(self, ticks_ns: IntArray, sent_ns: IntArray) -> IntArray:
        """Stamps of the next messages [ns], of their counter and times of sending [ns]; shape (n,) each.

        A counter of 0 is one that the sender does not set: 0, no stamp.
        """
        offsets, found = sent_ns - ticks_ns, np.empty_like(ticks_ns)
        leaps = np.flatnonzero(np.abs(np.diff(offsets)) > _AGAIN) + 1
        ends = sorted({0, *leaps.tolist(), *range(0, offsets.size, _NEAR), offsets.size})
        for first, end in pairwise(ends):
            block = offsets[first:end]
            again = abs(block[0] - self._near[-1:]) > _AGAIN
            self._near = block if again.any() else np.concatenate((self._near[-_NEAR:], block))
            found[first:end] = self._near.min()
        return np.where(ticks_ns == 0, 0, ticks_ns + found)
