"""Notes of the steps of a fold, and the arithmetic of going back over them.

For each event a note relates the state before it to the state after it. If x is the state before and x⁻ its prediction,
then given all measurements up to x

    x | x⁻ ~ N(m + G (x⁻ - m⁻), M),     G = C (P⁻)⁻¹,     M = P - C (P⁻)⁻¹ Cᵀ,     C = Cov(x, x⁻)

independently of all later measurements, which depend on x⁻ alone. So an update with its gate, weights and iterations
need not be noted. Steps within one event are joined: G ← G g, M ← M + G m Gᵀ. Going back,

    xˢ ← m + G (xˢ - m⁻),     Pˢ ← M + G Pˢ Gᵀ

Sources: Rauch, Tung & Striebel (1965), doi:10.2514/3.3166; Särkkä, Bayesian Filtering and Smoothing (2013), theorems
8.2, 9.1 and 12.4.
"""

from __future__ import annotations

import numpy as np

from ..compiled.context import circular_states
from ..events.maintenance import without
from ..gaussian.shared import wrap_mean
from ..numerics.jit import inlined, jit
from ..numerics.linalg import copy, copy_vector, multiply, root, wrap
from ..numerics.workspace import declare_layout

STAYED, MOVED, CUT = range(3)  # Effect of an event on the state before any update: none; predicted; restarted or lost


StepNote, step_layout = declare_layout(
    "StepNote", "n, own", kind="1", before="n", after="n", G="n, n", M="n, n", state="own"
)
"""Note of one event: STAYED, MOVED or CUT; mean m of the state before the event; its prediction m⁻; G; M, after a cut
all of P; the filter's state after the event (`own` numbers), or the answer to a query."""


@inlined
def step_at(tape, row, n, own):
    """Return a note of a tape that begins at an address."""
    first = step_layout(0, n, own)
    return step_layout(tape + row * first.end, n, own)


@inlined
def solve_semidefinite(U, C, W):
    """W ← U⁻ᵀ Cᵀ;  C ← C (Uᵀ U)⁻¹; a zero row of U contributes to neither."""
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
def cut(own, x, P):
    """Note that later measurements carry no information on the state N(x, P) before the event."""
    own.kind[0] = CUT
    own.G[:] = 0.0
    copy(P, own.M)
    copy_vector(x, own.before)
    copy_vector(x, own.after)


@jit
def join(own, x, P, after, G, W, T):
    """Append a step from N(x, P) to the mean `after`, of this G and M = P - Wᵀ W, to the note of the event so far."""
    n = x.size
    copy_vector(after, own.after)
    for i in range(n):
        for j in range(i + 1):
            s = P[i, j]
            for k in range(n):
                s -= W[k, i] * W[k, j]
            P[i, j] = s
            P[j, i] = s
    if own.kind[0] == STAYED:
        own.kind[0] = MOVED
        copy_vector(x, own.before)
        copy(G, own.G)
        copy(P, own.M)
        return
    turn(own.G, P, own.M, T)
    multiply(own.G, n, G, T)
    copy(T, own.G)


@jit
def finite(own):
    """Return whether all numbers of a note are finite."""
    total = 0.0
    for i in range(own.before.size):
        total += own.after[i]
        for j in range(own.before.size):
            total += own.G[i, j] + own.M[i, j]
    return np.isfinite(total)


@jit
def turn(G, P, M, T):
    """M ← M + G P Gᵀ for symmetric P and M; T (nx, nx) is scratch."""
    n = P.shape[0]
    multiply(G, n, P, T)
    for i in range(n):
        for j in range(i + 1):
            s = M[i, j]
            for k in range(n):
                s += T[i, k] * G[j, k]
            M[i, j] = s
            M[j, i] = s


def changed(mean: np.ndarray, cov: np.ndarray, prior: np.ndarray, state: int) -> tuple:
    """Return the note of a maintenance: one state of N(mean, cov) restarts with the prior's variance, uncorrelated."""
    C = cov.copy()
    C[:, state] = 0.0
    return _note(mean, cov, without(cov, prior, state), C)


def widened(mean: np.ndarray, cov: np.ndarray, added: np.ndarray) -> tuple:
    """Return the note of a widened covariance: variances (nx,) are added to those of N(mean, cov)."""
    return _note(mean, cov, cov + np.diag(added), cov.copy())


def _note(mean: np.ndarray, cov: np.ndarray, after: np.ndarray, C: np.ndarray) -> tuple:
    """Return the note of a change that keeps the mean; C (nx, nx) is the covariance of the states before and after."""
    n = mean.size
    U, W = np.zeros((n, n)), np.zeros((n, n))
    nothing = np.zeros(0)
    if not root(after, U, n):
        return StepNote(np.array([float(CUT)]), mean, mean, np.zeros((n, n)), cov, nothing, 0)
    solve_semidefinite(U, C, W)
    return StepNote(np.array([float(MOVED)]), mean, mean, C, cov - W.T @ W, nothing, 0)


@jit
def step_back(context, note, x, P, T, S):
    """Go back over a step: from the moments after it to those before it, in place; T and S (nx, nx) are scratch."""
    n = x.size
    if note.kind[0] == STAYED:
        return
    if note.kind[0] == CUT:
        copy_vector(note.before, x)
        copy(note.M, P)
        return
    circular = circular_states(context)
    off = S[0]
    for i in range(n):
        off[i] = x[i] - note.after[i]
        if circular[i] != 0:
            off[i] = wrap(off[i])
    for i in range(n):
        s = note.before[i]
        for j in range(n):
            s += note.G[i, j] * off[j]
        x[i] = s
    wrap_mean(context, x)
    copy(note.M, S)
    turn(note.G, P, S, T)
    copy(S, P)


@jit
def join_moments(note, P, out):
    """out ← Cov(x, x⁺ | y) = G P, of the smoothed states before and after a step, P that after it.

    Source: Särkkä, Bayesian Filtering and Smoothing (2013), theorem 12.4 and (12.49).
    """
    if note.kind[0] == MOVED:
        multiply(note.G, P.shape[0], P, out)
    elif note.kind[0] == STAYED:
        copy(P, out)
    else:
        out[:] = np.nan
