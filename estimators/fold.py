"""The fold: an estimator over a log. Live, replay, retuning and review are all this function.

    track = fold(estimator, model, tuning, log)

Same log, same tuning, same seed: the same bits, in whatever pieces the events came. It runs without the GIL, however
brief: a model's function that never returns must not keep the interpreter with it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np

from .compiled.context import context_of
from .compiled.jacobians import scratch_size, sensor_jacobian
from .compiled.model import CompiledModel, compile_model
from .diagnostics.account import spread_ratio
from .diagnostics.evidence import fresh, no_baseline, watched
from .diagnostics.failure_cause import Estimate, around, cause, failures, questions
from .diagnostics.field_pictures import Pictures
from .diagnostics.health import Bounds, HealthPolicy, chi_square_bounds
from .errors import EstimatorError, ModelError
from .estimator import Code, Estimator
from .events.checks import admitted
from .events.maintenance import versions_dropped, without
from .fold_checks import check_base, check_pairs, check_prior, check_soft, check_tuning, check_variances
from .fold_kernel import compiled
from .gate import doubt
from .gate.reopening import Decision, decide
from .gate.stories import widening
from .interpreted import fold_loop
from .interpreted.black_box_filters import driven
from .interpreted.fold_loop import LONGEST, UNSET
from .interpreted.view import View
from .log import BEFORE, INPUT, MAINTENANCE, MARK, READING, TICK, TRUTH, Log
from .model.mode_as_number import indicator
from .model.state_space import LARGE, StateSpaceModel
from .numerics.peaks import Peak
from .numerics.quantiles import chi_square_quantile
from .registry import find_estimator
from .screen import fresh_screen, limits_of
from .snapshots import Base, Snapshot, Snapshots, Story
from .track import WHITENED, Track
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
        self._own_prior = None if prior is None else check_prior(prior, model, self.estimator)
        self.policy = policy or HealthPolicy()
        self.options = self.estimator.complete_for(model, tuning.options)
        if tuning.gate is not None and tuning.gate_kind == "soft":
            check_soft(self.estimator, self.options)
        self.n = 0
        self._checked = -1
        self._check_log()
        # Only particles can carry a mode that jumps; the others see it as a number.
        self._compiled = compile_model(model if self.estimator.family == "particle" else indicator(model))
        self._code: Code = driven(self.estimator) if model.black_box else self.estimator.code()
        most = model.width * max(1, self.policy.window)
        self._bounds: Bounds = chi_square_bounds(most)
        self.marginal = self.estimator.family in ("particle", "ensemble")
        self.baseline = no_baseline(model) if tuning.baseline is None else tuning.baseline
        self._seen = self._see(expected)
        self._context: Any = self._seen
        numbers = self.estimator.state_size(self.options, model.nx) + self.estimator.memory(self.options, model)
        self._state = np.empty(numbers)
        self._spare = np.empty_like(self._state)
        self._work = _scratch(self.estimator.work_size(self.options, model.nx, model.width) + 1)
        self._score = np.empty(WHITENED + model.ny)
        self._evidence = fresh(model)
        self._edge = fresh_screen(model)
        reopens = tuning.reopen is not None and model.nx <= LARGE
        self._rule = doubt.rule_of(tuning.gate, tuning.gate_kind, reopens)
        self._doubt = doubt.fresh(len(model.sensors))
        self.decisions: list[Decision] = []
        """What was decided of sensors that stayed refused, see gate/reopening.py."""
        self._clock = np.array([UNSET])
        self._u = np.array([item.default for item in model.inputs], float)
        mean, cov = self._held["prior_mean"], self._held["prior_cov"]
        if base is None and log.start != BEFORE:
            self._clock[0] = log.start
        if base is not None:
            check_base(base, model)
            mean, cov, self._clock[0], self._u[:] = base.mean, base.cov, base.clock, base.u
        self._run, judge, begin, _ = compiled()
        if model.black_box or self.estimator.interpreted:
            self._context = View(self._compiled, self._context, tuning, self.options, self.pairs, self._held)
            self._run = partial(fold_loop.run_and_judge, judge, self._seen)
            begin = fold_loop.begin
        self._begin = begin
        begin(self._code, self._context, np.ascontiguousarray(mean), np.ascontiguousarray(cov), self._state)
        left = base.state if base is not None and base.estimator == estimator else None
        if left is not None and left.size == self._state.size:
            self._state[:] = left
            if base is not None and base.evidence is not None and base.evidence.size == self._evidence.size:
                self._evidence[:] = base.evidence
            if base is not None and base.doubt is not None and base.doubt.shape == self._doubt.shape:
                self._doubt[:] = base.doubt
        if base is not None and base.edge is not None and base.edge.size == self._edge.size:
            self._edge[:] = base.edge
        self._snapshots = Snapshots(self._state.nbytes)
        self.pictures = Pictures(model.grid, picture) if model.grid is not None else None
        self._asked = -1
        self._remember()
        self._rows = Track.allocate(log.capacity, len(model.shown), len(self.pairs), model.ny, model.width)

    def _see(self, expected: np.ndarray | None) -> np.void:
        """The context of this model and tuning; the arrays that it points to are kept in `self._held`."""
        model, tuning = self.model, self.tuning
        self.gate_limits = np.full(model.width + 1, np.inf)
        if tuning.gate is not None:
            self.gate_limits[1:] = chi_square_quantile(tuning.gate, np.arange(1, model.width + 1))
        held = {
            "p": np.ascontiguousarray(tuning.p, float),
            "q": np.ascontiguousarray(tuning.q, float),
            # Its own: what a reading brings stands here while it is folded, and other folds have the same tuning.
            "r": np.array(tuning.r, float),
            "used": tuning.used.astype(np.int8),
            "gate": np.tile(self.gate_limits, (len(model.sensors), 1)),
            "options": np.ascontiguousarray(self.estimator.tune(self.options, model, tuning), float),
            "pairs": self.pairs,
            "prepared": self.estimator.prepare(model, self.options),
            **limits_of(model),
            **watched(model, tuning.gate, self.marginal, self.baseline, expected),
        }
        values: dict[str, Any] = {**self._compiled.static, **held}
        if self._own_prior is not None:
            values["prior_mean"], values["prior_cov"] = self._own_prior
        self._held = values
        sizes = {
            "nx": model.nx,
            "nu": model.nu,
            "n_parameters": held["p"].size,
            "n_noises": held["q"].size,
            "n_sensors": len(model.sensors),
            "n_rows": held["r"].size,
            "n_options": held["options"].size,
            "n_pairs": len(self.pairs),
            "n_shown": len(model.shown),
            "n_prepared": held["prepared"].size,
            "n_baseline": held["baseline"].size,
            "width": model.width,
            "seed": tuning.seed,
        }
        plain = {k: v.ctypes.data if isinstance(v, np.ndarray) else v for k, v in values.items()}
        return context_of(**plain, **sizes)

    @property
    def track(self) -> Track:
        """Views of the rows folded so far."""
        return self._rows.select(slice(0, self.n))

    @property
    def evidence(self) -> np.ndarray:
        """The state of the bank of tests now; see diagnostics/evidence/."""
        return self._evidence.copy()

    @property
    def compiled(self) -> CompiledModel:
        """The model's functions as the filter sees them."""
        return self._compiled

    @property
    def clock(self) -> int:
        """Time of the state, ns."""
        return int(self._clock[0])

    @property
    def u(self) -> np.ndarray:
        """Inputs that hold now."""
        return self._u.copy()

    def moments(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean (nx,) and covariance (nx, nx) at `clock`; beyond `LARGE` states the variances (1, nx) instead."""
        return self.estimator.moments(self.options, self._state, self.model.nx)

    def points(self) -> np.ndarray:
        """What to draw beside the mean, (k, nx): sigma points, particles; none for most filters."""
        return self.estimator.points(self.options, self._state, self.model.nx)

    def recoveries(self) -> int:
        """Number of recoveries since the filter started: a cloud of particles that had lost the asset was widened."""
        return 0 if self.estimator.recoveries is None else self.estimator.recoveries(self._state)

    def account(self) -> dict[str, float | list[float]]:
        """What the filter says of itself: `spread`, see diagnostics/account.py, and what only this kind of it can say.

        Particles: how many there are (`particles`), how many count (`effective`), from how many of `lag` readings ago
        they descend (`ancestors`), how often they were resampled and recovered. Ensembles: `members`, and the counts of
        the rank histogram (`ranks`).
        """
        own = self.estimator.account
        said = {} if own is None else own(self.options, self._state, self.model.nx)
        return {"spread": spread_ratio(self.track, self.policy.window), **said}

    @property
    def failures(self) -> int:
        """How often a black box failed since this fold was made; the readings concerned have failed."""
        return int(getattr(self._context, "failures", 0))

    @property
    def failure(self) -> ModelError | None:
        """What a black box said when it failed last."""
        return getattr(self._context, "failure", None)

    def cause(self, row: int) -> str | None:
        """What in the model is to blame for a row whose reading failed or whose estimate is not a number, in one line.

        Tried anew from the last estimate before it that is a number; None if nothing is found. Takes milliseconds.
        """
        if self.failure is not None:
            return str(self.failure)
        log, track, model = self.log, self.track, self.model
        known = np.setdiff1d(np.arange(row), failures(track))
        last = int(known[-1]) if known.size else -1
        at, base = self.base_at(max(0, last))
        x, u, then = base.mean.copy(), base.u.copy(), base.clock
        std = np.sqrt(base.cov[0] if base.cov.shape[0] == 1 else np.diag(base.cov))
        if known.size:
            x[model.shown], std[model.shown], then = track.mean[last], track.std[last], int(log.t[last])
        for k in at + np.flatnonzero(log.kind[at:row] == INPUT):
            given = log.value[k, : u.size]
            np.copyto(u, given, where=np.isfinite(given))
        dt = (int(log.t[row]) - then) * 1e-9 if then != UNSET else 0.0
        if dt > LONGEST * model.max_step:
            cov = self._held["prior_cov"]
            x, std, dt = self._held["prior_mean"].copy(), np.sqrt(cov[0] if len(cov) == 1 else np.diag(cov)), 0.0
        sensor = int(log.channel[row]) if log.kind[row] == READING else None
        predicted = None
        if len(model.shown) == model.nx and np.all(np.isfinite(track.mean[row]) & np.isfinite(track.std[row])):
            predicted = Estimate(track.mean[row].copy(), track.std[row])
        return cause(self._compiled, Estimate(x, std), u, self._held["p"], self._held["q"], dt, sensor, predicted)

    def questions(self) -> Iterator[tuple[str, Callable[[], object]]]:
        """What the model is probably being asked by a fold that is under way in another thread, to be tried one by one.

        Each function at the filter's points, its mean and around it; nothing of a black box.
        """
        if self._compiled.box is not None or self.n >= self.log.n:
            return iter(())
        mean, cov = self.moments()
        std = np.sqrt(np.maximum(cov[0] if cov.shape[0] == 1 else np.diag(cov), 0.0))
        states = [mean, *self.points(), *around(self._compiled, Estimate(mean, std))]
        finite = [np.ascontiguousarray(x) for x in states if x.size == mean.size and np.all(np.isfinite(x))]
        later = self.log.t[self.n : self.log.n]
        then = int(self._clock[0])
        ahead = later[later > then]
        dt = (int(ahead[0]) - then) * 1e-9 if ahead.size and then != UNSET else 0.0
        # As the fold does: in equal steps that the model allows.
        dt /= max(1, int(np.ceil(dt / self.model.max_step)))
        return questions(self._compiled, finite, self._u, self._held["p"], self._held["q"], dt)

    def peaks(self) -> list[Peak]:
        """The peaks of the estimate, the heaviest first; a Gaussian filter has one."""
        if self.estimator.peaks is not None:
            return self.estimator.peaks(self.options, self._state, self.model.nx)
        return [Peak(1.0, *self.moments())]

    def _check_log(self) -> None:
        """Where log and model meet: refuse what the model has no place for, and variances that cannot be honoured."""
        log, layout = self.log, self.model.layout
        if self._checked == log.changes:
            return
        if log.width < layout.least:
            raise EstimatorError(
                f"the log has {log.width} value column(s); an event of {self.model.name} needs {layout.least}: make it "
                "by Log.of(model)"
            )
        if not layout.same(log.layout):
            admitted(log.events.select(slice(self.n, None)), log.width, layout)
        if log.has_variances:
            check_variances(self.estimator, self.options)
        self._checked = log.changes

    def advance(self, limit: int | None = None) -> int:
        """Fold the events that the log has beyond `n`, at most `limit`; return how many.

        A black box that fails stops nothing: see `failures`.

        Raises:
            EventError: If the log was not made for this model, and an event does not fit it.
        """
        self._check_log()
        end = self.log.n if limit is None else min(self.log.n, self.n + limit)
        begun = self.n
        if self.log.capacity > len(self._rows):
            model = self.model
            grown = Track.allocate(self.log.capacity, len(model.shown), len(self.pairs), model.ny, model.width)
            for new, old in zip(grown, self._rows, strict=True):
                new[: self.n] = old[: self.n]
            self._rows = grown
        log = self.log
        while self.n < end:
            if self.pictures is not None and self.pictures.check(log, self.n):
                self._take_picture()
            boundary = self._snapshots.next_stop(log.first + self.n, log.first + end) - log.first
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
                self._held["r"][:] = self.tuning.r
                self._held["gate"][:] = self.gate_limits
                self._restore(begun_at)
                raise
            if stop == boundary or changed:
                self._remember(pinned=changed)
        return end - begun

    def _decide(self, row: int) -> bool:
        """Decide on the sensor whose reading asks for it; whether the state is another now."""
        assert self.tuning.reopen is not None
        decision, changed = decide(self, row, self._doubt, self.tuning.reopen)
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
        snapshot = self._snapshots[at]
        clock, u, state = np.array([snapshot.clock]), snapshot.u.copy(), snapshot.state.copy()
        edge = snapshot.edge.copy()
        self._run_apart(at - self.log.first, start, clock, u, state, edge)
        mean, cov = self.estimator.moments(self.options, state, self.model.nx)
        prior = self._held["prior_cov"]
        diagonals = [matrix[0] if len(matrix) == 1 else np.diag(matrix) for matrix in (cov, prior)]
        H = self._slope(sensor, mean, u)
        added = widening(diagonals[0], diagonals[1], H, self._rows.innovation[start, : len(H)])
        cov = cov + (added if len(cov) == 1 else np.diag(added))
        self._begin(self._code, self._context, np.ascontiguousarray(mean), cov, state)
        self._held["gate"][sensor] = np.inf
        track = self._run_apart(start, stop, clock, u, state, edge)
        self._held["gate"][sensor] = self.gate_limits
        return Story(track, int(clock[0]), u, state, np.sqrt(added))

    def go_on_with(self, story: Story) -> None:
        """Take the state of the second story for one's own."""
        self._clock[0], self._u[:], self._state[:] = story.clock, story.u, story.state
        self._asked = -1

    def _slope(self, sensor: int, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """dh/dx (ny, nx) of a sensor; nothing depends on a mode."""
        if isinstance(self._context, View):
            H = self._context.H(sensor, x, u)
        else:
            H = np.empty((len(self.model.sensors[sensor].rows), self.model.nx))
            scratch = np.empty(scratch_size(self.model.nx, self.model.width))
            sensor_jacobian(self._context, sensor, np.ascontiguousarray(x), u, H, scratch)
        if self.model.mode >= 0:
            H[:, self.model.mode] = 0.0
        return H

    def _run_apart(
        self, start: int, stop: int, clock: np.ndarray, u: np.ndarray, state: np.ndarray, edge: np.ndarray
    ) -> Track:
        """Fold events into a track of their own; clock, u, state and screen move on."""
        log, model = self.log, self.model
        track = Track.allocate(stop - start, len(model.shown), len(self.pairs), model.ny, model.width)
        self._run(
            self._code,
            self._context,
            self._rule._replace(most=0),
            log.first + start,
            0,
            stop - start,
            log.t[start:stop],
            log.kind[start:stop],
            log.channel[start:stop],
            log.value[start:stop],
            log.width,
            clock,
            u,
            state,
            doubt.fresh(len(model.sensors)),
            edge,
            np.empty_like(state),
            self._work,
            self._score,
            track,
            self.policy,
            self._bounds,
            self._evidence.copy(),
        )
        return track

    def _run_events(self, start: int, stop: int) -> int:
        """Fold events in place; the row of a reading that asks for a decision, after which the loop stopped, or -1."""
        log = self.log
        asking = self._run(
            self._code,
            self._context,
            self._rule,
            log.first,
            start,
            stop,
            log.t,
            log.kind,
            log.channel,
            log.value,
            log.width,
            self._clock,
            self._u,
            self._state,
            self._doubt,
            self._edge,
            self._spare,
            self._work,
            self._score,
            self._rows,
            self.policy,
            self._bounds,
            self._evidence,
        )
        self._asked = stop - 1 if asking < 0 else -1
        return int(asking)

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
        mean, cov = self.estimator.moments(self.options, self._spare, self.model.nx)
        cov = without(cov, self._held["prior_cov"], int(self.log.channel[i]))
        if np.all(np.isfinite(mean)) and np.all(np.isfinite(cov)):
            self._begin(self._code, self._context, np.ascontiguousarray(mean), np.ascontiguousarray(cov), self._state)
            self._clock[0] = self.log.t[i]
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
            evidence = self._evidence.copy()
            self._run_events(last, self.n)
            self._evidence[:] = evidence
        state = self._spare if query else self._state
        mean, cov = self.estimator.moments(self.options, state, self.model.nx)
        self.pictures.take(self.log, self.n, mean, cov[0] if cov.shape[0] == 1 else np.diag(cov))

    def _remember(self, pinned: bool = False) -> None:
        self._snapshots.keep(self.log.first + self.n, self.log.first, self._snapshot(), pinned)

    def _snapshot(self) -> Snapshot:
        gathered = self._evidence.copy(), self._edge.copy(), self._doubt.copy()
        return Snapshot(int(self._clock[0]), self._u.copy(), self._state.copy(), *gathered)

    def rewind(self, index: int) -> None:
        """Go back so that the event at `index` (and all after it) will be folded again."""
        if index < self.n:
            self._restore(index)

    def _restore(self, index: int) -> None:
        at = self._snapshots.last(self.log.first + index)
        self._snapshots.forget_after(at)
        snapshot = self._snapshots[at]
        self._clock[0], self._u[:], self._state[:] = snapshot.clock, snapshot.u, snapshot.state
        self._evidence[:], self._edge[:], self._doubt[:] = snapshot.evidence, snapshot.edge, snapshot.doubt
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
        return self._base(self.log.first + self.n, self._snapshot())

    def _base(self, at: int, snapshot: Snapshot) -> Base:
        clock, u, state, evidence, edge, doubts = snapshot
        mean, cov = self.estimator.moments(self.options, state, self.model.nx)
        return Base(
            mean,
            cov,
            clock,
            u.copy(),
            self.estimator.name,
            state.copy(),
            at,
            evidence=evidence.copy(),
            edge=edge.copy(),
            version=self.log.version + versions_dropped(self.log.events, at - self.log.first),
            doubt=doubts.copy(),
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


def _scratch(size: int) -> np.ndarray:
    """`size` numbers that begin at a cache line, so that vectors at multiples of their length lie across none."""
    numbers = np.full(size + 8, np.nan)
    first = -numbers.ctypes.data % 64 // 8
    return numbers[first : first + size]
