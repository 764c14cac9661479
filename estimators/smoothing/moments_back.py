"""Go back over a fold by means and covariances: the Rauch-Tung-Striebel smoother over the notes of a recorder.

A query between two events has a note of its own, from its answer to the later of the two, and does not change the way
back.

Sources: Rauch, Tung & Striebel (1965), doi:10.2514/3.3166; Särkkä, Bayesian Filtering and Smoothing (2013), theorems
8.2 and 9.1.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import types

from ..compiled.context import context_type
from ..estimator import (
    MEMBERS,
    SmoothingRule,
    code_type,
    describe_signature,
    predict_signature,
    start_signature,
    update_signature,
)
from ..fold import Fold
from ..fold_kernel import advance_to, asks
from ..gaussian.shared import tell
from ..interpreted.fold_loop import UNSET
from ..log import INPUT, RESET
from ..numerics.jit import B1, F1, F2, I1, CPUDispatcher, borrowed, i64, inlined, jit
from ..numerics.linalg import copy, copy_vector
from ..numerics.workspace import size_of
from ..snapshots import Snapshot
from .notes import STAYED, StepNote, changed, cut, join_moments, step_at, step_back, step_layout, widened
from .recorder import (
    ROW,
    StepRecorder,
    covariance_of,
    describe,
    head_of,
    predict,
    start,
    update,
)
from .walk import QUERIES, Smoothed, StateJump, Stretch

HERE = 3  # Kind of a query's note: asked at the time of the state before it. STAYED: at that of the next event
NOWHERE = -(2**63)  # In place of the time of the event after a query: there is none, or its state is unrelated


class Moments(NamedTuple):
    """A mean (n,) and a covariance (n, n)."""

    x: np.ndarray
    P: np.ndarray


@inlined
def note_query(code, context, row, t, clock, following, u, holds, state, work, tape, own):
    """Note the step from the answer to a query to the time of the event after it."""
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
            copy_vector(note.state, state)
            head = head_of(state)
            head[ROW] = row
            advance_to(code, context, u, t, following, row, state, work)


@jit
def note_queries(code, context, first, t, kind, value, clock, u, after, holds, state, work, tape, own):
    """Note for each query among events the step from its answer to the next event that is no query.

    Args:
        code: The recorder's functions.
        context: The context.
        first: The row of the tape of the first event.
        t: Times of the events (N,), ns.
        kind: Their kinds (N,).
        value: Their values.
        clock: Time of the state before the first, ns.
        u: Inputs before the first (nu,); changed.
        after: Time of the first later event that is no query, or NOWHERE.
        holds: Form of the covariance: COVARIANCE, FACTOR, MEMBERS.
        state: A recorder's state; changed.
        work: Scratch of the filter.
        tape: Address of the tape.
        own: Length of the filter's state.
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
def backward(context, first, kind, tape, own, earlier, later, work, mean, std, cross, lag):
    """Fill the rows of N events from the last to the first.

    Args:
        context: The context.
        first: The row of the tape of the first event.
        kind: The events' kinds (N,).
        tape: Address of the tape.
        own: Length of the filter's state.
        earlier: The smoothed state after the last event that is no query; on return before the first.
        later: That of the first later event that is no query; on return of the first of these.
        work: Scratch, three times `earlier`.
        mean: (N, shown).
        std: (N, shown).
        cross: (N, pairs).
        lag: (N, nx, nx), or (0, nx, nx) for none: for each event that is no query the covariance of the smoothed states
            before and after it; NaN where no step relates them.
    """
    n = context.nx
    kind, mean, std, cross, lag = borrowed(kind), borrowed(mean), borrowed(std), borrowed(cross), borrowed(lag)
    earlier = Moments(borrowed(earlier.x), borrowed(earlier.P))
    later = Moments(borrowed(later.x), borrowed(later.P))
    work = borrowed(work)
    T, S, Q = work[0], work[1], work[2]
    x = np.empty(n)
    for i in range(kind.size - 1, -1, -1):
        note = step_at(tape, first + i, n, own)
        if asks(kind[i]):
            if note.kind[0] == HERE:
                tell(context, earlier.x, earlier.P, mean[i], std[i], cross[i])
            else:
                copy_vector(later.x, x)
                copy(later.P, Q)
                step_back(context, note, x, Q, T, S)
                tell(context, x, Q, mean[i], std[i], cross[i])
            continue
        tell(context, earlier.x, earlier.P, mean[i], std[i], cross[i])
        copy_vector(earlier.x, later.x)
        copy(earlier.P, later.P)
        if lag.shape[0] > 0:
            join_moments(note, earlier.P, lag[i])
        step_back(context, note, earlier.x, earlier.P, T, S)


