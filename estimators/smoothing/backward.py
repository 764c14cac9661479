"""Backward over the notes of a recorder: the smoothed state at each event, of the readings before and after it.

    xˢ ← m + G (xˢ - m⁻),     Pˢ ← M + G Pˢ Gᵀ

from the smoothed state at an event to that at the one before, where M = P - G P⁻ Gᵀ. A query between two of them does
not stand on the way: it has a note of its own, of how its answer goes on to the later of the two.

Sources: Rauch, Tung & Striebel (1965), doi:10.2514/3.3166; Särkkä, Bayesian Filtering and Smoothing (2013), theorems
8.2 and 9.1.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ..compiled.context import circular_states, shown_states
from ..fold_kernel import advance_to, asks
from ..gaussian.shared import wrap_mean
from ..interpreted.fold_loop import UNSET
from ..log import INPUT, RESET
from ..numerics.jit import inlined, ints, jit
from ..numerics.linalg import wrap
from .recorder import CUT, MOVED, ROW, STAYED, copy, covariance_of, cut, head_of, step_at, turn

HERE = 3
"""Of a query: it was asked at the time of the state before it. STAYED: at that of the next event, whose state it is."""

NOWHERE = -(2**63)
"""In place of the time of the event after a query: there is none, or it does not go on from the state."""


class Moments(NamedTuple):
    """A mean (n,) and a covariance (n, n)."""

    x: Any
    P: Any


@inlined
def note_query(code, context, row, t, clock, following, u, holds, state, work, tape, own):
    """Note how the answer to a query goes on to the time of the event after it."""
    n = context.nx
    note = step_at(tape, row, n, own)
    if t == clock:
        note.kind[0] = HERE
    elif following == NOWHERE:
        x, P = np.empty(n), np.empty((n, n))
        covariance_of(context, note.state, holds, x, P)
        cut(note, x, P)
    else:
        note.kind[0] = STAYED
        if t < following:
            for j in range(own):
                state[j] = note.state[j]
            head = head_of(state)
            head[ROW] = row
            advance_to(code, context, u, t, following, row, state, work)


@jit
def note_queries(code, context, first, t, kind, value, clock, u, after, holds, state, work, tape, own):
    """Note for each query among events how its answer goes on to the next event that is none.

    Args:
        code: The recorder's functions.
        context: The context.
        first: The row of the tape of the first event.
        t: Times of the events (N,), ns.
        kind: Their kinds (N,).
        value: Their values.
        clock: Time of the state before the first, ns.
        u: Inputs before the first (nu,); changed.
        after: Time of the first event behind these that is no query, or NOWHERE.
        holds: What the filter's state holds: COVARIANCE, FACTOR, MEMBERS.
        state: A recorder's state; changed.
        work: Scratch of the filter.
        tape: Address of the tape.
        own: Numbers of the filter's state.
    """
    n = t.size
    if clock == UNSET and n > 0:
        clock = t[0]
    following = after
    ahead = -1
    for i in range(n):
        if asks(kind[i]):
            if ahead < i:
                ahead = i
                while ahead < n and asks(kind[ahead]):
                    ahead += 1
                following = after
                if ahead < n:
                    following = t[ahead] if kind[ahead] != RESET else NOWHERE
            note_query(code, context, first + i, t[i], clock, following, u, holds, state, work, tape, own)
            continue
        clock = t[i]
        if kind[i] == INPUT:
            for j in range(u.size):
                if np.isfinite(value[i, j]):
                    u[j] = value[i, j]


@jit
def step_back(context, note, x, P, T, S):
    """From the moments behind a step to those before it, in place; T and S (nx, nx) are scratch."""
    n = x.size
    if note.kind[0] == STAYED:
        return
    if note.kind[0] == CUT:
        for i in range(n):
            x[i] = note.before[i]
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
    """out ← Cov(x, x⁺ | y) = G P, of the smoothed states before and behind a step, P that behind it.

    Source: Särkkä, Bayesian Filtering and Smoothing (2013), theorem 12.4 and (12.49).
    """
    n = P.shape[0]
    for i in range(n):
        for j in range(n):
            if note.kind[0] == MOVED:
                s = 0.0
                for k in range(n):
                    s += note.G[i, k] * P[k, j]
                out[i, j] = s
            else:
                out[i, j] = P[i, j] if note.kind[0] == STAYED else np.nan


@jit
def tell(context, x, P, mean, std, cross):
    """Mean, standard deviation and the configured covariances, as the track has them."""
    shown = shown_states(context)
    for k in range(mean.size):
        i = shown[k]
        mean[k] = x[i]
        std[k] = np.sqrt(P[i, i]) if P[i, i] >= 0.0 else np.nan
    pairs = ints(context.pairs, 2 * context.n_pairs)
    for k in range(cross.size):
        cross[k] = P[pairs[2 * k], pairs[2 * k + 1]]


@jit
def backward(context, first, kind, tape, own, earlier, later, work, mean, std, cross, lag):
    """Fill the rows of N events from the last to the first.

    Args:
        context: The context.
        first: The row of the tape of the first event.
        kind: The events' kinds (N,).
        tape: Address of the tape.
        own: Numbers of the filter's state.
        earlier: The smoothed state behind the last event that is no query; on return before the first.
        later: That of the first event behind these that is no query; on return of the first of these.
        work: Scratch, three times `earlier`.
        mean: (N, shown).
        std: (N, shown).
        cross: (N, pairs).
        lag: (N, nx, nx), or (0, nx, nx) for none: of each event that is no query the covariance of the state that it
            found and the state behind it, both smoothed; NaN where nothing joins them.
    """
    n = context.nx
    T, S, Q = work[0], work[1], work[2]
    x = np.empty(n)
    for i in range(kind.size - 1, -1, -1):
        note = step_at(tape, first + i, n, own)
        if asks(kind[i]):
            if note.kind[0] == HERE:
                tell(context, earlier.x, earlier.P, mean[i], std[i], cross[i])
            else:
                for j in range(n):
                    x[j] = later.x[j]
                copy(later.P, Q)
                step_back(context, note, x, Q, T, S)
                tell(context, x, Q, mean[i], std[i], cross[i])
            continue
        tell(context, earlier.x, earlier.P, mean[i], std[i], cross[i])
        for j in range(n):
            later.x[j] = earlier.x[j]
        copy(earlier.P, later.P)
        if lag.shape[0] > 0:
            join_moments(note, earlier.P, lag[i])
        step_back(context, note, earlier.x, earlier.P, T, S)
