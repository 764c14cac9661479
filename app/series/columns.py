"""What can be charted of a twin, by name: `mean:winding`, `reading:yoke`, `nis_mean`."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from estimators.log import INPUT, READING, Events, truth_of
from estimators.model.state_space import StateSpaceModel
from estimators.track import FAILED, GATED, HELD_OUT, USED, Track

from ..engine.counts import estimated_rows

LINE, UPPER, LOWER, DOTS = "line", "upper", "lower", "dots"
"""How the rows of a bucket become its points: both extremes; the highest or the lowest alone; a few rows among many."""

Values = Callable[[Events, Track], np.ndarray]


class Column:
    """A name, how its buckets are drawn, and how its values (n,) come from n rows."""

    __slots__ = ("kind", "name", "values")

    def __init__(self, name: str, kind: str, values: Values) -> None:
        self.name, self.kind, self.values = name, kind, values


def columns_of(model: StateSpaceModel) -> dict[str, Column]:
    """Every column of a model, by name. Bands are ± 2 σ, in the unit of the state or the row."""
    found: list[Column] = []
    for j, state in enumerate(model.shown_states):
        spread = 0.0 if j == model.mode else 2.0  # a probability has no band
        found += [
            Column(f"mean:{state.name}", LINE, partial(_mean, j, 0.0)),
            Column(f"upper:{state.name}", UPPER, partial(_mean, j, spread)),
            Column(f"lower:{state.name}", LOWER, partial(_mean, j, -spread)),
            Column(f"truth:{state.name}", LINE, partial(_truth, int(model.shown[j]))),
        ]
    for name, sensor, row in rows_of(model):
        found += [
            Column(f"reading:{name}", DOTS, partial(_reading, sensor, row, (USED,))),
            Column(f"refused:{name}", DOTS, partial(_reading, sensor, row, (GATED, FAILED))),
            Column(f"held:{name}", DOTS, partial(_reading, sensor, row, (HELD_OUT,))),
            Column(f"screened:{name}", DOTS, partial(_screened, sensor, row)),
            Column(f"innovation:{name}", DOTS, partial(_innovation, sensor, row)),
            Column(f"innovation_upper:{name}", UPPER, partial(_bound, sensor, row, 2.0)),
            Column(f"innovation_lower:{name}", LOWER, partial(_bound, sensor, row, -2.0)),
        ]
    found += [Column(f"input:{item.name}", LINE, partial(_input, k)) for k, item in enumerate(model.inputs)]
    found += [
        Column("nis", DOTS, lambda events, track: track.nis),
        Column("nis_mean", LINE, lambda events, track: track.nis_mean),
        Column("nis_low", LOWER, lambda events, track: track.nis_low),
        Column("nis_high", UPPER, lambda events, track: track.nis_high),
        Column("health", UPPER, lambda events, track: track.health.astype(float)),
        Column("effective", LINE, lambda events, track: track.effective),
        Column("ancestors", LINE, lambda events, track: track.ancestors),
    ]
    return {column.name: column for column in found}


def rows_of(model: StateSpaceModel) -> list[tuple[str, int, int]]:
    """Name, sensor and row within it of every row of a reading."""
    return [
        (model.row_names[start + row], sensor, row)
        for sensor, start in enumerate(model.row_start)
        for row in range(len(model.sensors[sensor].rows))
    ]


def _mean(j: int, spread: float, events: Events, track: Track) -> np.ndarray:
    return np.where(estimated_rows(track), track.mean[:, j] + spread * track.std[:, j], np.nan)


def _truth(state: int, events: Events, track: Track) -> np.ndarray:
    out = np.full(len(events), np.nan)
    rows, values = truth_of(events, state)
    out[rows] = values
    return out


def _of_sensor(sensor: int, events: Events) -> np.ndarray:
    return (events.kind == READING) & (events.channel == sensor)


def _reading(sensor: int, row: int, verdicts: tuple[int, ...], events: Events, track: Track) -> np.ndarray:
    mine = _of_sensor(sensor, events) & np.isin(track.verdict, verdicts) & (track.screened[:, row] == 0)
    return np.where(mine, events.value[:, row], np.nan)


def _screened(sensor: int, row: int, events: Events, track: Track) -> np.ndarray:
    return np.where(_of_sensor(sensor, events) & (track.screened[:, row] != 0), events.value[:, row], np.nan)


def _innovation(sensor: int, row: int, events: Events, track: Track) -> np.ndarray:
    return np.where(_of_sensor(sensor, events), track.innovation[:, row], np.nan)


def _bound(sensor: int, row: int, spread: float, events: Events, track: Track) -> np.ndarray:
    return np.where(_of_sensor(sensor, events), spread * track.innovation_std[:, row], np.nan)


def _input(k: int, events: Events, track: Track) -> np.ndarray:
    return np.where(events.kind == INPUT, events.value[:, k], np.nan)
