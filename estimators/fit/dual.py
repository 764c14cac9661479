"""Dual estimation: a fast filter for the state, and beside it a slow fit of parameters on windows of its log.

The filter runs with fixed parameters. From time to time the last window of its log is fitted in one batch (fit.py):
from the filter's state where the window begins, with a weak prior about the current values. If the result is better on
the window's held-out blocks, and beyond chance, it is proposed; once adopted, it replaces the current values and the
log is folded again. In joint estimation the parameters are states instead, and one filter estimates both
(`model/assemble.py`): that needs no fit, but a drift rate for each parameter, and no held-out data judge the result.

Sources: Nelson & Stear (1976), doi:10.1109/TAC.1976.1101148, for two estimators, each of which takes the other's
estimate as known; Plett (2006), doi:10.1016/j.jpowsour.2006.06.004, for both on a battery.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor
from typing import NamedTuple

import numpy as np

from ..errors import EstimatorError, NisusError
from ..fold import Fold
from ..log import Log
from ..snapshots import Base
from ..track import Track
from ..tuning import Tuning
from .entries import check_key
from .fit import EntryFit, Fitted, fit
from .objective import FitProgress, Go
from .recording import BLOCKS, Recording
from .uncertainty import Z


class WindowFit(NamedTuple):
    """Fit of one window.

    start and end are the times of its first and last event, ns; `tuning` is that of the filter until its end. `fitted`
    is None if nothing could be fitted, for the `reason`. `lived` are the filter's own rows since the previous window,
    before this one was adopted.
    """

    start: int
    end: int
    events: int
    tuning: Tuning
    fitted: Fitted | None
    reason: str
    lived: Track

    @property
    def proposed(self) -> bool:
        """Whether there is no reason against it."""
        return self.fitted is not None and not against(self.fitted)


def walk(
    estimator: str,
    tuning: Tuning,
    log: Log,
    *,
    wanted: Sequence[str],
    window: float,
    every: float | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    blocks: int = BLOCKS,
    go: Go = lambda folds: True,
    progress: FitProgress | None = None,
    executor: Executor | str | None = "threads",
) -> Iterator[WindowFit]:
    """Go through a log window after window, as a running twin does that adopts every proposal.

    A log shorter than a window is one window. The rest at its end is one too, if it is at least half the time between
    two windows.

    Args:
        estimator: The filter.
        tuning: Start of the first window.
        log: It must not grow meanwhile.
        wanted: Keys and groups, see `entries_of`.
        window: Length of a window, s.
        every: Time between the ends of two windows, s; None for one after another.
        bounds: Range by key.
        blocks: As `fit`.
        go: As `fit`.
        progress: As `fit`, of the present window; with its `stop` set, that window is the last.
        executor: As `fit`.

    Yields:
        Each window; the next one is folded with its proposal.

    Raises:
        Cancelled: If `go` returns False.
        ConfigError: If there is no such entry.
        EstimatorError: As `Fold`; if a window or the time between two is not positive.
    """
    step = window if every is None else every
    if not (window > 0.0 and step > 0.0):
        raise EstimatorError(f"windows of {window:g} s every {step:g} s: both must be positive")
    for key in wanted:
        check_key(estimator, tuning, key)
    span, stride = round(window * 1e9), round(step * 1e9)
    t = log.events.t
    fold, done = Fold(estimator, tuning.model, tuning, log), 0
    last = int(t[-1])
    end = int(t[0]) + span
    # A log that ends in the middle of a window has half of it at least, or is all there is.
    while done == 0 or last >= end - stride // 2:
        stop = int(np.searchsorted(t, end))
        if stop == done:
            # A gap in the log, longer than the time between two windows.
            end += stride
            continue
        fold.advance(stop - fold.n)
        lived = fold.track.select(slice(done, stop)).copy()
        part, base = tail(fold, int(np.searchsorted(t, end - span)))
        fitted, reason = None, ""
        try:
            fitted = fit(
                estimator,
                tuning,
                [Recording(part, base=base)],
                wanted=wanted,
                bounds=bounds,
                blocks=blocks,
                go=go,
                progress=progress,
                executor=executor,
            )
        except NisusError as error:
            reason = str(error)
        found = WindowFit(int(part.t[0]), int(part.t[part.n - 1]), part.n, tuning, fitted, reason, lived)
        yield found
        if progress is not None and progress.stop:
            return
        if fitted is not None and found.proposed:
            tuning = fitted.setting.tuning
            fold = Fold(estimator, tuning.model, tuning, log)
        done, end = stop, end + stride


def tail(fold: Fold, start: int, base: Base | None = None) -> tuple[Log, Base | None]:
    """Return the rows of a fold from `start` on as a log of their own, and the base of a fold of that.

    Args:
        fold: It is unchanged afterwards.
        start: First row; beyond the end, the last row.
        base: Base of the fold itself; None for the prior.
    """
    stop = fold.n
    start = min(start, stop - 1)
    if start > 0:
        fold.rewind(start)
        fold.advance(start - fold.n)
        base = fold.base_here()
        fold.advance(stop - fold.n)
    log = fold.log
    part = Log.resume(fold.model, base, log.events.select(slice(start, stop)))
    if base is None:
        part.start, part.floor = log.start, log.floor
    return part, base


def against(fitted: Fitted) -> tuple[str, ...]:
    """Return the reasons against a window's fit; empty if it is proposed.

    A fit whose current values all lie in their intervals is not proposed either: following the chance of each window
    would make a new version an hour without any information.
    """
    if not fitted.proposed:
        return fitted.verdict.reasons
    if all(line.alone or line.low <= line.before <= line.high for line in fitted.lines):
        return ("every current value lies in its 95 % interval",)
    return ()


def shift(line: EntryFit, value: float | None = None) -> float:
    """Return the distance of an estimate from a value (None: the one before), in deviations; NaN if it was reset."""
    if line.alone:
        return np.nan
    value = line.before if value is None else value
    after, other = (np.log(line.after), np.log(value)) if line.log else (line.after, value)
    return float((after - other) / line.deviation)


def agrees(fitted: Fitted, other: Fitted) -> bool:
    """Return whether a fit confirms another: the same entries, within the 95 % intervals of the first."""
    values = {line.key: line.after for line in other.lines if not line.alone}
    found = {line.key: line for line in fitted.lines if not line.alone}
    return found.keys() == values.keys() and all(abs(shift(found[key], value)) <= Z for key, value in values.items())
