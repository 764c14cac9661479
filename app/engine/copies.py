"""Copies of the engine's state for views, recorder and API, so that no reader ever waits for another."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from estimators.diagnostics.clock_fit import ClockFit
from estimators.diagnostics.consistency import NisVerdict
from estimators.diagnostics.field_pictures import Picture
from estimators.diagnostics.health import HealthPolicy
from estimators.diagnostics.references import WITHHELD
from estimators.diagnostics.sensitivity import Bound, Smallest
from estimators.fold import Fold
from estimators.log import Events, Log
from estimators.numerics.peaks import Peak
from estimators.snapshots import PERMANENT_SPACING, Base
from estimators.track import Track
from estimators.tuning import Tuning
from sources.faults.layer import FaultStatus

from ..result import JsonObject
from .notices import Notice

MAX_PULL_ROWS = 16_384
"""Rows copied at once, so that a long history does not hold the engine's lock for long."""


@dataclass
class Cursor:
    """Position of one consumer: `next` is the absolute index of its next row; a rewritten row moves it back.

    `picture` is the index of the last picture of a large field that was read. A cursor starts again with another log
    and, unless it `follows_log`, with another revision; it then gets only rows of the last `span` (ns), or all.
    """

    follows_log: bool = False
    span: int | None = None
    log: int = -1
    revision: int = -1
    next: int = 0
    notice: int = 0
    picture: int = -1


@dataclass(frozen=True)
class Pull:
    """Rows since the cursor.

    `fresh`: the rows start again (another revision or log, or the first pull); discard earlier ones. `first` is the
    absolute index of the first row; if it was pulled before, a late measurement rewrote the rows from there on.
    `pictures` are those of a large field since the cursor; a picture replaces an earlier one of the same index.
    `oldest` is the absolute index of the first row that still exists, `changed` that of the first row here that is new
    or rewritten; those before it are here for alignment. `version` is the model's at the row `oldest`. `settings` are
    tuning and estimator of the fold that has these rows.
    """

    revision: int
    fresh: bool
    first: int
    events: Events
    track: Track
    notices: list[Notice] = field(default_factory=list)
    pictures: list[Picture] = field(default_factory=list)
    oldest: int = 0
    changed: int = 0
    version: int = 1
    settings: tuple[Tuning, str] | None = None


class OutputLink(NamedTuple):
    """Whether an output reaches its clients, and its address, or the problem, in words."""

    connected: bool
    text: str


@dataclass(frozen=True)
class AlertMute:
    """Time in which no alerts are sent, with its reason; `until` is monotonic, s."""

    until: float
    reason: str = ""

    @property
    def seconds(self) -> float:
        """Seconds that are left."""
        return max(0.0, self.until - time.monotonic())

    @property
    def active(self) -> bool:
        """Whether it lasts."""
        return self.seconds > 0.0


@dataclass(frozen=True)
class LogTail:
    """Events since a cursor, folded or not, and the state from which log, fold and the checks on entry continue.

    `fresh`, `first` and `oldest` as in `Pull`; `floor` is that of the log, `base` the start of its fold. `estimator`
    and `tuning` are the requested ones. `taken` events of the source were accepted or rejected, with which the checks
    on entry came to the state `intake`, and the source to its `mark`.
    """

    fresh: bool
    first: int
    events: Events
    oldest: int
    floor: int
    base: Base | None
    estimator: str
    tuning: Tuning
    taken: int
    intake: JsonObject
    mark: int = 0

    @property
    def end(self) -> int:
        """Absolute index after the last event."""
        return self.first + len(self.events)


@dataclass(frozen=True)
class Belief:
    """Present estimate: time (ns), mean (nx,), covariance (nx, nx), points to draw (k, nx), its peaks if several."""

    t: int
    mean: np.ndarray
    cov: np.ndarray
    points: np.ndarray
    peaks: tuple[Peak, ...] = ()


@dataclass(frozen=True)
class Here:
    """State of the filter after the last event, of time `t` (ns), with the settings to fold on from there.

    `step` is the recent time between measurements, s; NaN if there were fewer than two.
    """

    revision: int
    estimator: str
    tuning: Tuning
    base: Base
    t: int
    step: float


class EventWindow(NamedTuple):
    """The last events of a fold with their rows, and where a fold of them starts; `base` None is the prior.

    `track` has the rows if they were requested, else none.
    """

    estimator: str
    tuning: Tuning
    events: Events
    track: Track
    base: Base | None
    revision: int

    @property
    def end(self) -> int:
        """Time of the last event, ns."""
        return int(self.events.t[-1])

    @property
    def first(self) -> int:
        """Absolute index of the first event."""
        return 0 if self.base is None else self.base.first

    def log(self) -> Log:
        """The events as a log of their own."""
        return Log.resume(self.tuning.model, self.base, self.events)

    def fold(
        self,
        estimator: str = "",
        tuning: Tuning | None = None,
        policy: HealthPolicy | None = None,
        expected: np.ndarray | None = None,
    ) -> Fold:
        """A fold over these events, by default with their own settings; nothing is folded yet."""
        tuning = tuning or self.tuning
        base, model = self.base, tuning.model
        return Fold(estimator or self.estimator, model, tuning, self.log(), policy=policy, base=base, expected=expected)


