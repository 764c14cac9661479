"""Back over a fold by means and covariances: the Rauch-Tung-Striebel smoother, in the form of recorder.py."""

from __future__ import annotations

import numpy as np

from ..fold import Fold
from ..log import RESET
from ..numerics.workspace import size_of
from ..snapshots import Snapshot
from .backward import NOWHERE, Moments, backward, note_queries, step_back, tell
from .jumps import changed, widened
from .recorder import MEMBERS, Kind, Recorder, step
from .smoothed import Smoothed
from .walk import QUERIES, Jump, Stretch


class MomentsBack:
    """Fills `out` on its way; see `Notes`."""

    def __init__(self, fold: Fold, kind: Kind, out: Smoothed, lag: np.ndarray | None = None) -> None:
        """`lag` (N, nx, nx) takes the covariances of neighbours, see `backward`."""
        n = fold.model.nx
        self._log, self._machine, self._kind, self._out = fold.log, fold.machine, kind, out
        self._members = int(fold.options["members"]) if kind.holds == MEMBERS else 0
        self._nx, self._own = n, fold.machine.fresh().state.size
        self.each = 8 * size_of(step, n, self._own)
        self._scratch = np.empty((3, n, n))
        self._earlier = Moments(*fold.moments())
        self._later = Moments(np.empty(n), np.empty((n, n)))
        self._after = NOWHERE
        self._lag = np.empty((0, n, n)) if lag is None else lag

    def room(self, events: int) -> None:
        """See `Notes`."""
        self._recorder = Recorder(self._machine.code, self._kind, self._own, self._nx, self._members, events)

    def take(self, part: Stretch, now: Snapshot, row: int) -> np.ndarray:
        """See `Notes`."""
        self._recorder.begin(row)
        noting = now._replace(state=self._recorder.around(now.state))
        _, spare = self._machine.run_apart(self._log, part.start, part.stop, noting, code=self._recorder.code)
        now.state[:] = noting.state[:-1]
        return spare[:-1]

    def back(self, part: Stretch, row: int, before: Snapshot, jump: Jump | None) -> None:
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
