"""Assets that have been silent for long, as of the present time."""

from __future__ import annotations

from itertools import groupby

import numpy as np

from estimators.events.arrays import blank
from estimators.fleet.fleet import Fleet
from estimators.log import TICK

LENGTH_BYTES = 8


class SilentAssets:
    """Queries assets of a fleet without changing their state.

    The state of an asset after its last event is kept while it is silent, and put back before its next one. So it
    depends on its own events alone, and not on when it was queried.
    """

    def __init__(self, fleet: Fleet) -> None:
        self._fleet = fleet
        self._states: dict[int, bytes] = {}
        """State of each after its last event, by position."""

    @property
    def places(self) -> np.ndarray:
        """Positions of the assets that are silent."""
        return np.fromiter(self._states, np.int64, len(self._states))

    def query(self, places: np.ndarray, times: np.ndarray) -> None:
        """Show the estimate and health of assets (rising positions) at their times, ns. All events must be folded."""
        for place in places.tolist():
            known = self._states.get(place)
            if known is None:
                self._states[place] = self._fleet.state(slice(place, place + 1))
            else:
                self._fleet.restore(place, known)
        self._fleet.add_events(places, blank(times, TICK, 0, self._fleet.model.width))
        self._fleet.advance()

    def forget(self, place: int, state: bytes) -> None:
        """Give an asset another state, such as that before its first event."""
        self._states.pop(place, None)
        self._fleet.restore(place, state)

    def put_back(self, places: np.ndarray) -> None:
        """Put back the state of those of some assets that are silent: they have new events."""
        if self._states:
            for place in places.tolist():
                state = self._states.pop(place, None)
                if state is not None:
                    self._fleet.restore(place, state)

    def state(self, part: slice) -> bytes:
        """Return the states of assets, that of silent ones after their last event, for `restore`."""
        pieces: list[bytes] = []
        for silent, group in groupby(range(part.start, part.stop), self._states.__contains__):
            places = list(group)
            runs = (
                [self._states[k] for k in places] if silent else [self._fleet.state(slice(places[0], places[-1] + 1))]
            )
            counts = [1] * len(places) if silent else [len(places)]
            for count, state in zip(counts, runs, strict=True):
                pieces += [np.array([count, len(state)], np.int64).tobytes(), state]
        return b"".join(pieces)

    def restore(self, first: int, data: bytes) -> None:
        """Take over the `state` of assets from a position on.

        Raises:
            EstimatorError: If it is not of a fleet of this model, estimator and tuning.
        """
        at = 0
        while at < len(data):
            count, size = np.frombuffer(data, np.int64, 2, at).tolist()
            at += 2 * LENGTH_BYTES
            self._fleet.restore(first, data[at : at + size])
            first, at = first + count, at + size
