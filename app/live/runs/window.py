"""The last events of a running twin as a log of their own, to be folded again beside it."""

from __future__ import annotations

from typing import NamedTuple

from estimators.fold import Fold
from estimators.log import Log
from estimators.snapshots import SPARSE_EVERY, Base
from estimators.track import Track
from estimators.tuning import Tuning

from ..interface import Running
from ..outputs import Pull

ALL = 2**62
"""Later than every event."""


class Window(NamedTuple):
    """Copies of the last rows, and what it takes to fold them again: a base before them, None for the prior."""

    estimator: str
    tuning: Tuning
    pull: Pull
    base: Base | None

    @property
    def track(self) -> Track:
        """What the running fold concluded."""
        return self.pull.track

    def fold(self, engine: Running, estimator: str, tuning: Tuning) -> Fold:
        """A fold over these events, of any estimator and tuning; nothing is folded yet."""
        log = Log.resume(engine.model, self.base, self.pull.events)
        return Fold(estimator, engine.model, tuning, log, policy=engine.policy, base=self.base)


def window(engine: Running, most: int) -> Window | None:
    """The last `most` events, from a snapshot on; None if there are none, or another fold took over meanwhile."""
    tuning, estimator = engine.folded_with()
    end = engine.index_at(ALL)
    index = max(0, end - most)
    # `origin` goes back to where all revisions have a snapshot.
    at, base = engine.origin(-(-index // SPARSE_EVERY) * SPARSE_EVERY)
    pull = engine.rows(at, end)
    if engine.folded_with()[0] is not tuning or not len(pull.events):
        return None
    return Window(estimator, tuning, pull, base)
