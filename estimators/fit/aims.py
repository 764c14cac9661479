"""What a fit aims at: what each event adds to what is maximised.

- `likelihood`: the log density that the filter gave to the reading before it saw it.
- `crps`: how well sensors are predicted that the filter does not use, each held out in turn: the continuous ranked
  probability score, which judges error and band together. What no sensor sees is more like these than like the next
  reading of a sensor that is used.
- `error`: the same without the band, half the square of the error.

The last two are in units of what they are at the start, so that a reading weighs about as much as in the first.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

from ..diagnostics.refusals import log_density
from ..errors import EstimatorError, nearest, quoted
from ..fold import Fold
from ..log import READING, Log
from ..model.state_space import StateSpaceModel
from ..snapshots import Base
from ..track import FAILED, GATED, HELD_OUT, USED, Track
from .entries import Setting

PRICE = 1e3
"""Nats that a reading costs which failed."""

LIKELIHOOD, CRPS, ERROR = AIMS = ("likelihood", "crps", "error")


class Recording(NamedTuple):
    """A log, how much its readings weigh, the events (n,) that take no part in the fit, and where it starts."""

    log: Log
    weight: float
    held_out: np.ndarray
    base: Base | None = None


@dataclass(frozen=True)
class Aim:
    """What is aimed at; `sensors` are held out in turn, and their rows' scores are in units of `scale` (rows,)."""

    kind: str = LIKELIHOOD
    sensors: tuple[int, ...] = ()
    scale: np.ndarray | None = None

    @property
    def folds(self) -> int:
        """Of a recording, at one point."""
        return max(1, len(self.sensors))

    def terms(self, estimator: str, given: Setting, recording: Recording) -> np.ndarray:
        """What each event adds, (n,); zero where it adds nothing."""
        if self.kind == LIKELIHOOD:
            return densities(track_of(estimator, given, recording), given.tuning.gate)
        model = given.tuning.model
        found = np.zeros(recording.log.n)
        for s in self.sensors:
            track = track_of(estimator, given, recording, without=s)
            first = model.row_start[s]
            for k, (rows, error, std) in enumerate(held_out_errors(model, recording.log, track, s)):
                scale = 1.0 if self.scale is None else self.scale[first + k]
                lost = crps(error, std) / scale if self.kind == CRPS else 0.5 * (error / scale) ** 2
                found[rows] -= np.where(np.isfinite(lost), lost, PRICE)
        return found


def aim_of(kind: str, estimator: str, given: Setting, recordings: list[Recording], wanted: tuple[str, ...]) -> Aim:
    """An aim, in units of what it is at the start.

    Args:
        kind: One of `AIMS`.
        estimator: The filter.
        given: Where the fit starts.
        recordings: To which is fitted.
        wanted: Names of the sensors that are to be held out; empty for each in turn.

    Raises:
        EstimatorError: If there is no such aim or sensor, or too few sensors.
    """
    if kind not in AIMS:
        raise EstimatorError(f"the aim is {quoted(kind)}; it must be one of {', '.join(AIMS)}")
    if kind == LIKELIHOOD:
        return Aim()
    model = given.tuning.model
    for name in wanted:
        if name not in model.sensor_names:
            raise EstimatorError(f"{quoted(name)} is no sensor of {model.name}; {nearest(name, model.sensor_names)}")
    speak = sensors_in_turn(given, recordings)
    sensors = tuple(s for s in speak if not wanted or model.sensor_names[s] in wanted)
    if not sensors:
        raise EstimatorError(f"the aim is {kind}; it needs a sensor to hold out, and another one that is used")
    scale = np.ones(len(model.row_names))
    sums: dict[int, list[np.ndarray]] = {}
    for record in recordings:
        for s in sensors:
            track = track_of(estimator, given, record, without=s)
            for k, (rows, error, std) in enumerate(held_out_errors(model, record.log, track, s)):
                lost = crps(error, std) if kind == CRPS else error**2
                sums.setdefault(model.row_start[s] + k, []).append(lost[~record.held_out[rows]])
    for row, parts in sums.items():
        mean = float(np.mean(np.concatenate(parts)))
        if np.isfinite(mean) and mean > 0.0:
            scale[row] = mean if kind == CRPS else np.sqrt(mean)
    return Aim(kind, sensors, scale)


def track_of(estimator: str, given: Setting, recording: Recording, without: int | None = None) -> Track:
    """A recording, folded; `without` one of the sensors, which is then predicted."""
    tuning, prior = given
    if without is not None:
        tuning = tuning.set(f"use.{tuning.model.sensor_names[without]}", False)
    fold = Fold(estimator, tuning.model, tuning, recording.log, base=recording.base, prior=prior)
    fold.advance()
    return fold.track


def sensors_in_turn(given: Setting, recordings: list[Recording]) -> list[int]:
    """Sensors that are used and speak; none if there is only one, without which nothing is told."""
    speak: set[int] = set()
    for record in recordings:
        log = record.log
        speak |= set(np.unique(log.channel[: log.n][log.kind[: log.n] == READING]).tolist())
    sensors = sorted(int(s) for s in speak if given.tuning.used[s])
    return sensors if len(sensors) > 1 else []


def held_out_errors(
    model: StateSpaceModel, log: Log, track: Track, s: int
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Of each row of a sensor that a fold held out: the events, error and standard deviation of its predictions."""
    own = (log.kind[: log.n] == READING) & (log.channel[: log.n] == s) & (track.verdict == HELD_OUT)
    found = []
    for k in range(len(model.sensors[s].rows)):
        rows = np.flatnonzero(own & np.isfinite(track.innovation[:, k]) & (track.innovation_std[:, k] > 0.0))
        found.append((rows, track.innovation[rows, k], track.innovation_std[rows, k]))
    return found


def densities(track: Track, gate: float | None) -> np.ndarray:
    """Log of the density of each reading, (n,): of those used and refused; of one that failed, its price; else 0."""
    values = np.where(track.verdict == USED, track.log_likelihood, 0.0)
    refused = np.flatnonzero(track.verdict == GATED)
    if refused.size:
        values[refused] = log_density(track.select(refused), gate)
    values = np.where(np.isfinite(values), values, -PRICE)
    values[track.verdict == FAILED] = -PRICE
    return values


def crps(error: np.ndarray, std: np.ndarray) -> np.ndarray:
    """Continuous ranked probability score of a Gaussian, (n,), of its error and standard deviation.

    CRPS(N(m, s²), y) = s (z (2 Φ(z) - 1) + 2 φ(z) - 1/√π),  z = (y - m) / s

    Source: Gneiting & Raftery (2007), doi:10.1198/016214506000001437, (21).
    """
    z = error / std
    density = np.exp(-0.5 * z**2) / np.sqrt(2.0 * np.pi)
    found: np.ndarray = std * (z * (2.0 * ndtr(z) - 1.0) + 2.0 * density - 1.0 / np.sqrt(np.pi))
    return found
