"""What the mean NIS should be: the one measure wherever a NIS is judged.

Of a filter that is as it should be, innovations are white and normal, and the sum of NIS is chi-square. Of a twin that
was commissioned (commission.py), what was normal then: each row's innovations have a bias b, a scale s and a lag-1
correlation φ. Then E e² = b² + s², and a long sum of n of them has the variance

    n (2 s⁴ (1 + φ²) / (1 - φ²) + 4 b² s² (1 + φ) / (1 - φ)),

which for b = 0, s = 1, φ = 0 is the 2 n of chi-square. The bounds are those of a scaled chi-square of that mean and
variance, of no more degrees of freedom than there are.

Sources: Bar-Shalom, Li & Kirubarajan (2001), 5.4.2, for the bounds; Bayley & Hammersley (1946), doi:10.2307/2983560,
for sums that are correlated; Satterthwaite (1946), doi:10.2307/3002019, for the scaled chi-square.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ..model.state_space import StateSpaceModel
from ..numerics.jit import inlined, plain
from ..numerics.quantiles import chi_square_quantile

PROBABILITY = 0.95
"""Of the bounds that charts and reports show."""

LEAST, MEAN, VARIANCE = range(3)
NORMALS = 3
"""Of each sensor's NIS: mean, at least 1, from which divergence counts; mean and variance of a degree of freedom."""


def normal_nis(model: StateSpaceModel, baseline: np.ndarray) -> np.ndarray:
    """What is normal of the NIS of each sensor, (sensors, NORMALS), its rows alike.

    Args:
        model: Whose sensors.
        baseline: Bias, scale and correlation of each row in its first columns, (rows, 3 or more).
    """
    b, s, phi = baseline[:, 0], baseline[:, 1], baseline[:, 2]
    mean = b**2 + s**2
    variance = 2.0 * s**4 * (1.0 + phi**2) / (1.0 - phi**2) + 4.0 * b**2 * s**2 * (1.0 + phi) / (1.0 - phi)
    rows = zip(model.row_start, (len(sensor.rows) for sensor in model.sensors), strict=True)
    means = [(mean[start : start + n].mean(), variance[start : start + n].mean()) for start, n in rows]
    return np.array([(max(m, 1.0), m, v) for m, v in means], float).reshape(-1, NORMALS)


@inlined
def free_degrees(mean: Any, variance: Any, dof: Any) -> Any:
    """Degrees of freedom of the scaled chi-square of that mean and variance, from 1 to `dof`."""
    return max(1.0, min(2.0 * mean * mean / variance, float(dof)))


def nis_bounds(dof: np.ndarray, readings: int, normal: np.ndarray | None = None) -> tuple[float, float]:
    """95 % bounds of the mean NIS of `readings` readings.

    Args:
        dof: Their degrees of freedom in all, by sensor, (sensors,).
        readings: How many.
        normal: What is normal of each sensor (`normal_nis`); None for white, normal innovations.
    """
    total = float(np.sum(dof))
    if not total:
        return np.nan, np.nan
    mean, variance = (total, 2.0 * total) if normal is None else (dof @ normal[:, MEAN], dof @ normal[:, VARIANCE])
    free = plain(free_degrees)(float(mean), float(variance), total)
    tail = (1.0 - PROBABILITY) / 2.0
    low, high = (float(mean / free * chi_square_quantile(q, free) / readings) for q in (tail, 1.0 - tail))
    return low, high
