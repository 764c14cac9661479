"""A ring of n coupled masses of heat, each losing heat along a curve: as many states as one likes, mildly nonlinear.

x_i' = x_i + dt (0.5 (x_{i-1} - 2 x_i + x_{i+1}) - 0.1 x_i³),      y_j = x_{3j} + 0.1 x_{3j}²
"""

from __future__ import annotations

import numpy as np

from estimators.model.state_space import Noise, Row, Sensor, State, StateSpaceModel

STD, Q, R = 0.5, 0.01, 0.04


def f(x, u, p, dt, out):
    n = x.size
    for i in range(n):
        flow = x[i - 1 if i > 0 else n - 1] - 2.0 * x[i] + x[i + 1 if i < n - 1 else 0]
        out[i] = x[i] + dt * (0.5 * flow - 0.1 * x[i] * x[i] * x[i])


def f_linear(x, u, p, dt, out):
    n = x.size
    for i in range(n):
        flow = x[i - 1 if i > 0 else n - 1] - 2.0 * x[i] + x[i + 1 if i < n - 1 else 0]
        out[i] = x[i] + dt * 0.5 * flow


def h(x, u, p, out):
    for j in range(out.size):
        out[j] = x[3 * j] + 0.1 * x[3 * j] * x[3 * j]


def h_linear(x, u, p, out):
    for j in range(out.size):
        out[j] = x[3 * j]


def f_numpy(x, dt):
    """The same for FilterPy, as a user of it would write it."""
    return x + dt * (0.5 * (np.roll(x, 1) - 2.0 * x + np.roll(x, -1)) - 0.1 * x**3)


def h_numpy(x):
    every_third = x[::3]
    return every_third + 0.1 * every_third**2


def ring(n: int, m: int, *, linear: bool = False) -> StateSpaceModel:
    """A ring of n states of which every third is read, m in all."""
    return StateSpaceModel(
        name=f"ring{n}",
        title=f"ring of {n}",
        states=tuple(State(f"x{i}", "K", mean=0.1 * (i % 5), std=STD) for i in range(n)),
        noises=tuple(Noise(f"x{i}", "K²/s", Q) for i in range(n)),
        sensors=(Sensor("y", tuple(Row(f"y{j}", "K", R) for j in range(m)), h=h_linear if linear else h),),
        f=f_linear if linear else f,
        linear=linear,
    )
