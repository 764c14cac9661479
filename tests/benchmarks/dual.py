"""`python -m tests.benchmarks.dual`: dual estimation beside joint estimation, on recordings whose truth is withheld.

Each recording is folded with a parameter held at its initial value, moved into the state (`estimate`, joint), and
fitted window by window as a running twin with `refit` does (dual; a window's result counts from its end on). All are
scored on the rows after the first window: RMSE of the withheld state and share in its 95 % band, log density of a
measurement before it was used, the parameter at the end with its 95 % interval, and processor seconds.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from functools import partial, update_wrapper
from typing import NamedTuple

import numpy as np

from app.twin.defaults import bounds_of
from app.twin.log_reader import read_log
from app.twin.twin import Twin, load_twin
from estimators.fit.dual import WindowFit, walk
from estimators.fit.fit import EntryFit, Fitted
from estimators.fit.judge import Z
from estimators.fold import Fold
from estimators.log import TICK, TRUTH, Log, truth_of
from estimators.track import USED, Track
from estimators.tuning import Tuning

from .timing import BenchmarkRow, run_sections, timed


class Interval(NamedTuple):
    """A parameter and its 95 % interval, NaN if it has none."""

    value: float
    low: float = np.nan
    high: float = np.nan

    def __str__(self) -> str:
        return f"{self.value:.4g}" + (f" ({self.low:.3g} to {self.high:.3g})" if np.isfinite(self.low) else "")


class Outcome(NamedTuple):
    """Rows of one way of estimation, the parameters at the end by name, folds, and adopted windows."""

    track: Track
    values: dict[str, Interval]
    folds: int = 1
    remark: str = ""


def folded(twin: Twin, log: Log, parameters: Sequence[str]) -> Outcome:
    """Fold with the parameters held, or as states where the twin estimates them."""
    fold = twin.fold(log)
    fold.advance()
    if parameters and parameters[0] in twin.model.state_names:
        return Outcome(fold.track, states_at_end(fold, parameters))
    return Outcome(fold.track, {name: Interval(float(twin.tuning.get(f"p.{name}") or 0.0)) for name in parameters})


def states_at_end(fold: Fold, parameters: Sequence[str]) -> dict[str, Interval]:
    """Return the parameters among the states."""
    mean, cov = fold.moments()
    found = {}
    for name in parameters:
        k = fold.model.state_names.index(name)
        reach = Z * float(np.sqrt(cov[k, k]))
        found[name] = Interval(float(mean[k]), float(mean[k]) - reach, float(mean[k]) + reach)
    return found


def dual(twin: Twin, log: Log, parameters: Sequence[str], window: float, every: float) -> Outcome:
    """Fit window by window; the rows are those that the filter had at the time."""
    log = without_truth(log)
    found = list(windows(twin, twin.tuning, log, parameters, window, every))
    last = found[-1]
    tuning = last.fitted.setting.tuning if last.fitted is not None and last.proposed else last.tuning
    rest = Fold(twin.estimator, twin.model, tuning, log)
    rest.advance()
    tracks = [refit.lived for refit in found]
    tracks.append(rest.track.select(slice(sum(map(len, tracks)), None)))
    track = Track(*(np.concatenate(columns) for columns in zip(*tracks, strict=True)))
    values = {}
    for name in parameters:
        lines = [line for refit in found if refit.proposed and (line := line_of(refit.fitted, name)) and not line.alone]
        low, high = (lines[-1].low, lines[-1].high) if lines else (np.nan, np.nan)
        values[name] = Interval(float(tuning.get(f"p.{name}") or 0.0), low, high)
    folds = sum(refit.fitted.folds for refit in found if refit.fitted is not None)
    return Outcome(track, values, folds, f"; adopted {sum(r.proposed for r in found)} of {len(found)} windows")


def windows(
    twin: Twin, tuning: Tuning, log: Log, parameters: Sequence[str], window: float, every: float
) -> Iterator[WindowFit]:
    """Fit windows as `nisus tune --windows` does."""
    wanted, bounds = [f"p.{name}" for name in parameters], bounds_of(twin.config, twin.model)
    return walk(twin.estimator, tuning, log, wanted=wanted, window=window, every=every, bounds=bounds)


def without_truth(log: Log) -> Log:
    """Return the same events with a query in place of each truth, which the judge of a fit would use."""
    events, truth = log.events, log.events.kind == TRUTH
    again = Log.of(log.model, capacity=log.n) if log.model is not None else Log(log.width, log.n)
    again.extend(
        events._replace(
            kind=np.where(truth, TICK, events.kind).astype(np.int8),
            channel=np.where(truth, 0, events.channel).astype(np.int32),
            value=np.where(truth[:, None], np.nan, events.value),
        )
    )
    return again


def line_of(fitted: Fitted | None, name: str) -> EntryFit | None:
    """Return the line of a parameter in a fit."""
    return None if fitted is None else next((line for line in fitted.lines if line.key == f"p.{name}"), None)


def errors(twin: Twin, log: Log, track: Track, truth: str, start: int) -> tuple[np.ndarray, np.ndarray]:
    """Return error and deviation of a state with a truth, from row `start` on."""
    k = twin.model.state_names.index(truth)
    rows, true = truth_of(log.events, k)
    kept = rows >= start
    return true[kept] - track.mean[rows[kept], k], track.std[rows[kept], k]


class Case(NamedTuple):
    """A recording: twin of the joint estimation with overrides, true state, parameter, windows in s, known value."""

    title: str
    twin: str
    truth: str
    parameter: str
    window: float
    every: float
    more: Mapping[str, str]
    note: str


CURVE = "ocv_error: {std: 0.015, drift: 1e-4, role: estimated}"  # as in the twin

CASES = (
    Case(
        "motor_bench, resistance of the water jacket, initially 50 % off",
        "motor_bench_joint", "magnet", "yoke_coolant", 600.0, 300.0, {},
        "fitted with the magnet measured: 0.032 K/W",
    ),
    Case(
        "motor_bench, resistance between tooth and magnet, which no sensor touches, initially 50 % off",
        "motor_bench", "magnet", "tooth_magnet", 600.0, 300.0,
        {
            "tuning": "held",
            "parameters.tooth_magnet": "{value: 1.65, std: 0.5, drift: 1e-4, role: estimated}",
            "view": "{}",
        },
        "fitted with the magnet measured: 1.1 K/W",
    ),
    Case(
        "battery_panasonic, US06, series resistance as the cell was fitted",
        "battery_panasonic", "soc", "r0", 1200.0, 600.0, {"tuning": "held"},
        "fitted with the charge known: 0.0328 Ω",
    ),
    Case(
        "battery_panasonic, US06, series resistance, initially 50 % off",
        "battery_panasonic", "soc", "r0", 1200.0, 600.0,
        {"parameters": f"{{r0: {{value: 0.0492, std: 0.02, drift: 3e-5, role: estimated}}, {CURVE}}}"},
        "fitted with the charge known: 0.0328 Ω",
    ),
    Case(
        "battery_panasonic, US06, capacity, initially 20 % off, series resistance in the state both ways",
        "battery_panasonic", "soc", "capacity", 1800.0, 900.0,
        {
            "parameters": "{capacity: {value: 2.32, std: 0.6, drift: 1e-4, role: estimated}, "
            f"r0: {{std: 0.005, drift: 3e-5, role: estimated}}, {CURVE}}}"
        },
        "by the tester's counter: 2.9 A h",
    ),
)  # fmt: skip


def twin_with_held(case: Case) -> Twin:
    """Return the twin with the parameter held; other parameters that it estimates stay states."""
    held = {f"parameters.{case.parameter}.{key}": value for key, value in (("role", "held"), ("drift", "0"))}
    return load_twin(case.twin, overrides={**case.more, **held, "view": "{}"})


def row(name: str, error: np.ndarray, std: np.ndarray, spent: float, remark: str, **more: float) -> BenchmarkRow:
    """Return the scores of one way of estimation."""
    inside = 100 * float(np.mean(np.abs(error) <= Z * std))
    figures = {"RMSE": float(np.sqrt(np.mean(error**2))), "in band [%]": inside, **more, "processor [s]": spent}
    return BenchmarkRow(name, figures, remark=remark)


def recording(case: Case) -> Iterator[BenchmarkRow]:
    """Held, joint and dual estimation of one recording."""
    single, together = twin_with_held(case), load_twin(case.twin, overrides=case.more)
    names = (case.parameter,)
    for name, twin, way in (
        ("held", single, folded),
        ("joint", together, folded),
        ("dual", single, partial(dual, window=case.window, every=case.every)),
    ):
        log, _ = read_log(twin, None)
        if name != "dual":
            way(twin, log, names)  # compiled before it is timed
        outcome, spent = timed(partial(way, twin, log, names))
        start = int(np.searchsorted(log.events.t, log.t[0] + round(case.window * 1e9)))
        track = outcome.track
        density = float(np.mean(track.log_likelihood[start:][track.verdict[start:] == USED]))
        remark = f"{case.parameter} {outcome.values[case.parameter]}{outcome.remark}"
        error, std = errors(twin, log, track, case.truth, start)
        yield row(name, error, std, spent, remark, density=density, folds=outcome.folds)


HELD, JOINT, HALF, DUAL = "held", "joint", "joint, half the drift", "dual"


def main() -> None:
    """Print the tables whose title has one of the words on the command line; all without any."""
    tables = [(f"{case.title}; {case.note}", partial(recording, case)) for case in CASES]
    sections = []
    for title, table in tables:
        if not sys.argv[1:] or any(word in title for word in sys.argv[1:]):
            section = update_wrapper(partial(table), table.func)
            section.__doc__, section.__name__ = title, title.split(",")[0]
            sections.append(section)
    run_sections(sections)


if __name__ == "__main__":
    main()
