"""Check of a fitted draft on the second half of its recording: NIS, coverage of each sensor, cause and remedy."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import numpy as np

from estimators.diagnostics.consistency import NisVerdict
from estimators.diagnostics.intervals import Interval, correlation_interval, share_interval
from estimators.diagnostics.score import MAX_NIS_FACTOR, nis_verdict
from estimators.fold import Fold, folded
from estimators.log import READING, RESET, Events, Log
from estimators.model.coloured import ColouredError, coloured
from estimators.model.state_space import StateSpaceModel
from estimators.model.user_file import run_file
from estimators.registry import find_entry
from estimators.tuning import Tuning

from .draft import python_text, rounded
from .plan import MAX_COVERAGE, MIN_COVERAGE, YAML_NAME, DraftCheck, DraftPlan, Moves, Reads, SensorCheck
from .signals import Signal

BAND_SIGMA = 1.959963984540054  # half width of the 95 % band
MIN_CHECKED = 60  # measurements that a check takes
MAX_CHANGE = 4.0  # Of the power of the innovations, from the first to the second half of the checked parts
HALVES_DIFFER = "in the second half than in the first"
MAX_CORRELATION = 0.2  # of successive innovations, as in the claims of `nisus advise`
MAX_FLOOR_FACTOR = 1.1  # of the variance of a resolution, up to which a noise is that resolution alone
FAR_SIGMA, MAX_FAR_SHARE = 4.0, 0.01  # innovations that are jumps, and their share from which on these are the cause


def with_options(tuning: Tuning, options: Mapping[str, str | float]) -> Tuning:
    """Return a tuning with options of the Kalman filter by name."""
    if not options:
        return tuning
    complete = find_entry("kf").complete(options)
    return tuning.with_options({key: complete[key] for key in options})


class Turns(NamedTuple):
    """Parts of a recording between times `edges`, ns, in turn fitted and checked; the first is fitted."""

    edges: tuple[int, ...]

    @property
    def alternate(self) -> bool:
        """Whether there are more than two parts."""
        return len(self.edges) > 1

    def fitted(self, t: np.ndarray) -> np.ndarray:
        """Return the mask of the times (n,), ns, that are in a fitted part."""
        mask: np.ndarray = np.searchsorted(self.edges, t, side="right") % 2 == 0
        return mask


ALTERNATE_PARTS = 8  # Parts of a recording whose halves differ


def split_of(drafted: DraftPlan, parts: int = 2) -> Turns:
    """Return an even number of parts with as many readings of the sensors each."""
    times = np.concatenate([reads.signal.series.t for reads in drafted.sensors])
    return Turns(tuple(int(np.quantile(times, k / parts)) for k in range(1, parts)))


def log_of(
    model: StateSpaceModel,
    sensors: Iterable[Reads],
    inputs: Sequence[tuple[str, Signal]],
    windows: Sequence[tuple[int, int]],
    zero: int,
) -> Log:
    """Return the readings of sensors and the inputs in windows from one time to another, ns; seconds count from `zero`.

    The windows are in order and do not overlap. Each begins with the prior.
    """
    log = Log.of(model, start=(windows[0][0] - zero) * 1e-9)
    for begin, end in windows:
        if begin > windows[0][0]:
            before = begin - zero - 1
            log.extend(Events.one(before, before, RESET, 0, [], log.width))
        for name, one in inputs:
            t = one.series.t
            # The value that holds at the begin is an event of the window as well.
            first = max(0, int(np.searchsorted(t, begin, side="right")) - 1)
            part = slice(first, int(np.searchsorted(t, end)))
            log.add_inputs(np.maximum(t[part] - zero, begin - zero) * 1e-9, **{name: one.series.values[part]})
        for reads in sensors:
            t = reads.signal.series.t
            part = slice(*np.searchsorted(t, (begin, end)))
            if part.stop > part.start:
                log.add(reads.name, (t[part] - zero) * 1e-9, reads.signal.series.values[part])
    return log


MAX_CHECKED_READINGS = 100_000  # readings of all sensors that a fold takes, in windows over the recording
CHECK_WINDOWS = 16  # windows, if there are more readings


def check_windows(sensors: Sequence[Reads], end: int) -> list[tuple[int, int]]:
    """Return the windows of a fold up to a time, ns: one, or several with `MAX_CHECKED_READINGS` readings together."""
    t = np.concatenate([reads.signal.series.t for reads in sensors])
    t = t[t < end]
    if t.size <= MAX_CHECKED_READINGS:
        return [(int(t.min()), end)]
    t.sort()
    each = MAX_CHECKED_READINGS // CHECK_WINDOWS
    starts = np.linspace(0, t.size - each - 1, CHECK_WINDOWS).astype(int)
    return [(int(t[k]), int(t[k + each])) for k in starts]


class ModelFiles:
    """Models of states as the draft's Python file has them; those with the same functions share their compiled code."""

    def __init__(self, folder: Path) -> None:
        """Write the files of functions to a folder, which must outlive their use."""
        self._folder = folder
        self._functions: dict[str, ModuleType] = {}

    def model(self, states: Sequence[Moves], inputs: Sequence[tuple[str, Signal]]) -> StateSpaceModel:
        """Return the model of some states."""
        drafted = DraftPlan(tuple(states), tuple(inputs), tuple(item.signal for item in states), ())
        text = python_text("draft", "DraftState", drafted)
        for k, reads in enumerate(drafted.sensors):  # What differs in its name alone is compiled once.
            text = re.sub(rf"\b(read_|Measurement of ){reads.name}\b", rf"\g<1>{k}", text)
        functions, begin, declaration = text.partition("\nDraftState = ")
        functions = re.sub(" +# .*", "", functions)
        if functions not in self._functions:
            path = self._folder / f"draft_{len(self._functions)}.py"
            path.write_text(functions, encoding="utf-8")
            self._functions[functions] = run_file(path.stem, path)
        names = dict(vars(self._functions[functions]))
        exec(begin + declaration, names)
        model: StateSpaceModel = names["DraftState"]
        return model


