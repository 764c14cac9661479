"""The figures that are guarded: which way each gets worse, and how much worse nobody could tell.

A fold is a pure function, so on one log a deterministic filter gives the same figures again, and any change is real.
What is allowed is then a change that says nothing of the asset: a tenth of the figure's standard error over the log,
which would add half a percent to how uncertain the figure is anyway (√(1 + 0.1²)). The standard error is that of the
jackknife over blocks of the log, longer than most correlation: with θ₋ᵦ the figure without block b of B,

    se² = (B - 1) / B · Σ (θ₋ᵦ - mean θ₋)²

But never more than `MOST`, so that five percent are always seen, nor less than what another processor's rounding does.

Source: Efron & Tibshirani, An Introduction to the Bootstrap (1993), eq. 11.5, with blocks left out in place of single
observations, as Künsch (1989), doi:10.1214/aos/1176347265, does for dependent data.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import t as student

from config.guard_schema import FigureSection, ReferenceSection
from estimators.diagnostics.field_pictures import Picture
from estimators.diagnostics.health import PROBABILITY
from estimators.diagnostics.score import score
from estimators.errors import ConfigError
from estimators.events.batch import truth_of
from estimators.fold import Fold
from estimators.log import Log
from estimators.track import DIVERGED, HELD_OUT, USED

from ...live.tunings.versions import COVERAGE, LIKELIHOOD, NIS, REFUSED, RMSE, figures

BLOCKS = 20
"""Of a log, of as many events each."""

SHARE = 0.1
"""Of a standard error, that a figure may change by."""

MOST, LEAST = 0.02, 1e-6
"""The most and the least that a figure may get worse by, as `badness` counts."""

LOST = "lost"
"""Share of the rows at which the estimate is diverged."""

FEW = 2
"""Errors that may leave a band, or enter it, and rows that may be lost: one is not told from rounding."""


def badness(name: str, value: float) -> float:
    """How bad a figure is, so that more is worse.

    The log of an RMSE, how far the log of the NIS is off 0, a coverage off 95 %; the others as they are, the likelihood
    with its sign changed. A change of 0.05 is 5 % of an RMSE, 5 % of the NIS, five of a hundred errors, 5 % of the
    density of a reading.
    """
    kind = name.partition(".")[0]
    if kind == RMSE:
        return float(np.log(max(value, np.finfo(float).tiny)))
    if kind == NIS:
        return abs(float(np.log(max(value, np.finfo(float).tiny))))
    if kind == COVERAGE:
        return abs(value - PROBABILITY)
    return -value if kind == LIKELIHOOD else value


def measured(fold: Fold) -> dict[str, float]:
    """Every figure of a finished fold; the NIS as a multiple of what it should be."""
    return _figures(fold, np.ones(fold.n, bool))


def allowances(fold: Fold) -> dict[str, float]:
    """By how much each of these figures may get worse (see above)."""
    n = fold.n
    block = np.arange(n) * BLOCKS // max(n, 1)
    parts = [_figures(fold, block != b) for b in range(BLOCKS)]
    counts = {LOST: n, **{f"{COVERAGE}.{name}": count for name, count in _errors(fold).items()}}
    return {
        name: _allowed([badness(name, part[name]) for part in parts if name in part], counts.get(name))
        for name in measured(fold)
    }


def _allowed(without: Sequence[float], errors: int | None) -> float:
    """What is allowed of a figure: its badness without each block, and the number of errors of which it is a share."""
    bad = np.array(without)
    error = np.sqrt((bad.size - 1) * np.mean((bad - bad.mean()) ** 2)) if bad.size > 1 else 0.0
    least = LEAST if errors is None else FEW / max(errors, 1)
    return float(max(min(SHARE * error, MOST), least))


def _errors(fold: Fold) -> dict[str, int]:
    """How many errors there are of each state whose truth is told, and of each sensor row held out."""
    model, track, events = fold.model, fold.track, fold.log.events.select(slice(0, fold.n))
    found = {model.state_names[j]: truth_of(events, int(j))[0].size for j in model.shown}
    held = track.verdict == HELD_OUT
    for s, sensor in enumerate(model.sensors):
        rows = track.innovation[held & (events.channel == s)]
        for k in range(len(sensor.rows)):
            name = model.row_names[model.row_start[s] + k]
            found[name] = found.get(name, 0) or int(np.isfinite(rows[:, k]).sum())
    taken = [] if fold.pictures is None else fold.pictures.taken
    return {**found, "field": sum(picture.cells for picture in taken)}


def _figures(fold: Fold, rows: np.ndarray) -> dict[str, float]:
    """Those of some rows of a fold."""
    track, events = fold.track.select(rows), fold.log.events.select(slice(0, fold.n)).select(rows)
    taken: Sequence[Picture] = () if fold.pictures is None else fold.pictures.taken
    # A picture shows what held before its event.
    pictures = [one for one in taken if 0 < one.before <= rows.size and rows[one.before - 1]]
    found = figures(score(track, events, fold.model, pictures, gate=fold.tuning.gate))
    used = track.verdict == USED
    if NIS in found:
        found[NIS] /= float(track.dof[used].mean())
    found.pop(REFUSED, None)
    found[LOST] = float(np.mean(track.health == DIVERGED)) if len(track) else 0.0
    return found


CHANCE = 1e-4
"""Probability with which a figure of a filter that draws is called worse though only its draws are others."""


class Judged(NamedTuple):
    """A figure before and now, its change for the worse, and what of that is allowed.

    Means over all folds; where logs are judged one by one, of the worst `log`, counted from 0. `now` is NaN if there is
    no such figure any more.
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


