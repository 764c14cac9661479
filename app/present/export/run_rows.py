"""One run with all its rows, to be written down."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from estimators.diagnostics.episodes import Course, Episode, found_in
from estimators.errors import ConfigError
from estimators.registry import find_entry

from ...live.history_copy import copy_rows
from ...live.interface import Running
from ...live.outputs import Pull
from ...live.revisions import Run

TRIES = 20
"""Times that the rows are copied while a late reading, or another revision, comes in between."""


class RunRows(NamedTuple):
    """A run, and the rows that it had folded."""

    run: Run
    pull: Pull

    @property
    def marginal(self) -> bool:
        """Whether the filter's predictions are not Gaussian."""
        return find_entry(self.run.estimator).family in ("particle", "ensemble")

    def episodes(self) -> list[Episode]:
        """What was wrong in it, in the order of its start, as `nisus fold` finds it."""
        events, track, tuning = self.pull.events, self.pull.track, self.run.tuning
        if not len(events):
            return []
        return [item.episode for item in found_in(Course(tuning.model, tuning, self.marginal, events, track))]

    def between(self, since: int | None, until: int | None) -> slice:
        """The rows from one time to another, ns; None is the end that there is."""
        t = self.pull.events.t
        start = 0 if since is None else int(np.searchsorted(t, since))
        stop = t.size if until is None else int(np.searchsorted(t, until, side="right"))
        return slice(start, max(start, stop))


def rows_of_run(engine: Running, number: int | None = None) -> RunRows:
    """A run and its rows: of what runs a copy, of another what was kept.

    Args:
        engine: Whose.
        number: Of the run; None is the one that runs.

    Raises:
        ConfigError: If there is no such run, nothing has come yet, or its track is gone.
    """
    for _ in range(TRIES):
        running = engine.revisions.runs[-1]
        run = running if number is None else engine.revisions.find(number)
        if run is not running:
            if run.track is None:
                raise ConfigError(f"run {run.number}: its track is gone; load it, and it is folded again")
            return RunRows(run, run.track)
        if not engine.span()[1]:
            raise ConfigError(f"run {run.number}: no reading has come yet")
        pull = copy_rows(engine)
        if pull is not None and pull.revision == run.number:
            return RunRows(run, pull)
    raise ConfigError("its rows change while they are copied; ask again")
