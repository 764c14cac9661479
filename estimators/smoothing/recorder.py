"""A filter that notes its steps: wraps the four functions of a Gaussian or ensemble filter, for the fold's loop.

For each event it writes a `Step` (notes.py) to a tape. The covariance of a state and its prediction, C = Cov(x, x⁻),
follows the rule with which the filter predicts: C = P Fᵀ with a tangent, the weighted sum over the points with sigma
points, C = w·spread Σ U[k]ᵀ (D₊ₖ - D₋ₖ) with the deviations D± of opposite points' images, and the sample covariance of
members.

The state of the recorder is that of the filter followed by the address of its head, so it can be copied for a query.

Sources: Rauch, Tung & Striebel (1965), doi:10.2514/3.3166; Särkkä (2008), doi:10.1109/TAC.2008.919531, for sigma
points.
"""

from __future__ import annotations

import numpy as np

from ..compiled.context import circular_states, options, transition_points
from ..compiled.jacobians import scratch_size, state_jacobian
from ..ensemble.shared import SIZE, column_mean, ensemble
from ..estimator import (
    CONSTANT,
    FACTOR,
    MEMBERS,
    POINTS,
    Code,
    SmoothingRule,
    call_describe,
    call_predict,
    call_start,
    call_update,
    describe_signature,
    predict_signature,
    start_signature,
    update_signature,
)
from ..gaussian.kf import constant_jacobian, kept
from ..gaussian.shared import moments_of
from ..gaussian.ukf import deviations, subtract_opposite, weights_of
from ..numerics.jit import address, floats, inlined, ints, jit
from ..numerics.linalg import copy, copy_vector, multiply_transposed, root
from ..numerics.simd_ir import padded
from ..numerics.simd_rows import cross_covariance, factor, spread_points
from ..numerics.workspace import declare_layout, size_of
from .notes import CUT, STAYED, cut, finite, join, solve_semidefinite, step_at, step_layout

START, PREDICT, UPDATE, DESCRIBE, OWN, RULE, HELD, ROW, TAPE, SCRATCH, HEAD = range(11)
"""Positions in the head: addresses of the filter's functions, length of its state, prediction rule, form of its
covariance, row of the tape that is written, addresses of tape and scratch."""


Noting, noting_layout = declare_layout(
    "Noting",
    "n, N",
    kept,
    scratch_size,
    padded,
    x="n",
    P="n, n",
    P_found="n, n",
    ahead="n, n",
    C="n, n",
    W="n, n",
    T="n, n",
    after="n",
    X="N, n",
    kept="Kept(at, n)",
    jacobian="scratch_size(n, n)",
    chol_P="n, padded(n)",
    sigma="2 * n + 1, padded(n)",
    D="2 * n + 1, padded(n)",
    across="n, padded(n) = D + padded(n)",
    mean="padded(n)",
)
"""Scratch of a note: m; P; P at the start of the event; P⁻, then its factor; Cov(x, x⁻), then G of the step; U⁻ᵀ Cᵀ,
for U of P⁻; a product; m⁻; the N members before the step, of an ensemble.

For the cross-covariance: df/dx, with the scratch of a Jacobian; upper chol_P, chol_Pᵀ chol_P = P; the sigma points; D,
the same through f, then their deviations from the mean; `across`, the differences between opposite ones, in the place
of the first of each pair; the mean."""


@inlined
def head_of(state):
    """Return the head of a recorder's state."""
    return ints(int(state[state.size - 1]), HEAD)


@inlined
def own_of(head, state):
    """Return the filter's own state in a recorder's."""
    return floats(state.ctypes.data, head[OWN])


@inlined
def noting_of(context, head):
    """Return the scratch of a note."""
    members = int(options(context)[SIZE]) if head[HELD] == MEMBERS else 0
    return noting_layout(head[SCRATCH], context.nx, members)


@jit
def members_covariance(X, x, Y, y, C):
    """x, y (n,) ← means of paired members X, Y (N, n);  C ← (X - x)ᵀ (Y - y) / (N - 1)."""
    N, n = X.shape
    for j in range(n):
        x[j] = column_mean(X, j)
        y[j] = column_mean(Y, j)
    C[:] = 0.0
    for k in range(N):
        for i in range(n):
            a = (X[k, i] - x[i]) / (N - 1)
            for j in range(n):
                C[i, j] += a * (Y[k, j] - y[j])


@jit
def covariance_of(context, state, holds, x, P):
    """Fill x and P with the moments of a filter's state."""
    n = context.nx
    if holds == MEMBERS:
        X = ensemble(context, state)
        members_covariance(X, x, X, x, P)
        return
    mean, held = moments_of(state, n)
    for i in range(n):
        x[i] = mean[i]
        for j in range(n):
            if holds == FACTOR:
                s = 0.0
                for k in range(min(i, j) + 1):
                    s += held[k, i] * held[k, j]
                P[i, j] = s
            else:
                P[i, j] = held[i, j]