def judge(known: ReferenceSection, found: ReferenceSection, *, simulated: bool) -> list[Judged]:
    """Every recorded figure beside what it is now.

    Args:
        known: What was recorded.
        found: What was measured.
        simulated: Whether the logs are simulated anew, so that others may stand in their place.

    Raises:
        ConfigError: If a recording is another one.
    """
    logs, others = ([*zip(each.events, each.sums, strict=True)] for each in (known, found))
    same = len(logs) == len(others) and all(map(same_log, logs, others))
    if not same and not simulated:
        raise ConfigError(
            f"its log is another one: {known.events[0]} events were folded, {found.events[0]} are now; if that is "
            "meant, record its scores with --accept"
        )
    judged = []
    for name, section in known.figures.items():
        before, after = _folds(name, section, known.seeds), None
        if name in found.figures:
            after = _folds(name, found.figures[name], found.seeds)
        if after is None:
            judged.append(Judged(name, float(np.mean(section.values)), np.nan, np.inf, float(np.mean(section.allowed))))
        elif same and known.seeds == found.seeds == 1:
            judged.append(_of_logs(name, section, found.figures[name], (after - before)[:, 0]))
        else:
            judged.append(_of_means(name, section, found.figures[name], before, after, same=same))
    return judged


def _folds(name: str, section: FigureSection, seeds: int) -> np.ndarray:
    """Badness of every fold, (logs, seeds)."""
    return np.array([badness(name, value) for value in section.values]).reshape(-1, seeds)


def _of_logs(name: str, known: FigureSection, found: FigureSection, change: np.ndarray) -> Judged:
    """The log that got worst, as what it is allowed has it; if none got worse than that, the one that got best."""
    ratio = change / np.array(known.allowed)
    k = int(np.argmax(ratio))
    k = k if ratio[k] > 1.0 else int(np.argmin(ratio))
    return Judged(name, known.values[k], found.values[k], float(change[k]), known.allowed[k], k)


def _of_means(
    name: str, known: FigureSection, found: FigureSection, before: np.ndarray, after: np.ndarray, *, same: bool
) -> Judged:
    if not same:
        before, after = (each.mean(axis=1)[None, :] for each in (before, after))
    change = float(after.mean() - before.mean())
    chance = _apart(before, after)
    if same and before.shape == after.shape:
        chance = min(chance, _deviation(after - before) / np.sqrt(before.size) * _quantile(_freedom(before)))
    allowed = max(float(np.mean(known.allowed)), chance)
    return Judged(name, float(np.mean(known.values)), float(np.mean(found.values)), change, allowed)


def _apart(before: np.ndarray, after: np.ndarray) -> float:
    variance = sum(_deviation(each) ** 2 / each.size for each in (before, after))
    return float(np.sqrt(variance) * _quantile(_freedom(before) + _freedom(after)))


def _freedom(folds: np.ndarray) -> int:
    return folds.shape[0] * (folds.shape[1] - 1)


def _deviation(folds: np.ndarray) -> float:
    """Of a fold about the mean of its log."""
    within = folds - folds.mean(axis=1, keepdims=True)
    return float(np.sqrt(np.sum(within**2) / max(_freedom(folds), 1)))


def _quantile(freedom: int) -> float:
    # Without a second fold nobody knows what chance makes.
    return float(student.ppf(1.0 - CHANCE, freedom)) if freedom else np.inf


ALIKE = 1e-9
"""Relative difference of two sums of one log's values, as another processor's rounding leaves of a simulated one."""


def fingerprint(log: Log) -> tuple[int, float]:
    """Number of events, and the sum of the sizes of their values: alike of the same log on any processor."""
    return log.n, float(np.nansum(np.abs(log.value[: log.n])))


def same_log(one: tuple[int, float], other: tuple[int, float]) -> bool:
    """Whether two fingerprints are of one log."""
    return one[0] == other[0] and abs(one[1] - other[1]) <= ALIKE * max(one[1], other[1])
