"""Three ways to a parameter: held, moved into the state (joint estimation), fitted window after window (dual)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from time import process_time
from typing import NamedTuple

import numpy as np

from app.twin.bounds import bounds_of
from app.twin.twin import Twin
from estimators.fit.dual import WindowFit, walk
from estimators.fit.fit import Fitted, Line
from estimators.fold import Fold
from estimators.log import TICK, TRUTH, Events, Log, truth_of
from estimators.track import Track
from estimators.tuning import Tuning

Z = 1.959963984540054
HELD, JOINT, DUAL = "held", "joint", "dual"


class Value(NamedTuple):
    """A parameter and its 95 % interval."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.value:.4g}" + (f" ({self.low:.3g} to {self.high:.3g})" if np.isfinite(self.low) else "")


class Came(NamedTuple):
    """What came of one way: its rows, the parameters at the end by name, seconds of the processor, folds, and more."""

    track: Track
    values: dict[str, Value]
    seconds: float
    folds: int
    said: str = ""


def held(twin: Twin, log: Log, parameters: Sequence[str]) -> Came:
    """As the twin starts it."""
    begun = process_time()
    fold = Fold(twin.estimator, twin.model, twin.tuning, log)
    fold.advance()
    values = {name: Value(float(twin.tuning.get(f"p.{name}") or 0.0), np.nan, np.nan) for name in parameters}
    return Came(fold.track, values, process_time() - begun, 1)


def joint(twin: Twin, log: Log, parameters: Sequence[str]) -> Came:
    """As states."""
    begun = process_time()
    fold = Fold(twin.estimator, twin.model, twin.tuning, log)
    fold.advance()
    return Came(fold.track, at_end(fold, parameters), process_time() - begun, 1)


def at_end(fold: Fold, parameters: Sequence[str]) -> dict[str, Value]:
    """The parameters among the states."""
    mean, cov = fold.moments()
    found = {}
    for name in parameters:
        k = fold.model.state_names.index(name)
        reach = Z * float(np.sqrt(cov[k, k]))
        found[name] = Value(float(mean[k]), float(mean[k]) - reach, float(mean[k]) + reach)
    return found


def dual(twin: Twin, log: Log, parameters: Sequence[str], window: float, every: float) -> tuple[Came, list[WindowFit]]:
    """By windows; the rows are those that the filter had at the time."""
    log, begun = untold(log), process_time()
    found = list(walked(twin, twin.tuning, log, parameters, window, every))
    last = found[-1]
    tuning = last.fitted.setting.tuning if last.fitted is not None and last.proposed else last.tuning
    rows = sum(len(refit.lived) for refit in found)
    rest = Fold(twin.estimator, twin.model, tuning, log)
    rest.advance()
    tracks = [refit.lived for refit in found] + [rest.track.select(slice(rows, None))]
    track = Track(*(np.concatenate(columns) for columns in zip(*tracks, strict=True)))
    folds = sum(refit.fitted.folds for refit in found if refit.fitted is not None)
    said = f"; adopted {sum(refit.proposed for refit in found)} of {len(found)} windows"
    return Came(track, told(found, tuning, parameters), process_time() - begun, folds, said), found


def walked(
    twin: Twin, tuning: Tuning, log: Log, parameters: Sequence[str], window: float, every: float
) -> Iterator[WindowFit]:
    """As `nisus tune --windows`."""
    wanted = [f"p.{name}" for name in parameters]
    bounds = bounds_of(twin.config, twin.model)
    return walk(twin.estimator, tuning, log, wanted=wanted, window=window, every=every, bounds=bounds)


def untold(log: Log) -> Log:
    """The same events, with a query in place of each truth: a fit's judge would see it, too."""
    kind = log.kind[: log.n].copy()
    truth = kind == TRUTH
    kind[truth] = TICK
    again = Log.of(log.model, capacity=log.n) if log.model is not None else Log(log.width, log.n)
    value = np.where(truth[:, None], np.nan, log.value[: log.n])
    events = log.events
    again.extend(Events(events.t, events.arrival, kind, np.where(truth, 0, events.channel).astype(np.int32), value))
    return again


def told(found: Sequence[WindowFit], tuning: Tuning, parameters: Sequence[str]) -> dict[str, Value]:
    """What was adopted last of each parameter, with the interval of that window."""
    values = {}
    for name in parameters:
        lines = [line for refit in found if refit.proposed and (line := line_of(refit.fitted, name)) and not line.alone]
        low, high = (lines[-1].low, lines[-1].high) if lines else (np.nan, np.nan)
        values[name] = Value(float(tuning.get(f"p.{name}") or 0.0), low, high)
    return values


def line_of(fitted: Fitted | None, name: str) -> Line | None:
    """Of a parameter."""
    return None if fitted is None else next((line for line in fitted.lines if line.key == f"p.{name}"), None)


def errors(
    model_states: Sequence[str], log: Log, track: Track, truth: str, start: int
) -> tuple[np.ndarray, np.ndarray]:
    """Error and deviation of a state whose truth is told, from row `start` on."""
    k = model_states.index(truth)
    rows, true = truth_of(log.events, k)
    kept = rows >= start
    return true[kept] - track.mean[rows[kept], k], track.std[rows[kept], k]
