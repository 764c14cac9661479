"""Dual estimation: a fast filter for the state, and beside it a slow fit of parameters on windows of what it has read.

The filter goes on with parameters that are held. Now and then the last window of its log is fitted in one batch
(fit.py): from the state that the filter had where the window begins, about the values of the day, which are weakly
believed. If that wins on the window's blocks that were held out, and moved beyond chance, it is proposed; what is
adopted takes the place of the values before, the log is folded again with it, and the filter goes on. In joint
estimation the parameters are states instead, and one filter moves both (`model/joint.py`): that costs no fit, but it
asks for a belief in how fast each parameter drifts, and nothing judges what it concludes.

Sources: Nelson & Stear (1976), doi:10.1109/TAC.1976.1101148, for two estimators, each of which takes the other's
estimate for true; Plett (2006), doi:10.1016/j.jpowsour.2006.06.004, for both ways on a battery.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from ..errors import EstimatorError, NisusError
from ..fold import Fold
from ..log import Log
from ..snapshots import Base
from ..track import Track
from ..tuning import Tuning
from .entries import check_key
from .fit import Fitted, Line, fit
from .objective import Go
from .recording import BLOCKS, Recording

Z = 1.959963984540054
"""Deviations from a rejected value within which the data say what they said then."""


class Refit(NamedTuple):
    """One window, fitted.

    start and end are the times of its first and last event, ns; `tuning` is that with which the filter had come so
    far. `fitted` is None where nothing could be fitted, for the `reason`. `lived` are the filter's own rows since the
    window before, as it concluded them at the time, before anything of this window was adopted.
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
        """Whether nothing speaks against it."""
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
) -> Iterator[Refit]:
    """Go through a log as a running twin does that adopts what is better: window after window.

    A log that is shorter than a window is one window. What is left at its end is one too, if it is as long as half the
    time between two.

    Args:
        estimator: The filter.
        tuning: Where it starts.
        log: It must not grow meanwhile.
        wanted: Keys and groups, see `entries_of`.
        window: Length of a window, s.
        every: Time between the ends of two windows, s; None for one after another.
        bounds: Least and greatest value by key.
        blocks: As `fit`.
        go: As `fit`.

    Yields:
        Each window; the next one is folded with what was proposed of it.

    Raises:
        Cancelled: If `go` says so.
        ConfigError: If there is no such entry.
        EstimatorError: As `Fold`; if a window or the time between two is not positive.
    """
    step = window if every is None else every
    if not (window > 0.0 and step > 0.0):
        raise EstimatorError(f"windows of {window:g} s every {step:g} s: both must be positive")
    for key in wanted:
        check_key(estimator, tuning, key)
    span, stride = round(window * 1e9), round(step * 1e9)
    t = log.t[: log.n]
    fold, done = Fold(estimator, tuning.model, tuning, log), 0
    last = int(t[-1])
    end = int(t[0]) + span
    # A log that ends in the middle of a window has half of it at least, or is all there is.
    while done == 0 or last >= end - stride // 2:
        stop = int(np.searchsorted(t, end))
        if stop == done:
            # A hole, longer than the time between two windows.
            end += stride
            continue
        fold.advance(stop - fold.n)
        lived = fold.track.select(slice(done, stop)).copy()
        part, base = tail(fold, int(np.searchsorted(t, end - span)))
        fitted, reason = None, ""
        try:
            fitted = fit(
                estimator, tuning, [Recording(part, base=base)], wanted=wanted, bounds=bounds, blocks=blocks, go=go
            )
        except NisusError as error:
            reason = str(error)
        found = Refit(int(part.t[0]), int(part.t[part.n - 1]), part.n, tuning, fitted, reason, lived)
        yield found
        if fitted is not None and found.proposed:
            tuning = fitted.setting.tuning
            fold = Fold(estimator, tuning.model, tuning, log)
        done, end = stop, end + stride


def tail(fold: Fold, start: int, base: Base | None = None) -> tuple[Log, Base | None]:
    """What a fold has folded from row `start` on, as a log of its own, and where a fold of that begins.

    Args:
        fold: It is where it was afterwards.
        start: The first row that is wanted; one that leaves no event gives the last.
        base: Where the fold itself began; None for the prior.
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
    """Why a window's fit is not proposed; nothing where it is.

    Beside what blocks and sensors held out say: a value of the day that lies in every interval has nothing against it,
    and to follow each window's chance would be a new version an hour, and none of them news.
    """
    if not fitted.proposed:
        return fitted.verdict.reasons
    if all(line.alone or line.low <= line.before <= line.high for line in fitted.lines):
        return ("every value of the day lies in its 95 % interval",)
    return ()


def shift(line: Line) -> float:
    """By how many standard deviations of its estimate an entry moved; NaN of one that was left alone."""
    return _apart(line, line.before)


def agrees(fitted: Fitted, other: Fitted) -> bool:
    """Whether a fit finds no more than another did: the same entries, within the 95 % intervals of the first."""
    values = {line.key: line.after for line in other.lines if not line.alone}
    told = {line.key: line for line in fitted.lines if not line.alone}
    return told.keys() == values.keys() and all(abs(_apart(told[key], value)) <= Z for key, value in values.items())


def _apart(line: Line, value: float) -> float:
    if line.alone:
        return np.nan
    after, other = (np.log(line.after), np.log(value)) if line.log else (line.after, value)
    return float((after - other) / line.deviation)
