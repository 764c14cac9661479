"""The exponential in vectors against Python's, at lengths on both sides of a vector's."""

import math

import numpy as np
import pytest
from numba import njit

from estimators.numerics.simd import exp_minus


@njit
def exp_of(x, shift, out):
    exp_minus(x.size, x, shift, out)


@pytest.mark.parametrize("n", [1, 2, 7, 8, 9, 16, 1000])
@pytest.mark.parametrize("shift", [0.0, -3.7, 250.0])
def test_within_a_unit_in_the_last_place(n, shift):
    """math.exp of the C library is itself within one unit, so two are allowed."""
    x = np.random.default_rng(n).uniform(-700.0, 700.0, n) + shift
    out = np.full(n + 1, 7.0)
    exp_of(x, shift, out[:n])
    expected = np.array([math.exp(value) for value in x - shift])
    assert np.all(np.abs(out[:n] - expected) <= 2 * np.spacing(expected))
    assert out[n] == 7.0


def test_at_the_ends():
    x = np.array([0.0, -708.5, -1e308, -np.inf, 709.5, np.inf, np.nan, 1.0, -0.0])
    out = np.empty(x.size)
    exp_of(x, 0.0, out)
    assert np.isnan(out[6]) and abs(out[7] - math.e) <= np.spacing(math.e)
    np.testing.assert_array_equal(out[[0, 1, 2, 3, 4, 5, 8]], [1.0, 0.0, 0.0, 0.0, np.inf, np.inf, 1.0])
