"""Offset of a held-out sensor against the prediction by the others.

The mean of its last n innovations ν is compared with its bound. Of the variance S of an innovation, R is noise, which
averages to R/n; the rest, H P Hᵀ, is an error of the estimate that all of them share:

    |mean ν| ≤ z √(S - R + R/n)

The estimate does not use a held-out sensor, so its measurements are independent evidence.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..events.batch import Events
from ..log import READING
from ..numerics.quantiles import normal_quantile
from ..track import HELD_OUT, Track
from ..tuning import Tuning
from .health import PROBABILITY

LAST_MEASUREMENTS = 200  # Readings of a row that are looked at, the last
MIN_MEASUREMENTS = 10  # Below which nothing is said


class Offset(NamedTuple):
    """Mean innovation of a row of a held-out sensor, and its bound, in `unit`; `alone`: no other sensor is used."""

    sensor: str
    row: str
    offset: float
    allowed: float
    unit: str
    alone: bool = False

    @property
    def beyond(self) -> bool:
        """Whether the offset exceeds its bound."""
        return abs(self.offset) > self.allowed

    @property
    def words(self) -> str:
        """Description in one sentence."""
        unit = "" if self.unit == "1" else f" {self.unit}"
        others = "the model alone" if self.alone else "the other sensors"
        side = "above" if self.offset > 0 else "below"
        size, expected = f"{abs(self.offset):.2g}{unit} {side}", f"±{self.allowed:.2g}{unit} expected"
        if self.beyond:
            return f"{self.row}, held out: {size} the prediction of {others}, {expected}"
        return f"{self.row}, held out: agrees with {others} ({size} the prediction, {expected})"


def offsets(events: Events, track: Track, tuning: Tuning) -> list[Offset]:
    """Return the offsets of every row of the sensors that are held out at the end of consecutive events.

    Args:
        events: The events.
        track: Their track.
        tuning: Tuning of the track.
    """
    model, found = tuning.model, []
    held = (events.kind == READING) & (track.verdict == HELD_OUT)
    for s in np.flatnonzero(~tuning.used.astype(bool)):
        rows = np.flatnonzero(held & (events.channel == s))[-LAST_MEASUREMENTS:]
        for k, row in enumerate(model.sensors[s].rows):
            nu, std = track.innovation[rows, k], track.innovation_std[rows, k]
            known = np.isfinite(nu) & np.isfinite(std)
            n = int(known.sum())
            if n < MIN_MEASUREMENTS:
                continue
            S = float(np.mean(std[known] ** 2))
            R = min(float(tuning.r[model.row_start[s] + k]), S)
            allowed = normal_quantile(0.5 + 0.5 * PROBABILITY) * float(np.sqrt(S - R + R / n))
            name = model.row_names[model.row_start[s] + k]
            alone = not bool(np.any(tuning.used))
            found.append(Offset(model.sensor_names[s], name, float(np.mean(nu[known])), allowed, row.unit, alone))
    return found
