"""Cause of a failed measurement: the model's functions are called again from the last finite estimate.

If a filter obtains a number that is not finite, or a matrix that is no covariance, the function of the model that
returned it is searched afterwards, outside the fold: the prediction is repeated from the estimate and from states
around it, where sigma points and particles are.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from ..compiled.context import steps_of
from ..compiled.model import CompiledModel
from ..errors import ModelError
from ..model.check import indefinite, numbers, place
from ..model.state_space import SHOWN
from ..track import FAILED, GATED, Track, estimated_rows

SIGMA_OFFSETS = (1.0, -1.0, 3.0, -3.0)
"""Standard deviations from the estimate, a state at a time; the sigma points of nx states lie at about √nx."""

MAX_STEPS = 100  # Steps of a prediction that are repeated at most; a longer prediction has longer steps


class Estimate(NamedTuple):
    """Mean and standard deviation, (nx,) each."""

    mean: np.ndarray
    std: np.ndarray


def failures(track: Track, first: int = 0) -> np.ndarray:
    """Return the rows from `first` on with a failed measurement (or rejected without a NIS) or no finite estimate."""
    verdict = track.verdict[first:]
    failed = (verdict == FAILED) | (verdict == GATED) & ~np.isfinite(track.nis[first:])
    return first + np.flatnonzero(~estimated_rows(track, first) | failed)


def cause(
    compiled: CompiledModel,
    before: Estimate,
    u: np.ndarray,
    p: np.ndarray,
    q: np.ndarray,
    dt: float,
    sensor: int | None,
    predicted: Estimate | None,
) -> str | None:
    """Return which function of a model fails between an estimate and a measurement dt seconds later.

    Args:
        compiled: The model.
        before: The estimate before.
        u: Inputs, (nu,).
        p: Parameters.
        q: Noise variances.
        dt: Seconds to the measurement; 0 without a prediction.
        sensor: Index of the sensor whose measurement failed; None if the prediction did.
        predicted: The predicted estimate, if it is finite.

    Returns:
        One line with function, place and remedy; None if none of them fails, or a black box raises an error.
    """
    try:
        with np.errstate(all="ignore"):
            met = _walk(compiled, before.mean, u, p, q, dt)
            if isinstance(met, str):
                return met
            if sensor is not None:
                met = met if predicted is None else predicted.mean
                asked = (_ask(compiled, sensor, x, u, p) for x in (met, *around(compiled, predicted or before)))
                found = next((line for line in asked if line is not None), None)
                if found is not None:
                    return found
            walked = (_walk(compiled, x, u, p, q, dt) for x in around(compiled, before))
            return next((line for line in walked if isinstance(line, str)), None)
    except ModelError:
        return None


def questions(
    compiled: CompiledModel, states: Sequence[np.ndarray], u: np.ndarray, p: np.ndarray, q: np.ndarray, dt: float
) -> Iterator[tuple[str, Callable[[], object]]]:
    """Yield the calls of a filter to a compiled model: each function at each of some states.

    Args:
        compiled: The model.
        states: States, (nx,) each.
        u: Inputs, (nu,).
        p: Parameters.
        q: Noise variances.
        dt: Seconds of the prediction.

    Yields:
        Description of the call, and the call.
    """
    model = compiled.model
    for x in states:
        at = f"at x = {numbers(x)}, u = {numbers(u)}"
        if dt > 0.0:
            named = f"{place(model.f)}model {model.name}: f(x, u, dt) {at}, dt = {dt:.4g} s"
            yield named, partial(compiled.f, x, u, p, dt, np.empty(x.size))
            if model.Q is not None:
                named = f"{place(model.Q)}model {model.name}: Q(x, u, dt) {at}, dt = {dt:.4g} s"
                yield named, partial(compiled.Q, x, u, p, q, dt, np.zeros((x.size, x.size)))
        for sensor, h in zip(model.sensors, compiled.h, strict=True):
            named = f"{place(sensor.h)}model {model.name}: h(x, u) of sensor {sensor.name} {at}"
            yield named, partial(h, x, u, p, np.empty(len(sensor.rows)))


def around(compiled: CompiledModel, estimate: Estimate) -> Iterator[np.ndarray]:
    """Yield states around an estimate of a small, compiled model."""
    if estimate.mean.size <= SHOWN and compiled.box is None:
        for away in SIGMA_OFFSETS:
            for j in np.flatnonzero(estimate.std > 0.0):
                x = estimate.mean.copy()
                x[j] += away * estimate.std[j]
                yield x


def _walk(
    compiled: CompiledModel, x: np.ndarray, u: np.ndarray, p: np.ndarray, q: np.ndarray, dt: float
) -> str | np.ndarray:
    """Return the end of a prediction from a state, or the first function that fails on the way."""
    model = compiled.model
    steps = min(MAX_STEPS, steps_of(dt, model.max_step)) if dt > 0.0 else 0
    for _ in range(steps):
        step = dt / steps
        at = f"x = {numbers(x)}, u = {numbers(u)}, dt = {step:.4g} s"
        if model.Q is not None:
            Q = np.zeros((x.size, x.size))
            compiled.Q(x, u, p, q, step, Q)
            wrong = indefinite(Q) if np.all(np.isfinite(Q)) else "is not finite"
            if wrong:
                return _line(compiled, "Q(x, u, dt)", model.Q, wrong, at, "a covariance for every state")
        there = np.full(x.size, np.nan)
        compiled.f(x, u, p, step, there)
        if not np.all(np.isfinite(there)):
            return _line(compiled, "f(x, u, dt)", model.f, f"is {numbers(there)}", at, "finite for every state")
        x = there
    return x


def _ask(compiled: CompiledModel, sensor: int, x: np.ndarray, u: np.ndarray, p: np.ndarray) -> str | None:
    """Return the error of h of a sensor at a state, or None."""
    given = compiled.model.sensors[sensor]
    y = np.full(len(given.rows), np.nan)
    compiled.h[sensor](x, u, p, y)
    if np.all(np.isfinite(y)):
        return None
    at = f"x = {numbers(x)}, u = {numbers(u)}"
    return _line(compiled, f"h(x, u) of sensor {given.name}", given.h, f"is {numbers(y)}", at, "finite for every state")


def _line(compiled: CompiledModel, what: str, function: Callable, wrong: str, at: str, rule: str) -> str:
    name = compiled.model.name
    return f"{place(function)}model {name}: {what} {wrong} at {at}, where the estimate got; it must be {rule}"
