"""The way to the maximum: scipy's optimisers, in units in which every entry is told about equally well.

The gradient is by refolds side by side; the same refolds give Σ s sᵀ of the scores s of single readings, whose diagonal
scales the entries (Berndt, Hall, Hall & Hausman 1974, Annals of Economic and Social Measurement 3, 653). Without it a
noise of which the data say little needs hundreds of folds. The scale is taken anew every few steps, since the
information of a noise that is far off says nothing of where it ends. What draws members by chance is not smooth even
with common random numbers where it resamples; there the search is by trust regions without derivatives (COBYQA,
Ragonneau & Zhang 2023).
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import minimize

from .objective import Objective

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
