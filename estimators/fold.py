"""The fold: an estimator applied to the events of a log. Live, replay, retuning and review all run this function.

    track = fold(estimator, model, tuning, log)

The same log, tuning and seed give the same bits, however the events were cut into batches. The fold releases the GIL,
so that a model function that never returns does not block the interpreter.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from .compiled.model import CompiledModel
from .diagnostics.field_pictures import Pictures
from .diagnostics.health import HealthPolicy
from .diagnostics.score import spread_ratio
from .errors import EstimatorError, ModelError
from .estimator import Estimator
from .events.maintenance import versions_dropped
from .fold_checks import check_base, check_log, check_pairs, check_prior, check_soft, check_tuning
from .fold_machine import Machine, Moments, variances_of
from .gate.isolation import Decision, decide
from .log import BEFORE, MAINTENANCE, MARK, TICK, TRUTH, Events, Log
from .model.state_space import StateSpaceModel
from .numerics.peaks import Peak
from .registry import find_estimator
from .snapshots import Base, Blank, Snapshot, Snapshots, Story
from .track import Track
from .tuning import Tuning


class Fold:
    """Incremental fold: it follows a growing log, and can be rewound to any event."""

    def __init__(
        self,
        estimator: str,
        model: StateSpaceModel,
        tuning: Tuning,
        log: Log,
        *,
        pairs: np.ndarray | None = None,
        policy: HealthPolicy | None = None,
        base: Base | None = None,
        picture: float | None = None,
        prior: tuple[np.ndarray, np.ndarray] | None = None,
        expected: np.ndarray | None = None,
        idle: bool = False,
        room: int = 0,
    ) -> None:
        """Prepare the fold; `advance` folds events.

        Args:
            estimator: Name in the registry.
            model: Model of the log; compiled on first use.
            tuning: Noise, parameters, gate, options.
            log: Events; the fold follows the log as it grows.
            pairs: Pairs of states whose covariance the track keeps, shape (k, 2).
            policy: Thresholds of health.
            base: Start of the fold if events before the log's first were dropped; None for the prior. The estimator
                that left the base resumes its full state, also under another tuning, unless an option changed the size
                of the state; any other estimator starts from mean and covariance.
            picture: Seconds of the log between two pictures of a large field; None takes only pictures with a score.
            prior: Mean (nx,) and covariance (nx, nx), positive semidefinite, in place of the model's; beyond `LARGE`
                states the variances (1, nx). It holds at the log's start and after a reset.
            expected: Sensors that must report, (sensors,) of bool; None for those that have reported.
            idle: Fold no events and compile nothing: a placeholder until the estimator is compiled. Its moments are
                those of the start.
            room: Rows to allocate for the track, if the log has a smaller capacity.

        Raises:
            EstimatorError: If the estimator does not exist or does not apply, an option is out of range, or log,
                tuning, pairs, base or prior do not fit the model.
            EventError: If an event does not fit the model.
            ModelError: If the model's functions contradict its declaration.
        """
        self.estimator: Estimator = find_estimator(estimator, model)
        self.model, self.tuning, self.log = model, tuning, log
        self.pairs = check_pairs(pairs, model)
        check_tuning(tuning, model)
        prior = None if prior is None else check_prior(prior, model, self.estimator)
        self.policy = policy or HealthPolicy()
        self.options = self.estimator.complete_for(model, tuning.options)
        check_soft(tuning, self.estimator, self.options)
        self.n, self._checked = 0, -1
        self._check_log()
        self.machine = Machine(
            self.estimator, self.options, model, tuning, self.pairs, self.policy, prior=prior, expected=expected
        )
        """Estimator, context and scratch of this fold."""
        self.marginal, self.gate_limits = self.machine.marginal, self.machine.gate_limits
        self.decisions: list[Decision] = []
        """Decisions on sensors that stayed rejected, see gate/."""
        self._now = self.machine.fresh()
        self._spare = np.empty_like(self._now.state)
        self.idle, self._start = idle, self.machine.prior if base is None else (base.mean, base.cov)
        if base is not None:
            check_base(base, model)
        if idle:
            self._now.state[:] = 0.0
        elif base is not None:
            self.machine.begin_at(base, self._now)
        else:
            self.machine.begin(*self.machine.prior, self._now.state)
            if log.start != BEFORE:
                self._now.clock[0] = log.start
        self.snapshots = Snapshots(self._now.state.nbytes)
        """Snapshots to which the fold can be rewound."""
        self.pictures = Pictures(model.grid, picture) if model.grid is not None else None
        self._asked = -1
        self._remember(self._now.copy())
        self._rows = self.machine.rows(max(log.capacity, room))

    @property
    def events(self) -> Events:
        """Views of the events that are folded."""
        return self.log.events.select(slice(0, self.n))

    @property
    def track(self) -> Track:
        """Rows folded so far, as views."""
        return self._rows.select(slice(0, self.n))

    @property
    def evidence(self) -> np.ndarray:
        """Present state of the detectors; see diagnostics/detector_state.py."""
        return self._now.evidence.copy()

    @property
    def compiled(self) -> CompiledModel:
        """The compiled functions of the model."""
        return self.machine.compiled

    @property
    def clock(self) -> int:
        """Time of the state, ns."""
        return int(self._now.clock[0])

    @property
    def u(self) -> np.ndarray:
        """Inputs in effect now, (nu,)."""
        return self._now.u.copy()

    @property
    def prior(self) -> Moments:
        """Mean (nx,) and covariance (nx, nx) at the start without a base, and after a reset."""
        return self.machine.prior

    def moments(self) -> Moments:
        """Return mean (nx,) and covariance (nx, nx) at `clock`; beyond `LARGE` states the variances (1, nx)."""
        return self._start if self.idle else self.machine.moments(self._now.state)

    def described(self, t: int | None = None, u: np.ndarray | None = None) -> np.ndarray:
        """Return the mean of the shown states at `clock`, or as the next event would be predicted at its time `t`, ns.

        The prediction draws the same random numbers as that of the event itself; nothing changes. `u` (nu,) takes the
        place of the inputs.
        """
        now, log, row = self._now, self.log, min(self.n, self.log.n - 1)
        kept, event = now.copy(), (log.kind[row], log.t[row])
        log.kind[row], log.t[row] = TICK, now.clock[0] if t is None else t
        line = self._rows.select(slice(row, row + 1)).copy()
        try:
            if u is not None:
                now.u[:] = u
            self.machine.run(log, row, row + 1, now, self._spare, self._rows)
            return self._rows.mean[row].copy()
        finally:
            log.kind[row], log.t[row] = event
            now.copy_from(kept)
            for column, value in zip(self._rows, line, strict=True):
                column[row : row + 1] = value
            self._asked = -1

    def points(self) -> np.ndarray:
        """Return sigma points or particles (k, nx) to draw beside the mean; none for most filters."""
        nothing = np.empty((0, self.model.nx))
        return nothing if self.idle else self.estimator.points(self.options, self._now.state, self.model.nx)

    def recoveries(self) -> int:
        """Return how often a particle cloud that had lost the asset was widened since the filter started."""
        return 0 if self.idle or self.estimator.recoveries is None else self.estimator.recoveries(self._now.state)

    def account(self) -> dict[str, float | list[float]]:
        """Return figures of the filter itself: `spread` (see diagnostics/account.py) and those of its family.

        Particle filters: the number of particles (`particles`), the effective sample size (`effective`), the distinct
        ancestors `lag` measurements ago (`ancestors`), the numbers of resamplings and recoveries. Ensembles: `members`,
        and the counts of the rank histogram (`ranks`).
        """
        own = self.estimator.account
        figures = {} if own is None or self.idle else own(self.options, self._now.state, self.model.nx)
        return {"spread": spread_ratio(self.track, self.policy.window), **figures}

    @property
    def failures(self) -> int:
        """Number of failures of a black box since this fold was made; their measurements have the verdict failed."""
        return int(getattr(self.machine.context, "failures", 0))

    @property
    def failure(self) -> ModelError | None:
        """The last error of a black box."""
        return getattr(self.machine.context, "failure", None)

    def peaks(self) -> list[Peak]:
        """Return the peaks of the estimate, the heaviest first; a Gaussian filter has one."""
        if self.estimator.peaks is not None and not self.idle:
            return self.estimator.peaks(self.options, self._now.state, self.model.nx)
        return [Peak(1.0, *self.moments())]

    def _check_log(self) -> None:
        if self._checked != self.log.changes:
            check_log(self.log, self.n, self.model, self.estimator, self.options)
            self._checked = self.log.changes

    def advance(self, limit: int | None = None) -> int:
        """Fold the log's events from `n` on, at most `limit`, and return how many.

        A black box that fails does not stop the fold: see `failures`.

        Raises:
            EventError: If the log was not made for this model, and an event does not fit it.
        """
        self._check_log()
        if self.idle:
            return 0
        end = self.log.n if limit is None else min(self.log.n, self.n + limit)
        begun = self.n
        if self.log.capacity > len(self._rows):
            grown = self.machine.rows(self.log.capacity)
            for new, old in zip(grown, self._rows, strict=True):
                new[: self.n] = old[: self.n]
            self._rows = grown
        log = self.log
        while self.n < end:
            if self.pictures is not None and self.pictures.check(log, self.n):
                self._take_picture()
            # Snapshots are dense at the end of the log, where late measurements fall, not at the end of this call.
            boundaries = [at - log.first for at in self.snapshots.stops(log.first + self.n, log.first + log.n)]
            stop = min(end, boundaries[-1])
            if self.pictures is not None:
                stop = self.pictures.next(log, self.n, stop)
            # A maintenance event is handled by itself. For one event at a time, NumPy takes longer than a filter step.
            found = log.kind[self.n : stop].tobytes().find(MAINTENANCE)
            stop = stop if found < 0 else self.n + max(1, found)
            begun_at, changed = self.n, False
            try:
                if log.kind[self.n] == MAINTENANCE:
                    self._maintain(self.n)
                    self.n = stop
                else:
                    blanks = [(at, *self._now.blank()) for at in boundaries if at < stop]
                    asking = self._run_events(self.n, stop, blanks)
                    stop = stop if asking < 0 else asking + 1
                    for at, snapshot, _ in blanks:
                        if at < stop:
                            self.n = at
                            self._remember(snapshot)
                    self.n = stop
                    if asking >= 0:
                        changed = self._decide(asking)
            except BaseException:
                # Interrupted between two events: return to the last consistent state.
                self.machine.settle()
                self._restore(begun_at)
                raise
            if stop in boundaries or changed:
                self._remember(self._now.copy(), changed)
        return end - begun

    def _decide(self, row: int) -> bool:
        """Decide on the sensor whose measurement asks for it; return whether the state changed."""
        assert self.tuning.reopen is not None
        decision, changed = decide(self, row, self._now.doubt, self.tuning.reopen)
        if decision is not None:
            self.decisions.append(decision)
        return changed

    def second_story(self, start: int, stop: int, sensor: int, *, every: bool = False) -> Story:
        """Fold events `start` to `stop` separately, under the hypothesis that the estimate was wrong before them.

        Args:
            start: Row of a rejected measurement of the sensor.
            stop: Row after the last; these rows have been folded.
            sensor: Sensor whose gate is off; the covariance is widened before its measurement.
            every: Whether the gates of all sensors are off.
        """
        at = self.snapshots.last(self.log.first + start)
        first = at - self.log.first, self.snapshots[at]
        return self.machine.second_story(self.log, *first, start, stop, sensor, self._rows.innovation[start], every)

    def go_on_with(self, story: Story) -> None:
        """Adopt the state at the end of a story."""
        self._now.copy_from(story.end, 3)
        self._asked = -1

    def _run_events(self, start: int, stop: int, blanks: Sequence[Blank] = ()) -> int:
        """Fold events in place; return the row of a measurement that asks for a decision and ends the loop, or -1.

        The `blanks` become snapshots at their events, all before `stop`; after a decision, the later ones stay blank.
        """
        asking = self.machine.run(self.log, start, stop, self._now, self._spare, self._rows, blanks)
        self._asked = stop - 1 if asking < 0 else -1
        return asking

    def _maintain(self, i: int) -> None:
        """Predict to a maintenance event and reset the variance of its state to the prior's; the mean stays.

        The filter restarts from these moments, and so loses the shape of particles, members and modes.
        """
        self._run_events(i, i + 1)
        mean, cov = self.machine.moments(self._spare)
        if self.machine.maintain(mean, cov, int(self.log.channel[i]), int(self.log.t[i]), self._now):
            self._run_events(i, i + 1)

    def finish(self) -> None:
        """Take the last picture, which would otherwise wait for one more event."""
        if self.pictures is not None and self.n:
            taken = self.pictures.taken
            if not taken or taken[-1].before < self.log.first + self.n:
                self._take_picture()

    def _take_picture(self) -> None:
        """Take a picture of the state before event `n`; after a query, of the predicted state that answered it."""
        assert self.pictures is not None
        last = self.n - 1
        query = self.log.kind[last] in (TRUTH, TICK, MARK)
        if query and self._asked != last:
            evidence = self._now.evidence.copy()
            self._run_events(last, self.n)
            self._now.evidence[:] = evidence
        mean, cov = self.machine.moments(self._spare if query else self._now.state)
        self.pictures.take(self.log, self.n, mean, variances_of(cov))

    def _remember(self, snapshot: Snapshot, pinned: bool = False) -> None:
        self.snapshots.keep(self.log.first + self.n, self.log.first, snapshot, pinned)

    def rewind(self, index: int) -> None:
        """Go back so that the event at `index` and all after it are folded again."""
        if index < self.n:
            self._restore(index)

    def _restore(self, index: int) -> None:
        at = self.snapshots.last(self.log.first + index)
        self.snapshots.forget_after(at)
        self._now.copy_from(self.snapshots[at])
        self.decisions = [decision for decision in self.decisions if decision.row < at]
        self.n = at - self.log.first
        self._asked = -1
        if self.pictures is not None:
            self.pictures.cut(at)

    def base_at(self, index: int) -> tuple[int, Base]:
        """Return the last snapshot at or before event `index`: its index, and the base of a fold that starts there."""
        at = self.snapshots.last(self.log.first + index)
        return at - self.log.first, self._base(at, self.snapshots[at])

    def base_here(self) -> Base:
        """Return the base of a fold that continues with the next event."""
        return self._base(self.log.first + self.n, self._now)

    def _base(self, at: int, snapshot: Snapshot) -> Base:
        left = snapshot.copy()
        mean, cov = self.machine.moments(left.state)
        return Base(
            mean,
            cov,
            int(left.clock[0]),
            left.u,
            self.estimator.name,
            left.state,
            at,
            evidence=left.evidence,
            edge=left.edge,
            version=self.log.version + versions_dropped(self.log.events, at - self.log.first),
            doubt=left.doubt,
        )

    def follow(self, log: Log, changed_from: int | None) -> None:
        """Continue with the log of which the present one is an earlier copy.

        Args:
            log: The log, which may have grown and dropped its oldest events meanwhile.
            changed_from: Absolute index from which its events differ from the copy's, if a late measurement arrived.

        Raises:
            EstimatorError: If the log was cut at an event without a snapshot of this fold.
        """
        cut = log.first - self.log.first
        if cut < 0 or cut > self.n:
            raise EstimatorError("the log is another one; fold it from its start")
        if cut:
            self.drop_front(cut)
        self.log, self._checked = log, -1
        if changed_from is not None:
            self.rewind(max(0, changed_from - log.first))

    def drop_front(self, count: int) -> None:
        """Drop the rows of the log's oldest `count` events, which must end at a snapshot (see `base_at`).

        Call it before `Log.drop_front`.
        """
        if self.log.first + count not in self.snapshots:
            raise EstimatorError(f"cannot drop {count} events: no snapshot there; drop up to one that base_at names")
        for column in self._rows:
            column[: self.n - count] = column[count : self.n].copy()
        self.n -= count
        self._asked = -1
        if self.pictures is not None:
            self.pictures.drop_front(self.log.first + count)
        self.snapshots.forget_before(self.log.first + count)
        self.decisions = [decision for decision in self.decisions if decision.row >= self.log.first + count]


def folded(estimator: str, model: StateSpaceModel, tuning: Tuning, log: Log, **options: Any) -> Fold:
    """Return a fold that has reached the end of its log; for the options see `Fold`."""
    whole = Fold(estimator, model, tuning, log, **options)
    whole.advance()
    return whole


def fold(
    estimator: str,
    model: StateSpaceModel,
    tuning: Tuning,
    log: Log,
    *,
    pairs: np.ndarray | None = None,
    policy: HealthPolicy | None = None,
    prior: tuple[np.ndarray, np.ndarray] | None = None,
) -> Track:
    """Fold an estimator over a log; see `Fold`.

    Returns:
        The track, one row per event.

    Raises:
        EstimatorError: If the estimator does not exist or does not apply to the model.
        ModelError: If the model's functions contradict its declaration, or those of a black box fail.
    """
    whole = folded(estimator, model, tuning, log, pairs=pairs, policy=policy, prior=prior)
    if whole.failure is not None:
        raise whole.failure
    return whole.track
