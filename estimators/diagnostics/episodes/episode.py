"""What episodes are made of: rows with their track, runs of rows in alarm, and the episode itself."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from ...log import Events
from ...model.state_space import StateSpaceModel
from ...track import GATED, MISSING, USED, Track
from ...tuning import Tuning

JOINED = 100  # Rows without an alarm after which the next alarm begins another episode


class Episode(NamedTuple):
    """One fault or inconsistency.

    start, end: seconds of the log; end is None while it lasts. subject: a sensor, one of its rows, a state, an input,
    or "twin". cause: name of a row of the table of detectors. size: in `unit`, with its 95 % interval `low` to `high`
    (NaN where there is none). text: one sentence with the remedy. grade: health that it gives to the twin; "advisory"
    where the bands are valid.
    """

    start: float
    end: float | None
    subject: str
    cause: str
    size: float
    low: float
    high: float
    unit: str
    text: str
    grade: str = "suspect"


class FoundEpisode(NamedTuple):
    """An episode and its alarm.

    key: condition and subject; there is one episode of a key at a time. begin: first row in alarm, among the rows to
    which the condition applies; at: its time, ns; until: time of the last row in alarm, ns.
    """

    key: tuple[str, str]
    begin: int
    at: int
    until: int
    episode: Episode


def episode_json(episode: Episode) -> dict[str, float | str | None]:
    """Return the fields of an episode for JSON, with null for numbers that are not finite."""
    return {k: None if isinstance(v, float) and not np.isfinite(v) else v for k, v in episode._asdict().items()}


class JudgedRows(NamedTuple):
    """Consecutive events with their track and the settings of the fold.

    marginal: whether predictions are not Gaussian. last_heard (sensors,): time of each sensor's last measurement before
    these events, ns, 0 where there is none; None if they are the first. alarmed (sensors,): measurements for which the
    sensor had been in alarm by then without being lost. stale_after: seconds without a measurement after which the
    estimate is stale, also where no event shows it.
    """

    model: StateSpaceModel
    tuning: Tuning
    marginal: bool
    events: Events
    track: Track
    last_heard: np.ndarray | None = None
    alarmed: np.ndarray | None = None
    stale_after: float = np.inf

    def measured(self, s: int) -> np.ndarray:
        """Return the rows in which sensor s has a value."""
        rows = self.events.of_sensor(s)
        return rows[self.track.verdict[rows] != MISSING]


class AlarmRun(NamedTuple):
    """Rows `begin` to `end` in alarm, and whether the alarm lasts at the end of the rows."""

    begin: int
    end: int
    lasts: bool

    def start(self, t: np.ndarray) -> float:
        """Return the time of the first row, s, from times t (n,), ns."""
        return float(t[self.begin] * 1e-9)

    def over(self, t: np.ndarray) -> float | None:
        """Return the time of the first row after the alarm, s; None while it lasts."""
        return None if self.lasts else float(t[min(self.end, t.size - 1)] * 1e-9)


def runs(on: np.ndarray, joined: int = 0) -> Iterator[AlarmRun]:
    """Yield the runs of True in `on` (n,) of bool; pauses of at most `joined` rows are bridged."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], on.astype(np.int8), [0]))))
    begins, ends = edges[::2], edges[1::2]
    if not begins.size:
        return
    apart = np.flatnonzero(begins[1:] - ends[:-1] > joined)
    for begin, end in zip(begins[np.append(0, apart + 1)], ends[np.append(apart, ends.size - 1)], strict=True):
        yield AlarmRun(int(begin), int(end), bool(on.size - end <= joined))


def standardised(judged: JudgedRows, rows: np.ndarray, k: int) -> np.ndarray:
    """Return e of row k of the measurements at `rows`, as the detectors see it; NaN where there is none."""
    track = judged.track
    with np.errstate(invalid="ignore", divide="ignore"):  # infinite or zero variance
        e = track.innovation[rows, k] / track.innovation_std[rows, k]
    if judged.marginal:
        e = track.whitened[rows, k]
    verdict = track.verdict[rows]
    return np.where((verdict == USED) | (verdict == GATED), e, np.nan)


def without_baseline(judged: JudgedRows, s: int, k: int, e: np.ndarray) -> np.ndarray:
    """Standardise finite e (n,) of row k of sensor s by the baseline of the tuning: N(0, 1) if nothing has changed."""
    if judged.tuning.baseline is None:
        return e
    bias, scale, phi = judged.tuning.baseline[judged.model.row_start[s] + k, :3]
    e = (e - bias) / scale
    return np.append(e[:1], (e[1:] - phi * e[:-1]) / np.sqrt(1.0 - phi**2)) if phi else e
