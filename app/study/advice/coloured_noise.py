"""Test whether coloured noise explains correlated innovations, by fitting it before it is recommended.

White noise makes white innovations. Correlated innovations point to a disturbance of the process, or an error of the
sensor, with a correlation time (estimators/model/coloured.py). Each candidate that affects the row is appended in turn,
its size and time are fitted by likelihood, and the best one is kept, until no row is correlated.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from config.yaml_files import rounded
from estimators.diagnostics.calibration import LIMITS, Calibration
from estimators.errors import ModelError, NisusError
from estimators.fit.entries import entries_of
from estimators.fit.objective import Cancelled, Objective, scaled_rounds
from estimators.fit.recording import Recording, without_queries
from estimators.fold import Fold, folded
from estimators.log import Log
from estimators.model.coloured import ColouredError, coloured, disturbance_time, error_time, errors_of
from estimators.model.state_space import StateSpaceModel
from estimators.tuning import Tuning

from .measured import NO, UNTOLD, YES, Claim, Measured, digits
from .questions import Question, correlated_rows, used_rows

COLOURED = Question(
    "lasting",
    "Does coloured noise explain the correlated innovations?",
    LIMITS.correlation,
    "correlation of one innovation with the next",
)

MAX_APPENDED = 3  # noises that are appended; beyond that the model itself needs work
MIN_GAIN_NATS = 10.0  # least gain in likelihood: each adds two parameters, and the best of several is taken
BUDGET_S = 30.0  # processor seconds for all trials; the best result so far is reported

MIN_EFFECT = 0.05
"""Change of a row's innovations, in parts of their size, by four times the Q of a noise that has to do with it."""

MAX_TIME_FACTOR = 30.0
"""How many times as long as that of the innovations themselves the time of an error is tried at most."""


class Appended(NamedTuple):
    """A noise or the error of a sensor, and where its fit begins: correlation time, s, and variance of a sensor."""

    noise: str | None
    sensor: str | None
    over: float
    variance: float = 0.0


@dataclass(frozen=True)
class Explained:
    """Appended entries by key of the YAML, gain in likelihood, nats, and rows that are still correlated."""

    sections: Mapping[str, dict[str, object]] = field(default_factory=dict)
    gain: float = 0.0
    related: tuple[Calibration, ...] = ()


@dataclass(frozen=True)
class _Trial:
    """The model with some errors appended, its tuning as fitted, the fold with it, and its log-likelihood."""

    appended: tuple[Appended, ...]
    tuning: Tuning
    fold: Fold
    likelihood: float


def lasting(measured: Measured, estimator: str, options: Mapping[str, float] | None) -> tuple[Claim, Explained] | None:
    """Test the chosen filter; None if no row has correlated innovations."""
    fold = measured.folded(estimator, options).fold
    before = _Trial((), fold.tuning, fold, _likelihood(fold))
    related = _related(before)
    if not related:
        return None
    worst = related[0].correlation.value
    try:
        after = _explained(measured.twin.model, estimator, before)
    except NisusError as error:
        return COLOURED.claim(UNTOLD, worst, str(error)), Explained()
    if after is before:
        reason = f"{related[0].subject} has correlation {worst:+.2f}, and no coloured noise raises the likelihood"
        text = "a state is missing, or the asset changes: see the innovations over time"
        return COLOURED.claim(NO, worst, reason, text), Explained()
    left = _related(after)
    found = Explained(_sections(after), after.likelihood - before.likelihood, tuple(left))
    figure = max((entry.correlation.value for entry in _rows(after)), default=0.0)
    times = ", ".join(
        f"{each.noise or each.sensor} for {digits(_time(after.tuning, each))} s" for each in after.appended
    )
    reason = (
        f"with coloured noise ({times}) the log-likelihood is higher by {digits(found.gain)} nats; of {len(related)} "
        f"row{'s' if len(related) > 1 else ''} correlated by up to {worst:+.2f}, "
        + (f"{len(left)} still {'is' if len(left) == 1 else 'are'}, {left[0].subject} most" if left else "none remains")
    )
    remedy = "put the lines with `correlation_time` into the YAML; nisus tune fits their size and time"
    return COLOURED.claim(NO if left else YES, figure, reason, remedy), found


def _likelihood(fold: Fold) -> float:
    return float(np.nansum(fold.track.log_likelihood[: fold.n]))


def _rows(trial: _Trial) -> list[Calibration]:
    return [entry for entry in used_rows(trial.fold) if np.isfinite(entry.scale.high)]


def _related(trial: _Trial) -> list[Calibration]:
    """Return the rows with positive correlation, the largest first."""
    rows = [entry for entry in correlated_rows(_rows(trial)) if entry.correlation.value > 0.0]
    return sorted(rows, key=lambda each: -each.correlation.value)


def _explained(model: StateSpaceModel, estimator: str, begun: _Trial) -> _Trial:
    """Append the best noise for the most correlated row, repeatedly until the budget is spent."""
    log, best, given_up = without_queries(begun.fold.log), begun, set[str]()
    end = time.thread_time() + BUDGET_S
    while len(best.appended) < MAX_APPENDED and time.thread_time() < end:
        rows = [entry for entry in _related(best) if entry.subject not in given_up]
        if not rows:
            break
        candidates = list(_candidates(model, estimator, best, rows[0]))
        tried = [_tried(model, estimator, begun, best, one, log, end) for one in candidates]
        better = max((one for one in tried if one is not None), key=lambda one: one.likelihood, default=None)
        if better is None or better.likelihood < best.likelihood + MIN_GAIN_NATS:
            given_up.add(rows[0].subject)
        else:
            best = better
    return best


