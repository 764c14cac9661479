"""Columns for charts, by name: `mean:winding`, `reading:yoke`, `nis_mean`."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np

from estimators.diagnostics.considered_shares import noise_states, noise_std
from estimators.diagnostics.detectors import MEMORY_FLAGS
from estimators.diagnostics.references import hidden
from estimators.log import INPUT, READING, Events, truth_of
from estimators.model.state_space import State, StateSpaceModel
from estimators.track import FAILED, GATED, HELD_OUT, USED, Track, estimated_rows

LINE, UPPER, LOWER, DOTS = "line", "upper", "lower", "dots"
"""How the rows of a group become its points: both extremes; the highest or the lowest; single dots."""


class Rows:
    """Events and their track rows, with intermediate results that columns share."""

    def __init__(self, events: Events, track: Track) -> None:
        self.events, self.track = events, track
        self._of_sensors: dict[int, np.ndarray] = {}

    @cached_property
    def estimated(self) -> np.ndarray:
        """Mask of rows with an estimate, (n,)."""
        return estimated_rows(self.track)

    def of_sensor(self, sensor: int) -> np.ndarray:
        """Return the mask of measurements of a sensor, (n,)."""
        if sensor not in self._of_sensors:
            events = self.events
            self._of_sensors[sensor] = (events.kind == READING) & (events.channel == sensor)
        return self._of_sensors[sensor]


Values = Callable[[Rows], np.ndarray]


class Column(NamedTuple):
    """Chart column: name, kind of drawing, and function from n rows to values (n,)."""

    name: str
    kind: str
    of: Values

    def values(self, events: Events, track: Track) -> np.ndarray:
        """Return the values of these rows."""
        return self.of(Rows(events, track))


def columns_of(model: StateSpaceModel) -> dict[str, Column]:
    """Return every column of a model, by name. Bands are ± 2 σ, in the unit of the state or the row."""
    found: list[Column] = []
    for j, state in enumerate(model.shown_states):
        spread = 0.0 if j == model.mode else 2.0  # a probability has no band
        found += [
            Column(f"mean:{state.name}", LINE, partial(_mean, j, 0.0, withhold=state.withhold)),
            Column(f"upper:{state.name}", UPPER, partial(_mean, j, spread)),
            Column(f"lower:{state.name}", LOWER, partial(_mean, j, -spread)),
            *_noise_band(model, j, state),
            Column(f"truth:{state.name}", LINE, partial(_truth, int(model.shown[j]))),
        ]
    for name, sensor, row in rows_of(model):
        found += [
            Column(f"reading:{name}", DOTS, partial(_reading, sensor, row, (USED,))),
            Column(f"refused:{name}", DOTS, partial(_reading, sensor, row, (GATED, FAILED))),
            Column(f"held:{name}", DOTS, partial(_reading, sensor, row, (HELD_OUT,))),
            Column(f"screened:{name}", DOTS, partial(_screened, sensor, row)),
            Column(f"innovation:{name}", DOTS, partial(_of_row, sensor, row, "innovation", 1.0)),
            Column(f"innovation_upper:{name}", UPPER, partial(_of_row, sensor, row, "innovation_std", 2.0)),
            Column(f"innovation_lower:{name}", LOWER, partial(_of_row, sensor, row, "innovation_std", -2.0)),
        ]
    found += [Column(f"input:{item.name}", LINE, partial(_input, k)) for k, item in enumerate(model.inputs)]
    found += [
        Column("nis", DOTS, lambda rows: rows.track.nis),
        Column("nis_mean", LINE, lambda rows: rows.track.nis_mean),
        Column("nis_low", LOWER, lambda rows: rows.track.nis_low),
        Column("nis_high", UPPER, lambda rows: rows.track.nis_high),
        Column("health", UPPER, lambda rows: rows.track.health.astype(float)),
        Column("effective", LINE, lambda rows: rows.track.effective),
        Column("ancestors", LINE, lambda rows: rows.track.ancestors),
    ]
    return {column.name: column for column in found}


def rows_of(model: StateSpaceModel) -> list[tuple[str, int, int]]:
    """Return name, sensor and row within it of every row of a measurement."""
    return [
        (model.row_names[start + row], sensor, row)
        for sensor, start in enumerate(model.row_start)
        for row in range(len(model.sensors[sensor].rows))
    ]


def units_by_name(model: StateSpaceModel) -> dict[str, str]:
    """Return the unit of every charted state, input and row of a measurement, by name."""
    return model.units | {name: model.sensors[sensor].rows[row].unit for name, sensor, row in rows_of(model)}


def _mean(j: int, spread: float, rows: Rows, withhold: float = np.inf) -> np.ndarray:
    track = rows.track
    value = track.mean[:, j] + spread * track.std[:, j] * track.factor[:, j] if spread else track.mean[:, j]
    shown = rows.estimated if withhold == np.inf else rows.estimated & ~hidden(track, j, withhold)
    return np.where(shown, value, np.nan)


def _noise_band(model: StateSpaceModel, j: int, state: State) -> list[Column]:
    """Return the inner band of a state: without considered parameters; while it is suspect, without its factor."""
    considered = j < noise_states(model)
    if not considered and (state.appended or j >= MEMORY_FLAGS):
        return []

    def edge(sign: float, rows: Rows) -> np.ndarray:
        track = rows.track
        std = noise_std(model, j, track.std, track.cross) if considered else track.std[:, j]
        shown = rows.estimated & (considered | (track.factor[:, j] > 1.0))
        return np.where(shown, track.mean[:, j] + sign * 2.0 * std, np.nan)

    return [
        Column(f"noise_upper:{state.name}", UPPER, partial(edge, 1.0)),
        Column(f"noise_lower:{state.name}", LOWER, partial(edge, -1.0)),
    ]


def _truth(state: int, rows: Rows) -> np.ndarray:
    out = np.full(len(rows.events), np.nan)
    told, values = truth_of(rows.events, state)
    out[told] = values
    return out


def _reading(sensor: int, row: int, verdicts: tuple[int, ...], rows: Rows) -> np.ndarray:
    verdict = rows.track.verdict
    judged = np.logical_or.reduce([verdict == one for one in verdicts])
    mine = rows.of_sensor(sensor) & judged & (rows.track.screened[:, row] == 0)
    return np.where(mine, rows.events.value[:, row], np.nan)


def _screened(sensor: int, row: int, rows: Rows) -> np.ndarray:
    return np.where(rows.of_sensor(sensor) & (rows.track.screened[:, row] != 0), rows.events.value[:, row], np.nan)


def _of_row(sensor: int, row: int, name: str, factor: float, rows: Rows) -> np.ndarray:
    """Return a column of the track, of the measurements of a row, times a factor."""
    return np.where(rows.of_sensor(sensor), factor * getattr(rows.track, name)[:, row], np.nan)


def _input(k: int, rows: Rows) -> np.ndarray:
    return np.where(rows.events.kind == INPUT, rows.events.value[:, k], np.nan)
