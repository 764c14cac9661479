"""The machine of a fold: the filter's code, the context of model and tuning that it reads, and its scratch."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property, partial
from typing import Any

import numpy as np

from .compiled.context import context_of, place_of_record
from .compiled.jacobians import constant_rows, scratch_size, sensor_jacobian
from .compiled.model import compile_model
from .diagnostics.detector_state import detector_context, fresh, no_baseline
from .diagnostics.health import Bounds, HealthPolicy, chi_square_bounds
from .diagnostics.memory import fresh_memory, memory_context
from .estimator import Code, Estimator, Options
from .events.maintenance import without
from .fold_kernel import compiled, compiled_judge
from .gate import rejection_runs as doubt
from .gate.isolation import widening
from .interpreted import fold_loop
from .interpreted.fold_loop import UNSET
from .interpreted.view import View, driven
from .log import Log
from .model.state_space import LARGE, StateSpaceModel
from .model.wrapping import indicator
from .numerics.quantiles import chi_square_quantile
from .plausibility import fresh_screen, limits_of
from .snapshots import Base, Blank, Snapshot, Story
from .track import WHITENED, Track
from .tuning import Tuning

Moments = tuple[np.ndarray, np.ndarray]


class Machine:
    """Folds events in place. It keeps no state between calls; that is in `Snapshot`."""

    def __init__(
        self,
        estimator: Estimator,
        options: Options,
        model: StateSpaceModel,
        tuning: Tuning,
        pairs: np.ndarray,
        policy: HealthPolicy,
        *,
        prior: Moments | None,
        expected: np.ndarray | None,
    ) -> None:
        """Set up from the checked arguments of `Fold`."""
        self.estimator, self.options, self.model, self.tuning = estimator, options, model, tuning
        self.policy, self._pairs = policy, pairs
        # Only particle filters represent a jumping mode; the others treat it as a number.
        self.compiled = compile_model(model if estimator.family == "particle" else indicator(model))
        self.bounds: Bounds = chi_square_bounds(model.width * max(1, policy.window))
        self.marginal = estimator.marginal
        reopens = tuning.reopen is not None and model.nx <= LARGE
        self.rule = doubt.rule_of(tuning.gate, tuning.gate_kind, reopens)
        self.gate_limits = np.full(model.width + 1, np.inf)
        if tuning.gate is not None:
            self.gate_limits[1:] = chi_square_quantile(tuning.gate, np.arange(1, model.width + 1))
        self._seen = self._see(expected, prior)
        self._place = place_of_record(self._seen)
        self.context: Any = self._seen
        self._in_python = model.black_box or estimator.interpreted
        if self._in_python:
            self.context = View(self.compiled, self._seen, tuning, options, pairs, self.held)
        self.work = scratch(estimator.work_size(options, model.nx, model.width) + 1)
        self.score = np.empty(WHITENED + model.ny)

    @cached_property
    def code(self) -> Code:
        """The filter's functions, compiled or loaded from the cache at first use."""
        return driven(self.estimator) if self.model.black_box else self.estimator.code()

    @cached_property
    def _run(self) -> Callable:
        """The loop over events, compiled or loaded from the cache at first use."""
        return partial(fold_loop.run_and_judge, compiled_judge(), self.context) if self._in_python else compiled()[0]

    @cached_property
    def _begin(self) -> Callable:
        return fold_loop.begin if self._in_python else compiled()[1]

    def _see(self, expected: np.ndarray | None, prior: Moments | None) -> np.void:
        """Make the context of this model and tuning; `held` keeps the arrays that it points to."""
        model, tuning = self.model, self.tuning
        baseline = no_baseline(model) if tuning.baseline is None else tuning.baseline
        own = {
            "p": np.ascontiguousarray(tuning.p, float),
            "q": np.ascontiguousarray(tuning.q, float),
            # A copy: variances of a single measurement are written here while it is folded.
            "r": np.array(tuning.r, float),
            "used": tuning.used.astype(np.int8),
            "gate": np.tile(self.gate_limits, (len(model.sensors), 1)),
            "options": np.ascontiguousarray(self.estimator.tune(self.options, model, tuning), float),
            "pairs": self._pairs,
            "prepared": self.estimator.prepare(model, self.options),
            **limits_of(model),
            **detector_context(model, tuning.gate, self.marginal, baseline, expected),
        }
        if model.linear and model.nu == 0:
            rows = [len(sensor.rows) for sensor in model.sensors]
            own["H"], own["H_mode"], self._jacobians = constant_rows(self.compiled.static, own["p"], rows, model.nx)
        self.held: dict[str, Any] = {**self.compiled.static, **own}
        if prior is not None:
            self.held["prior_mean"], self.held["prior_cov"] = prior
        sizes = {
            "nx": model.nx,
            "nu": model.nu,
            "n_parameters": own["p"].size,
            "n_noises": own["q"].size,
            "n_sensors": len(model.sensors),
            "n_rows": own["r"].size,
            "n_options": own["options"].size,
            "n_pairs": len(self._pairs),
            "n_shown": len(model.shown),
            "n_prepared": own["prepared"].size,
            "n_memory": self.estimator.memory(self.options, model),
            "n_baseline": own["baseline"].size,
            "width": model.width,
            "seed": tuning.seed,
            **memory_context(self.estimator, model, self.policy.corrections),
        }
        plain = {k: v.ctypes.data if isinstance(v, np.ndarray) else v for k, v in self.held.items()}
        return context_of(**plain, **sizes)

    @property
    def prior(self) -> Moments:
        """Mean (nx,) and covariance (nx, nx) at the log's start; of a large state the variances (1, nx)."""
        return self.held["prior_mean"], self.held["prior_cov"]

    def fresh(self) -> Snapshot:
        """Return the snapshot before the first event; `begin` has yet to fill the filter's state."""
        model = self.model
        numbers = self.estimator.state_size(self.options, model.nx) + self.estimator.memory(self.options, model)
        return Snapshot(
            clock=np.array([UNSET]),
            u=model.default_inputs.copy(),
            state=np.empty(numbers),
            evidence=fresh(model, fresh_memory(model) if self._seen["memory"] else None),
            edge=fresh_screen(model),
            doubt=doubt.fresh(len(model.sensors)),
        )

    def rows(self, count: int) -> Track:
        """Allocate the track of `count` events."""
        model = self.model
        return Track.allocate(count, len(model.shown), len(self._pairs), model.ny, model.width)

    def begin(self, mean: np.ndarray, cov: np.ndarray, state: np.ndarray) -> None:
        """Set a filter's state to N(mean, cov)."""
        self._begin(self.code, self.context, np.ascontiguousarray(mean), np.ascontiguousarray(cov), state)

    def begin_at(self, base: Base, now: Snapshot) -> None:
        """Set a snapshot to a base."""
        now.clock[0], now.u[:] = base.clock, base.u
        self.begin(base.mean, base.cov, now.state)
        left = [(now.edge, base.edge)]
        if base.estimator == self.estimator.name and base.state is not None and base.state.size == now.state.size:
            left += [(now.state, base.state), (now.doubt, base.doubt)]
            # A fleet follows no memory of the states, which comes last.
            if base.evidence is not None and base.evidence.size in (now.evidence.size, fresh(self.model).size):
                left += [(now.evidence[: base.evidence.size], base.evidence)]
        for mine, its in left:
            if its is not None and its.shape == mine.shape:
                mine[:] = its

    def moments(self, state: np.ndarray) -> Moments:
        """Return mean and covariance (beyond `LARGE` states the variances) of a filter's state."""
        return self.estimator.moments(self.options, state, self.model.nx)

    def run(
        self, log: Log, start: int, stop: int, now: Snapshot, spare: np.ndarray, track: Track,
        blanks: Sequence[Blank] = (),
    ) -> int:  # fmt: skip
        """Fold events `start` to `stop` of a log into the same rows of a track.

        Args:
            log: The log.
            start: The first event.
            stop: The event after the last.
            now: Snapshot before `start`; becomes the one before `stop`.
            spare: Scratch of the size of `now.state`; holds the state that answered the last query.
            track: Its rows are filled.
            blanks: Become snapshots before events between `start` and `stop`, ascending.

        Returns:
            The row of a measurement that asks for a decision, after which the loop stopped, or -1.
        """
        columns = log.t, log.kind, log.channel, log.value, log.width
        return self._call(self.rule, log.first, start, stop, *columns, now, spare, track, blanks=blanks)

    def run_apart(
        self, log: Log, start: int, stop: int, now: Snapshot, code: Code | None = None, judged: bool = True
    ) -> tuple[Track, np.ndarray]:
        """Fold events into a separate track, without decisions on sensors.

        Args:
            log: The log.
            start: The first event.
            stop: The event after the last.
            now: Snapshot before `start`; becomes the one before `stop`.
            code: Functions to use in place of the filter's.
            judged: Whether windows, alarms and health of the rows are filled, which does not change the estimate.

        Returns:
            The track, and the state from which the last query was answered.
        """
        track = self.rows(stop - start)
        within = slice(start, stop)
        columns = log.t[within], log.kind[within], log.channel[within], log.value[within], log.width
        spare, rule = np.empty_like(now.state), self.rule._replace(most=0)
        policy = self.policy if judged else self.policy._replace(window=0)
        self._call(rule, log.first + start, 0, stop - start, *columns, now, spare, track, code, policy=policy)
        return track, spare

    def _call(
        self, rule: doubt.Rule, first: int, start: int, stop: int, t: np.ndarray, kind: np.ndarray,
        channel: np.ndarray, value: np.ndarray, width: int, now: Snapshot, spare: np.ndarray, track: Track,
        code: Code | None = None, blanks: Sequence[Blank] = (), policy: HealthPolicy | None = None,
    ) -> int:  # fmt: skip
        """Call `fold_kernel.run_and_judge`."""
        stops = np.array([*(at for at, _, _ in blanks), stop], np.int64)
        places = np.array([place for _, _, place in blanks], np.int64)
        kept = [blank for _, blank, _ in blanks] if self._in_python else places
        asking = self._run(
            code or self.code, self._place, rule, first, start, stops, t, kind, channel, value, width,
            now.clock, now.u, now.state, now.doubt, now.edge, spare, self.work, self.score, track,
            policy or self.policy, self.bounds, now.evidence, kept,
        )  # fmt: skip
        return int(asking)

    def second_story(
        self, log: Log, at: int, snapshot: Snapshot, start: int, stop: int, sensor: int, innovation: np.ndarray,
        every: bool = False,
    ) -> Story:  # fmt: skip
        """Fold events under the hypothesis that the estimate was wrong before a rejected measurement.

        Args:
            log: The log.
            at: Event of the snapshot, not after `start`.
            snapshot: State of the fold before `at`.
            start: The rejected measurement.
            stop: The event after the last.
            sensor: Sensor of the measurement: its gate is off, and the covariance is widened before.
            innovation: Innovation of the measurement when it was rejected, (width,).
            every: Whether the gates of all sensors are off.
        """
        # Under this hypothesis no sensor is wrong, so the record of rejected sensors starts empty.
        end = snapshot.copy()._replace(doubt=doubt.fresh(len(self.model.sensors)))
        self.run_apart(log, at, start, end)
        added = self.widen(end, sensor, innovation)
        with self.open(slice(None) if every else sensor):
            track, _ = self.run_apart(log, start, stop, end)
        return Story(track, end, np.sqrt(added))

    def widen(self, now: Snapshot, sensor: int, innovation: np.ndarray) -> np.ndarray:
        """Widen the covariance until an innovation (ny,) of a sensor passes; return the added variances (nx,)."""
        mean, cov = self.moments(now.state)
        H = self._slope(sensor, mean, now.u)
        added = widening(variances_of(cov), variances_of(self.prior[1]), H, innovation[: len(H)])
        self.begin(mean, cov + (added if len(cov) == 1 else np.diag(added)), now.state)
        now.doubt[:] = doubt.fresh(len(self.model.sensors))
        return added

    def maintain(self, mean: np.ndarray, cov: np.ndarray, state: int, t: int, now: Snapshot) -> bool:
        """Restart from N(mean, cov) at time t with one state as in the prior; return False if these are not finite."""
        if not (np.all(np.isfinite(mean)) and np.all(np.isfinite(cov))):
            return False
        self.begin(mean, without(cov, self.prior[1], state), now.state)
        now.clock[0] = t
        return True

    def _slope(self, sensor: int, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Return dh/dx (ny, nx) of a sensor, with zeros for the mode."""
        if isinstance(self.context, View):
            H = self.context.H(sensor, x, u)
        else:
            H = np.empty((len(self.model.sensors[sensor].rows), self.model.nx))
            scratch = np.empty(scratch_size(self.model.nx, self.model.width))
            sensor_jacobian(self.context, sensor, np.ascontiguousarray(x), u, H, scratch)
        if self.model.mode >= 0:
            H[:, self.model.mode] = 0.0
        return H

    @contextmanager
    def open(self, sensor: int | slice) -> Iterator[None]:
        """Context manager: switch the gate of a sensor, or of several, off."""
        self.held["gate"][sensor] = np.inf
        try:
            yield
        finally:
            self.held["gate"][sensor] = self.gate_limits

    def settle(self) -> None:
        """Restore the tuned noise and gates after an interrupt between two events."""
        self.held["r"][:] = self.tuning.r
        self.held["gate"][:] = self.gate_limits


def variances_of(cov: np.ndarray) -> np.ndarray:
    """Return the diagonal (nx,) of a covariance, or the variances (1, nx) of a large state as (nx,)."""
    return cov[0] if len(cov) == 1 else np.diag(cov)


def scratch(size: int) -> np.ndarray:
    """Return `size` numbers of NaN aligned to a cache line, so that aligned vectors never cross one."""
    numbers = np.full(size + 8, np.nan)
    first = -numbers.ctypes.data % 64 // 8
    return numbers[first : first + size]
