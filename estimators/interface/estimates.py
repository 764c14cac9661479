"""What a fold gave, with the names of its model: series, a table, scores."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from ..diagnostics.consistency import Nees, nees
from ..diagnostics.episodes import Course, Episode, found_in
from ..diagnostics.score import Score, score
from ..errors import EstimatorError
from ..events.batch import READING, Events
from ..model.state_space import StateSpaceModel
from ..registry import find_estimator
from ..track import Track
from ..tuning import Tuning
from .table import table_of


@dataclass(frozen=True)
class Estimates:
    """One row an event of the log, in its order; `track` has all columns, `events` what was folded."""

    estimator: str
    model: StateSpaceModel
    tuning: Tuning = field(repr=False)
    events: Events = field(repr=False)
    track: Track = field(repr=False)
    covariance: bool = False

    def __len__(self) -> int:
        """Number of events."""
        return len(self.track)

    @cached_property
    def seconds(self) -> np.ndarray:
        """Times of the events, s, (N,)."""
        seconds: np.ndarray = self.events.t * 1e-9
        return seconds

    @property
    def mean(self) -> np.ndarray:
        """Estimates of the states after each event, (N, nx), in their units."""
        mean: np.ndarray = self.track.mean
        return mean

    @property
    def std(self) -> np.ndarray:
        """Their standard deviations, (N, nx)."""
        std: np.ndarray = self.track.std
        return std

    @property
    def nis(self) -> np.ndarray:
        """Normalised innovation squared of each reading, (N,); NaN for other events."""
        nis: np.ndarray = self.track.nis
        return nis

    @property
    def cov(self) -> np.ndarray:
        """Covariances after each event, (N, nx, nx).

        Raises:
            EstimatorError: If the fold did not keep them.
        """
        if not self.covariance:
            raise EstimatorError("the covariances were not kept; fold with covariance=True")
        n = self.model.nx
        cov = np.empty((len(self), n, n))
        cov[:, range(n), range(n)] = self.track.std**2
        i, j = np.triu_indices(n, 1)
        cov[:, i, j] = cov[:, j, i] = self.track.cross
        return cov

    @property
    def log_likelihood(self) -> float:
        """Sum over the readings that were used or refused; see diagnostics/refusals.py."""
        return self.score().log_likelihood

    def readings(self, sensor: str) -> np.ndarray:
        """Indices of the rows that are readings of a sensor.

        Raises:
            EstimatorError: If there is no such sensor.
        """
        if sensor not in self.model.sensor_names:
            raise EstimatorError(
                f"{self.model.name} has no sensor {sensor!r}; it has {', '.join(self.model.sensor_names)}"
            )
        channel = self.model.sensor_names.index(sensor)
        return np.flatnonzero((self.events.kind == READING) & (self.events.channel == channel))

    def table(self) -> Any:
        """A pyarrow.Table, one row an event; `.to_pandas()` makes a frame of it. See tabular.py for its columns."""
        return table_of(self.model, self.events, self.track, self.episodes())

    def episodes(self) -> list[Episode]:
        """What was wrong from when to when, with whom, by how much, and what to do: see docs/alarms.md."""
        marginal = find_estimator(self.estimator, self.model).family in ("particle", "ensemble")
        course = Course(self.model, self.tuning, marginal, self.events, self.track)
        return [found.episode for found in found_in(course)]

    def score(self) -> Score:
        """NIS and its bounds, errors against the truth, predictions of sensors held out."""
        return score(self.track, self.events, self.model, gate=self.tuning.gate, baseline=self.tuning.baseline)

    def nees(self) -> Nees:
        """Normalised estimation error squared wherever the truth is known.

        Raises:
            EstimatorError: If the fold did not keep the covariances, or no truth is known.
        """
        return nees(self.model, self.events, self.mean, self.cov)
