"""What the engine shows to views, recorder and API: copies, so that nobody ever waits for anybody."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from estimators.diagnostics.clock_fit import ClockFit
from estimators.diagnostics.field_pictures import Picture
from estimators.log import Events
from estimators.numerics.peaks import Peak
from estimators.snapshots import Base
from estimators.track import Track
from estimators.tuning import Tuning
from sources.faults.layer import FaultStatus

from .integrity import Integrity
from .notices import Notice


@dataclass
class Cursor:
    """How far one consumer has read. `next` is the absolute index of the next row; a rewritten row moves it back.

    `picture` is the index of the last picture of a large field that was read. One that `follows_log` starts again with
    another log only; for the others another revision does so too. Whoever starts so gets no rows that are more than
    `span` (ns) older than the newest; None gets all.
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

    `fresh`: these rows start afresh (another revision or log, or the first pull): forget what was drawn. `first` is the
    absolute index of the first row; if it is below what was pulled before, a late reading rewrote the rows from there.
    `pictures` are those of a large field since the cursor; one with an index that was seen before takes its place.
    `oldest` is the absolute index of the first row that is still there, `changed` that of the first of these that is
    new or another; those before it were asked for to be aligned. `version` is the model's at the row `oldest`.
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


@dataclass(frozen=True)
class Belief:
    """The estimate now: time (ns), mean (nx,), covariance (nx, nx), points to draw (k, nx), its peaks if several."""

    t: int
    mean: np.ndarray
    cov: np.ndarray
    points: np.ndarray
    peaks: tuple[Peak, ...] = ()


@dataclass(frozen=True)
class Here:
    """The filter as it stands after the last event, of time `t` (ns), and what it takes to fold on from there.

    `step` is how far readings were apart lately, s; NaN where there were not two.
    """

    revision: int
    estimator: str
    tuning: Tuning
    base: Base
    t: int
    step: float


@dataclass(frozen=True)
class Status:
    """The state of the running twin, for panels and the API.

    `t` is the time of the last event (ns), `since` the time when the present health began, `lost` the time from which
    the estimate has not been a number (None if it is one). `cause` is the text of the leading episode while health is
    not tracking; `sensors` gives each sensor's state (diagnostics/sensor_states.py) and the text of its own episode.
    `model_version` counts up with each maintenance. `clock` is
    that of a live source against this machine's, None while it is not known. `counts` are those of the rows of this
    revision, and of other things that happened to the twin. `account` is what the filter says of itself (see
    `Fold.account`). `latency_ms` is the 99th percentile from a reading's arrival to its row. `faults` are those that
    were put into the source, and hold or will. `integrity` bounds what could be wrong with each state unnoticed; None
    until it is known. `compiling` are the filters that are not compiled yet: for how many seconds each has been, None
    of one that waits; for `awaited` the running fold waits to give way. `nis_judged` is what of a commissioned twin
    is compared with the bounds of the NIS (diagnostics/consistency.py).
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
    nis: float
    nis_low: float
    nis_high: float
    paused: bool
    speed: float | None
    seekable: bool
    span: tuple[int, int] | None
    finished: bool
    recording: Path | None
    latency_ms: float | None
    latency_p50_ms: float | None
    faults: tuple[FaultStatus, ...] = ()
    integrity: Integrity | None = None
    awaited: str | None = None
    compiling: Mapping[str, float | None] = field(default_factory=dict)
    nis_judged: float = np.nan
