"""How many events to fold at once: as many as take a moment, so that whoever waits for the fold does not wait long."""

from __future__ import annotations

import time
from collections.abc import Callable

from estimators.fold import Fold

MOMENT = 0.02
"""Seconds that a piece should take; one event of a large field may take longer."""

MOST = 16_384
"""Events of a piece."""


class Pieces:
    """Folds in pieces whose size follows from what the last ones took. The rows are the same in whatever pieces."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        """`clock` gives seconds that only rise."""
        self._clock = clock
        self.begin()

    def begin(self) -> None:
        """Another fold, of which nothing is known."""
        self.size = 1

    def advance(self, fold: Fold) -> int:
        """Fold the next piece; how many events it had."""
        begun = self._clock()
        count = fold.advance(self.size)
        took = self._clock() - begun
        if took > MOMENT:
            self.size = max(1, int(self.size * MOMENT / took))
        elif took < MOMENT / 8 and count == self.size:
            self.size = min(MOST, 4 * self.size)
        return count
