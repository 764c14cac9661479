"""A filter that notes what it does: around the four functions of a Gaussian or ensemble filter, for the fold's loop.

For each event it notes how the state that the event found hangs together with what came of it. If x is the state
before and x⁻ its prediction, then given all readings up to x

    x | x⁻ ~ N(m + G (x⁻ - m⁻), M),     G = C (P⁻)⁻¹,     M = P - C (P⁻)⁻¹ Cᵀ,     C = Cov(x, x⁻)

whatever the readings after it say, which speak of x⁻ alone. So an update, its gate, its weights, its iterations need
not be known. Steps within one event are joined: G ← G g, M ← M + G m Gᵀ.

The state of the recorder is that of the filter and, behind it, where its notes are; so it can be copied, for a query.

Source: Särkkä, Bayesian Filtering and Smoothing (2013), theorems 8.2 and 9.1.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ..compiled.context import options
from ..ensemble.shared import SIZE, column_mean, ensemble
from ..estimator import (
    Code,
    call_describe,
    call_predict,
    call_start,
    call_update,
    describe_signature,
    predict_signature,
    start_signature,
    update_signature,
)
from ..gaussian.shared import moments_of
from ..numerics.jit import address, floats, inlined, ints, jit
from ..numerics.linalg import root
from ..numerics.workspace import layout, size_of, take_matrix, take_vector
from .cross_covariance import POINTS, Crossing, by_points, by_tangent, crossing, take_factor

STAYED, MOVED, CUT = range(3)
"""What an event did to the state before any update: nothing; it was predicted; it began anew, or came to nothing."""

START, PREDICT, UPDATE, DESCRIBE, OWN, RULE, HELD, ROW, TAPE, SCRATCH, HEAD = range(11)
"""Positions in the head: the addresses of the filter's functions, how many numbers its state has, how it predicts,
what its state holds, the row of the tape that is written, and where tape and scratch are."""

COVARIANCE, FACTOR, MEMBERS = range(3)
"""What the state of a filter holds beside or in place of the mean: P, a factor of it, or the members of an ensemble."""


class Step(NamedTuple):
    """One row of the tape."""

    kind: Any
    """(1,): STAYED, MOVED or CUT."""
    before: Any
    """(n,): m, the mean of the state that the event found."""
    after: Any
    """(n,): m⁻, its prediction."""
    G: Any
    """(n, n)."""
    M: Any
    """(n, n); after a cut all of P."""
    state: Any
    """The filter's state behind the event, or of a query the answer to it."""
    end: int


@layout
def step(at, n, own):
    """The layout of a row, of a filter whose state has `own` numbers."""
    kind, at = take_vector(at, 1)
    before, at = take_vector(at, n)
    after, at = take_vector(at, n)
    G, at = take_matrix(at, n, n)
    M, at = take_matrix(at, n, n)
    state, at = take_vector(at, own)
    return Step(kind, before, after, G, M, state, at)


class Noting(NamedTuple):
    """What a note is computed in."""

    x: Any
    """(n,): m."""
    P: Any
    """(n, n)."""
    P_found: Any
    """(n, n): that with which the event began."""
    ahead: Any
    """(n, n): P⁻, then its factor."""
    C: Any
    """(n, n): Cov(x, x⁻), then G of the step."""
    W: Any
    """(n, n): U⁻ᵀ Cᵀ, for U of P⁻."""
    T: Any
    """(n, n): scratch of a product."""
    after: Any
    """(n,): m⁻."""
    X: Any
    """(N, n): the members before the step, of an ensemble."""
    crossing: Crossing
    end: int


@layout
def noting(at, n, N):
    """The layout of it, for N members."""
    x, at = take_vector(at, n)
    P, at = take_matrix(at, n, n)
    P_found, at = take_matrix(at, n, n)
    ahead, at = take_matrix(at, n, n)
    C, at = take_matrix(at, n, n)
    W, at = take_matrix(at, n, n)
    T, at = take_matrix(at, n, n)
    after, at = take_vector(at, n)
    X, at = take_matrix(at, N, n)
    own = crossing(at, n)
    return Noting(x, P, P_found, ahead, C, W, T, after, X, own, own.end)


