"""When a fold said something, of whom: from the rows in which its alarms stood."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from estimators.diagnostics.episodes import Episode, episodes
from estimators.diagnostics.sensitivity.nudges import DRIFT, SENSOR
from estimators.diagnostics.sensitivity.suspects import RIDDLES, likeliest, suspects
from estimators.errors import NisusError
from estimators.log import READING
from estimators.track import TRACKING, WAITING

if TYPE_CHECKING:
    from estimators.fold import Fold

SAME = 1_000_000_000
"""ns between two episodes of one subject and cause that are the same, with a mistake and without."""


def green(fold: Fold) -> np.ndarray:
    """Rows in which the twin says that all is well, shape (N,)."""
    health: np.ndarray = fold.track.health[: fold.n] == TRACKING
    return health


def said_at(fold: Fold, episode: Episode) -> int:
    """When an episode was first heard of, ns of the log; its start is when it began, found in hindsight."""
    log, track, model = fold.log, fold.track, fold.model
    kind, channel = log.kind[: fold.n], log.channel[: fold.n]
    since = log.t[: fold.n] >= round(episode.start * 1e9)
    alarmed, health = track.alarms[: fold.n].any(axis=1), track.health[: fold.n]
    own = episode.subject.partition(".")[0]
    sensors = [
        k
        for k, sensor in enumerate(model.sensors)
        if own == sensor.name or episode.subject in (row.name for row in sensor.rows)
    ]
    flagged = track.flags[: fold.n] != 0
    if episode.cause in ("silent", "never heard", "outside"):
        heard = flagged
    elif sensors:
        heard = alarmed & (kind == READING) & (channel == sensors[0])
    else:
        heard = (health != TRACKING) & (health != WAITING)
    rows = np.flatnonzero(heard & since)
    return int(log.t[rows[0]]) if rows.size else round(episode.start * 1e9)


def first_word(fold: Fold, start: int, calm: Fold | None = None) -> float | None:
    """Seconds from `start` (ns) to the first row that is not green, once a reading has come; None if all stay green.

    Where `calm`, the fold without the mistake, was not green either at that time, nothing is said of the mistake.
    """
    t, ok = fold.log.t[: fold.n], green(fold)
    waiting = fold.track.health[: fold.n] == WAITING
    said = ~ok & ~waiting & (t >= start)
    if calm is not None:
        # What holds at a time is what held before its events, and after each of them.
        before = np.searchsorted(calm.log.t[: calm.n], t, side="left") - 1
        after = np.searchsorted(calm.log.t[: calm.n], t, side="right")
        wrong = np.concatenate(([0], np.cumsum(~green(calm))))
        said &= wrong[after] == wrong[np.maximum(before, 0)]
    rows = np.flatnonzero(said)
    return int(t[rows[0]] - start) / 1e9 if rows.size else None


def heard_in(fold: Fold, calm: Fold) -> list[tuple[int, Episode]]:
    """Episodes and when each was first heard of, ns of the log; not those that were heard of without the mistake."""
    known = [(said_at(calm, item), item) for item in episodes(calm)]
    return sorted(
        (
            (at, item)
            for at, item in ((said_at(fold, item), item) for item in episodes(fold))
            if not any(
                (item.subject, item.cause) == (other.subject, other.cause) and abs(at - when) < SAME
                for when, other in known
            )
        ),
        key=lambda pair: pair[0],
    )


def accused(fold: Fold, episode: Episode, until: int) -> str:
    """Whom a user is told to look at: the likeliest suspect where an episode leaves that open, else its subject.

    A sensor row by its name alone, an input or a parameter after that word.

    Args:
        fold: In which the episode is.
        episode: What was said.
        until: When it is asked, ns of the log: what comes later is not known yet.
    """
    if episode.cause not in RIDDLES:
        return episode.subject
    seen = fold.log.copy()
    seen.n = int(np.searchsorted(fold.log.t[: fold.n], until))
    try:
        found = likeliest(suspects(fold.estimator.name, fold.model, fold.tuning, seen, episode.start))
    except NisusError:
        found = ()
    if not found:
        return episode.subject
    nudge = found[0].nudge
    return nudge.name if nudge.kind in (SENSOR, DRIFT) else f"{nudge.kind} {nudge.name}"


def green_share(fold: Fold, start: int, end: int) -> float:
    """Share of green rows in [start, end), ns of the log."""
    t = fold.log.t[: fold.n]
    during = (t >= start) & (t < end)
    return float(green(fold)[during].mean()) if during.any() else np.nan


def recovery(fold: Fold, end: int) -> float | None:
    """Seconds from `end` (ns) until the twin is green for good; None if it is not at the end of the log."""
    t, ok = fold.log.t[: fold.n], green(fold)
    after = np.flatnonzero(t >= end)
    if not after.size:
        return None
    wrong = after[~ok[after]]
    if not wrong.size:
        return 0.0
    if wrong[-1] == fold.n - 1:
        return None
    return int(t[wrong[-1] + 1] - end) / 1e9
