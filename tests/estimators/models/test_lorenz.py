"""The chaotic models against their published equations, integrated by another method."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from estimators.models.lorenz import LORENZ63, LORENZ96


def butterfly(t, s):
    x, y, z = s
    return [10.0 * (y - x), x * (28.0 - z) - y, x * y - 8.0 / 3.0 * z]


def circle(t, x):
    return (np.roll(x, -1) - np.roll(x, 2)) * np.roll(x, 1) - x + 8.0


@pytest.mark.parametrize(("model", "tendency", "dt"), [(LORENZ63, butterfly, 0.01), (LORENZ96, circle, 0.05)])
def test_a_step_is_right_to_fourth_order(model, tendency, dt):
    """One step is off by c dt⁵, so half the step leaves 1/32 of it, the reference is good to 1e-11."""
    rng = np.random.default_rng(0)
    p = np.array([item.value for item in model.parameters])
    x = model.prior_mean + model.prior_std * rng.standard_normal(model.nx)
    off = []
    for step in (dt, dt / 2, dt / 4):
        exact = solve_ivp(tendency, (0.0, step), x, rtol=1e-13, atol=1e-13).y[:, -1]
        out = np.empty(model.nx)
        model.f(x, np.zeros(0), p, step, out)
        off.append(np.max(np.abs(out - exact)))
    assert off[0] < 0.02
    assert 24 < off[0] / off[1] < 42 and 24 < off[1] / off[2] < 42