class DraftFold:
    """Fold of a whole draft, as its YAML has it, over its recording, or over the first half alone."""

    def __init__(self, drafted: DraftPlan, model: StateSpaceModel, split: Turns, *, fitted_only: bool = False) -> None:
        self.drafted, self.model = drafted, model
        self._sensors = drafted.sensors
        zero = min(int(reads.signal.series.t[0]) for reads in self._sensors)
        self._zero, self._split = zero, split
        noises = {item.second if item.smooth else item.name: rounded(item.over) for item in drafted.states if item.over}
        errors = {
            reads.name: ColouredError((rounded(reads.error[0]),), rounded(reads.error[1]))
            for reads in self._sensors
            if reads.error
        }
        larger = coloured(model, noises, errors)
        used = np.array([name not in drafted.held_out for name in larger.sensor_names])
        self._tuning = replace(with_options(Tuning.of(larger), drafted.options), used=used)
        end = split.edges[-1] if fitted_only else np.iinfo(np.int64).max
        self._windows = check_windows(self._sensors, end)
        self._log = log_of(larger, self._sensors, drafted.inputs, self._windows, zero)
        self._fold = self._folded(self._tuning)

    @property
    def log_likelihood(self) -> float:
        """Log-likelihood of the fitted measurements."""
        return float(np.nansum(self._fold.track.log_likelihood[self._fitted]))

    @property
    def _fitted(self) -> np.ndarray:
        """Mask of the events in fitted parts."""
        return self._split.fitted(self._log.events.t + self._zero)

    @property
    def memory(self) -> float:
        """Measurements over which the noise adapts; infinite if it does not."""
        return float(self.drafted.options.get("memory", np.inf))

    def _folded(self, tuning: Tuning) -> Fold:
        fold = folded("kf", tuning.model, tuning, self._log.copy())
        if fold.failure is not None:
            raise fold.failure
        return fold

    def _rows(self, k: int, *, fitted: bool = False) -> np.ndarray:
        """Return the mask of the measurements of sensor k in the checked parts, or the fitted ones."""
        log = self._log
        mask: np.ndarray = (log.events.kind == READING) & (log.events.channel == k) & (self._fitted == fitted)
        return mask

    def _innovations(self, fold: Fold, k: int, *, fitted: bool = False) -> np.ndarray:
        """Return the innovations of sensor k on the checked parts, or the fitted ones, in σ."""
        rows = self._rows(k, fitted=fitted)
        with np.errstate(all="ignore"):
            e: np.ndarray = fold.track.innovation[rows, 0] / fold.track.innovation_std[rows, 0]
        return e[np.isfinite(e)]

    def check(self, span: float) -> DraftCheck:
        """Return the check on the parts that were not fitted; `span` is the length of the recording, s."""
        found, late, ratios = [], {}, {}
        failed = np.zeros(len(self._sensors), np.int64)
        for k, reads in enumerate(self._sensors):
            e = late[reads.name] = self._innovations(self._fold, k)
            failed[k] = np.count_nonzero(self._rows(k)) - e.size
            before = self._innovations(self._fold, k, fitted=True)
            before, after = np.array_split(e, 2) if self._split.alternate else (before, e)
            ratios[reads.name] = _power(after) / max(_power(before), 1e-300)
            item = next(item for item in self.drafted.states if reads in item.sensors)
            others = [one for one in item.sensors if one.name not in self.drafted.held_out and one is not reads]
            alone = e[:0]
            if reads.name in self.drafted.held_out:
                alone = e
            elif others and not reads.rate and not all(one.rate for one in others):
                without = replace(self._tuning, used=self._tuning.used & (np.arange(len(self._sensors)) != k))
                alone = self._innovations(self._folded(without), k)
            found.append(SensorCheck(reads.name, e.size, _coverage(e), correlation_interval(e), _coverage(alone)))
        fitted, nis = (self._verdict(self._fitted == part) for part in (True, False))
        reason, wide = _reason(nis, fitted, self._sensors, found, late, ratios, alternate=self._split.alternate)
        if failed.any():
            name, count = self._sensors[int(np.argmax(failed))].name, int(failed.max())
            reason, wide = f"the estimate of {name} diverged: {count:,} measurements have no prediction; omit it", False
        start, parts = (self._split.edges[0] - self._zero) * 1e-9, len(self._split.edges) + 1
        windows = len(self._windows)
        return DraftCheck(
            start, span, nis.ratio, nis.low, nis.high, tuple(found), reason, nis.words, parts, wide, windows=windows
        )

    def _verdict(self, part: np.ndarray) -> NisVerdict:
        """Return the verdict on the mean NIS of some events, as `nisus fold` gives it."""
        return nis_verdict(self._fold.track.select(part), self._log.events.select(part), self._fold.model)


