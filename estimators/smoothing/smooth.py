"""The smoother: over a fold's snapshots backward, each stretch between two of them folded again with notes taken.

It works on what the fold did, reading by reading: refused, weighted, adapted, let in again. What is kept at a time are
the fold's snapshots and the notes of one stretch, whatever the log's length.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from ..errors import EstimatorError
from ..estimator import Estimator
from ..fold import Fold
from ..gate.stories import BELIEVED, REOPENED
from ..log import MAINTENANCE, MARK, RESET, TICK, TRUTH
from ..model.state_space import StateSpaceModel
from ..numerics.workspace import size_of
from ..snapshots import Snapshot
from ..track import Track
from .backward import NOWHERE, Moments, backward, note_queries, step_back, tell
from .cross_covariance import CONSTANT, POINTS, TANGENT
from .jumps import changed, widened
from .recorder import COVARIANCE, FACTOR, MEMBERS, Kind, Recorder, Step, step

NOTES = 32 * 2**20
"""Bytes that the notes of one stretch may take; at least one event is noted at a time."""

FEWEST = 512
"""Events of a stretch, where its notes have room: the snapshots of the last events are closer than it pays."""

QUERIES = (TRUTH, TICK, MARK)

KINDS = {
    "kf": Kind(CONSTANT, COVARIANCE),
    "kf-steady": Kind(CONSTANT, COVARIANCE),
    "ekf": Kind(TANGENT, COVARIANCE),
    "iekf": Kind(TANGENT, COVARIANCE),
    "ukf": Kind(POINTS, COVARIANCE),
    "ckf": Kind(POINTS, COVARIANCE),
    "sr-kf": Kind(CONSTANT, FACTOR),
    "sr-ekf": Kind(TANGENT, FACTOR),
    "sr-ukf": Kind(POINTS, FACTOR),
    **dict.fromkeys(("enkf", "etkf", "ensrf", "letkf"), Kind(TANGENT, MEMBERS)),
}
"""By filter."""


class Smoothed(NamedTuple):
    """What all readings say of the state at each event of a fold: columns of one length N, as `Track` has them.

    mean, std (N, shown); cross (N, pairs).
    """

    mean: np.ndarray
    std: np.ndarray
    cross: np.ndarray

    def instead_of(self, track: Track) -> Track:
        """The fold's track with these moments in the place of its own."""
        return track._replace(mean=self.mean, std=self.std, cross=self.cross)


class Stretch(NamedTuple):
    """Events from row `start` to `stop` that are folded in one go; `sensor` is let in at the first, after a widening.

    `state` begins again at the first event, the only one; -1 for none, of either.
    """

    start: int
    stop: int
    sensor: int = -1
    state: int = -1


def check_smooth(estimator: Estimator, model: StateSpaceModel, options: Mapping[str, float | str]) -> None:
    """Refuse a filter whose estimates of a model cannot be smoothed.

    Raises:
        EstimatorError: With the reason.
    """
    if estimator.name not in KINDS:
        raise EstimatorError(f"{estimator.name} cannot be smoothed; use {', '.join(KINDS)}")
    if model.black_box:
        raise EstimatorError(f"{estimator.name} cannot be smoothed: {model.name} is a black box, which is not compiled")
    if KINDS[estimator.name].holds == MEMBERS:
        members = int(estimator.complete(options)["members"])
        if members < model.nx + 2:
            raise EstimatorError(
                f"{estimator.name} cannot be smoothed: the covariance of {members} members of {model.name} with its "
                f"{model.nx:,} states has no inverse; give at least {model.nx + 2:,} members, better several times that"
            )


def smooth(fold: Fold) -> Smoothed:
    """Smooth what a fold has folded; the fold itself stays as it is.

    Raises:
        EstimatorError: If there is no smoother for its filter.
    """
    check_smooth(fold.estimator, fold.model, fold.options)
    return _Smoother(fold).smoothed()


