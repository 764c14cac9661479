"""Quantities that a fold did not use and that judge it: true states, and measurements of held-out sensors."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from ..events.batch import READING, Events, truth_of
from ..model.state_space import StateSpaceModel
from ..track import HELD_OUT, Track


class Reference(NamedTuple):
    """A true state (`truth`), or a row of a held-out sensor.

    At the events `rows` (n,): `error` (n,), reference less prediction, and `std` (n,) of the prediction, in `unit`.
    """

    name: str
    unit: str
    truth: bool
    rows: np.ndarray
    error: np.ndarray
    std: np.ndarray

    @property
    def log_density(self) -> np.ndarray:
        """Log density of the reference under its prediction, (n,)."""
        found: np.ndarray = -0.5 * (self.error / self.std) ** 2 - np.log(self.std) - 0.5 * np.log(2.0 * np.pi)
        return found

    def finite(self) -> Reference:
        """Return the events with a finite error and a positive standard deviation."""
        kept = np.isfinite(self.error) & (self.std > 0.0)
        return self._replace(rows=self.rows[kept], error=self.error[kept], std=self.std[kept])


def wrapped(angle: np.ndarray) -> np.ndarray:
    """Return angles within ±π."""
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


def true_states(model: StateSpaceModel, events: Events, track: Track) -> Iterator[Reference]:
    """Yield the shown states with a known truth at the rows of a track."""
    for column, (j, state) in enumerate(zip(model.shown, model.shown_states, strict=True)):
        rows, true = truth_of(events, int(j))
        if rows.size:
            error = true - track.mean[rows, column]
            error = wrapped(error) if state.circular else error
            yield Reference(state.name, state.unit, True, rows, error, track.std[rows, column])


def held_out_references(model: StateSpaceModel, events: Events, track: Track, s: int) -> Iterator[Reference]:
    """Yield the rows of sensor s, where a fold held it out."""
    own = np.flatnonzero((events.kind == READING) & (events.channel == s) & (track.verdict == HELD_OUT))
    for k, row in enumerate(model.sensors[s].rows):
        name = model.row_names[model.row_start[s] + k]
        yield Reference(name, row.unit, False, own, track.innovation[own, k], track.innovation_std[own, k])


def references(model: StateSpaceModel, events: Events, track: Track) -> list[Reference]:
    """Return all finite references of a track: true states first, then the rows of held-out sensors."""
    found = [*true_states(model, events, track)]
    for s in range(len(model.sensors)):
        found += held_out_references(model, events, track, s)
    return [item for item in map(Reference.finite, found) if item.rows.size]