def _coverage(e: np.ndarray) -> Interval:
    return share_interval(np.abs(e) <= BAND_SIGMA, e)


def _power(e: np.ndarray) -> float:
    return float(np.mean(e**2)) if e.size else np.nan


def _within_fit_error(nis: NisVerdict, fitted: NisVerdict) -> bool:
    """Return whether a NIS is outside its bounds because the noises were fitted to few measurements.

    The variances of both means add, as the fit makes that of the first half 1.
    """
    half = float(np.hypot(np.log(nis.high), np.log(fitted.high)))
    return abs(np.log(nis.ratio)) <= min(half, np.log(MAX_NIS_FACTOR))


def _reason(
    nis: NisVerdict,
    fitted: NisVerdict,
    sensors: Sequence[Reads],
    checks: Sequence[SensorCheck],
    late: Mapping[str, np.ndarray],
    ratios: Mapping[str, float],
    *,
    alternate: bool,
) -> tuple[str, bool]:
    """Return why a draft is not consistent, with the next step, and whether its bands are only wider than needed.

    The reason is empty if it is consistent.

    Args:
        nis: Verdict on the NIS of the checked parts.
        fitted: The same of the parts to which the noises were fitted.
        sensors: Sensors.
        checks: Their checks.
        late: Their innovations on the checked parts, σ.
        ratios: Power of the innovations on the second half of the recording over that on the first.
        alternate: Whether parts of both halves were fitted.
    """
    known = [one for one in checks if one.n]
    if sum(one.n for one in known) < MIN_CHECKED or not nis.place:
        part = "checked parts have" if alternate else "second half has"
        return f"the {part} fewer than {MIN_CHECKED} measurements; record a longer log", False
    narrow, wide = min(known, key=lambda one: one.coverage.value), max(known, key=lambda one: -_power(late[one.name]))
    if alternate:
        changed = max(ratios, key=lambda name: abs(np.log(max(ratios[name], 1e-300))))
        if abs(np.log(max(ratios[changed], 1e-300))) > np.log(MAX_CHANGE):
            return _varies(changed), False
    place = "inside" if _within_fit_error(nis, fitted) else nis.place
    if place == "above" or not narrow.coverage.high >= MIN_COVERAGE:
        far = {one.name: float(np.mean(np.abs(late[one.name]) > FAR_SIGMA)) for one in known}
        worst = max(far, key=lambda name: far[name])
        if ratios[narrow.name] > MAX_NIS_FACTOR and not alternate:
            return f"{narrow.name} moves more {HALVES_DIFFER}; fit all of the log with nisus tune {YAML_NAME}", False
        if far[worst] > MAX_FAR_SHARE:
            return (
                f"{100 * far[worst]:.1f} % of the innovations of {worst} exceed {FAR_SIGMA:g} σ, so it jumps; give the "
                f"cause with --inputs, or omit {worst}",
                False,
            )
        if narrow.correlation.low > MAX_CORRELATION:
            return _missing_cause(narrow), False
        return _varies(narrow.name), False
    contrary = min(known, key=lambda one: one.correlation.high)
    if contrary.correlation.high < -MAX_CORRELATION:
        return (
            f"successive innovations of {contrary.name} alternate ({contrary.correlation.value:+.2f}): its rows are of "
            "several sources, or its noise is larger than fitted; give each source its rows by `only`, or raise "
            f"R.{contrary.name} with nisus tune {YAML_NAME}",
            False,
        )
    if place == "below" or any(one.coverage.low > MAX_COVERAGE for one in known):
        reads = next(one for one in sensors if one.name == wide.name)
        if reads.r <= MAX_FLOOR_FACTOR * reads.signal.resolution**2 / 12.0:
            return (
                f"{wide.name} varies less than its resolution of {reads.signal.resolution:.3g} "
                f"{reads.signal.series.unit or 'units'}, so its bands are wider than needed; they are valid",
                narrow.coverage.value >= MIN_COVERAGE,
            )
        if ratios[wide.name] * MAX_NIS_FACTOR < 1.0 and not alternate:
            why = f"{wide.name} moves less {HALVES_DIFFER}; fit all of the log with nisus tune {YAML_NAME}"
        elif narrow.coverage.value >= MIN_COVERAGE:
            widest = max(known, key=lambda one: one.coverage.value)
            why = (
                f"{100 * widest.coverage.value:.1f} % of {widest.name} are in the 95 % band, so its bands are wider "
                f"than needed; they are valid (nisus advise {YAML_NAME} --apply compares filters that follow its noise)"
            )
        else:
            why = _varies(wide.name)
        return why, narrow.coverage.value >= MIN_COVERAGE
    lasting = max(known, key=lambda one: one.correlation.low)
    if lasting.correlation.low > MAX_CORRELATION:
        return _missing_cause(lasting), False
    for one in checks:
        if one.held_out.high < MIN_COVERAGE:
            return (
                f"predicted from the other sensors alone, {100 * one.held_out.value:.1f} % of {one.name} is in the "
                "95 % band, so its scale or offset changes; omit it",
                False,
            )
    return "", False


def _missing_cause(one: SensorCheck) -> str:
    return (
        f"successive innovations of {one.name} are correlated ({one.correlation.value:+.2f}), so a cause of its motion "
        "is missing; name it with --inputs"
    )


def _varies(name: str) -> str:
    return (
        f"the noise of {name} varies; nisus advise {YAML_NAME} --apply compares filters that follow it, and sets the "
        "best"
    )