def _candidates(model: StateSpaceModel, estimator: str, trial: _Trial, row: Calibration) -> Iterator[Appended]:
    """Yield noises that change the innovations of a row, and the error of its sensor, unless already appended."""
    fold = trial.fold
    index = fold.model.row_names.index(row.subject)
    k = int(np.searchsorted(fold.model.row_start, index, side="right")) - 1
    rows = fold.events.of_sensor(k)
    column = index - int(fold.model.row_start[k])
    innovation = fold.track.innovation[rows, column]
    period = float(np.median(np.diff(fold.log.t[rows]))) * 1e-9
    # Of a lag of first order the correlation over a period is exp(-period / time).
    over = float(
        np.clip(-period / np.log(np.clip(row.correlation.value, 0.05, 0.95)), period, MAX_TIME_FACTOR * period)
    )
    done = {each.noise or each.sensor for each in trial.appended}
    for noise in model.noises:
        if noise.name in done or not _can(model, Appended(noise.name, None, over)):
            continue
        key = f"Q.{noise.name}"
        louder = trial.tuning.set(key, 4.0 * float(trial.tuning.get(key) or 0.0))
        other = folded(estimator, fold.model, louder, fold.log)
        if np.nanstd(other.track.innovation[rows, column] - innovation) > MIN_EFFECT * np.nanstd(innovation):
            yield Appended(noise.name, None, over)
    sensor = model.sensors[k]
    one = Appended(None, sensor.name, over, float(trial.tuning.r[index]))
    if sensor.name not in done and len(sensor.rows) == 1 and _can(model, one):
        yield one


def _can(model: StateSpaceModel, one: Appended) -> bool:
    try:
        _model(model, (one,))
    except ModelError:
        return False
    return True


def _model(model: StateSpaceModel, appended: tuple[Appended, ...]) -> StateSpaceModel:
    noises = {each.noise: each.over for each in appended if each.noise is not None}
    errors = {each.sensor: ColouredError((each.variance,), each.over) for each in appended if each.sensor is not None}
    return coloured(model, noises, errors)


def _tried(
    model: StateSpaceModel, estimator: str, begun: _Trial, best: _Trial, one: Appended, log: Log, end: float
) -> _Trial | None:
    """Return a trial with one more noise, fitted; None if it cannot be folded or the budget is spent."""
    appended = (*best.appended, one)
    larger = _model(model, appended)
    tuning = _onto(larger, begun.tuning)
    if one.noise is not None:
        # Coloured noise of the same effect is stronger than white noise.
        key = f"Q.{one.noise}"
        tuning = tuning.set(key, 2.0 * float(tuning.get(key) or 0.0))
    for key in _keys(larger, best.appended):
        if key in best.tuning.keys():  # noqa: SIM118  a method of a tuning
            tuning = tuning.set(key, best.tuning.get(key))
    whole = Log.resume(larger, None, log.events)
    try:
        entries, _ = entries_of(estimator, tuning, [whole], _keys(larger, (one,)))
        recording = Recording(whole, 1.0, np.zeros(whole.n, bool))
        objective = Objective(
            estimator, tuning, tuple(entries), (recording,), go=lambda _: time.thread_time() < end, executor=None
        )
        x, _ = scaled_rounds(objective, objective.start, rounds=1)
        tuning = objective.setting(x).tuning
        fold = folded(estimator, larger, tuning, whole)
    except (NisusError, Cancelled):
        return None
    return None if fold.failure is not None else _Trial(appended, tuning, fold, _likelihood(fold))


def _onto(model: StateSpaceModel, tuning: Tuning) -> Tuning:
    """Return a tuning for the extended model; new entries follow the old ones."""
    new = Tuning.of(model)
    new.q[: tuning.q.size], new.p[: tuning.p.size] = tuning.q, tuning.p
    return replace(tuning, model=model, q=new.q, p=new.p, baseline=None)


def _keys(model: StateSpaceModel, appended: tuple[Appended, ...]) -> list[str]:
    """Return the fitted entries: strength and time of each, and for a sensor also its white noise."""
    keys = []
    for each in appended:
        if each.noise is not None:
            keys += [f"Q.{each.noise}", f"p.{disturbance_time(each.noise)}"]
        elif each.sensor is not None:
            sensor = model.sensors[model.sensor_names.index(each.sensor)]
            keys += [f"R.{sensor.rows[0].name}", f"Q.{errors_of(sensor)[0]}", f"p.{error_time(each.sensor)}"]
    return keys


def _time(tuning: Tuning, one: Appended) -> float:
    name = disturbance_time(one.noise) if one.noise is not None else error_time(str(one.sensor))
    return float(tuning.get(f"p.{name}") or 0.0)


def _sections(trial: _Trial) -> dict[str, dict[str, object]]:
    """Return the entries of the YAML, by `noise.NAME` or `sensors.NAME`."""
    found: dict[str, dict[str, object]] = {}
    for each in trial.appended:
        over = f"{_time(trial.tuning, each):.3g} s"
        if each.noise is not None:
            variance = rounded(trial.tuning.get(f"Q.{each.noise}"), 3)
            found[f"noise.{each.noise}"] = {"variance": variance, "correlation_time": over}
        elif each.sensor is not None:
            sensor = trial.fold.model.sensors[trial.fold.model.sensor_names.index(each.sensor)]
            white, error = f"R.{sensor.rows[0].name}", f"Q.{errors_of(sensor)[0]}"
            found[f"sensors.{each.sensor}"] = {
                "variance": rounded(trial.tuning.get(white), 3),
                "error": {"variance": rounded(trial.tuning.get(error), 3), "correlation_time": over},
            }
    return found