def event_window(
    fold: Fold, revision: int, limit: int, *, origin: Base | None = None, rows: bool = False, stop: int | None = None
) -> EventWindow | None:
    """Copy the last events of a fold from a snapshot on; None while there are none. Takes about a millisecond.

    `revision` is the fold's number, `origin` where it started, None for the prior. A few more than `limit` events are
    copied, since the window begins at a snapshot; with `rows` the track is copied too, and the window begins where all
    revisions have a snapshot. `stop` is the row after the last event; None for the end.
    """
    if not fold.n:
        return None
    stop = fold.n if stop is None else stop
    index = max(0, stop - limit)
    if rows:
        first = fold.log.first
        index = -(-(first + index) // PERMANENT_SPACING) * PERMANENT_SPACING - first
    at, base = fold.base_at(index)
    events = fold.log.events.select(slice(at, stop)).copy()
    track = fold.track.select(slice(at, stop) if rows else slice(0, 0)).copy()
    return EventWindow(fold.estimator.name, fold.tuning, events, track, base if at else origin, revision)


@dataclass(frozen=True)
class ProtectionLevels:
    """Protection levels (integrity bounds) by state at the log's time `t` (ns) for one revision, or why there are none.

    `smallest` are the minimal detectable faults.
    """

    revision: int
    t: int
    reason: str = ""
    bounds: dict[str, Bound] = field(default_factory=dict)
    smallest: tuple[Smallest, ...] = ()

    def age(self, now: int | None) -> float | None:
        """Seconds of the log since then; `now` is the time of its last event, ns."""
        return None if now is None else (now - self.t) * 1e-9


@dataclass(frozen=True)
class Status:
    """State of the running twin, for panels and the API.

    `t` is the time of the last event (ns), `since` the time when the present health began, `lost` the time from which
    the estimate has not been a number (None if it is one). `cause` is the text of the leading episode while health is
    not tracking; `sensors` has each sensor's state (`detector_state.SENSOR_STATES`) and the text of its own episode.
    `model_version` increases with each maintenance. `clock` compares the clock of a live source with this machine's,
    None while it is not known. `counts` are those of the rows of this revision, and of notices. `account` has the
    filter's own figures (see `Fold.account`). `latency_ms` is the 99th percentile from a measurement's arrival to its
    row. `faults` are the injected ones that are active or planned. `integrity` has the protection levels; None until
    they are known. `compiling` are the filters that are not compiled yet: seconds since each was begun, None for one
    that waits; `awaited` is the one for which a refold waits. `grades` has grade and reason of each state that has its
    own (see `own_grades`). `nis` is the verdict on the last window, `sensor_nis`
    (sensors,) the mean NIS per degree of freedom of each sensor's recent measurements, `sensor_rows` (sensors,
    verdicts) how many have which verdict. `heard` is the monotonic time at which the last event arrived, s; `mean` and
    `std` (shown states,) and `inputs` (nu,) are those after it.
    """

    estimator: str
    tuning: Tuning
    options: dict[str, float]
    revision: int
    refolding: bool
    t: int | None
    health: int
    since: int | None
    cause: str
    sensors: dict[str, tuple[str, str]]
    episodes_open: int
    lost: int | None
    model_version: int
    clock: ClockFit | None
    counts: dict[str, int]
    account: dict[str, float | list[float]]
    nis: NisVerdict
    paused: bool
    speed: float | None
    seekable: bool
    span: tuple[int, int] | None
    finished: bool
    recording: Path | None
    latency_ms: float | None
    faults: tuple[FaultStatus, ...] = ()
    integrity: ProtectionLevels | None = None
    awaited: str | None = None
    compiling: Mapping[str, float | None] = field(default_factory=dict)
    grades: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    sensor_nis: np.ndarray = field(default_factory=lambda: np.zeros(0))
    sensor_rows: np.ndarray = field(default_factory=lambda: np.zeros((0, 0), np.int64))
    heard: float = 0.0
    mean: np.ndarray = field(default_factory=lambda: np.zeros(0))
    std: np.ndarray = field(default_factory=lambda: np.zeros(0))
    inputs: np.ndarray = field(default_factory=lambda: np.zeros(0))

    @property
    def withheld(self) -> dict[str, str]:
        """The reason of each state whose estimate is withheld."""
        return {name: reason for name, (grade, reason) in self.grades.items() if grade == WITHHELD}