@inlined
def head_of(state):
    """The head of a recorder's state."""
    return ints(int(state[state.size - 1]), HEAD)


@inlined
def own_of(head, state):
    """The filter's own state in a recorder's."""
    return floats(state.ctypes.data, head[OWN])


@inlined
def step_at(tape, row, n, own):
    """A row of a tape that begins at an address."""
    first = step(0, n, own)
    return step(tape + row * first.end, n, own)


@inlined
def count_of(context, holds):
    """How many members the state has."""
    return int(options(context)[SIZE]) if holds == MEMBERS else 0


@jit
def members_covariance(X, x, Y, y, C):
    """x, y (n,) ← means of the members X, Y (N, n), which belong together;  C ← (X - x)ᵀ (Y - y) / (N - 1)."""
    N, n = X.shape
    for j in range(n):
        x[j] = column_mean(X, j)
        y[j] = column_mean(Y, j)
    for i in range(n):
        for j in range(n):
            C[i, j] = 0.0
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
def cut(own, x, P):
    """Note that nothing of what comes says anything of the state N(x, P) that the event found."""
    own.kind[0] = CUT
    for i in range(x.size):
        own.before[i] = x[i]
        own.after[i] = x[i]
        for j in range(x.size):
            own.G[i, j] = 0.0
            own.M[i, j] = P[i, j]


@inlined
def solve_semidefinite(U, C, W):
    """W ← U⁻ᵀ Cᵀ;  C ← C (Uᵀ U)⁻¹; a row of U that is zero has no share in either."""
    n = U.shape[0]
    for i in range(n):
        for r in range(n):
            W[i, r] = C[r, i]
    for i in range(n):
        inverse = 1.0 / U[i, i] if U[i, i] > 0.0 else 0.0
        for r in range(n):
            W[i, r] *= inverse
        for j in range(i + 1, n):
            a = U[i, j]
            for r in range(n):
                W[j, r] -= a * W[i, r]
    for i in range(n - 1, -1, -1):
        inverse = 1.0 / U[i, i] if U[i, i] > 0.0 else 0.0
        for r in range(n):
            s = W[i, r]
            for j in range(i + 1, n):
                s -= U[i, j] * C[r, j]
            C[r, i] = s * inverse


@jit
def join(own, x, P, after, G, W, T):
    """Note a step from N(x, P) to the mean `after`, of this G and M = P - Wᵀ W, behind what the event has so far."""
    n = x.size
    for i in range(n):
        own.after[i] = after[i]
    for i in range(n):
        for j in range(i + 1):
            s = P[i, j]
            for k in range(n):
                s -= W[k, i] * W[k, j]
            P[i, j] = s
            P[j, i] = s
    if own.kind[0] == STAYED:
        own.kind[0] = MOVED
        for i in range(n):
            own.before[i] = x[i]
            for j in range(n):
                own.G[i, j] = G[i, j]
                own.M[i, j] = P[i, j]
        return
    turn(own.G, P, own.M, T)
    for i in range(n):
        for j in range(n):
            s = 0.0
            for k in range(n):
                s += own.G[i, k] * G[k, j]
            T[i, j] = s
    copy(T, own.G)


@inlined
def copy(A, B):
    """B ← A."""
    for i in range(A.shape[0]):
        for j in range(A.shape[1]):
            B[i, j] = A[i, j]


@jit
def turn(G, P, M, T):
    """M ← M + G P Gᵀ for symmetric P and M; T (nx, nx) is scratch."""
    n = P.shape[0]
    for i in range(n):
        for j in range(n):
            T[i, j] = 0.0
        for k in range(n):
            a = G[i, k]
            for j in range(n):
                T[i, j] += a * P[k, j]
    for i in range(n):
        for j in range(i + 1):
            s = M[i, j]
            for k in range(n):
                s += T[i, k] * G[j, k]
            M[i, j] = s
            M[j, i] = s


