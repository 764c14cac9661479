"""What a running twin offers to commands, views, recorder and API. The engine is one; tests may bring another."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np

from estimators.diagnostics.episodes import Episode
from estimators.diagnostics.health import HealthPolicy
from estimators.log import Events
from estimators.model.state_space import StateSpaceModel
from estimators.snapshots import Base
from estimators.tuning import Tuning
from sources.source import Source

from .commands import Command
from .jobs import Jobs
from .notices import Notices
from .outputs import Belief, Cursor, EventWindow, Here, Pull, Status
from .revisions import Revisions

if TYPE_CHECKING:
    from ..twin.twin import Twin


WINDOW_EVENTS = 4000
"""Events of a window that is folded many times over."""


class Records(Protocol):
    """What records a running twin."""

    finished: list[Path]
    failure: str
    folder: Path
    """Where it puts what is given a name only."""

    @property
    def path(self) -> Path | None:
        """The file that is being written."""

    def record(self, path: Path | None) -> None:
        """Record into a new file from now on, or finish the one that is open."""


class Running(Protocol):
    """A running twin. Everything here may be called from any thread, and never waits for a viewer."""

    twin: Twin
    model: StateSpaceModel
    pairs: np.ndarray
    estimator: str
    tuning: Tuning
    notices: Notices
    jobs: Jobs
    recorder: Records | None
    revisions: Revisions

    @property
    def source(self) -> Source:
        """Where the readings come from; it may be reopened."""

    @property
    def policy(self) -> HealthPolicy:
        """When the estimate may be trusted."""

    def reload(self, twin: Twin, why: str, *, exact: bool = False) -> None:
        """Queue going on with another twin of the same shape, or the same one as it was saved anew; see reload.py."""

    def submit(self, command: Command) -> None:
        """Queue a command."""

    def status(self) -> Status:
        """What a panel shows."""

    def cursor(self, *, follows_log: bool = False, span: int | None = None) -> Cursor:
        """A cursor for one consumer, for `pull`; give it back with `release`. See `Cursor`."""

    def release(self, cursor: Cursor) -> None:
        """Forget a cursor."""

    def pull(self, cursor: Cursor, limit: int | None = None, *, align: int = 1) -> Pull:
        """Copies of the rows since the cursor, from a multiple of `align` on, at most `limit`; the notices since."""

    def rows(self, start: int, stop: int) -> Pull:
        """Copies of the rows with these absolute indices, as far as they are there."""

    def index_at(self, t: int) -> int:
        """Absolute index of the first folded event at or after a time, ns."""

    def episodes(self) -> list[Episode]:
        """What was and is wrong, in the order of its start."""

    def previous(self) -> Pull | None:
        """The whole previous revision, for comparison."""

    def belief(self) -> Belief:
        """The estimate now."""

    def here(self) -> Here | None:
        """The filter as it stands, to fold on from; None while nothing has come."""

    def last_events(self, limit: int = WINDOW_EVENTS, *, rows: bool = False) -> EventWindow | None:
        """Copy the last events, to fold them again; None while there are none.

        With `rows` the window has its track and begins where all revisions have a snapshot; without, it is None while
        a refold is under way.
        """

    def span(self) -> tuple[int, int]:
        """Times of the first and the last event, ns; zeros while there is none."""

    def base(self) -> Base | None:
        """Where a fold of the present log starts, if its oldest events were dropped."""

    def origin(self, index: int) -> tuple[int, Base | None]:
        """Where a fold that gives the rows from `index` on can start."""

    def folded_with(self) -> tuple[Tuning, str]:
        """Tuning and estimator of the fold that `pull` shows."""

    def options_of(self, estimator: str) -> Mapping[str, float]:
        """The options with which an estimator starts."""

    def retune(self, estimator: str, tuning: Tuning) -> None:
        """Fold the history again with another estimator or tuning; on the engine's own thread."""

    def insert(self, event: Events) -> None:
        """Put in an event of our own; on the engine's own thread."""