@jit
def by_tangent(context, rule, x, u, dt, P, own, C):
    """C (nx, nx) = P Fᵀ."""
    F = own.kept.F
    if rule == CONSTANT:
        constant_jacobian(context, u, dt, own.kept, own.jacobian)
    else:
        state_jacobian(context, x, u, dt, F, own.jacobian)
    multiply_transposed(P, F, C)


@jit
def by_points(context, x, u, dt, own, C):
    """C (nx, nx) from sigma points about x, spread by the factor in own.chol_P."""
    n = x.size
    w = weights_of(context)
    spread_points(x, own.chol_P, w.spread, own.sigma)
    transition_points(context, own.sigma, u, dt, own.D)
    deviations(own.D, w.outer, circular_states(context), own.mean)
    subtract_opposite(own.D, n, own.across)
    cross_covariance(own.chol_P, own.across, w.outer * w.spread, C)


@inlined
def take_factor(P, U, rooted, own):
    """Fill own.chol_P: from U, if the state holds a factor, otherwise from P; False if P has none."""
    if not rooted:
        return factor(P, own.chol_P)
    copy(U, own.chol_P)
    return True


@jit
def start(context, mean, cov, state):
    """Start the filter; note that the state before is lost."""
    head = head_of(state)
    own = own_of(head, state)
    places = noting_of(context, head)
    covariance_of(context, own, head[HELD], places.x, places.P)
    cut(step_at(head[TAPE], head[ROW], context.nx, own.size), places.x, places.P)
    call_start(head[START], context, mean, cov, own)


@jit
def predict(context, u, dt, index, state, work):
    """Predict as the filter does, and note the step."""
    n = context.nx
    head = head_of(state)
    own = own_of(head, state)
    row = step_at(head[TAPE], head[ROW], n, own.size)
    if row.kind[0] == CUT:
        call_predict(head[PREDICT], context, u, dt, index, own, work)
        return
    holds = head[HELD]
    places = noting_of(context, head)
    x, P, C = places.x, places.P, places.C
    covariance_of(context, own, holds, x, P)
    if row.kind[0] == STAYED:
        copy(P, places.P_found)
    good = True
    if holds == MEMBERS:
        copy(ensemble(context, own), places.X)
    elif head[RULE] == POINTS:
        _, held = moments_of(own, n)
        good = take_factor(P, held, holds == FACTOR, places)
        if good:
            by_points(context, x, u, dt, places, C)
    else:
        by_tangent(context, head[RULE], x, u, dt, P, places, C)
    call_predict(head[PREDICT], context, u, dt, index, own, work)
    covariance_of(context, own, holds, places.after, places.ahead)
    if holds == MEMBERS:
        members_covariance(places.X, x, ensemble(context, own), places.after, C)
    good = good and root(places.ahead, places.ahead, n)
    if good:
        solve_semidefinite(places.ahead, C, places.W)
        join(row, x, P, places.after, C, places.W, places.T)
        good = finite(row)
    if not good:
        cut(row, x if row.kind[0] == STAYED else row.before, places.P_found)


@jit
def update(context, u, sensor, y, index, state, work, innovation, innovation_std, score):
    """Update as the filter does."""
    head = head_of(state)
    own = own_of(head, state)
    return call_update(head[UPDATE], context, u, sensor, y, index, own, work, innovation, innovation_std, score)


@jit
def describe(context, state, mean, std, cross):
    """Describe as the filter does; each event ends with this call, so the next row of the tape begins."""
    head = head_of(state)
    own = own_of(head, state)
    row = step_at(head[TAPE], head[ROW], context.nx, own.size)
    copy_vector(own, row.state)
    head[ROW] += 1
    ahead = step_at(head[TAPE], head[ROW], context.nx, own.size)
    ahead.kind[0] = STAYED
    call_describe(head[DESCRIBE], context, own, mean, std, cross)


class StepRecorder:
    """The noting functions, and room for the notes of a number of events."""

    def __init__(self, code: Code, kind: SmoothingRule, own: int, nx: int, members: int, rows: int) -> None:
        """`code` is the filter's, `own` how many numbers its state has; `members` is 0 unless it is an ensemble."""
        self._each = size_of(step_layout, nx, own)
        self._tape = np.zeros((rows + 1) * self._each)
        self._scratch = np.full(size_of(noting_layout, nx, members), np.nan)
        self._head = np.zeros(HEAD, np.int64)
        self._head[[START, PREDICT, UPDATE, DESCRIBE]] = code
        self._head[[OWN, RULE, HELD]] = own, *kind
        self._head[[TAPE, SCRATCH]] = self._tape.ctypes.data, self._scratch.ctypes.data
        self._nx, self._own = nx, own
        self.tape = self._tape.ctypes.data
        """The address of the rows."""
        self.code = Code(
            address(start, start_signature),
            address(predict, predict_signature),
            address(update, update_signature),
            address(describe, describe_signature),
        )

    def around(self, state: np.ndarray) -> np.ndarray:
        """A recorder's state around that of a filter."""
        # An address is less than 2^53, and so the same as a float64.
        return np.append(state, float(self._head.ctypes.data))

    def begin(self, row: int) -> None:
        """Note the next event in a row of the tape."""
        self._head[ROW] = row
        self._tape[row * self._each] = STAYED
