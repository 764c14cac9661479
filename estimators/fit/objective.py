"""What a fit maximises: what it aims at (aims.py), and a weak belief in what the twin says.

Usually that is

    log p(y_1..n) = Σ log p(y_t | y_1..t-1),    - ½ Σ ((θ - θ_0) / d)²

The first is the predictive (prequential, or innovation) likelihood of a fold, with the price of what the gate refused
(diagnostics/refusals.py); the second believes weakly in what the twin says. A reading that fails, and a fold that does
not run, cost more than anything that can be gained, so an optimiser turns round there. A filter that draws does so with
the seed of the tuning at every point: common random numbers, without which a difference of two points is mostly chance.

Sources: Schweppe (1965), doi:10.1109/TIT.1965.1053737; Glasserman & Yao (1992), doi:10.1287/mnsc.38.6.884.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np

from ..diagnostics.sensitivity.responses import each
from ..errors import NisusError
from ..log import INPUT, MAINTENANCE, READING, RESET, TRUTH, Log
from ..registry import find_estimator
from ..tuning import Tuning
from .aims import Aim, Recording
from .entries import Entry, Setting, setting

HOPELESS = -1e12
"""Nats of a point at which nothing can be folded."""

STEP = 1e-4
"""Of a logarithm, or of the deviation of what has none: a difference over it is off by half of it times the curvature,
far below the deviation of an estimate, and rounding by far less."""

ALONE = ("particle", "ensemble")
"""Families whose folds run one after the other: each of them runs on all processors."""

Go = Callable[[int], bool]
"""Told how many folds were done more; says whether to go on."""


class Cancelled(Exception):
    """Whoever asked for a fit wants it no more."""


@dataclass(frozen=True)
class Objective:
    """What is maximised over the entries, from the tuning on, over the recordings; `fixed` are held at their `at`."""

    estimator: str
    tuning: Tuning
    entries: tuple[Entry, ...]
    recordings: tuple[Recording, ...]
    fixed: tuple[Entry, ...] = ()
    at: tuple[float, ...] = ()
    aim: Aim = Aim()
    go: Go = lambda folds: True
    executor: Executor | str | None = "threads"

    @property
    def start(self) -> np.ndarray:
        """Where the tuning is, (k,)."""
        return np.array([item.inward(item.start) for item in self.entries])

    @property
    def limits(self) -> list[tuple[float, float]]:
        """Range of every entry, on its scale."""
        return [(_inward(item, item.low), _inward(item, item.high)) for item in self.entries]

    @property
    def steps(self) -> np.ndarray:
        """Of the differences, (k,)."""
        return np.array([STEP * (1.0 if item.log else item.deviation) for item in self.entries])

    @property
    def precision(self) -> np.ndarray:
        """Of the weak belief, (k,)."""
        return np.array([item.deviation**-2 for item in self.entries])

    def penalty(self, x: np.ndarray) -> float:
        """½ Σ ((θ - θ_0) / d)²."""
        return 0.5 * float(np.sum(self.precision * (x - self.start) ** 2))

    def pinned(self, fixed: Sequence[int], x: np.ndarray) -> Objective:
        """The same over the other entries, with some fixed at their values in x (k,)."""
        rest = [i for i in range(x.size) if i not in fixed]
        return replace(
            self,
            entries=tuple(self.entries[i] for i in rest),
            fixed=(*self.fixed, *(self.entries[i] for i in fixed)),
            at=(*self.at, *(float(x[i]) for i in fixed)),
        )

    def setting(self, x: np.ndarray) -> Setting:
        """What a fold is given at a point."""
        return setting(self.tuning, (*self.entries, *self.fixed), np.concatenate([x, self.at]))

    def terms(self, x: np.ndarray) -> np.ndarray:
        """What each event of the fit adds, weighted, all recordings in one row."""
        given = self.setting(x)
        found = []
        for recording in self.recordings:
            try:
                values = recording.weight * self.aim.terms(self.estimator, given, recording)
            except NisusError:
                values = np.full(recording.log.n, HOPELESS / recording.log.n)
            found.append(np.where(recording.held_out, 0.0, values))
        if not self.go(self.aim.folds * len(found)):
            raise Cancelled
        return np.concatenate(found)

    def all_terms(self, points: Sequence[np.ndarray]) -> list[np.ndarray]:
        """The terms at several points, side by side."""
        alone = find_estimator(self.estimator, self.tuning.model).family in ALONE
        return each(self.terms, points, None if alone else self.executor)

    def value(self, x: np.ndarray) -> float:
        """What is maximised."""
        return float(self.terms(x).sum()) - self.penalty(x)

    def slopes(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The terms (n,) at a point, and their derivatives (k, n), by differences towards the inside of the ranges."""
        steps = self.steps
        for k, (_, high) in enumerate(self.limits):
            if x[k] + steps[k] > high:
                steps[k] = -steps[k]
        points = [x, *(x + step * unit for step, unit in zip(steps, np.eye(x.size), strict=True))]
        here, *moved = self.all_terms(points)
        return here, np.array([(there - here) / step for there, step in zip(moved, steps, strict=True)])

    def gradient(self, x: np.ndarray) -> tuple[float, np.ndarray]:
        """What is maximised, and its gradient (k,)."""
        here, slopes = self.slopes(x)
        return float(here.sum()) - self.penalty(x), slopes.sum(axis=1) - self.precision * (x - self.start)


def only_told(log: Log, *, truth: bool = False) -> Log:
    """The same log without queries, which never change the estimate; true states stay if `truth`.

    The first event stays in any case: it is where the prior holds.
    """
    kind = log.kind[: log.n]
    says = np.isin(kind, (READING, INPUT, RESET, MAINTENANCE, *((TRUTH,) if truth else ())))
    if not says.any():
        return log
    says[0] = True
    kept = log.copy()
    kept.n = 0
    kept._insert(log.events.select(says))
    return kept


def _inward(item: Entry, value: float) -> float:
    return item.inward(value) if value > 0.0 or not item.log else -np.inf
