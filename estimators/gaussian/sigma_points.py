"""Sigma points: where they stand, what they weigh, and their mean where a coordinate is an angle.

x and x ± √(n+λ) U[i] with P = Uᵀ U and λ = α² (n + κ) - n; weights 1/(2(n+λ)), the central one λ/(n+λ) for the mean
and λ/(n+λ) + 1 - α² + β for the covariance.

Sources: Julier & Uhlmann (2004), doi:10.1109/JPROC.2003.823141; Wan & van der Merwe (2000),
doi:10.1109/ASSPCC.2000.882463.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..compiled.context import options
from ..numerics.jit import inlined
from ..numerics.linalg import wrap
from ..numerics.padded_rows import centre
from .robust import OWN

CENTRAL_COV, OUTER, SPREAD = range(OWN, OWN + 3)
"""Positions in the context's options: the central covariance weight, the outer weight, √(n+λ)."""


class Weights(NamedTuple):
    """`central` is the covariance weight of the central point, `outer` that of the others, `spread` is √(n+λ)."""

    central: float
    outer: float
    spread: float


def weights(alpha: float, beta: float, kappa: float, nx: int) -> Weights:
    """The weights and the spread that alpha, beta and kappa give for nx states."""
    total = alpha**2 * (nx + kappa)
    central = 1.0 - nx / total
    return Weights(central + 1.0 - alpha**2 + beta, 0.5 / total, float(np.sqrt(total)))


@inlined
def weights_of(context):
    """The weights and the spread that the filter's `tune` found."""
    numbers = options(context)
    return Weights(numbers[CENTRAL_COV], numbers[OUTER], numbers[SPREAD])


def sigma_points(x: np.ndarray, P: np.ndarray, spread: float) -> np.ndarray:
    """The sigma points (2 nx + 1, nx) of a mean and covariance; none where the covariance has no factor."""
    try:
        U = np.linalg.cholesky(P).T * spread
    except np.linalg.LinAlgError:
        return np.zeros((0, x.size))
    return np.vstack((x, x + U, x - U))


@inlined
def deviations(D, w, circular, mean):
    """Turn points D (2n+1, padded k) into deviations from their weighted mean (padded k,), from the central point on.

    The weights sum to 1, so mean = D₀ + w Σ (Dᵢ - D₀): small alpha then costs no digits, and angles do not tear.
    """
    for j in range(circular.size):
        if circular[j] != 0:
            for i in range(1, D.shape[0]):
                d = D[i, j] - D[0, j]
                if abs(d) > np.pi:
                    D[i, j] = D[0, j] + wrap(d)
    centre(D, circular.size, w, mean)
