"""Forecasts: a fold that continues over a future without measurements.

The filter's present state is the base of a fold over a log of inputs alone. Each step of that log is an INPUT event, so
the state is predicted exactly as between measurements. As `f` is discrete, the steps should be as long as those
between the measurements so far.

Filters made of members (ensembles, bootstrap particles) are sampled at every time and some between. A member keeps its
identity while no measurement arrives, so its path shows when it passes a limit for the first time. Other filters
give moments, and from these the probability of being beyond the limit at each time, which is smaller than the
probability of having passed it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

from .errors import EstimatorError
from .fold import Fold
from .log import INPUT, Events, Log
from .model.state_space import LARGE, StateSpaceModel
from .numerics.linalg import wrapped
from .snapshots import Base
from .tuning import Tuning

SIGMAS = (-2.0, -1.0, 1.0, 2.0)
"""Edges of the bands, in standard deviations; of members the quantiles that a normal variable has there."""

SAMPLES_PER_TIME = 4
"""Samples of the members from one time to the next, if there are as many steps. A member that returns between two
samples does not count as having passed a limit."""


class Crossing(NamedTuple):
    """Limit of one state, in its unit, and the probability (T,) of crossing it.

    `above` is True if the mean is below the limit now, so that crossing means exceeding it. From members, `probability`
    is that of having passed the limit up to each time; from moments, of being beyond it at each time.
    """

    state: str
    limit: float
    above: bool
    probability: np.ndarray


class Forecast(NamedTuple):
    """Forecast of the shown states at T times, the first of them now.

    t (T,): seconds from now. mean and std (T, shown), bands (T, 4, shown) at `SIGMAS`, in the units of the states.
    `members` is the number of members, 0 for a forecast from moments.
    """

    t: np.ndarray
    mean: np.ndarray
    std: np.ndarray
    bands: np.ndarray
    members: int
    crossings: tuple[Crossing, ...]


def forecast(
    estimator: str,
    model: StateSpaceModel,
    tuning: Tuning,
    base: Base,
    now: int,
    horizon: float,
    step: float,
    *,
    inputs: Events | None = None,
    limits: Mapping[str, float] | None = None,
    most: int = 160,
    between: Callable[[], None] = lambda: None,
) -> Forecast:
    """Continue a fold from a base without measurements.

    Args:
        estimator: Name in the registry; the estimator that left the base resumes its full state.
        model: Model of the twin.
        tuning: Tuning of the twin.
        base: Present state of the filter, see `Fold.base_here`.
        now: Start of the forecast, ns; not before the base's clock.
        horizon: Length of the forecast, s.
        step: Longest step, s.
        inputs: Events of inputs from now on; the other inputs keep their values.
        limits: Limits of shown states, by name.
        most: Largest number of times, without the first.
        between: Called between two times; an exception from it ends the forecast.

    Raises:
        EstimatorError: If horizon or step are not positive, `now` is before the base, or a limit is of a state that is
            not shown, an angle or a mode; and as `Fold`.
        EventError: If an input does not fit the model.
    """
    if not (0.0 < horizon < np.inf and step > 0.0):
        raise EstimatorError(f"horizon is {horizon:g} s in steps of {step:g} s; both must be positive")
    if now < base.clock:
        raise EstimatorError("now is before the time of the state; a forecast begins where the filter stands")
    columns = {name: _column(model, name) for name in limits or {}}
    times = max(1, min(most, int(np.ceil(horizon / step))))
    fine = times * max(1, int(np.ceil(horizon / (times * step))))
    instants = now + np.rint(np.linspace(0.0, 1e9 * horizon, fine + 1)).astype(np.int64)
    # An event at each instant predicts the state to it.
    steps = Events.alike(INPUT, instants, np.full((instants.size, model.width), np.nan))
    ahead = Log.resume(model, base, steps if inputs is None else Events.concat([steps, inputs], model.width))
    fold = Fold(estimator, model, tuning, ahead, base=base)
    by_members = fold.estimator.blocks is not None and model.nx <= LARGE
    rows = np.searchsorted(fold.log.events.t, instants, side="right")
    each = fine // times
    apart = np.unique(np.linspace(0, each, min(SAMPLES_PER_TIME, each) + 1).astype(int))[1:]
    watch = _Watch(model, limits or {}, columns)
    bands = np.empty((times + 1, len(SIGMAS), len(model.shown)))
    points = np.zeros((0, model.nx))
    for k in range(times + 1):
        looks = (k - 1) * each + apart if k and by_members and limits else [k * each]
        for stop in rows[looks]:
            fold.advance(int(stop) - fold.n)
            if by_members:
                points = fold.points()
                watch.members(points, fold.track.mean[-1])
        between()
        mean, std = fold.track.mean[-1], fold.track.std[-1]
        if by_members:
            off = wrapped(points[:, model.shown] - mean, model.circular[model.shown])
            bands[k] = mean + np.quantile(off, ndtr(SIGMAS), axis=0)
        else:
            bands[k] = mean + np.outer(SIGMAS, std)
        watch.moments(mean, std, by_members)
    last = rows[::each] - 1
    t = (instants[::each] - now) * 1e-9
    return Forecast(t, fold.track.mean[last], fold.track.std[last], bands, len(points), watch.crossings())


def first_time(t: np.ndarray, probability: np.ndarray, share: float) -> float:
    """Return when a probability first reaches a share, s, interpolated between two times; NaN if it never does.

    Args:
        t: Times (T,), s.
        probability: Probability (T,) at these times.
        share: Threshold, from 0 to 1.
    """
    reached = np.flatnonzero(probability >= share)
    if not reached.size:
        return np.nan
    k = int(reached[0])
    if k == 0:
        return float(t[0])
    part = (share - probability[k - 1]) / (probability[k] - probability[k - 1])
    return float(t[k - 1] + part * (t[k] - t[k - 1]))


def _column(model: StateSpaceModel, name: str) -> int:
    names = [state.name for state in model.shown_states]
    if name not in names:
        raise EstimatorError(f"limits: {model.name} shows no state {name!r}; it has {', '.join(names)}")
    column = names.index(name)
    if model.shown_states[column].circular or int(model.shown[column]) == model.mode:
        kind = "an angle" if model.shown_states[column].circular else "a mode"
        raise EstimatorError(f"limits: {name} is {kind}, which has no side beyond a limit")
    return column


class _Watch:
    """Crossings of limits while the states move."""

    def __init__(self, model: StateSpaceModel, limits: Mapping[str, float], columns: Mapping[str, int]) -> None:
        self._model, self._limits, self._columns = model, limits, columns
        self._above: dict[str, bool] = {}
        self._passed: dict[str, np.ndarray] = {}
        self._found: dict[str, list[float]] = {name: [] for name in limits}

    def members(self, points: np.ndarray, mean: np.ndarray) -> None:
        """Note the members (k, nx) beyond a limit; the mean (shown,) gives the side."""
        for name, limit in self._limits.items():
            above = self._above.setdefault(name, bool(mean[self._columns[name]] < limit))
            x = points[:, self._model.shown[self._columns[name]]]
            beyond = x >= limit if above else x <= limit
            self._passed[name] = self._passed[name] | beyond if name in self._passed else beyond

    def moments(self, mean: np.ndarray, std: np.ndarray, by_members: bool) -> None:
        """Add the probabilities at one time, from the members that have passed or from normal moments, (shown,)."""
        for name, limit in self._limits.items():
            j = self._columns[name]
            above = self._above.setdefault(name, bool(mean[j] < limit))
            with np.errstate(divide="ignore", invalid="ignore"):
                far = (mean[j] - limit) / std[j] * (1.0 if above else -1.0)
            self._found[name].append(float(np.mean(self._passed[name])) if by_members else float(ndtr(far)))

    def crossings(self) -> tuple[Crossing, ...]:
        """Return the crossings of all limits."""
        return tuple(
            Crossing(name, limit, self._above[name], np.array(self._found[name]))
            for name, limit in self._limits.items()
        )