@jit
def finite(own):
    """Whether a note holds numbers."""
    total = 0.0
    for i in range(own.before.size):
        total += own.after[i]
        for j in range(own.before.size):
            total += own.G[i, j] + own.M[i, j]
    return np.isfinite(total)


@jit
def start(context, mean, cov, state):
    """As the filter's; the state that is given up is noted, and that it was."""
    head = head_of(state)
    own = own_of(head, state)
    places = noting(head[SCRATCH], context.nx, count_of(context, head[HELD]))
    covariance_of(context, own, head[HELD], places.x, places.P)
    cut(step_at(head[TAPE], head[ROW], context.nx, own.size), places.x, places.P)
    call_start(head[START], context, mean, cov, own)


@jit
def predict(context, u, dt, index, state, work):
    """As the filter's, and the note of it."""
    n = context.nx
    head = head_of(state)
    own = own_of(head, state)
    row = step_at(head[TAPE], head[ROW], n, own.size)
    if row.kind[0] == CUT:
        call_predict(head[PREDICT], context, u, dt, index, own, work)
        return
    holds = head[HELD]
    places = noting(head[SCRATCH], n, count_of(context, holds))
    x, P, C = places.x, places.P, places.C
    covariance_of(context, own, holds, x, P)
    if row.kind[0] == STAYED:
        copy(P, places.P_found)
    good = True
    if holds == MEMBERS:
        copy(ensemble(context, own), places.X)
    elif head[RULE] == POINTS:
        _, held = moments_of(own, n)
        good = take_factor(P, held, holds == FACTOR, places.crossing)
        if good:
            by_points(context, x, u, dt, places.crossing, C)
    else:
        by_tangent(context, head[RULE], x, u, dt, P, places.crossing, C)
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
    """As the filter's."""
    head = head_of(state)
    own = own_of(head, state)
    return call_update(head[UPDATE], context, u, sensor, y, index, own, work, innovation, innovation_std, score)


@jit
def describe(context, state, mean, std, cross):
    """As the filter's; each event ends with it, so the next row of the tape begins."""
    head = head_of(state)
    own = own_of(head, state)
    row = step_at(head[TAPE], head[ROW], context.nx, own.size)
    for i in range(own.size):
        row.state[i] = own[i]
    head[ROW] += 1
    ahead = step_at(head[TAPE], head[ROW], context.nx, own.size)
    ahead.kind[0] = STAYED
    call_describe(head[DESCRIBE], context, own, mean, std, cross)


class Kind(NamedTuple):
    """How a filter predicts (CONSTANT, TANGENT, POINTS; of an ensemble all one), and what its state holds."""

    rule: int
    holds: int


class Recorder:
    """The functions that note, and room for the notes of so many events."""

    def __init__(self, code: Code, kind: Kind, own: int, nx: int, members: int, rows: int) -> None:
        """`code` is the filter's, `own` how many numbers its state has; `members` is 0 unless it is an ensemble."""
        self._each = size_of(step, nx, own)
        self._tape = np.zeros((rows + 1) * self._each)
        self._scratch = np.full(size_of(noting, nx, members), np.nan)
        self._head = np.zeros(HEAD, np.int64)
        self._head[[START, PREDICT, UPDATE, DESCRIBE]] = code
        self._head[[OWN, RULE, HELD]] = own, *kind
        self._head[[TAPE, SCRATCH]] = self._tape.ctypes.data, self._scratch.ctypes.data
        self._nx, self._own = nx, own
        self.code = Code(
            address(start, start_signature),
            address(predict, predict_signature),
            address(update, update_signature),
            address(describe, describe_signature),
        )

    @property
    def tape(self) -> int:
        """The address of the rows."""
        return self._tape.ctypes.data

    def around(self, state: np.ndarray) -> np.ndarray:
        """A recorder's state around that of a filter."""
        # An address is less than 2^53, and so the same as a float64.
        return np.append(state, float(self._head.ctypes.data))

    def begin(self, row: int) -> None:
        """Note the next event in a row of the tape."""
        self._head[ROW] = row
        self._tape[row * self._each] = STAYED
