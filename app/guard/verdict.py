"""What got worse: a new fold's figures against the recorded ones, and how much could be chance.

A filter that does not draw is judged fold by fold: on the same log nothing is chance, and more than the recorded
allowance (figures.py) is worse. Of one that draws, and of simulated logs that are no longer the same, the mean over m
folds is judged, and more than chance makes of it is allowed: with d the differences of badness, fold by fold,

    t(m - 1) · s(d) / √m        where both have the same draws, which then cancel,
    t(2 m - 2) · √(s² / m + s'² / m)        where they have not,

t being Student's quantile of 1 - `CHANCE`, and the smaller of the two, as each is right by itself.
"""

from __future__ import annotations

from collections.abc import Mapping
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
    """A figure before and now (means over folds, where it is judged by them), its change for the worse, and what of it
    is allowed; `now` is NaN if it is no longer there. `fold` is the one that is worst; None where means are judged.
    """  # noqa: D205

    figure: str
    before: float
    now: float
    change: float
    allowed: float
    fold: int | None = None

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
        simulated: Whether the logs are drawn anew, so that others may stand in their place.

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
    exact = same and not known.draws and not found.draws
    return [_judged(name, section, found.figures, exact, same) for name, section in known.figures.items()]


def _judged(name: str, known: FigureSection, found: Mapping[str, FigureSection], exact: bool, paired: bool) -> Judged:
    if name not in found:
        return Judged(name, float(np.mean(known.values)), np.nan, np.inf, float(np.mean(known.allowed)))
    now = found[name].values
    bad, worse = (np.array([badness(name, value) for value in each]) for each in (known.values, now))
    if exact:
        change = worse - bad
        k = int(np.argmax(change / known.allowed))
        if change[k] <= known.allowed[k]:
            # None is worse; if any is better, it is the one to tell of.
            k = int(np.argmin(change / known.allowed))
        return Judged(name, known.values[k], now[k], float(change[k]), known.allowed[k], k)
    change = float(worse.mean() - bad.mean())
    allowed = max(float(np.mean(known.allowed)), _chance(bad, worse, paired))
    return Judged(name, float(np.mean(known.values)), float(np.mean(now)), change, allowed)


def _chance(bad: np.ndarray, worse: np.ndarray, paired: bool) -> float:
    """What chance makes of the difference of two means."""
    m, n = bad.size, worse.size
    if min(m, n) < 2:
        return np.inf
    apart = np.sqrt(bad.var(ddof=1) / m + worse.var(ddof=1) / n) * student.ppf(1.0 - CHANCE, m + n - 2)
    if not paired:
        return float(apart)
    together = np.std(worse - bad, ddof=1) / np.sqrt(m) * student.ppf(1.0 - CHANCE, m - 1)
    return float(min(apart, together))
