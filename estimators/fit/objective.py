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
from scipy.optimize import minimize

from ..diagnostics.sensitivity.responses import each
from ..errors import NisusError
from ..registry import find_estimator
from ..tuning import Tuning
from .aims import Aim
from .entries import Entry, Setting, setting
from .recording import Recording

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


def _inward(item: Entry, value: float) -> float:
    return item.inward(value) if value > 0.0 or not item.log else -np.inf


ROUNDS = 8
"""Times that the scale is taken anew, at most."""

STEPS = 15
"""Steps of the optimiser between."""

GRADIENT = 0.02
"""Gradient in deviations of an estimate at which the maximum is reached: half its square is what is left, in nats."""

GAIN = 0.01
"""Nats that a round must bring for another one."""

EVALUATIONS = 60
"""Folds an entry without derivatives, at most."""

REACH = 1.0
"""First step without derivatives, in logarithms."""


def maximise(objective: Objective, x: np.ndarray, *, rounds: int = ROUNDS) -> tuple[np.ndarray, float]:
    """The point (k,) of the maximum nearest to x, and the value there."""
    low, high = np.array(objective.limits).T
    value = -np.inf
    for _ in range(rounds):
        _, slopes = objective.slopes(x)
        unit = 1.0 / np.sqrt(np.sum(slopes**2, axis=1) + objective.precision)

        def down(z: np.ndarray, x: np.ndarray = x, unit: np.ndarray = unit) -> tuple[float, np.ndarray]:
            found, gradient = objective.gradient(np.clip(x + unit * z, low, high))
            return -found, -gradient * unit

        found = minimize(
            down,
            np.zeros_like(x),
            jac=True,
            method="L-BFGS-B",
            bounds=list(zip((low - x) / unit, (high - x) / unit, strict=True)),
            options={"maxiter": STEPS, "maxfun": 2 * STEPS, "gtol": GRADIENT, "ftol": 1e-12},
        )
        gained, value = -found.fun - value, float(-found.fun)
        x = np.clip(x + unit * found.x, low, high)
        if gained < GAIN or found.status == 0:
            break
    return x, value


def search(objective: Objective, x: np.ndarray) -> tuple[np.ndarray, float]:
    """The same without derivatives, for a filter that draws by chance."""
    low, high = np.array(objective.limits).T
    unit = np.array([REACH if item.log else item.deviation for item in objective.entries])
    found = minimize(
        lambda z: -objective.value(np.clip(x + unit * z, low, high)),
        np.zeros_like(x),
        method="COBYQA",
        bounds=list(zip((low - x) / unit, (high - x) / unit, strict=True)),
        options={"maxfev": EVALUATIONS * x.size, "final_tr_radius": 0.02},
    )
    return np.clip(x + unit * found.x, low, high), float(-found.fun)
