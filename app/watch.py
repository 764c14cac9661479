"""What new rows mean for people: readings that could not be used, clouds that were lost, changes of health."""

from __future__ import annotations

import numpy as np

from estimators.fold import Fold
from estimators.track import DIVERGED, HEALTH_NAMES, TRACKING, Track

from .notices import Notices
from .tally import UNSETTLED, complaints, last_run


class Watch:
    """Reports the rows of a fold as they come."""

    def __init__(self, notices: Notices) -> None:
        self._notices = notices
        self._health = TRACKING
        self._recoveries = 0
        self._lost: tuple[int, int] | None = None

    @property
    def lost(self) -> int | None:
        """Time (ns) from which on the estimate has not been a number; None if it is one."""
        return None if self._lost is None else self._lost[1]

    def again(self) -> None:
        """Another fold begins, whose recoveries are counted from none."""
        self._recoveries = 0
        self._lost = None

    def look(self, fold: Fold, before: int) -> None:
        """Report the rows from `before` on."""
        track, log = fold.track, fold.log
        for key, text in complaints(fold.model, log.channel, track, before):
            self._notices.report(key, text, counted=False)
        count, known = fold.recoveries(), self._recoveries
        self._recoveries = count
        if count > known:
            name = fold.estimator.name
            text = f"{name}: no particle explained a reading; the cloud was widened, {count} time(s) so far"
            self._notices.report("recovered", text, counted=False)
        was_lost = self._lost is not None
        self._lost = self._look_for_numbers(fold, before)
        if self._lost is not None and not was_lost:
            text = "the estimate is not a number; Reset or another filter may mend it"
            self._notices.say(text, level="error", t=self._lost[1])
        if len(track) and track.health[-1] != self._health:
            self._health = int(track.health[-1])
            more = "; Reset begins anew from the prior" if self._health == DIVERGED and self._lost is None else ""
            level = "info" if self._health == TRACKING else "warn"
            since = int(log.t[last_run(track.health)])
            self._notices.say(f"health: {HEALTH_NAMES[self._health]}{more}", level=level, t=since)

    def _look_for_numbers(self, fold: Fold, before: int) -> tuple[int, int] | None:
        """The first of the last rows without a number: its absolute index, and its time; None if the last has one."""
        track, log = fold.track, fold.log
        end = len(track)
        if not end or numbers(track, end - 1, end)[0]:
            return None
        known = self._lost
        if known is not None and known[0] < log.first + before and not numbers(track, before, end).any():
            return known
        while end > 0:
            start = max(0, end - UNSETTLED)
            good = np.flatnonzero(numbers(track, start, end))
            if good.size:
                end = start + int(good[-1]) + 1
                break
            end = start
        return log.first + end, int(log.t[end])


def numbers(track: Track, start: int, end: int) -> np.ndarray:
    """Which rows from `start` to `end` of a track hold an estimate of finite numbers."""
    return np.asarray(np.isfinite(track.mean[start:end]).all(axis=1) & np.isfinite(track.std[start:end]).all(axis=1))
