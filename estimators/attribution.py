"""Attribution of a change of the estimate to the model, the inputs and each measurement.

Over a span of time the mean moves from m₀ to m₁. Between two events the model predicts it, m⁻ = f(m, u); a measurement
then corrects it by m - m⁻, which is K ν of a Kalman filter, and in any other what its update does. The sum of all
is m₁ - m₀. Of a prediction, the share of the model is that with the inputs at their defaults; inputs are set to their
values one after the other, in the order of the model, and each has the difference that it makes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from .errors import EstimatorError
from .log import INPUT, MAINTENANCE, MARK, READING, RESET, TICK, TRUTH
from .numerics.linalg import wrapped

if TYPE_CHECKING:
    from .fold import Fold

MAX_EVENTS = 50_000
"""Events of a span; each takes some 0.1 ms."""

LARGEST = 5
"""Corrections that are kept of each state."""


class Correction(NamedTuple):
    """Change of a state by one measurement: its time (ns), the index of its sensor, and the difference of the mean."""

    t: int
    sensor: int
    change: float


@dataclass(frozen=True)
class Attribution:
    """Change of the shown states (n,) from the row before `first` to the row `last`, by its causes.

    `before` and `after` are the means there; `t` their times, ns. `model` (n,), `inputs` (nu, n),
    `sensors` (sensors, n) and `restarts` (n,), those by maintenance, resets and reopened gates, add up to the
    difference, of an angle modulo 2π. `readings` (sensors,) counts measurements, and `largest` has the largest
    corrections of each state.
    """

    t: tuple[int, int]
    before: np.ndarray
    after: np.ndarray
    model: np.ndarray
    inputs: np.ndarray
    sensors: np.ndarray
    restarts: np.ndarray
    readings: np.ndarray
    largest: tuple[tuple[Correction, ...], ...]


def attribution(fold: Fold, since: int, until: int) -> Attribution:
    """Attribute the change of the estimate between two times.

    Args:
        fold: A fold of its own, at or before `since`. It is advanced to `until`; its log is changed and restored.
        since: ns; the change begins with the estimate after the last event at or before it.
        until: ns; it ends with that after the last event at or before it.

    Raises:
        EstimatorError: If there is no event between the two, or too many.
    """
    model, log = fold.model, fold.log
    t = log.events.t
    first, end = (int(np.searchsorted(t, time, side="right")) for time in (since, until))
    if first == 0 and end:
        first = 1  # before the first event there is no estimate
    if end <= first:
        raise EstimatorError("there is no event in the span, so the estimate does not change; choose a longer one")
    if end - first > MAX_EVENTS:
        raise EstimatorError(f"the span has {end - first:,} events; choose one with at most {MAX_EVENTS:,}")
    while fold.n < first and fold.advance(first - fold.n):
        pass

    def difference(new: np.ndarray, old: np.ndarray) -> np.ndarray:
        return wrapped(new - old, model.circular[model.shown])

    n, defaults = len(model.shown), model.default_inputs
    own, restarts = np.zeros(n), np.zeros(n)
    inputs, sensors = np.zeros((model.nu, n)), np.zeros((len(model.sensors), n))
    corrections: list[tuple[int, int, np.ndarray]] = []
    mean = before = fold.described()
    for i in range(first, end):
        kind, decided = log.kind[i], len(fold.decisions)
        if kind in (TRUTH, TICK, MARK):
            fold.advance(1)
            continue
        u, held = fold.u.copy(), defaults.copy()
        moved = [j for j in range(model.nu) if u[j] != defaults[j]]
        predicted = fold.described(int(t[i]), held)
        own += difference(predicted, mean)
        mean = predicted
        for j in moved:
            held[j] = u[j]
            predicted = fold.described(int(t[i]), held)
            inputs[j] += difference(predicted, mean)
            mean = predicted
        fold.advance(1)
        plain = kind in (READING, INPUT) and len(fold.decisions) == decided
        updated = fold.track.mean[i].copy() if kind == READING else mean
        if kind == READING:
            change = difference(updated, mean)
            sensors[log.channel[i]] += change
            corrections.append((int(t[i]), int(log.channel[i]), change))
        if not plain or kind in (RESET, MAINTENANCE):
            mean, updated = updated, fold.described()
            restarts += difference(updated, mean)
        mean = updated
    changes = np.array([change for _, _, change in corrections]).reshape(-1, n)
    order = np.argsort(-np.abs(changes), axis=0, kind="stable")[:LARGEST]
    largest = tuple(
        tuple(
            Correction(corrections[k][0], corrections[k][1], float(changes[k, j]))
            for k in order[:, j]
            if changes[k, j] != 0.0
        )
        for j in range(n)
    )
    readings = np.bincount(np.array([sensor for _, sensor, _ in corrections], int), minlength=len(model.sensors))
    times = int(t[first - 1]), int(t[end - 1])
    return Attribution(times, before, mean, own, inputs, sensors, restarts, readings, largest)
