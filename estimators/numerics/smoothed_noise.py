"""Correlated noise on a grid, without a covariance matrix: white noise, smoothed along each axis in linear time."""

from __future__ import annotations

from collections.abc import Callable
from math import exp

import numpy as np

from .jit import jit, matrix


@jit
def smooth(z, rows, columns, down, across, out):
    """out = L z with L Lᵀ of unit diagonal and correlation down^|i-k| across^|j-l| between cells (i, j) and (k, l).

    A first-order autoregression along each axis in turn, started in its steady state: xᵢ = k xᵢ₋₁ + √(1-k²) zᵢ.
    Exact at the edges too.

    Args:
        z: White noise (rows·columns,), row by row.
        rows: Cells along the first axis.
        columns: Cells along the second.
        down: Correlation of neighbours along the first axis.
        across: Along the second.
        out: Gets the correlated noise.
    """
    fresh = np.sqrt(1.0 - down * down)
    Z = matrix(z, 0, rows, columns)
    X = matrix(out, 0, rows, columns)
    for j in range(columns):
        X[0, j] = Z[0, j]
    for i in range(1, rows):
        for j in range(columns):
            X[i, j] = down * X[i - 1, j] + fresh * Z[i, j]
    fresh = np.sqrt(1.0 - across * across)
    for i in range(rows):
        for j in range(1, columns):
            X[i, j] = across * X[i, j - 1] + fresh * X[i, j]


def exponential(rows: int, columns: int, *, spacing: float | tuple[float, float], length: float) -> Callable:
    """A model's `shape`: correlation exp(-(|Δx| + |Δy|) / length) between cells `spacing` apart, one number or two."""
    steps = spacing if isinstance(spacing, tuple) else (spacing, spacing)
    down, across = exp(-steps[0] / length), exp(-steps[1] / length)

    def shape(z, p, out):  # noqa: ANN001, ANN202
        smooth(z, rows, columns, down, across, out)

    return shape
