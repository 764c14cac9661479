"""Source of events in memory."""

from __future__ import annotations

from estimators.log import Events

BATCH = 4096


class MemorySource:
    """Returns `readings` in their order, some thousands at a time."""

    live = False

    def __init__(self, readings: Events, *, batch: int = BATCH) -> None:
        self._readings = readings
        self._batch = batch
        self._next = 0

    @property
    def span(self) -> tuple[int, int] | None:
        """First and last time, ns."""
        t = self._readings.t
        return (int(t.min()), int(t.max())) if t.size else None

    def read(self, timeout: float) -> Events | None:
        """Return the next events; None at the end."""
        if self._next >= len(self._readings):
            return None
        part = self._readings.select(slice(self._next, self._next + self._batch))
        self._next += self._batch
        return part

    def now(self) -> int | None:
        """Return None: it has no clock."""
        return None

    def close(self) -> None:
        """Release nothing."""
