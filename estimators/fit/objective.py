"""The objective of a fit: its aim (aims.py) with a weak prior about the twin's values, and the way to its maximum.

For the likelihood that is

    log p(y_1..n) = Σ log p(y_t | y_1..t-1),    - ½ Σ ((θ - θ_0) / d)²

the predictive (prequential, or innovation) likelihood of a fold, where rejected measurements count with their own
density (diagnostics/score.py). A failed measurement and a failed fold cost more than any gain, so an optimiser turns
back there. A filter that draws uses the tuning's seed at every point: common random numbers, without which a difference
of two points is mostly chance.

Folds are the cost. A gradient takes one per entry, so the steps are those of a quasi-Newton method. Its curvature is
Σ s sᵀ of the scores s of single measurements (Berndt, Hall, Hall & Hausman 1974, Annals of Economic and Social
Measurement 3, 653) with a damped BFGS update by the last step. If the model is wrong the scores are correlated, and
their curvature is wrong, too: where it differs from the change of the slope along the step by more than `AGREEMENT`,
the curvature before the step has the update instead. A step goes to the maximum of the parabola within the ranges. Near
the maximum it is tried alone; further away several shares of it are tried at once, a fold each, since the curvature far
from the optimum does not tell how far it holds, and rejected measurements make the objective rough. Where a step gains
nothing the curvature is taken from the scores again. They end where the parabola promises less than `PRECISION`, or
where two steps in a row gain nothing.

Parameters bend the objective: along their curved valleys these steps end too early, so a search with parameters is by
L-BFGS-B, in rounds of a few steps whose units are the deviations by the scores.

The objective of a filter that draws is not smooth where it resamples; there the search is by trust regions without
derivatives (COBYQA, Ragonneau & Zhang 2023).

Sources: Schweppe (1965), doi:10.1109/TIT.1965.1053737; Glasserman & Yao (1992), doi:10.1287/mnsc.38.6.884; Nocedal &
Wright, Numerical Optimization (2006), procedure 18.2, for the damped update.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple, TypeVar

import numpy as np

from ..diagnostics.sensitivity.responses import each
from ..errors import NisusError
from ..model.state_space import StateSpaceModel
from ..registry import find_estimator
from ..tuning import Tuning
from .aims import Aim
from .entries import Setting, TuningEntry, with_values
from .recording import Recording

FAILED_FOLD = -1e12  # Nats of a point at which no fold is possible

STEP = 1e-4
"""Step of the differences, in logarithms or deviations: the error of a difference, half the step times the curvature,
is far below the deviation of an estimate, and rounding even more."""

MAX_STEPS = 200  # Most quasi-Newton steps
MAX_ROUNDS = 8  # Most rounds of L-BFGS-B, each with a new scale
ROUND_STEPS = 15  # Steps per round
GRADIENT = 0.02  # Gradient at the maximum, in deviations of an estimate: half its square is the remaining gain, in nats
RESOLUTION = 0.05  # Nats of gain below which a step that falls short of its promise counts as failed, and a round ends
MIN_SHARE = 0.25  # Share of the promised gain of which a step falls short then
MAX_RATIO = 1.2  # Ratio of gain and promise above which a longer step is tried
PRECISION = 1e-3  # Nats of promised gain below which it ends: a twentieth of a deviation of one entry
MAX_CHANGE = 2.0  # Largest change of an entry in one step, in logarithms or deviations
NEAR = 3.0  # Nats of promised gain below which a step is tried alone at first: two and a half deviations of one entry
SHARES = (2.0, 1.0, 0.3, 0.08)  # Shares of a step that are tried at once
AGREEMENT = 1.5  # Factor within which the curvatures along a step by the scores and by the slopes agree
DAMPING = 0.2  # Least share of the present curvature that an update leaves along its step
MIN_EIGENVALUE = 1e-10  # Share of the largest eigenvalue of a scaled curvature below which it counts as that share
RECENT_POINTS = 2  # Last points whose derivatives are kept
SEARCH_FOLDS = 60  # Most folds per entry of a search without derivatives
PLAIN_SHARE = 1e-9  # Share of the weak prior's precision that keeps matrices regular where there is none
POLISH_STEPS = 30  # Most steps to the exact maximum
POLISHED = 1e-6  # Step, in deviations, that ends them
T = TypeVar("T")
R = TypeVar("R")
Go = Callable[[int], bool]  # Callback with the number of folds done since the last call; returns whether to continue


class Cancelled(Exception):
    """The fit was cancelled."""


@dataclass
class FitProgress:
    """Progress of a fit, for another thread to read.

    Attributes:
        folds: Folds done.
        expected: Folds in all, estimated.
        gain: Gain on the fitted blocks so far, in the unit of the aim (nats for likelihoods).
        values: Entries at the best point so far, before and after, by key.
        judging: Whether the search is over; the held-out blocks then decide how much of it remains.
        stop: Set it to end the search: the best point so far is judged and returned.
    """

    folds: int = 0
    expected: int = 0
    gain: float = 0.0
    values: dict[str, tuple[float, float]] = field(default_factory=dict)
    judging: bool = False
    stop: bool = False

    def expect(self, more: int) -> None:
        """Estimate the folds to come."""
        self.expected = self.folds + more


Point = tuple[tuple[TuningEntry, ...], tuple[float, ...]]  # Entries and their values


def terms_at(estimator: str, tuning: Tuning, recordings: Sequence[Recording], aim: Aim, point: Point) -> np.ndarray:
    """Return the weighted score of each event at a point, all recordings in one row."""
    setting = with_values(tuning, *point)
    found = []
    for recording in recordings:
        try:
            values = recording.weight * aim.terms(estimator, setting, recording)
        except NisusError:
            values = np.full(recording.log.n, FAILED_FOLD / recording.log.n)
        found.append(np.where(recording.held_out, 0.0, values))
    return np.concatenate(found)


def each_folded(
    work: Callable[[T], R],
    items: Iterable[T],
    folds: int,
    estimator: str,
    model: StateSpaceModel,
    *,
    executor: Executor | str | None,
    go: Go,
) -> list[R]:
    """Map a function that folds recordings over items, see `each`; `folds` of each item are counted.

    Raises:
        Cancelled: If `go` returns False.
    """
    alone = executor == "threads" and find_estimator(estimator, model).samples

    def count() -> None:
        if not go(folds):
            raise Cancelled

    return each(work, items, None if alone else executor, count)


@dataclass(frozen=True)
class Objective:
    """Objective over the entries, about the tuning, over the recordings; `fixed` are held at their values `at`."""

    estimator: str
    tuning: Tuning
    entries: tuple[TuningEntry, ...]
    recordings: tuple[Recording, ...]
    fixed: tuple[TuningEntry, ...] = ()
    at: tuple[float, ...] = ()
    aim: Aim = Aim()
    go: Go = lambda folds: True
    progress: FitProgress = field(default_factory=FitProgress)
    penalised: bool = True
    executor: Executor | str | None = "threads"
    work: Callable[[Point], np.ndarray] = field(init=False, repr=False, compare=False)
    recent: dict[bytes, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Bind the recordings to the work, which an Executor of processes sends to each of them once."""
        work = partial(terms_at, self.estimator, self.tuning, self.recordings, self.aim)
        object.__setattr__(self, "work", work)

    @property
    def start(self) -> np.ndarray:
        """Point of the tuning, (k,)."""
        return np.array([item.inward(item.start) for item in self.entries])

    @property
    def limits(self) -> np.ndarray:
        """Ends of the range of every entry, on its scale, (2, k)."""
        return np.array([(item.inward(item.low), item.inward(item.high)) for item in self.entries]).reshape(-1, 2).T

    @property
    def unit(self) -> np.ndarray:
        """Natural step of every entry, on its scale, (k,)."""
        return np.array([1.0 if item.log else item.deviation for item in self.entries])

    def within(self, x: np.ndarray) -> np.ndarray:
        """Return a point (k,), or the nearest in the ranges."""
        return np.clip(x, *self.limits)

    @property
    def precision(self) -> np.ndarray:
        """Precision of the weak prior, (k,), next to none where the objective is not penalised."""
        share = 1.0 if self.penalised else PLAIN_SHARE
        return np.array([share * item.deviation**-2 for item in self.entries])

    @property
    def folds(self) -> int:
        """Folds per point."""
        return self.aim.folds * len(self.recordings)

    def penalty(self, x: np.ndarray) -> float:
        """Return ½ Σ ((θ - θ_0) / d)²."""
        return 0.5 * float(np.sum(self.precision * (x - self.start) ** 2))

    def pinned(self, fixed: Sequence[int], x: np.ndarray) -> Objective:
        """Return the objective over the other entries, with some fixed at their values in x (k,)."""
        rest = [i for i in range(x.size) if i not in fixed]
        return replace(
            self,
            entries=tuple(self.entries[i] for i in rest),
            fixed=(*self.fixed, *(self.entries[i] for i in fixed)),
            at=(*self.at, *(float(x[i]) for i in fixed)),
            recent={},
        )

    def setting(self, x: np.ndarray) -> Setting:
        """Return tuning and prior at a point."""
        return with_values(self.tuning, *self._values(x))

    def _values(self, x: np.ndarray) -> Point:
        """Return the entries, those held too, and their values at a point."""
        items, values = (*self.entries, *self.fixed), (*x.tolist(), *self.at)
        return items, tuple(item.outward(value) for item, value in zip(items, values, strict=True))

    def report(self, x: np.ndarray, gained: float) -> None:
        """Report a better point and its gain over the last one."""
        progress = self.progress
        progress.gain += gained
        progress.values |= {item.key: (item.start, item.outward(v)) for item, v in zip(self.entries, x, strict=True)}

    def all_terms(self, points: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Return the weighted score of each event, all recordings in one row, at several points; in the executor."""
        values = [self._values(x) for x in points]
        found = each_folded(
            self.work, values, self.folds, self.estimator, self.tuning.model, executor=self.executor, go=self.go
        )
        # An Executor may return views of a message, which NumPy sums in another order where they are not aligned.
        return [np.require(terms, requirements="A") for terms in found]

    def value(self, x: np.ndarray) -> float:
        """Return the objective."""
        return float(self.all_terms([x])[0].sum()) - self.penalty(x)

    def slopes(self, x: np.ndarray, here: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return the terms (n,) at a point, and their derivatives (k, n), by differences into the ranges.

        Those of the last points are kept: a round begins, and the curvature is taken, where the round before ended.
        `here` has the terms where they are known.
        """
        known = self.recent.get(x.tobytes())
        if known is not None:
            return known
        steps = STEP * self.unit
        steps[x + steps > self.limits[1]] *= -1.0
        points = [x + step * unit for step, unit in zip(steps, np.eye(x.size), strict=True)]
        if here is None:
            here, *moved = self.all_terms([x, *points])
        else:
            moved = self.all_terms(points)
        found = here, np.array([(there - here) / step for there, step in zip(moved, steps, strict=True)])
        while len(self.recent) >= RECENT_POINTS:
            del self.recent[next(iter(self.recent))]
        self.recent[x.tobytes()] = found
        return found

    def slope_and_scores(self, x: np.ndarray, here: np.ndarray | None = None) -> tuple[float, np.ndarray, np.ndarray]:
        """Return the objective, its gradient (k,), and the derivatives of its terms (k, n); `here` as `slopes`."""
        here, scores = self.slopes(x, here)
        slope = scores.sum(axis=1) - self.precision * (x - self.start)
        return float(here.sum()) - self.penalty(x), slope, scores


class _StopSearch(Exception):
    """The search was ended early."""


class _BestPoint:
    """Best point of a search so far, reported as it improves."""

    def __init__(self, objective: Objective, x: np.ndarray) -> None:
        self.objective, self.x, self.value = objective, x, -np.inf

    def add(self, x: np.ndarray, value: float) -> None:
        """Keep a point if it is the best one.

        Raises:
            _StopSearch: If the search is to end.
        """
        progress = self.objective.progress
        if value > self.value:
            if np.isfinite(self.value):
                self.objective.report(x, value - self.value)
            self.x, self.value = x, value
        if progress.stop:
            raise _StopSearch


def maximise(objective: Objective, x: np.ndarray, H: np.ndarray | None = None) -> tuple[np.ndarray, float]:
    """Return the point (k,) of the maximum nearest to x, and the value there.

    Args:
        objective: The objective.
        x: Start (k,).
        H: Curvature there, minus the second derivatives (k, k), where it is known; else it is taken from the scores.
    """
    noises = all(item.key.startswith(("Q.", "R.")) for item in objective.entries)
    return quasi_newton(objective, x, H) if noises else scaled_rounds(objective, x)


def scaled_rounds(objective: Objective, x: np.ndarray, *, rounds: int = MAX_ROUNDS) -> tuple[np.ndarray, float]:
    """Return the same by rounds of L-BFGS-B, each with deviations by the scores as units."""
    from scipy.optimize import minimize  # 15 MB, imported with the first fit

    low, high = objective.limits
    value, best = -np.inf, _BestPoint(objective, x)
    progress, folds = objective.progress, (ROUND_STEPS + 1) * (x.size + 1) * objective.folds
    for _ in range(rounds):
        progress.expected = max(progress.expected, progress.folds + folds)
        _, slopes = objective.slopes(x)
        unit = 1.0 / np.sqrt(np.sum(slopes**2, axis=1) + objective.precision)

        def loss(z: np.ndarray, x: np.ndarray = x, unit: np.ndarray = unit) -> tuple[float, np.ndarray]:
            point = objective.within(x + unit * z)
            found, gradient, _ = objective.slope_and_scores(point)
            best.add(point, found)
            return -found, -gradient * unit

        try:
            found = minimize(
                loss,
                np.zeros_like(x),
                jac=True,
                method="L-BFGS-B",
                bounds=list(zip((low - x) / unit, (high - x) / unit, strict=True)),
                options={"maxiter": ROUND_STEPS, "maxfun": 2 * ROUND_STEPS, "gtol": GRADIENT, "ftol": 1e-12},
            )
        except _StopSearch:
            break
        gained, value = -found.fun - value, float(-found.fun)
        x = objective.within(x + unit * found.x)
        if gained < RESOLUTION or found.status == 0:
            break
    return best.x, best.value


def quasi_newton(
    objective: Objective, x: np.ndarray, H: np.ndarray | None = None, *, steps: int = MAX_STEPS
) -> tuple[np.ndarray, float]:
    """Return the point (k,) that a number of quasi-Newton steps reach, and the value there; args as `maximise`."""
    if not x.size:
        return x, objective.value(x)
    value, slope, scores = objective.slope_and_scores(x)
    fresh = H is None  # whether the curvature is that of the scores here
    if H is None:
        H = _outer(objective, scores)
    unit, (low, high) = objective.unit, objective.limits
    ended, scale = 0, 1.0
    for _ in range(steps):
        if objective.progress.stop:
            break
        step = _step(H, slope, np.maximum(low - x, -MAX_CHANGE * unit), np.minimum(high - x, MAX_CHANGE * unit))
        promised = float(slope @ step - 0.5 * step @ H @ step)
        gained = 0.0
        if promised >= PRECISION:
            # Near the maximum the parabola holds, and one fold is enough.
            near = promised < NEAR and scale == 1.0
            found = _along(objective, x, step, [1.0] if near else [scale * share for share in SHARES])
            if near:
                # Of the promised gain there was too little, or far more: a smaller or a larger share of the step.
                ratio = (found[0].value - value) / promised
                more = [s for s in SHARES if (ratio < MIN_SHARE and s < 1.0) or (ratio > MAX_RATIO and s > 1.0)]
                found += _along(objective, x, step, more)
            best = max(found, key=lambda item: item.value)
            gained = best.value - value
            if gained <= 0.0 and scale == 1.0:
                scale = SHARES[-1] ** 2
                continue
        scale = 1.0
        if gained > 0.0:
            moved, before, x = best.x - x, slope, best.x
            objective.report(x, gained)
            value, slope, scores = objective.slope_and_scores(x, best.terms)
            scored, seen = _outer(objective, scores), float(moved @ (before - slope))
            agrees = seen / AGREEMENT < float(moved @ scored @ moved) < seen * AGREEMENT
            H = _updated(scored if agrees else H, moved, before - slope)
        ended = ended + 1 if gained < min(RESOLUTION, MIN_SHARE * promised) or promised < PRECISION else 0
        if ended == 2 or (ended and fresh):
            break
        fresh = ended > 0
        if fresh:
            H = _outer(objective, scores)
    return x, value


class _Tried(NamedTuple):
    """A point (k,), the terms of the objective there (n,), and its value."""

    x: np.ndarray
    terms: np.ndarray
    value: float


def _along(objective: Objective, x: np.ndarray, step: np.ndarray, shares: Sequence[float]) -> list[_Tried]:
    """Return the objective at shares of a step (k,), within the ranges."""
    points = [objective.within(x + share * step) for share in shares]
    terms = objective.all_terms(points)
    return [_Tried(at, own, float(own.sum()) - objective.penalty(at)) for at, own in zip(points, terms, strict=True)]


def polished(objective: Objective, x: np.ndarray, cov: np.ndarray) -> np.ndarray:
    """Return the maximum (k,) to `POLISHED` deviations, from a point that a search reached.

    Newton's steps with gradients by central differences; entries at the end of their range stay there.

    Args:
        objective: The objective.
        x: Start (k,).
        cov: Inverse of the curvature there, (k, k).
    """
    unit, (low, high) = STEP * objective.unit, objective.limits
    H, deviation, value = np.linalg.inv(cov), np.sqrt(np.diag(cov)), objective.value(x)
    before: tuple[np.ndarray, np.ndarray] | None = None
    for _ in range(POLISH_STEPS):
        if objective.progress.stop:
            break
        moved = [
            x + side * step * axis for step, axis in zip(unit, np.eye(x.size), strict=True) for side in (1.0, -1.0)
        ]
        found = np.array([terms.sum() for terms in objective.all_terms(moved)]).reshape(-1, 2)
        slope = (found[:, 0] - found[:, 1]) / (2.0 * unit) - objective.precision * (x - objective.start)
        if before is not None:
            H = _updated(H, x - before[0], before[1] - slope)
        step = _step(H, slope, low - x, high - x)
        ahead = objective.within(x + step)
        reached = objective.value(ahead)
        if reached < value:
            break
        before, x, value = (x, slope), ahead, reached
        if np.all(np.abs(step) < POLISHED * deviation):
            break
    return x


def _outer(objective: Objective, scores: np.ndarray) -> np.ndarray:
    """Return the curvature (k, k) by the scores (k, n)."""
    return scores @ scores.T + np.diag(objective.precision)


def _step(H: np.ndarray, slope: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the step (k,) within a box to the maximum of slope · d - ½ d · H d."""
    from scipy.optimize import lsq_linear  # 15 MB, imported with the first fit

    scale = 1.0 / np.sqrt(np.diag(H))
    values, vectors = np.linalg.eigh(H * np.outer(scale, scale))
    root = np.sqrt(np.maximum(values, MIN_EIGENVALUE * values[-1]))
    free: np.ndarray = scale * (vectors @ (vectors.T @ (slope * scale) / root**2))
    if np.all(low <= free) and np.all(free <= high):
        return free
    # An entry at the end of its range has no room.
    room = high > low
    found = np.zeros_like(slope)
    parabola = ((vectors * root).T / scale)[:, room]
    solved = lsq_linear(parabola, vectors.T @ (slope * scale) / root, (low[room], high[room]), method="bvls")
    found[room] = np.clip(solved.x, low[room], high[room])
    return found


def _updated(H: np.ndarray, step: np.ndarray, change: np.ndarray) -> np.ndarray:
    """Return the curvature (k, k) after a step over which the slope fell by `change`; it stays positive definite."""
    along = H @ step
    present, seen = float(step @ along), float(step @ change)
    if not present > 0.0 or not np.all(np.isfinite(change)):
        return H
    weight = 1.0 if seen >= DAMPING * present else (1.0 - DAMPING) * present / (present - seen)
    change = weight * change + (1.0 - weight) * along
    return H - np.outer(along, along) / present + np.outer(change, change) / float(step @ change)


def search(objective: Objective, x: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the same without derivatives, for a filter that draws; the first step is one logarithm or deviation."""
    from scipy.optimize import minimize  # 15 MB, imported with the first fit

    unit, (low, high) = objective.unit, objective.limits
    best = _BestPoint(objective, x)

    def loss(z: np.ndarray) -> float:
        point = objective.within(x + unit * z)
        value = objective.value(point)
        best.add(point, value)
        return -value

    with suppress(_StopSearch):
        minimize(
            loss,
            np.zeros_like(x),
            method="COBYQA",
            bounds=list(zip((low - x) / unit, (high - x) / unit, strict=True)),
            options={"maxfev": SEARCH_FOLDS * x.size, "final_tr_radius": 0.02},
        )
    return best.x, best.value
