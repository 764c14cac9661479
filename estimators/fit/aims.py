"""What a fit aims at: what each event adds to what is maximised.

- `likelihood`: the log density that the filter gave to the reading before it saw it.
- `witnesses`: the same, and the log density that it gave to what the recording knows and the filter is never told
  (witnesses.py). These are weighted by how many of their errors are independent: a model that errs slowly, as that of
  every asset does, must not pass for one that was confirmed at every step. All readings together weigh as much as all
  witnesses, and no more than they have independent ones: what lasts of a sensor's error the next reading confirms too.
- `crps`: how well sensors are predicted that the filter does not use, each held out in turn: the continuous ranked
  probability score, which judges error and band together. What no sensor sees is more like these than like the next
  reading of a sensor that is used.
- `error`: the same without the band, half the square of the error.

The last two are in units of what they are at the start, so that a reading weighs about as much as in the first.

Source: Varin, Reid & Firth, Statistica Sinica 21, 5 (2011), for a likelihood that is composed of several, with weights.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

from ..diagnostics.score import log_density
from ..errors import EstimatorError, nearest, quoted
from ..fold import Fold
from ..log import READING, Log, truth_of
from ..model.state_space import StateSpaceModel
from ..track import FAILED, GATED, HELD_OUT, USED, Track
from .entries import Setting
from .recording import Recording

PRICE = 1e3
"""Nats that a reading costs which failed."""

LIKELIHOOD, WITNESSES, CRPS, ERROR = AIMS = ("likelihood", "witnesses", "crps", "error")

FARTHEST = 5.0
"""Root mean squares beyond which an error counts as this for how long errors last: one peak must not hide that."""


@dataclass(frozen=True)
class Aim:
    """What is aimed at; `sensors` are held out in turn, and their rows' scores are in units of `scale` (rows,).

    `weights` are those of the witnesses, by name, and `own` is that of the readings; the witnesses have `independent`
    errors in all.
    """

    kind: str = LIKELIHOOD
    sensors: tuple[int, ...] = ()
    scale: np.ndarray | None = None
    weights: Mapping[str, float] = field(default_factory=dict)
    own: float = 1.0
    independent: float = np.inf

    @property
    def folds(self) -> int:
        """Of a recording, at one point."""
        return max(1, len(self.sensors))

    def terms(self, estimator: str, given: Setting, recording: Recording) -> np.ndarray:
        """What each event adds, (n,); zero where it adds nothing."""
        model = given.tuning.model
        if self.kind in (LIKELIHOOD, WITNESSES):
            track = track_of(estimator, given, recording)
            return self.told(model, recording.log, track, given.tuning.gate)
        found = np.zeros(recording.log.n)
        for s in self.sensors:
            track = track_of(estimator, given, recording, without=s)
            first = model.row_start[s]
            for k, item in enumerate(of_sensor(model, recording.log, track, s)):
                scale = 1.0 if self.scale is None else self.scale[first + k]
                lost = crps(item.error, item.std) / scale if self.kind == CRPS else 0.5 * (item.error / scale) ** 2
                found[item.rows] -= np.where(np.isfinite(lost), lost, PRICE)
        return found

    def told(self, model: StateSpaceModel, log: Log, track: Track, gate: float | None) -> np.ndarray:
        """What a fold says of each event, (n,), of an aim that holds no sensor out."""
        found = self.own * densities(track, gate)
        if self.weights:
            for item in witnesses(model, log, track):
                # What was never told when the fit began has no weight.
                found[item.rows] += self.weights.get(item.name, 0.0) * np.maximum(item.log_density, -PRICE)
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
    if kind == WITNESSES:
        return _weighed(estimator, given, recordings)
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
            for k, item in enumerate(of_sensor(model, record.log, track, s)):
                lost = crps(item.error, item.std) if kind == CRPS else item.error**2
                sums.setdefault(model.row_start[s] + k, []).append(lost[~record.held_out[item.rows]])
    for row, parts in sums.items():
        mean = float(np.mean(np.concatenate(parts)))
        if np.isfinite(mean) and mean > 0.0:
            scale[row] = mean if kind == CRPS else np.sqrt(mean)
    return Aim(kind, sensors, scale)


def _weighed(estimator: str, given: Setting, recordings: list[Recording]) -> Aim:
    """Witnesses by the share of their errors that are independent at the start, and readings to match."""
    lasting: dict[str, list[tuple[float, int]]] = {}
    for record in recordings:
        track = track_of(estimator, given, record)
        # Of several rows, those that are there.
        used = (track.verdict == USED) & ~record.held_out
        squares = {"": track.nis[used] / np.maximum(track.dof[used], 1)}
        for item in witnesses(given.tuning.model, record.log, track):
            squares[item.name] = ((item.error / item.std) ** 2)[~record.held_out[item.rows]]
        for name, values in squares.items():
            values = values[np.isfinite(values)]
            values = np.minimum(values, FARTHEST**2 * values.mean()) if values.size else values
            lasting.setdefault(name, []).append((correlation_time(values), values.size))
    independent = {name: sum(n / tau for tau, n in items) for name, items in lasting.items()}
    counts = {name: sum(n for _, n in items) for name, items in lasting.items()}
    weights = {name: independent[name] / count for name, count in counts.items() if name and count}
    told = sum(independent[name] for name in weights)
    own = min(independent[""], told) / max(1, counts[""])
    # Without a witness it is the likelihood as it is.
    return Aim(WITNESSES, weights=weights, own=own, independent=told) if weights else Aim()


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


class Witness(NamedTuple):
    """What a fold said of something that it was not told.

    At the events `rows` (n,): `error` (n,), what was true less what was said, and `std` (n,), in `unit`. `truth` is
    whether it is a true state, or else a row of a sensor held out.
    """

    name: str
    unit: str
    truth: bool
    rows: np.ndarray
    error: np.ndarray
    std: np.ndarray

    @property
    def log_density(self) -> np.ndarray:
        """Of what was true, as it was said, (n,)."""
        found: np.ndarray = -0.5 * (self.error / self.std) ** 2 - np.log(self.std) - 0.5 * np.log(2.0 * np.pi)
        return found


def witnesses(model: StateSpaceModel, log: Log, track: Track) -> list[Witness]:
    """The witnesses that a log has, of a fold of it: true states first."""
    found = []
    for column, (j, state) in enumerate(zip(model.shown, model.shown_states, strict=True)):
        rows, true = truth_of(log.events, int(j))
        error, std = true - track.mean[rows, column], track.std[rows, column]
        if state.circular:
            error = (error + np.pi) % (2.0 * np.pi) - np.pi
        found.append(_told(state.name, state.unit, True, rows, error, std))
    for s in range(len(model.sensors)):
        found += of_sensor(model, log, track, s)
    return [item for item in found if item.rows.size]


def of_sensor(model: StateSpaceModel, log: Log, track: Track, s: int) -> list[Witness]:
    """Of each row of a sensor that a fold held out."""
    own = np.flatnonzero((log.kind[: log.n] == READING) & (log.channel[: log.n] == s) & (track.verdict == HELD_OUT))
    first = model.row_start[s]
    return [
        _told(model.row_names[first + k], row.unit, False, own, track.innovation[own, k], track.innovation_std[own, k])
        for k, row in enumerate(model.sensors[s].rows)
    ]


def _told(name: str, unit: str, truth: bool, rows: np.ndarray, error: np.ndarray, std: np.ndarray) -> Witness:
    kept = np.isfinite(error) & (std > 0.0)
    return Witness(name, unit, truth, rows[kept], error[kept], std[kept])


def correlation_time(values: np.ndarray) -> float:
    """τ of a series (n,), at least 1: how many of its values tell as much as one that is independent."""
    n = values.size
    centred = values - values.mean() if n else values
    power = np.abs(np.fft.rfft(centred, 2 * n)) ** 2 if n else np.zeros(1)
    covariance = np.fft.irfft(power)[:n] if n else np.zeros(1)
    if not n or not covariance[0] > 0.0:
        return 1.0
    rho = covariance / covariance[0]
    pairs = rho[: n - n % 2].reshape(-1, 2).sum(axis=1)
    ends = np.flatnonzero(pairs <= 0.0)
    return max(1.0, 2.0 * float(pairs[: ends[0] if ends.size else pairs.size].sum()) - 1.0)
