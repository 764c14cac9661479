"""Witnesses: what a recording knows and its filter is never told, so that it can say whether the filter is right.

They are true states, and sensors that the twin itself holds out. They are what the estimate is for more than the next
reading of a sensor that is used, and a fit may aim at them too.

A filter's errors last: a thousand true values within one swing of the error are one. Where z are the errors in their
standard deviations, z² tells of the noises, and n of them tell as much as n / τ that are independent, τ = 1 + 2 Σ ρ_k
with ρ the correlation of z² at lag k, summed up to where the sum of two neighbours is no more positive.

Sources: Abbeel, Coates, Montemerlo, Ng & Thrun, Discriminative training of Kalman filters (Robotics: Science and
Systems 2005), who maximise the likelihood of what an accurate instrument says of the estimate; Geyer (1992),
doi:10.1214/ss/1177011137, 3.3, for where the sum ends.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..log import READING, Log, truth_of
from ..model.state_space import StateSpaceModel
from ..track import HELD_OUT, Track


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
