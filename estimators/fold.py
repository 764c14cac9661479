"""The fold: an estimator over a log. Live, replay, retuning and review are all this function.

    track = fold(estimator, model, tuning, log)

Same log, same tuning, same seed: the same bits, in whatever pieces the events came. It runs without the GIL, however
brief: a model's function that never returns must not keep the interpreter with it.
"""

from __future__ import annotations

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
from .log import BEFORE, MAINTENANCE, MARK, TICK, TRUTH, Log
from .model.state_space import StateSpaceModel
from .numerics.peaks import Peak
from .registry import find_estimator
from .snapshots import Base, Snapshot, Snapshots, Story
from .track import Track
from .tuning import Tuning


class Fold:
    """A fold that grows with its log, and can be taken back to any event to fold again from there."""

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
        """Prepare; nothing is folded yet.

        Args:
            estimator: Name in the registry.
            model: The model; compiled on first use.
            tuning: Noise, parameters, gate, options.
            log: Events; the fold follows it as it grows.
            pairs: Pairs of states whose covariance the track keeps, shape (k, 2).
            policy: When the estimate may be trusted.
            base: Where to start, where events before the log's first were dropped; without it, at the prior. The
                filter that left it goes on from its whole state, also under another tuning, unless an option changed
                the size of that; any other filter starts from the mean and covariance.
            picture: Seconds of the log between two pictures of a large field; None for those that score it only.
            prior: Mean (nx,) and covariance (nx, nx), positive semidefinite, in place of the model's; beyond `LARGE`
                states the variances (1, nx). It holds at the log's start, and a reset goes back to it.
            expected: Sensors that must speak, (sensors,) of bool; None for those that have spoken.
            idle: Folds nothing, ever, so that neither filter nor loop is compiled for it: what stands in the place of
                a fold until one can be had. Its moments are those where it would start.
            room: Events for which the track has room at once, if the log has less: one that it shall follow has more.

        Raises:
            EstimatorError: If the estimator does not exist, does not apply, an option is out of range, or log, tuning,
                pairs, base or prior do not fit the model.
            EventError: If an event does not fit the model.
            ModelError: If the model's functions disagree with its declaration.
        """
        self.estimator: Estimator = find_estimator(estimator, model)
        self.model, self.tuning, self.log = model, tuning, log
        self.pairs = check_pairs(pairs, model)
        check_tuning(tuning, model)
        prior = None if prior is None else check_prior(prior, model, self.estimator)
        self.policy = policy or HealthPolicy()
        self.options = self.estimator.complete_for(model, tuning.options)
        if tuning.gate is not None and tuning.gate_kind == "soft":
            check_soft(self.estimator, self.options)
        self.n, self._checked = 0, -1
        self._check_log()
        self._machine = Machine(
            self.estimator, self.options, model, tuning, self.pairs, self.policy, prior=prior, expected=expected
        )
        self.marginal, self.gate_limits = self._machine.marginal, self._machine.gate_limits
        self.decisions: list[Decision] = []
        """What was decided of sensors that stayed refused, see gate/reopening.py."""
        self._now = self._machine.fresh()
        self._spare = np.empty_like(self._now.state)
        self.idle, self._start = idle, self._machine.prior if base is None else (base.mean, base.cov)
        if base is not None:
            check_base(base, model)
        if idle:
            self._now.state[:] = 0.0
        elif base is not None:
            self._machine.begin_at(base, self._now)
        else:
            self._machine.begin(*self._machine.prior, self._now.state)
            if log.start != BEFORE:
                self._now.clock[0] = log.start
        self._snapshots = Snapshots(self._now.state.nbytes)
        self.pictures = Pictures(model.grid, picture) if model.grid is not None else None
        self._asked = -1
        self._remember()
        self._rows = self._machine.rows(max(log.capacity, room))

    @property
    def track(self) -> Track:
        """Views of the rows folded so far."""
        return self._rows.select(slice(0, self.n))

    @property
    def evidence(self) -> np.ndarray:
        """Present state of the detectors; see diagnostics/detector_state.py."""
        return self._now.evidence.copy()

    @property
    def compiled(self) -> CompiledModel:
        """The model's functions as the filter sees them."""
        return self._machine.compiled

    @property
    def machine(self) -> Machine:
        """What it folds with."""
        return self._machine

    @property
    def snapshots(self) -> Snapshots:
        """Where it can go back to."""
        return self._snapshots

    @property
    def clock(self) -> int:
        """Time of the state, ns."""
        return int(self._now.clock[0])

    @property
    def u(self) -> np.ndarray:
        """Inputs that hold now."""
        return self._now.u.copy()

    @property
    def prior(self) -> Moments:
        """Mean (nx,) and covariance (nx, nx) with which it begins without a base, and after a reset."""
        return self._machine.prior

    def moments(self) -> Moments:
        """Mean (nx,) and covariance (nx, nx) at `clock`; beyond `LARGE` states the variances (1, nx) instead."""
        return self._start if self.idle else self._machine.moments(self._now.state)

    def points(self) -> np.ndarray:
        """What to draw beside the mean, (k, nx): sigma points, particles; none for most filters."""
        nothing = np.empty((0, self.model.nx))
        return nothing if self.idle else self.estimator.points(self.options, self._now.state, self.model.nx)

    def recoveries(self) -> int:
        """Number of recoveries since the filter started: a cloud of particles that had lost the asset was widened."""
        return 0 if self.idle or self.estimator.recoveries is None else self.estimator.recoveries(self._now.state)

    def account(self) -> dict[str, float | list[float]]:
        """What the filter says of itself: `spread`, see diagnostics/account.py, and what only this kind of it can say.

        Particles: how many there are (`particles`), how many count (`effective`), from how many of `lag` readings ago
        they descend (`ancestors`), how often they were resampled and recovered. Ensembles: `members`, and the counts of
        the rank histogram (`ranks`).
        """
        own = self.estimator.account
        said = {} if own is None or self.idle else own(self.options, self._now.state, self.model.nx)
        return {"spread": spread_ratio(self.track, self.policy.window), **said}

    @property
    def failures(self) -> int:
        """How often a black box failed since this fold was made; the readings concerned have failed."""
        return self._machine.failures

    @property
    def failure(self) -> ModelError | None:
        """What a black box said when it failed last."""
        return self._machine.failure

    def peaks(self) -> list[Peak]:
        """The peaks of the estimate, the heaviest first; a Gaussian filter has one."""
        if self.estimator.peaks is not None and not self.idle:
            return self.estimator.peaks(self.options, self._now.state, self.model.nx)
        return [Peak(1.0, *self.moments())]

    def _check_log(self) -> None:
        if self._checked != self.log.changes:
            check_log(self.log, self.n, self.model, self.estimator, self.options)
            self._checked = self.log.changes

    def advance(self, limit: int | None = None) -> int:
        """Fold the events that the log has beyond `n`, at most `limit`; return how many.

        A black box that fails stops nothing: see `failures`.

        Raises:
            EventError: If the log was not made for this model, and an event does not fit it.
        """
        self._check_log()
        if self.idle:
            return 0
        end = self.log.n if limit is None else min(self.log.n, self.n + limit)
        begun = self.n
        if self.log.capacity > len(self._rows):
            grown = self._machine.rows(self.log.capacity)
            for new, old in zip(grown, self._rows, strict=True):
                new[: self.n] = old[: self.n]
            self._rows = grown
        log = self.log
        while self.n < end:
            if self.pictures is not None and self.pictures.check(log, self.n):
                self._take_picture()
            # Dense where late readings fall, which is at the end of the log, not of each piece that is folded at once.
            boundary = self._snapshots.next_stop(log.first + self.n, log.first + log.n) - log.first
            stop = min(end, boundary)
            if self.pictures is not None:
                stop = self.pictures.next(log, self.n, stop)
            stop = self._maintenance(stop)
            begun_at, changed = self.n, False
            try:
                if log.kind[self.n] == MAINTENANCE:
                    self._maintain(self.n)
                    self.n = stop
                else:
                    asking = self._run_events(self.n, stop)
                    stop = stop if asking < 0 else asking + 1
                    self.n = stop
                    if asking >= 0:
                        changed = self._decide(asking)
            except BaseException:
                # Python was stopped between two events: back to where the state is known.
                self._machine.settle()
                self._restore(begun_at)
                raise
            if stop == boundary or changed:
                self._remember(pinned=changed)
        return end - begun

    def _decide(self, row: int) -> bool:
        """Decide on the sensor whose reading asks for it; whether the state is another now."""
        assert self.tuning.reopen is not None
        decision, changed = decide(self, row, self._now.doubt, self.tuning.reopen)
        if decision is not None:
            self.decisions.append(decision)
        return changed

    def second_story(self, start: int, stop: int, sensor: int) -> Story:
        """Fold the events from `start` to `stop` apart, as if the twin had been wrong before the first of them.

        Args:
            start: A refused reading of the sensor.
            stop: The row after the last, folded already.
            sensor: Its gate is off, and the covariance is widened before its reading.
        """
        at = self._snapshots.last(self.log.first + start)
        first = at - self.log.first, self._snapshots[at]
        return self._machine.second_story(self.log, *first, start, stop, sensor, self._rows.innovation[start])

    def go_on_with(self, story: Story) -> None:
        """Take the state of the second story for one's own."""
        now, end = self._now, story.end
        now.clock[:], now.u[:], now.state[:] = end.clock, end.u, end.state
        self._asked = -1

    def _run_events(self, start: int, stop: int) -> int:
        """Fold events in place; the row of a reading that asks for a decision, after which the loop stopped, or -1."""
        asking = self._machine.run(self.log, start, stop, self._now, self._spare, self._rows)
        self._asked = stop - 1 if asking < 0 else -1
        return asking

    def _maintenance(self, stop: int) -> int:
        """Where to stop, at `stop` at the latest, so that an event of maintenance is dealt with by itself."""
        # A search of the bytes: with one event at a time NumPy would take longer for it than the filter for a step.
        found = self.log.kind[self.n : stop].tobytes().find(MAINTENANCE)
        return stop if found < 0 else self.n + max(1, found)

    def _maintain(self, i: int) -> None:
        """Predict to the event; there its state is as unknown as in the prior, and its mean stays.

        The filter begins again from these moments: of particles, members and modes it keeps no more than them.
        """
        self._run_events(i, i + 1)
        mean, cov = self._machine.moments(self._spare)
        if self._machine.maintain(mean, cov, int(self.log.channel[i]), int(self.log.t[i]), self._now):
            self._run_events(i, i + 1)

    def finish(self) -> None:
        """The log has ended: take the picture for which another event would have been waited."""
        if self.pictures is not None and self.n:
            taken = self.pictures.taken
            if not taken or taken[-1].before < self.log.first + self.n:
                self._take_picture()

    def _take_picture(self) -> None:
        """Of what stands before event `n`; after a query, of what it was answered with."""
        assert self.pictures is not None
        last = self.n - 1
        query = self.log.kind[last] in (TRUTH, TICK, MARK)
        if query and self._asked != last:
            evidence = self._now.evidence.copy()
            self._run_events(last, self.n)
            self._now.evidence[:] = evidence
        mean, cov = self._machine.moments(self._spare if query else self._now.state)
        self.pictures.take(self.log, self.n, mean, variances_of(cov))

    def _remember(self, pinned: bool = False) -> None:
        self._snapshots.keep(self.log.first + self.n, self.log.first, self._now.copy(), pinned)

    def rewind(self, index: int) -> None:
        """Go back so that the event at `index` (and all after it) will be folded again."""
        if index < self.n:
            self._restore(index)

    def _restore(self, index: int) -> None:
        at = self._snapshots.last(self.log.first + index)
        self._snapshots.forget_after(at)
        self._now.put(self._snapshots[at])
        self.decisions = [decision for decision in self.decisions if decision.row < at]
        self.n = at - self.log.first
        self._asked = -1
        if self.pictures is not None:
            self.pictures.cut(at)

    def base_at(self, index: int) -> tuple[int, Base]:
        """The last snapshot at or before the event `index`: its index, and the base of a fold that starts there."""
        at = self._snapshots.last(self.log.first + index)
        return at - self.log.first, self._base(at, self._snapshots[at])

    def base_here(self) -> Base:
        """The base of a fold that goes on with the next event."""
        return self._base(self.log.first + self.n, self._now)

    def _base(self, at: int, snapshot: Snapshot) -> Base:
        left = snapshot.copy()
        mean, cov = self._machine.moments(left.state)
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
        """Go on with the log of which the present one is an earlier copy.

        Args:
            log: The log that grew meanwhile, and may have dropped its oldest events.
            changed_from: Absolute index from which its events differ from the copy's, if a late reading came.

        Raises:
            EstimatorError: If the log was cut where this fold has no snapshot.
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
        """Follow the log in forgetting its oldest `count` events, which must end at a snapshot (see `base_at`).

        Call it before the log's own `drop_front`.
        """
        if self.log.first + count not in self._snapshots:
            raise EstimatorError(f"cannot drop {count} events: no snapshot there; drop up to one that base_at names")
        for column in self._rows:
            column[: self.n - count] = column[count : self.n].copy()
        self.n -= count
        self._asked = -1
        if self.pictures is not None:
            self.pictures.drop_front(self.log.first + count)
        self._snapshots.forget_before(self.log.first + count)
        self.decisions = [decision for decision in self.decisions if decision.row >= self.log.first + count]


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
    """Fold an estimator over a whole log; see `Fold`.

    Returns:
        The track, one row an event.

    Raises:
        EstimatorError: If the estimator does not exist or does not apply to the model.
        ModelError: If the model's functions disagree with its declaration, or those of a black box fail.
    """
    growing = Fold(estimator, model, tuning, log, pairs=pairs, policy=policy, prior=prior)
    growing.advance()
    if growing.failure is not None:
        raise growing.failure
    return growing.track
