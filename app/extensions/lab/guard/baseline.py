"""Baseline figures of a fold: definition, storage and comparison.

A fold is a pure function, so on one log a deterministic filter gives the same figures again, and any change is real.
A negligible change is allowed: a tenth of the figure's standard error over the log, which would add half a percent to
its uncertainty (√(1 + 0.1²)). The standard error is that of the jackknife over blocks of the log, which are longer than
most correlation: with θ₋ᵦ the figure without block b of B,

    se² = (B - 1) / B · Σ (θ₋ᵦ - mean θ₋)²

but at most `MAX_ALLOWED`, so that five percent are always detected, and at least the rounding of another processor.

A filter that draws random members is judged by the mean over L logs of K folds each, and chance is allowed too. With s
the deviation of a fold's badness about the mean of its log, pooled over the logs, and s(d) that of the differences of
badness, fold by fold, the smaller of

    t(L (K - 1)) · s(d) / √(L K)                    if both have the same draws, which then cancel,
    t(2 L (K - 1)) · √((s² + s'²) / (L K))          if not,

with t Student's quantile of 1 - `FALSE_ALARM`. If simulated logs differ, as rounding makes them for a chaotic asset,
the means of the logs are compared as if they were folds of one.

Source: Efron & Tibshirani, An Introduction to the Bootstrap (1993), eq. 11.5, with blocks left out in place of single
observations, as Künsch (1989), doi:10.1214/aos/1176347265, does for dependent data.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.special import stdtrit

from app.study.scores import pictures_of
from app.twin.versions import COVERAGE, REFUSED, badness, figures
from config.problems import check_section
from config.yaml_files import as_flow, read_text, rounded, writing
from estimators.diagnostics.score import score
from estimators.errors import ConfigError
from estimators.events.batch import truth_of
from estimators.fold import Fold
from estimators.log import Log
from estimators.track import DIVERGED, HELD_OUT

from .schema import FigureSection, ReferenceSection

N_BLOCKS = 20  # blocks of a log, with equally many events
ALLOWED_SHARE = 0.1  # part of a standard error that a figure may change by
MAX_ALLOWED, MIN_ALLOWED = 0.02, 1e-6  # limits of the allowed change, in units of `badness`
LOST = "lost"  # share of rows at which the estimate has diverged
MIN_COUNT = 2  # errors that may leave their band and rows that may be lost; a single one is rounding
FALSE_ALARM = 1e-4  # probability of calling a figure of a random filter worse when only its draws differ
DIGITS = 10  # significant digits of a stored figure: a thousandth of the smallest allowed change
SAME_LOG = 1e-9  # relative difference of the sums of one simulated log on two processors, by rounding


def fold_figures(fold: Fold, rows: np.ndarray | None = None) -> dict[str, float]:
    """Return every figure of a finished fold, or of those rows (mask, (n,)); the NIS is per degree of freedom."""
    rows = np.ones(fold.n, bool) if rows is None else rows
    track, events = fold.track.select(rows), fold.events.select(rows)
    # A picture shows the field before its event.
    pictures = [one for one in pictures_of(fold) if 0 < one.before <= rows.size and rows[one.before - 1]]
    found = figures(score(track, events, fold.model, pictures, gate=fold.tuning.gate))
    found.pop(REFUSED, None)
    found[LOST] = float(np.mean(track.health == DIVERGED)) if len(track) else 0.0
    return found


def allowances(fold: Fold) -> dict[str, float]:
    """Return how much worse each figure may get (see above)."""
    n = fold.n
    block = np.arange(n) * N_BLOCKS // max(n, 1)
    parts = [fold_figures(fold, block != b) for b in range(N_BLOCKS)]
    counts = {LOST: n, **{f"{COVERAGE}.{name}": count for name, count in _error_counts(fold).items()}}
    return {
        name: _allowance([badness(name, part[name]) for part in parts if name in part], counts.get(name))
        for name in fold_figures(fold)
    }


def _allowance(without: Sequence[float], count: int | None) -> float:
    """Return the allowance from the badness without each block, and the number of errors that it is a share of."""
    bad = np.array(without)
    error = np.sqrt((bad.size - 1) * np.mean((bad - bad.mean()) ** 2)) if bad.size > 1 else 0.0
    least = MIN_ALLOWED if count is None else MIN_COUNT / max(count, 1)
    return float(max(min(ALLOWED_SHARE * error, MAX_ALLOWED), least))


def _error_counts(fold: Fold) -> dict[str, int]:
    """Return the number of errors of each state with known truth, and of each held-out row."""
    model, track, events = fold.model, fold.track, fold.events
    found = {model.state_names[j]: truth_of(events, int(j))[0].size for j in model.shown}
    held = track.verdict == HELD_OUT
    for s, sensor in enumerate(model.sensors):
        rows = track.innovation[held & (events.channel == s)]
        for k in range(len(sensor.rows)):
            name = model.row_names[model.row_start[s] + k]
            found[name] = found.get(name, 0) or int(np.isfinite(rows[:, k]).sum())
    return {**found, "field": sum(picture.cells for picture in pictures_of(fold))}


class ComparedFigure(NamedTuple):
    """A figure before and now, its change for the worse, and the allowed change.

    Means over all folds; where logs are judged one by one, of the worst `log`, counted from 0. `now` is NaN if the
    figure is gone.
    """

    figure: str
    before: float
    now: float
    change: float
    allowed: float
    log: int | None = None

    @property
    def worse(self) -> bool:
        """Whether it got worse by more than is allowed."""
        return not self.change <= self.allowed

    @property
    def better(self) -> bool:
        """Whether it got better by more than that."""
        return self.change < -self.allowed

    def in_words(self) -> str:
        """Return a figure that got worse as one line."""
        if self.now != self.now:
            return f"{self.figure} was {self.before:.6g} and is missing"
        values = f"{self.figure} was {self.before:.6g} and is {self.now:.6g}"
        return f"{values}: worse by {self.change:.3g}, allowed {self.allowed:.3g}"


def compare_figures(known: ReferenceSection, found: ReferenceSection, *, simulated: bool) -> list[ComparedFigure]:
    """Compare every recorded figure with its present value; logs that are `simulated` anew may differ.

    Raises:
        ConfigError: If a recording is another one.
    """
    pairs = zip(known.sums, found.sums, strict=False)
    same = known.events == found.events and all(abs(a - b) <= SAME_LOG * max(a, b) for a, b in pairs)
    if not same and not simulated:
        raise ConfigError(
            f"its log is another one: {known.events[0]} events were folded, {found.events[0]} are now; if that is "
            "intended, record its figures with --accept"
        )
    compared = []
    for name, section in known.figures.items():
        before, after = _fold_badness(name, section, known.seeds), None
        if name in found.figures:
            after = _fold_badness(name, found.figures[name], found.seeds)
        if after is None:
            mean, allowed = float(np.mean(section.values)), float(np.mean(section.allowed))
            compared.append(ComparedFigure(name, mean, np.nan, np.inf, allowed))
        elif same and known.seeds == found.seeds == 1:
            compared.append(_by_log(name, section, found.figures[name], (after - before)[:, 0]))
        else:
            compared.append(_by_mean(name, section, found.figures[name], before, after, same=same))
    return compared


def _fold_badness(name: str, section: FigureSection, seeds: int) -> np.ndarray:
    """Return the badness of every fold, (logs, seeds)."""
    return np.array([badness(name, value) for value in section.values]).reshape(-1, seeds)


def _by_log(name: str, known: FigureSection, found: FigureSection, change: np.ndarray) -> ComparedFigure:
    """Return the log that got worst relative to its allowance; if none got worse than that, the one that got best."""
    ratio = change / np.array(known.allowed)
    k = int(np.argmax(ratio))
    k = k if ratio[k] > 1.0 else int(np.argmin(ratio))
    return ComparedFigure(name, known.values[k], found.values[k], float(change[k]), known.allowed[k], k)


def _by_mean(
    name: str, known: FigureSection, found: FigureSection, before: np.ndarray, after: np.ndarray, *, same: bool
) -> ComparedFigure:
    if not same:
        before, after = (each.mean(axis=1)[None, :] for each in (before, after))
    variance = sum(_deviation(each) ** 2 / each.size for each in (before, after))
    chance = float(np.sqrt(variance) * _quantile(_freedom(before) + _freedom(after)))
    if same and before.shape == after.shape:
        chance = min(chance, _deviation(after - before) / np.sqrt(before.size) * _quantile(_freedom(before)))
    allowed = max(float(np.mean(known.allowed)), chance)
    change = float(after.mean() - before.mean())
    return ComparedFigure(name, float(np.mean(known.values)), float(np.mean(found.values)), change, allowed)


def _freedom(folds: np.ndarray) -> int:
    return folds.shape[0] * (folds.shape[1] - 1)


def _deviation(folds: np.ndarray) -> float:
    """Return the deviation of a fold about the mean of its log."""
    within = folds - folds.mean(axis=1, keepdims=True)
    return float(np.sqrt(np.sum(within**2) / max(_freedom(folds), 1)))


def _quantile(freedom: int) -> float:
    # One fold alone does not show how large chance is.
    return float(stdtrit(freedom, 1.0 - FALSE_ALARM)) if freedom else np.inf


def fingerprint(log: Log) -> tuple[int, float]:
    """Return the number of events and the sum of the sizes of their values, alike on any processor."""
    return log.n, float(np.nansum(np.abs(log.events.value)))


def read_baseline(path: Path) -> ReferenceSection | None:
    """Read recorded figures; None if there are none.

    Raises:
        ConfigError: If the file is wrong.
    """
    if not path.is_file():
        return None
    text = read_text(path, "nisus guard --accept")
    return check_section(ReferenceSection, text, path, "write it anew with `nisus guard --accept`")[0]


def write_baseline(path: Path, name: str, found: ReferenceSection) -> None:
    """Write recorded figures.

    Raises:
        ConfigError: If the file cannot be written.
    """
    lines = [f"# Baseline of {name} for `nisus guard`, written by `nisus guard --accept --note ...`."]
    given = found.model_dump(mode="json", exclude_none=True)
    figures = given.pop("figures")
    lines += [f"{key}: {as_flow(value)}" for key, value in rounded(given, DIGITS).items()]
    lines.append("figures:")
    for figure, each in figures.items():
        section = {"values": rounded(each["values"], DIGITS), "allowed": rounded(each["allowed"], 3)}
        lines.append(f"  {as_flow(figure)}: {as_flow(section)}")
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
