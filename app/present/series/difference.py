"""A kept revision less what runs, row by row."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from estimators.track import estimated_rows

from ...live.interface import Running
from ...live.outputs import Pull
from .columns import Column
from .pyramid import Groups
from .run import ROWS, KeptRun


class DifferenceRun:
    """See `Run`. Means are differences, NaN where what runs has no such row; other columns are the kept ones."""

    def __init__(self, pull: Pull, columns: dict[str, Column], engine: Running) -> None:
        self.of, self._columns, self._engine = pull, columns, engine
        self._kept = KeptRun(pull, columns)
        self.revision, self.generation = -1, 0
        self.end = self.changed = self._kept.end

    def sync(self, columns: Iterable[str]) -> None:
        """See `Run`. Another revision runs: all rows are others."""
        revision = self._engine.revisions.runs[-1].number
        if revision != self.revision:
            self._kept = KeptRun(replace(less(self.of, self._engine), revision=revision), self._columns)
            self.revision = revision
            self.generation += 1
        self._kept.sync(columns)

    def span(self, since: int, until: int) -> tuple[int, int]:
        """See `Run`."""
        return self._kept.span(since, until)

    def groups(self, size: int, start: int, stop: int, columns: list[str]) -> Groups:
        """See `Run`."""
        return self._kept.groups(size, start, stop, columns)


def less(pull: Pull, engine: Running) -> Pull:
    """Rows with means less those of what runs, NaN where that has no such row."""
    mean = np.full_like(pull.track.mean, np.nan)
    for start in range(0, len(mean), ROWS):
        stop = min(start + ROWS, len(mean))
        live = engine.rows(pull.first + start, pull.first + stop)
        at = live.first - pull.first
        rows = slice(at, at + len(live.events))
        # The log may have begun again: a row of the same number at another time is another.
        same = (live.events.t == pull.events.t[rows]) & estimated_rows(live.track)
        mean[rows] = np.where(same[:, None], pull.track.mean[rows] - live.track.mean, np.nan)
    for j, state in enumerate(engine.model.shown_states):
        if state.circular:
            mean[:, j] = (mean[:, j] + np.pi) % (2.0 * np.pi) - np.pi
    return replace(pull, track=pull.track._replace(mean=mean))
