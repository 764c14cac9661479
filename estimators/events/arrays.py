"""Conversion of arrays by name, in seconds and the units of the model, to events; see `Log.add`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from ..errors import EventError, nearest
from .batch import BEFORE, INPUT, READING, TICK, TRUTH, Events

if TYPE_CHECKING:
    from ..model.state_space import StateSpaceModel


def nanoseconds(name: str, seconds: ArrayLike) -> np.ndarray:
    """Convert seconds to int64 nanoseconds, shape (N,).

    Raises:
        EventError: If one is not finite or beyond ±146 years.
    """
    s = _numbers(name, seconds)
    if s.ndim > 1:
        raise EventError(f"{name} has shape {s.shape}; it must be one number or (N,)")
    s = np.atleast_1d(s)
    bad = ~(np.abs(s) < -BEFORE * 1e-9)
    if bad.any():
        at = int(np.argmax(bad))
        raise EventError(f"{name}[{at}] is {s[at]}; times must be finite, in seconds, and within ±146 years of zero")
    return np.rint(s * 1e9).astype(np.int64)


def readings(
    model: StateSpaceModel, sensor: str, seconds: ArrayLike, values: ArrayLike, variance: ArrayLike | None = None
) -> Events:
    """Return events of one sensor; see `Log.add`."""
    index = _index("sensor", sensor, model.sensor_names, model)
    rows = len(model.sensors[index].rows)
    t = nanoseconds("seconds", seconds)
    y = _rows(f"values of {sensor}", values, t.size, rows)
    width = model.width + (model.ny if variance is not None else 0)
    batch = blank(t, READING, index, width)
    batch.value[:, :rows] = y
    if variance is not None:
        given = _numbers(f"variance of {sensor}", variance)
        if given.ndim == 1 and rows > 1 and given.shape == (t.size,) and t.size != rows:
            given = given[:, None]
        try:
            batch.value[:, model.width : model.width + rows] = given.reshape(-1, 1) if rows == 1 else given
        except ValueError:
            raise EventError(
                f"variance of {sensor} has shape {given.shape}; it must be one number or of shape {y.shape}"
            ) from None
        bad = ~(np.isnan(given) | (given > 0.0))
        if bad.any():
            wrong = given.flat[int(np.argmax(bad))]
            raise EventError(f"variance of {sensor} is {wrong:g}; it must be positive, or NaN for the tuned one")
    return batch


def inputs(model: StateSpaceModel, seconds: ArrayLike, named: Mapping[str, ArrayLike]) -> Events:
    """Return events of inputs by name; see `Log.add_inputs`."""
    if not named:
        raise EventError(f"add_inputs: no input is given; {nearest('', model.input_names)}")
    t = nanoseconds("seconds", seconds)
    batch = blank(t, INPUT, 0, model.width)
    for name, values in named.items():
        batch.value[:, _index("input", name, model.input_names, model)] = _column(name, values, t.size)
    return batch


def truth(model: StateSpaceModel, seconds: ArrayLike, named: Mapping[str, ArrayLike]) -> Events:
    """Return events of true states by name, as few per time as their indices allow; see `Log.add_truth`."""
    if not named:
        raise EventError(f"add_truth: no state is given; {nearest('', model.state_names)}")
    t = nanoseconds("seconds", seconds)
    known = {
        _index("state", name, model.state_names, model): _column(name, values, t.size) for name, values in named.items()
    }
    blocks: list[Events] = []
    for state in sorted(known):
        if not blocks or state >= int(blocks[-1].channel[0]) + model.width:
            blocks.append(blank(t, TRUTH, state, model.width))
        first = int(blocks[-1].channel[0]) if t.size else 0
        blocks[-1].value[:, state - first] = known[state]
        if not t.size:
            break
    return Events.concat(blocks, model.width)


def ticks(width: int, seconds: ArrayLike) -> Events:
    """Return queries; see `Log.add_ticks`."""
    return blank(nanoseconds("seconds", seconds), TICK, 0, width)


def blank(t: np.ndarray, kind: int, channel: int, width: int) -> Events:
    """Return events with values of NaN, which arrive when they are measured."""
    return Events.alike(kind, t, np.full((t.size, width), np.nan), channel)


def _numbers(name: str, values: ArrayLike) -> np.ndarray:
    try:
        return np.asarray(values, float)
    except (TypeError, ValueError):
        sample = next(iter(np.asarray(values, object).flat), None)
        raise EventError(f"{name} contains {sample!r}; all entries must be numbers") from None


def _rows(name: str, values: ArrayLike, n: int, rows: int) -> np.ndarray:
    y = _numbers(name, values)
    if y.ndim == 0 and rows == 1:
        y = np.full((n, 1), float(y))
    elif y.shape == (n * rows,) and 1 in (n, rows):
        y = y.reshape(n, rows)
    if y.shape != (n, rows):
        wanted = f"({n},)" if rows == 1 else f"({n}, {rows}), a column for each row of the sensor"
        raise EventError(f"{name} have shape {y.shape} for {n} times; the shape must be {wanted}")
    return y


def _column(name: str, values: ArrayLike, n: int) -> np.ndarray:
    """Return values of one input or state as (n,)."""
    y = _numbers(name, values)
    if y.ndim == 0:
        return np.full(n, float(y))
    if y.shape != (n,):
        raise EventError(f"{name} has shape {y.shape} for {n} times; the shape must be ({n},), or one number")
    return y


def _index(what: str, name: str, names: Sequence[str], model: StateSpaceModel) -> int:
    try:
        return names.index(name)
    except ValueError:
        remedy = nearest(str(name), names[:1000])
        raise EventError(f"{model.name} has no {what} {name!r}; {remedy}") from None
