"""Interface of a running twin for commands, views, recorder and API; the engine implements it."""

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
    """Recorder of a running twin."""

    finished: list[Path]
    failure: str
    folder: Path
    """Folder of recordings that are given by name."""

    @property
    def path(self) -> Path | None:
        """The file that is being written."""

    def record(self, path: Path | None) -> None:
        """Record into a new file from now on, or finish the open one."""


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
        """The source of the measurements; it may be reopened."""

    @property
    def policy(self) -> HealthPolicy:
        """Rules of the health."""

    def reload(self, twin: Twin, why: str, *, exact: bool = False) -> None:
        """Queue a change to another twin of the same shape, or to the same one as it was saved anew."""

    def submit(self, command: Command) -> None:
        """Queue a command."""

    def status(self) -> Status:
        """Return the status for panels."""

    def cursor(self, *, follows_log: bool = False, span: int | None = None) -> Cursor:
        """Return a cursor of one consumer for `pull`, to be given back with `release`; see `Cursor`."""

    def release(self, cursor: Cursor) -> None:
        """Give a cursor back."""

    def pull(self, cursor: Cursor, limit: int | None = None, *, align: int = 1) -> Pull:
        """Copy the rows since the cursor, from a multiple of `align` on and at most `limit`, and the notices since."""

    def rows(self, start: int, stop: int) -> Pull:
        """Copy the rows with these absolute indices, as far as they exist."""

    def index_at(self, t: int) -> int:
        """Return the absolute index of the first folded event at or after a time, ns."""

    def episodes(self) -> list[Episode]:
        """Return all episodes in the order of their start."""

    def previous(self) -> Pull | None:
        """Return all rows of the previous revision."""

    def belief(self) -> Belief:
        """Return the present estimate."""

    def here(self) -> Here | None:
        """Return the state of the filter, to fold on from; None before the first event."""

    def last_events(self, limit: int = WINDOW_EVENTS, *, rows: bool = False) -> EventWindow | None:
        """Copy the last events, to fold them again; None while there are none.

        With `rows` the window has its track and begins where all revisions have a snapshot; without, it is None while
        a refold is under way.
        """

    def span(self) -> tuple[int, int]:
        """Return the times of the first and the last event, ns; zeros while there is none."""

    def base(self) -> Base | None:
        """Return the start of a fold of the present log if its oldest events were dropped."""

    def origin(self, index: int) -> tuple[int, Base | None]:
        """Return an event at or before `index` at which a fold can start, and its base."""

    def folded_with(self) -> tuple[Tuning, str]:
        """Return tuning and estimator of the fold that `pull` shows."""

    def options_of(self, estimator: str) -> Mapping[str, float]:
        """Return the options with which an estimator starts."""

    def retune(self, estimator: str, tuning: Tuning) -> None:
        """Fold the history again with another estimator or tuning, on the engine's own thread."""

    def insert(self, event: Events) -> None:
        """Put an event into the log, on the engine's own thread."""
