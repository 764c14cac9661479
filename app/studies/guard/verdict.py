"""What got worse: a new fold's figures against the recorded ones, and how much could be chance.

A filter that does not draw is judged log by log: on the same log nothing is chance, and more than the recorded
allowance (figures.py) is worse. Of one that draws, the mean over L logs of K folds each is judged, and more is allowed
where chance makes more of it: with s the deviation of a fold's badness about the mean of its log, pooled over the logs,
and s(d) the same of the differences of badness, fold by fold,

    t(L (K - 1)) · s(d) / √(L K)                    where both have the same draws, which then cancel,
    t(2 L (K - 1)) · √((s² + s'²) / (L K))           where they have not,

t being Student's quantile of 1 - `CHANCE`, and the smaller of the two, as each is right by itself. Where the simulated
logs are others, as another processor's rounding makes them of a chaotic asset, the means of the logs are compared as if
they were folds of one.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.stats import t as student

from config.guard_schema import FigureSection, ReferenceSection
from estimators.errors import ConfigError

from .figures import badness
from .reference import same_log

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
