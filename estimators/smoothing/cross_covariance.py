"""The covariance of a state and its prediction, C = Cov(x, x⁻), by the rule with which the filter itself predicts.

Filters that go by a tangent have C = P Fᵀ; those that go by sigma points the weighted sum over the points,
C = w·spread Σ U[k]ᵀ (D₊ₖ - D₋ₖ), with the deviations D± of opposite points' images.

Sources: Rauch, Tung & Striebel (1965), doi:10.2514/3.3166; Särkkä (2008), doi:10.1109/TAC.2008.919531.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from ..compiled.context import circular_states, transition_points
from ..compiled.jacobians import scratch_size, state_jacobian
from ..gaussian.ukf import deviations, weights_of
from ..numerics.jit import floats, inlined, jit
from ..numerics.padded_rows import cross_covariance, factor, spread_points
from ..numerics.simd_ir import padded
from ..numerics.workspace import layout, take_matrix, take_vector

CONSTANT, TANGENT, POINTS = range(3)
"""How a filter predicts: by the one F of a linear model, by the tangent of f at the estimate, by sigma points."""


class Crossing(NamedTuple):
    """What it is computed in."""

    F: Any
    """(n, n): df/dx."""
    jacobian: Any
    """Scratch of a Jacobian."""
    chol_P: Any
    """(n, padded n): upper, chol_Pᵀ chol_P = P."""
    sigma: Any
    """(2n + 1, padded n): the sigma points."""
    D: Any
    """(2n + 1, padded n): the same through f, then their deviations from the mean."""
    across: Any
    """(n, padded n): the differences between opposite ones, in the place of the first of each pair."""
    mean: Any
    """(padded n,)."""
    end: int


@layout
def crossing(at, n):
    """The layout of it."""
    F, at = take_matrix(at, n, n)
    jacobian, at = take_vector(at, scratch_size(n, n))
    chol_P, at = take_matrix(at, n, padded(n))
    sigma, at = take_matrix(at, 2 * n + 1, padded(n))
    _, second = take_vector(at, padded(n))
    across, _ = take_matrix(second, n, padded(n))
    D, at = take_matrix(at, 2 * n + 1, padded(n))
    mean, at = take_vector(at, padded(n))
    return Crossing(F, jacobian, chol_P, sigma, D, across, mean, at)


@jit
def by_tangent(context, rule, x, u, dt, P, own, C):
    """C (nx, nx) = P Fᵀ."""
    n = x.size
    # That of a linear model is found where its filter finds it: differences round differently at each x.
    at = floats(context.prior_mean, n) if rule == CONSTANT else x
    state_jacobian(context, at, u, dt, own.F, own.jacobian)
    for i in range(n):
        for j in range(n):
            s = 0.0
            for k in range(n):
                s += P[i, k] * own.F[j, k]
            C[i, j] = s


@jit
def by_points(context, x, u, dt, own, C):
    """C (nx, nx) from sigma points about x, spread by the factor in own.chol_P."""
    n = x.size
    w = weights_of(context)
    spread_points(x, own.chol_P, w.spread, own.sigma)
    transition_points(context, own.sigma, u, dt, own.D)
    deviations(own.D, w.outer, circular_states(context), own.mean)
    for k in range(n):
        for j in range(n):
            own.across[k, j] -= own.D[1 + n + k, j]
    cross_covariance(own.chol_P, own.across, w.outer * w.spread, C)


@inlined
def take_factor(P, U, rooted, own):
    """Fill own.chol_P: from U, if the state holds a factor, or else from P; False if P has none."""
    if not rooted:
        return factor(P, own.chol_P)
    for i in range(U.shape[0]):
        for j in range(U.shape[1]):
            own.chol_P[i, j] = U[i, j]
    return True
