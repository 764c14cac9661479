"""Quantiles from scipy.special: scipy.stats has the same, and takes as long to import as all else together."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.special import gammaincinv, ndtri


def chi_square_quantile(probability: float, dof: Any) -> Any:
    """The value that a chi-square variable with `dof` degrees of freedom stays below with this probability."""
    return 2.0 * gammaincinv(0.5 * np.asarray(dof, float), probability)


def normal_quantile(probability: float) -> float:
    """The value that a standard normal variable stays below with this probability."""
    return float(ndtri(probability))