class MomentsBack:
    """Fills `out` on its way; see `Notes`."""

    def __init__(self, fold: Fold, kind: SmoothingRule, out: Smoothed, lag: np.ndarray | None = None) -> None:
        """`lag` (N, nx, nx) takes the covariances of neighbours, see `backward`."""
        n = fold.model.nx
        self._log, self._machine, self._kind, self._out = fold.log, fold.machine, kind, out
        self._members = int(fold.options["members"]) if kind.holds == MEMBERS else 0
        self._nx, self._own = n, fold.machine.fresh().state.size
        self.each = 8 * size_of(step_layout, n, self._own)
        self._scratch = np.empty((3, n, n))
        self._earlier = Moments(*fold.moments())
        self._later = Moments(np.empty(n), np.empty((n, n)))
        self._after = NOWHERE
        self._lag = np.empty((0, n, n)) if lag is None else lag

    def room(self, events: int) -> None:
        """See `Notes`."""
        self._recorder = StepRecorder(self._machine.code, self._kind, self._own, self._nx, self._members, events)

    def forward(self, part: Stretch, now: Snapshot, row: int) -> np.ndarray:
        """See `Notes`."""
        self._recorder.begin(row)
        noting = now._replace(state=self._recorder.around(now.state))
        code = self._recorder.code
        _, spare = self._machine.run_apart(self._log, part.start, part.stop, noting, code, judged=False)
        now.state[:] = noting.state[:-1]
        return spare[:-1]

    def back(self, part: Stretch, row: int, before: Snapshot, jump: StateJump | None) -> None:
        """See `Notes`."""
        log, machine, recorder = self._log, self._machine, self._recorder
        context = machine.context
        rows = slice(part.start, part.stop)
        kind, columns = log.kind[rows], [column[rows] for column in self._out]
        if jump is not None and jump.state >= 0:
            # What is shown stands behind the change, and the note leads to what was before it.
            tell(context, *self._earlier, *(column[0] for column in columns))
            note = changed(jump.mean, jump.cov, machine.prior[1], jump.state)
            step_back(context, note, *self._earlier, *self._scratch[:2])
            kind, columns = np.full(1, RESET, np.int8), [np.empty_like(column) for column in columns]
        elif np.isin(kind, QUERIES).any():
            note_queries(
                recorder.code, context, row, log.t[rows], kind, log.value[rows], int(before.clock[0]), before.u.copy(),
                self._after, self._kind.holds, recorder.around(before.state), machine.work, recorder.tape,
                self._own,
            )  # fmt: skip
        moments = self._earlier, self._later, self._scratch
        backward(context, row, kind, recorder.tape, self._own, *moments, *columns, self._lag[rows])
        told = np.flatnonzero(~np.isin(log.kind[rows], QUERIES))
        if told.size:
            ahead = part.start + int(told[0])
            self._after = int(log.t[ahead]) if log.kind[ahead] != RESET else NOWHERE
        if jump is not None and jump.added is not None:
            note = widened(jump.mean, jump.cov, jump.added)
            step_back(context, note, *self._earlier, *self._scratch[:2])
            self._after = NOWHERE


_F3 = types.Array(types.float64, 3, "C")
_moments = types.NamedTuple((F1, F2), Moments)


_step = types.NamedTuple((F1, F1, F1, F2, F2, F1, i64), StepNote)


PIECES: tuple[tuple[CPUDispatcher, tuple[types.Type, ...]], ...] = (
    (predict, predict_signature.args),
    (start, start_signature.args),
    (update, update_signature.args),
    (describe, describe_signature.args),
    (backward, (context_type, i64, B1, i64, i64, _moments, _moments, _F3, F2, F2, F2, _F3)),
    (note_queries, (code_type, context_type, i64, I1, B1, F2, i64, F1, i64, i64, F1, F1, i64, i64)),
    (step_back, (context_type, _step, F1, F2, F2, F2)),
    (tell, (context_type, F1, F2, F1, F1, F1)),
)
"""Functions that smoothing compiles and the types of their arguments, slowest first; see estimators/pieces.py."""