class _Smoother:
    """The work on one fold."""

    def __init__(self, fold: Fold) -> None:
        self._fold, self._machine, self._log = fold, fold.machine, fold.log
        n, own = fold.model.nx, fold.machine.fresh().state.size
        kind = KINDS[fold.estimator.name]
        self._holds, members = kind.holds, 0
        if kind.holds == MEMBERS:
            members = int(fold.options["members"])
        first, names = fold.log.first, fold.model.sensor_names
        told = [decision for decision in fold.decisions if decision.outcome in (REOPENED, BELIEVED)]
        self._stories = [Stretch(d.first - first, d.row - first + 1, sensor=names.index(d.sensor)) for d in told]
        self._most = max(1, NOTES // (8 * size_of(step, n, own)))
        room = min(self._most, fold.n)
        longest = max((story.stop - story.start for story in self._stories), default=1)
        self._recorder = Recorder(self._machine.code, kind, own, n, members, max(room, longest))
        self._scratch = np.empty((3, n, n))
        self._earlier = Moments(*fold.moments())
        self._later = Moments(np.empty(n), np.empty((n, n)))
        self._after = NOWHERE
        shape = (fold.n, len(fold.model.shown))
        self._out = Smoothed(np.empty(shape), np.empty(shape), np.empty((fold.n, len(fold.pairs))))

    def smoothed(self) -> Smoothed:
        """Every row."""
        stations = self._stations()
        for start, stop in reversed(list(zip(stations, stations[1:], strict=False))):
            self._between(start, stop)
        return self._out

    def _stations(self) -> list[int]:
        """Rows with a snapshot before them, between which to go back; the first, and the end."""
        first, n = self._log.first, self._fold.n
        chosen = [n]
        for row in reversed([at - first for at in self._fold.snapshots.places]):
            # Within a story that was told again the snapshots are those of the first.
            told = any(story.start < row < story.stop for story in self._stories)
            if row == 0 or (not told and chosen[-1] - row >= min(FEWEST, self._most)):
                chosen.append(row)
        return chosen[::-1]

    def _stretches(self, start: int, stop: int) -> list[Stretch]:
        """The rows between two stations in pieces that are folded in one go, and for whose notes there is room."""
        kind, channel = self._log.kind, self._log.channel
        apart = [story for story in self._stories if start <= story.start < stop]
        apart += [
            Stretch(row, row + 1, state=int(channel[row]))
            for row in (start + np.flatnonzero(kind[start:stop] == MAINTENANCE)).tolist()
            if not any(story.start <= row < story.stop for story in self._stories)
        ]
        parts, at = [], start
        for part in [*sorted(apart), Stretch(stop, stop)]:
            edges = [*range(at, part.start, self._most), part.start]
            parts += [Stretch(a, b) for a, b in zip(edges, edges[1:], strict=False)]
            parts += [part] if part.start < stop else []
            at = part.stop
        return parts

    def _between(self, start: int, stop: int) -> None:
        """Smooth the rows between two stations, in batches for whose notes there is room."""
        batches: list[list[Stretch]] = []
        for part in self._stretches(start, stop):
            if batches and part.stop - batches[-1][0].start <= self._most:
                batches[-1].append(part)
            else:
                batches.append([part])
        self._batches(batches, self._fold.snapshots[self._log.first + start].copy())

    def _batches(self, batches: list[list[Stretch]], now: Snapshot) -> None:
        """Smooth batches from the last to the first; of the states before them no more are kept than there is room."""
        if len(batches) == 1:
            self._batch(batches[0], now)
            return
        each = -(-len(batches) // max(2, NOTES // now.state.nbytes))
        groups = [batches[k : k + each] for k in range(0, len(batches), each)]
        begins = [now.copy()]
        for group in groups[:-1]:
            for part in [part for batch in group for part in batch]:
                self._fold_on(part, now)
            begins.append(now.copy())
        for group, begin in zip(reversed(groups), reversed(begins), strict=True):
            self._batches(group, begin)

    def _batch(self, parts: list[Stretch], now: Snapshot) -> None:
        """Smooth stretches: forward with notes, then back."""
        first = parts[0].start
        noted = []
        for part in parts:
            before = now.copy()
            noted.append((part, before, self._fold_on(part, now, part.start - first)))
        for part, before, jump in reversed(noted):
            self._back(part, part.start - first, before, jump)

    def _fold_on(self, part: Stretch, now: Snapshot, row: int | None = None) -> Step | None:
        """Fold a stretch, noted from a row of the tape on if one is given; the note of what happened from outside."""
        machine = self._machine
        if part.sensor >= 0:
            begun = machine.moments(now.state)
            added = machine.widen(now, part.sensor, self._fold.track.innovation[part.start])
            with machine.open(part.sensor):
                self._run(part, now, row)
            return widened(*begun, added)
        spare = self._run(part, now, row)
        if part.state < 0:
            return None
        mean, cov = machine.moments(spare)
        machine.maintain(mean, cov, part.state, int(self._log.t[part.start]), now)
        return changed(mean, cov, machine.prior[1], part.state)

    def _run(self, part: Stretch, now: Snapshot, row: int | None) -> np.ndarray:
        """Fold events; the state from which the last query was answered."""
        if row is None:
            return self._machine.run_apart(self._log, part.start, part.stop, now)[1]
        noting = now._replace(state=self._recorder.around(now.state, row))
        _, spare = self._machine.run_apart(self._log, part.start, part.stop, noting, code=self._recorder.code)
        now.state[:] = noting.state[:-1]
        return spare[:-1]

    def _back(self, part: Stretch, row: int, before: Snapshot, jump: Step | None) -> None:
        """Go back over a stretch whose notes begin at a row of the tape."""
        log, context, recorder = self._log, self._machine.context, self._recorder
        rows = slice(part.start, part.stop)
        kind, columns = log.kind[rows], [column[rows] for column in self._out]
        if part.state >= 0:
            # What is shown stands behind the change, and the note leads to what was before it.
            assert jump is not None
            tell(context, *self._earlier, *(column[0] for column in columns))
            step_back(context, jump, *self._earlier, *self._scratch[:2])
            kind, columns = np.full(1, RESET, np.int8), [np.empty_like(column) for column in columns]
        elif np.isin(kind, QUERIES).any():
            note_queries(
                recorder.code, context, row, log.t[rows], kind, log.value[rows], int(before.clock[0]), before.u.copy(),
                self._after, self._holds, recorder.around(before.state, row), self._machine.work, recorder.tape,
                before.state.size,
            )  # fmt: skip
        backward(
            context, row, kind, recorder.tape, before.state.size, self._earlier, self._later, self._scratch, *columns
        )
        told = np.flatnonzero(~np.isin(log.kind[rows], QUERIES))
        if told.size:
            ahead = part.start + int(told[0])
            self._after = int(log.t[ahead]) if log.kind[ahead] != RESET else NOWHERE
        if part.sensor >= 0:
            assert jump is not None
            step_back(context, jump, *self._earlier, *self._scratch[:2])
            self._after = NOWHERE
