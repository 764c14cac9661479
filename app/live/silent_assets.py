"""Assets that have been silent for long, as of the present time."""

from __future__ import annotations

import numpy as np

from estimators.fleet import Fleet
from estimators.log import TICK, Events


class SilentAssets:
    """Queries assets of a fleet without changing their state.

    The state of an asset after its last event is kept while it is silent, and put back before its next one. So it
    depends on its own events alone, and not on when it was queried.
    """

    def __init__(self, fleet: Fleet) -> None:
        self._fleet = fleet
        self._places = np.zeros(0, np.int64)
        self._states = np.zeros((0, 0), np.uint8)
        """State of each after its last event, (silent, bytes)."""

    def query(self, places: np.ndarray, t: int) -> None:
        """Show the estimate and health of assets (rising positions) at a time, ns. All events must be folded."""
        self.put_back(places)
        parts = [self._fleet.state(slice(run[0], run[-1] + 1)) for run in _runs(places)]
        states = np.frombuffer(b"".join(parts), np.uint8).reshape(places.size, -1)
        if self._places.size:
            places_now = np.concatenate([self._places, places])
            order = np.argsort(places_now, kind="stable")
            self._places, self._states = places_now[order], np.concatenate([self._states, states])[order]
        else:
            self._places, self._states = places, states
        times, none = np.full(places.size, t), np.zeros(places.size, np.int32)
        missing = np.full((places.size, self._fleet.model.width), np.nan)
        self._fleet.add_events(places, Events(times, times, np.full(places.size, TICK, np.int8), none, missing))
        self._fleet.advance()

    def put_back(self, places: np.ndarray) -> None:
        """Put back the state of those of some assets that are silent: they have new events."""
        if not self._places.size:
            return
        chosen = np.isin(self._places, places)
        states = self._states[chosen]
        at = 0
        for run in _runs(self._places[chosen]):
            self._fleet.restore(int(run[0]), states[at : at + run.size].tobytes())
            at += run.size
        self._places, self._states = self._places[~chosen], self._states[~chosen]

    def state(self, part: slice) -> bytes:
        """Return the state of assets as `Fleet.state` does, that of silent ones after their last event."""
        data = self._fleet.state(part)
        mine = (self._places >= part.start) & (self._places < part.stop)
        if not mine.any():
            return data
        rows = np.frombuffer(data, np.uint8).reshape(part.stop - part.start, -1).copy()
        rows[self._places[mine] - part.start] = self._states[mine]
        return rows.tobytes()


def _runs(places: np.ndarray) -> list[np.ndarray]:
    """Split rising positions where one is left out."""
    return np.split(places, np.flatnonzero(np.diff(places) != 1) + 1) if places.size else []
