"""Integrity: how wrong a state can be by one fault that nobody has noticed (the protection level of navigation)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ...numerics.quantiles import normal_quantile

PROBABILITY = 0.95
"""That an error stays below the bound, under the fault that is worst for it."""


class Integrity(NamedTuple):
    """Bounds of the error of each state, row by row, under one fault that was there from the first row on and unseen.

    bias (N, shown): the largest |dx| by any fault as large as can pass unseen. bound (N, shown): bias + 1.96 σ, what
    the error stays below with 95 % at least. cause (N, shown): the index of the nudge that causes it, -1 for none.
    """

    bias: np.ndarray
    bound: np.ndarray
    cause: np.ndarray


def integrity(errors: Sequence[np.ndarray], std: np.ndarray) -> Integrity:
    """Bounds from the error (N, shown) by the largest unseen fault of each nudge, and σ (N, shown)."""
    bias = np.zeros(std.shape)
    cause = np.full(std.shape, -1)
    for k, error in enumerate(errors):
        worse = error > bias
        bias[worse], cause[worse] = error[worse], k
    return Integrity(bias, bias + normal_quantile(0.5 + PROBABILITY / 2.0) * std, cause)
