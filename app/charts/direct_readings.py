"""Sensor rows that measure a state directly, so that charts and scenes draw their measurements over it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from estimators.model.state_space import Sensor, StateSpaceModel

from ..terminal import complain

SCALE_TOLERANCE, OFFSET_TOLERANCE = 0.05, 0.2
"""Largest relative difference of a row from its state at the mean of the prior (the scale of a wheel), and elsewhere,
where an estimated error is added (of a GNSS receiver)."""

ARITHMETIC_ERRORS = (ArithmeticError, ValueError)
"""Errors of Python where machine code returns NaN."""

STEP = 1e-3
"""Step of the slopes, as a share of a state's standard deviation."""


@dataclass(frozen=True)
class Observed:
    """One row of a sensor, and the state that it measures."""

    sensor: int
    row: int
    state: int


def observed(model: StateSpaceModel) -> list[Observed]:
    """Return the sensor rows that measure one charted state, up to a scale near one: h ≈ x_j, ∂h/∂x_j ≈ 1.

    Evaluated at the mean of the prior, and at two points within its standard deviation.
    """
    rng = np.random.default_rng(0)
    share = np.array([SCALE_TOLERANCE, OFFSET_TOLERANCE, OFFSET_TOLERANCE])
    moves = np.concatenate((np.zeros((1, model.nx)), rng.uniform(0.3, 0.9, (2, model.nx))))
    points = model.prior_mean + moves * model.prior_std
    charted, places = model.shown.tolist(), points[:, model.shown]
    units = np.array([state.unit for state in model.shown_states])
    sizes = np.array([state.std or 1.0 for state in model.shown_states])  # of one that is certain at first, in its unit
    u, p = model.default_inputs, model.default_parameters
    found = []
    for k, sensor in enumerate(model.sensors):
        values, there = np.full((len(points), len(sensor.rows)), np.nan), np.zeros(len(sensor.rows))
        for x, out in zip(points, values, strict=True):
            _expect(model, sensor, x, u, p, out)
        slopes: dict[int, np.ndarray] = {}  # by state, of those that the rows are near
        for r, row in enumerate(sensor.rows):
            # A distance to a wall grows as the vehicle moves, but is not where the vehicle is; and a sum of two states
            # may be one of them by chance, as long as the other is zero.
            near = np.all(np.abs(values[:, [r]] - places) < share[:, None] * np.maximum(np.abs(places), sizes), axis=0)
            likely = []
            for column in np.flatnonzero(near & (units == row.unit)):
                j = charted[column]
                if j not in slopes:
                    moved = points[0].copy()
                    moved[j] += STEP * sizes[column]
                    _expect(model, sensor, moved, u, p, there)
                    slopes[j] = (there - values[0]) / (STEP * sizes[column])
                if abs(slopes[j][r] - 1.0) < SCALE_TOLERANCE:
                    likely.append(j)
            likely.sort(key=lambda j: model.state_names[j] not in (row.name, sensor.name))
            if likely:
                found.append(Observed(k, r, likely[0]))
    return found


def measured_by(model: StateSpaceModel) -> dict[str, list[str]]:
    """Return the names of the sensor rows that measure a state directly, by state."""
    found: dict[str, list[str]] = {}
    for item in observed(model):
        name = model.row_names[model.row_start[item.sensor] + item.row]
        found.setdefault(model.state_names[item.state], []).append(name)
    return found


def expected(model: StateSpaceModel, sensor: Sensor, x: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Return h(x, u, p) of a sensor with the inputs' defaults, shape (ny,); NaN where it fails."""
    out = np.full(len(sensor.rows), np.nan)
    _expect(model, sensor, x, model.default_inputs, p, out)
    return out


def _expect(
    model: StateSpaceModel, sensor: Sensor, x: np.ndarray, u: np.ndarray, p: np.ndarray, out: np.ndarray
) -> None:
    """Fill `out` with h(x, u, p), or NaN where it fails.

    Python raises where machine code returns NaN and the twin runs; other errors are reported.
    """
    try:
        if model.black_box:
            out[:] = sensor.h(x[np.newaxis], u, p)[0]
        else:
            sensor.h(x, u, p, out)
    except Exception as error:  # noqa: BLE001  a user's model may raise anything; the views go on without its dots
        out[:] = np.nan
        if model.black_box or not isinstance(error, ARITHMETIC_ERRORS):
            _report_once(
                f"model {model.name}: h of {sensor.name} fails near the prior: {type(error).__name__}: {error}"
            )


@cache
def _report_once(text: str) -> None:
    """Report once: every view asks."""
    complain(f"{text}; its measurements are drawn over no state")
