"""What became of the latest messages, for the answers to those who sent them."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Sequence

import numpy as np

from estimators.log import INPUT, READING, Events

OUTCOMES = ("used", "late", "stale", "waiting", "unused")
"""In time; inserted where it belongs; too old, dropped; held until others confirm its time; without a value to use."""

USED, LATE, STALE, WAITING, UNUSED = range(len(OUTCOMES))

MAX_OUTCOMES = 200_000
"""Events of which it is known, at least."""


class Outcomes:
    """Outcomes by arrival, which is another for each message: written by the thread that folds, read by any."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._noted: deque[np.ndarray] = deque()
        self._count = self._mark = 0
        self._waiting = np.zeros(0, np.int64)

    def note(
        self, mark: int, events: Events, arrival: np.ndarray, waiting: np.ndarray, late: np.ndarray, stale: np.ndarray
    ) -> None:
        """Note events (n,) that passed, with arrivals and masks (n,), and the arrivals of those that wait (m,), ns.

        They are all that the source gave up to its `mark`.
        """
        valued = np.isin(events.kind, (READING, INPUT)) & np.isfinite(events.value).any(axis=1)
        code = np.select([~valued, stale, late], [UNUSED, STALE, LATE], USED)
        # The first of a message counts: one of its values may be missing.
        order = np.lexsort((code, arrival))
        rows = np.stack((arrival[order], code[order]))
        with self._lock:
            self._mark, self._waiting = mark, waiting
            self._noted.append(rows)
            self._count += rows.shape[1]
            while self._count - self._noted[0].shape[1] > MAX_OUTCOMES:
                self._count -= self._noted.popleft().shape[1]

    def of(self, mark: int, arrivals: np.ndarray) -> Sequence[str] | None:
        """Return the outcomes of messages by arrival (n,), ns; None until the source has been read to their mark."""
        with self._lock:
            if self._mark < mark:
                return None
            waiting, noted = self._waiting, [*self._noted]
        found = np.where(np.isin(arrivals, waiting), WAITING, UNUSED)
        for known, code in noted:
            place = np.searchsorted(known, arrivals)
            there = place < known.size
            there[there] = known[place[there]] == arrivals[there]
            found[there] = np.minimum(found[there], code[place[there]])
        return [OUTCOMES[k] for k in found.tolist()]
