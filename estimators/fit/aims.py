"""Aims of a fit: the score that each event adds to the objective.

- `likelihood`: the log density that the filter gave to the measurement before it saw it.
- `witnesses`: the same, plus the log density of quantities that the recording contains and the filter does not use, its
  references: true states, and sensors that the twin holds out. References are weighted by their number of independent
  errors, so that a model with slow errors, as every real asset has, does not count as confirmed at every step. All
  measurements together weigh as much as all references, and no more than their own number of independent errors.
- `crps`: the continuous ranked probability score of sensors that are held out in turn, which judges error and band
  together. A state that no sensor measures resembles these more than the next measurement of a sensor in use.
- `error`: the same without the band, half the square of the error.

The last two are in units of their value at the start, so that a measurement weighs about as much as in the first.

The errors z of a filter, in standard deviations, last: n values of z² carry as much information as n / τ independent
ones, τ = 1 + 2 Σ ρ_k with ρ the correlation of z² at lag k, summed while the sum of two neighbours is positive.

Sources: Varin, Reid & Firth, Statistica Sinica 21, 5 (2011), for composite likelihoods with weights; Abbeel, Coates,
Montemerlo, Ng & Thrun, Discriminative training of Kalman filters (Robotics: Science and Systems 2005), for the
likelihood of reference measurements; Geyer (1992), doi:10.1214/ss/1177011137, 3.3, for the end of the sum.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy.special import ndtr

from ..diagnostics.health import HealthPolicy
from ..diagnostics.references import held_out_references, references
from ..diagnostics.score import log_density
from ..errors import EstimatorError, nearest, quoted
from ..fold import folded
from ..log import READING, Log
from ..track import FAILED, GATED, USED, Track
from .entries import Setting
from .recording import Recording

FAILURE_COST = 1e3  # Nats that a failed measurement costs

LIKELIHOOD, WITNESSES, CRPS, ERROR = AIMS = ("likelihood", "witnesses", "crps", "error")

MAX_ERROR = 5.0
"""Error in root mean squares at which errors are clipped for the correlation time: one peak must not dominate it."""


def correlation_time(values: np.ndarray, *, about_mean: bool = True) -> float:
    """Return the autocorrelation time τ ≥ 1 of a series (n,): correlated values per independent value.

    About zero instead of its mean a bias counts as what lasts.
    """
    n = values.size
    if not n:
        return 1.0
    power = np.abs(np.fft.rfft(values - values.mean() if about_mean else values, 2 * n)) ** 2
    covariance = np.fft.irfft(power)[:n]
    if not covariance[0] > 0.0:
        return 1.0
    rho = covariance / covariance[0]
    pairs = rho[: n - n % 2].reshape(-1, 2).sum(axis=1)
    ends = np.flatnonzero(pairs <= 0.0)
    return max(1.0, 2.0 * float(pairs[: ends[0] if ends.size else pairs.size].sum()) - 1.0)


@dataclass(frozen=True)
class Aim:
    """Aim of a fit.

    Attributes:
        kind: One of `AIMS`.
        sensors: Sensors that are held out in turn.
        scale: Units of their rows' scores (rows,).
        weights: Weights of the references, by name.
        own: Weight of the measurements.
        independent: Number of independent errors of all references.
    """

    kind: str = LIKELIHOOD
    sensors: tuple[int, ...] = ()
    scale: np.ndarray | None = None
    weights: Mapping[str, float] = field(default_factory=dict)
    own: float = 1.0
    independent: float = np.inf

    @property
    def folds(self) -> int:
        """Folds per recording and point."""
        return max(1, len(self.sensors))

    def terms(self, estimator: str, setting: Setting, recording: Recording) -> np.ndarray:
        """Return the score of each event, (n,); zero for events that add nothing."""
        model = setting.tuning.model
        if self.kind in (LIKELIHOOD, WITNESSES):
            return self.fold_terms(recording.log, track_of(estimator, setting, recording), setting)
        found = np.zeros(recording.log.n)
        for s in self.sensors:
            track = track_of(estimator, setting, recording, without=s)
            first = model.row_start[s]
            for k, item in enumerate(held_out_references(model, recording.log.events, track, s)):
                item = item.finite()
                scale = 1.0 if self.scale is None else self.scale[first + k]
                loss = crps(item.error, item.std) / scale if self.kind == CRPS else 0.5 * (item.error / scale) ** 2
                found[item.rows] -= np.where(np.isfinite(loss), loss, FAILURE_COST)
        return found

    def fold_terms(self, log: Log, track: Track, setting: Setting) -> np.ndarray:
        """Return the score of each event of one fold, (n,), for an aim that holds no sensor out."""
        found = self.own * densities(track, setting.tuning.gate)
        if self.weights:
            for item in references(setting.tuning.model, log.events, track):
                # A reference that was absent when the fit began has no weight.
                found[item.rows] += self.weights.get(item.name, 0.0) * np.maximum(item.log_density, -FAILURE_COST)
        return found


def aim_of(kind: str, estimator: str, setting: Setting, recordings: list[Recording], wanted: tuple[str, ...]) -> Aim:
    """Return an aim, in units of its value at the start.

    Args:
        kind: One of `AIMS`.
        estimator: The filter.
        setting: Start of the fit.
        recordings: Recordings to fit to.
        wanted: Names of the sensors to hold out; empty for each in turn.

    Raises:
        EstimatorError: If there is no such aim or sensor, or too few sensors.
    """
    if kind not in AIMS:
        raise EstimatorError(f"the aim is {quoted(kind)}; it must be one of {', '.join(AIMS)}")
    if kind == LIKELIHOOD:
        return Aim()
    if kind == WITNESSES:
        return _weighted(estimator, setting, recordings)
    model = setting.tuning.model
    for name in wanted:
        if name not in model.sensor_names:
            raise EstimatorError(f"{quoted(name)} is no sensor of {model.name}; {nearest(name, model.sensor_names)}")
    candidates = sensors_in_turn(setting, recordings)
    sensors = tuple(s for s in candidates if not wanted or model.sensor_names[s] in wanted)
    if not sensors:
        raise EstimatorError(f"the aim is {kind}; it needs a sensor to hold out, and another one that is used")
    losses: dict[int, list[np.ndarray]] = {}
    for record in recordings:
        for s in sensors:
            track = track_of(estimator, setting, record, without=s)
            for k, item in enumerate(held_out_references(model, record.log.events, track, s)):
                item = item.finite()
                loss = crps(item.error, item.std) if kind == CRPS else item.error**2
                losses.setdefault(model.row_start[s] + k, []).append(loss[~record.held_out[item.rows]])
    scale = np.ones(len(model.row_names))
    for row, parts in losses.items():
        mean = float(np.mean(np.concatenate(parts)))
        if np.isfinite(mean) and mean > 0.0:
            scale[row] = mean if kind == CRPS else np.sqrt(mean)
    return Aim(kind, sensors, scale)


def _weighted(estimator: str, setting: Setting, recordings: list[Recording]) -> Aim:
    """Return the aim that weights references by their share of independent errors, and measurements to match."""
    # By name, the empty one for the measurements: numbers of errors, and of independent ones.
    counts: dict[str, int] = {}
    independent: dict[str, float] = {}
    for record in recordings:
        track = track_of(estimator, setting, record)
        # Per finite row of a measurement.
        used = (track.verdict == USED) & ~record.held_out
        squares = {"": track.nis[used] / np.maximum(track.dof[used], 1)}
        for item in references(setting.tuning.model, record.log.events, track):
            squares[item.name] = ((item.error / item.std) ** 2)[~record.held_out[item.rows]]
        for name, values in squares.items():
            values = values[np.isfinite(values)]
            values = np.minimum(values, MAX_ERROR**2 * values.mean()) if values.size else values
            counts[name] = counts.get(name, 0) + values.size
            independent[name] = independent.get(name, 0) + values.size / correlation_time(values)
    weights = {name: independent[name] / count for name, count in counts.items() if name and count}
    total = sum(independent[name] for name in weights)
    own = min(independent[""], total) / max(1, counts[""])
    # Without references it is the likelihood.
    return Aim(WITNESSES, weights=weights, own=own, independent=total) if weights else Aim()


def track_of(estimator: str, setting: Setting, recording: Recording, without: int | None = None) -> Track:
    """Return the track of a recording without alarms and health; the sensor `without` is held out."""
    tuning, prior = setting
    if without is not None:
        tuning = tuning.set(f"use.{tuning.model.sensor_names[without]}", False)
    policy = HealthPolicy(window=0)
    return folded(estimator, tuning.model, tuning, recording.log, base=recording.base, prior=prior, policy=policy).track


def sensors_in_turn(setting: Setting, recordings: list[Recording]) -> list[int]:
    """Return the sensors that are used and report; none if there is only one, which leaves nothing to predict it by."""
    logs = [record.log.events for record in recordings]
    found = np.unique(np.concatenate([events.channel[events.kind == READING] for events in logs]))
    sensors = [int(s) for s in found if setting.tuning.used[s]]
    return sensors if len(sensors) > 1 else []


def densities(track: Track, gate: float | None) -> np.ndarray:
    """Return the log density of each used or rejected measurement, (n,); the cost of a failed one; otherwise 0."""
    values = np.where(track.verdict == USED, track.log_likelihood, 0.0)
    rejected = np.flatnonzero(track.verdict == GATED)
    if rejected.size:
        values[rejected] = log_density(track.select(rejected), gate)
    values = np.where(np.isfinite(values), values, -FAILURE_COST)
    values[track.verdict == FAILED] = -FAILURE_COST
    return values


def crps(error: np.ndarray, std: np.ndarray) -> np.ndarray:
    """Return the continuous ranked probability score of a Gaussian, (n,), of its error and standard deviation.

    CRPS(N(m, s²), y) = s (z (2 Φ(z) - 1) + 2 φ(z) - 1/√π),  z = (y - m) / s

    Source: Gneiting & Raftery (2007), doi:10.1198/016214506000001437, (21).
    """
    z = error / std
    density = np.exp(-0.5 * z**2) / np.sqrt(2.0 * np.pi)
    return std * (z * (2.0 * ndtr(z) - 1.0) + 2.0 * density - 1.0 / np.sqrt(np.pi))
