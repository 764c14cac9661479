"""A simulated asset: a model with a truth of its own, and sensors with rates, noise and losses."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from estimators.compiled.context import steps_of
from estimators.compiled.model import compile_model
from estimators.errors import NisusError, SourceError, nearest
from estimators.log import INPUT, READING, TICK, TRUTH, Events
from estimators.model.state_space import StateSpaceModel
from estimators.numerics.jit import plain
from estimators.numerics.linalg import wrapped

from .faults.kinds import NEVER_NS, Change
from .merged import batch_of
from .source import Source

BATCH_EVENTS = 32  # Events after which `read` returns; a change of the asset affects unread events only


@dataclass(frozen=True)
class SensorPlan:
    """A sensor reports at every `every`th step; one in `drop_every` of its measurements is lost (it arrives empty).

    `variances` of its true noise, one for each row, in place of the model's.
    """

    every: int = 1
    variances: tuple[float, ...] | None = None
    drop_every: int | None = None


class Simulator(Source):
    """Source of a simulated asset, as fast as it is read.

    In each step, in this order: the mode jumps, where the model has one; x ← f(x, u, p, dt) + w with w ~ N(0, Q); then
    y = h(x, u, p) + v with v ~ N(0, R) for each sensor that is due, drawn even if the reading is lost, so that a loss
    does not change what follows. Its first event is a tick at time zero, where the estimator's prior holds; then, after
    every step: the inputs if they changed, the readings, and the true states that a track shows, in blocks of the log's
    width; or, every `truth_every` steps, all states.
    """

    live = False

    def __init__(
        self,
        model: StateSpaceModel,
        *,
        seed: int,
        step: float,
        duration: float | None = None,
        initial: Mapping[str, float] | None = None,
        truth_parameters: Mapping[str, float] | None = None,
        truth_model: StateSpaceModel | None = None,
        truth_noise: Mapping[str, float] | None = None,
        inputs: Mapping[str, Profile] | None = None,
        sensors: Mapping[str, SensorPlan] | None = None,
        truth_every: int | None = None,
    ) -> None:
        """Set the asset up.

        Args:
            model: The estimator's model: inputs, sensors and, by default, the truth.
            seed: Of all noise.
            step: Seconds.
            duration: Seconds; None never ends.
            initial: True states at the start, where they differ from the prior's mean.
            truth_parameters: Parameters of the asset, where they differ from the model's values.
            truth_model: Another model with the same states, inputs and sensors: unmodelled behaviour.
            truth_noise: Variances that the asset's noise adds in a second, where they differ.
            inputs: Profiles by name; the others keep their default.
            sensors: Plans by name; a sensor without one reports at every step.
            truth_every: Steps between two outputs of all states of a large field; None for never.

        Raises:
            SourceError: If a duration or step is not positive.
        """
        truth = truth_model or model
        if not step > 0:
            raise SourceError(f"simulator: step is {step} s; it must be positive")
        if duration is not None and not duration > 0:
            raise SourceError(f"simulator: duration is {duration} s; it must be positive, or null for no end")
        self._truth = compile_model(truth)
        self._model = model
        self._step = step
        self._steps = None if duration is None else round(duration / step)
        self.endless = duration is None
        self.span = None if duration is None else (0, self._time(round(duration / step)))
        self._x = truth.prior_mean.copy()
        for name, value in dict(initial or {}).items():
            self._x[truth.state_names.index(name)] = value
        values = dict(truth_parameters or {})
        self._own_p = np.array([values.get(item.name, item.value) for item in truth.parameters], float)
        self._p = self._own_p.copy()
        self._changes: list[Change] = []
        variances = dict(truth_noise or {})
        self._q = np.array([variances.get(item.name, item.variance) for item in truth.noises], float)
        profiles = dict(inputs or {})
        self._profiles = [profiles.get(item.name, constant_input(item.default)) for item in model.inputs]
        plans = dict(sensors or {})
        self._plans = [plans.get(sensor.name, SensorPlan()) for sensor in model.sensors]
        self._std = [
            np.sqrt(plan.variances if plan.variances is not None else [row.variance for row in sensor.rows])
            for plan, sensor in zip(self._plans, model.sensors, strict=True)
        ]
        # Factors of the correlation matrices, by which white noise becomes the sensor's.
        self._roots = [
            None if sensor.correlation is None else factor(np.array(sensor.correlation)) for sensor in model.sensors
        ]
        self._reported = [0] * len(self._plans)
        self._rng = np.random.default_rng(seed)
        self._factor: tuple[bytes, np.ndarray] | None = None
        self._shown_runs = _runs(model.shown, model.width)
        self._all_every = truth_every
        self._all = _runs(np.arange(model.nx), model.width) if truth_every is not None else []
        self._k = 0
        self._u = self._inputs(0.0)
        self._begun = False

    def _time(self, k: int) -> int:
        return round(k * self._step * 1e9)

    def _inputs(self, t: float) -> np.ndarray:
        return np.array([profile(t) for profile in self._profiles], float)

    def read(self, timeout: float) -> Events | None:
        """Return the events of the next steps; None at the end."""
        rows: list[tuple[int, int, int, np.ndarray]] = []
        if not self._begun:
            self._begun = True
            rows.append((0, TICK, 0, np.zeros(0)))
            if self._u.size:
                rows.append((0, INPUT, 0, self._u))
        while len(rows) < BATCH_EVENTS and (self._steps is None or self._k < self._steps):
            try:
                self._advance(rows)
            except NisusError:
                raise
            except Exception as error:
                raise SourceError(
                    f"the simulator's model {self._model.name} fails at {self._k * self._step:g} s: "
                    f"{type(error).__name__}: {error}; it may not fail at states that the asset reaches"
                ) from error
        if not rows:
            return None
        return batch_of([(t, t, kind, channel, given) for t, kind, channel, given in rows], self._model.width)

    def _advance(self, rows: list[tuple[int, int, int, np.ndarray]]) -> None:
        """Simulate one step and append its events."""
        truth = self._truth
        self._k += 1
        t = self._time(self._k)
        if self._changes:
            self._p = self._changed(t)
        pieces = steps_of(self._step, truth.model.max_step)
        for _ in range(pieces):
            self._jump(self._step / pieces)
            after = np.empty_like(self._x)
            truth.f(self._x, self._u, self._p, self._step / pieces, after)
            self._x = after
        self._x = self._x + self._noise()
        self._x = wrapped(self._x, truth.model.circular)
        u = self._inputs(self._k * self._step)
        if not np.array_equal(u, self._u):
            rows.append((t, INPUT, 0, u))
            self._u = u
        for i, plan in enumerate(self._plans):
            if self._k % plan.every:
                continue
            y = np.empty(self._std[i].size)
            truth.h[i](self._x, self._u, self._p, y)
            root = self._roots[i]
            if root is None:
                y += self._rng.normal(0.0, self._std[i], size=y.size)
            else:
                y += self._std[i] * np.sum(root * self._rng.standard_normal(y.size), axis=1)
            lost = plan.drop_every is not None and self._reported[i] % plan.drop_every == plan.drop_every - 1
            self._reported[i] += 1
            rows.append((t, READING, i, np.full(y.size, np.nan) if lost else y))
        runs = self._all if self._all_every is not None and self._k % self._all_every == 0 else self._shown_runs
        rows += [(t, TRUTH, first, self._x[first:end].copy()) for first, end in runs]

    def change(self, parameter: str, factor: float, start: int | None = None, length: int | None = None) -> Change:
        """Multiply a true parameter for `length` ns, or for ever, from `start` on (ns), or with the next step.

        Raises:
            SourceError: If there is no such parameter.
        """
        names = [item.name for item in self._truth.model.parameters]
        if parameter not in names:
            raise SourceError(
                f"simulator: {self._truth.model.name} has no parameter {parameter!r}; {nearest(parameter, names)}"
            )
        begin = self._time(self._k + 1) if start is None else start
        change = Change(parameter, factor, begin, NEVER_NS if length is None else begin + length)
        self._changes.append(change)
        return change

    def end(self, change: Change) -> None:
        """End a change with the next step."""
        change.end = max(change.start, self._time(self._k + 1))

    def _changed(self, t: int) -> np.ndarray:
        """Return the true parameters of the step that ends at t ns."""
        p = self._own_p.copy()
        names = [item.name for item in self._truth.model.parameters]
        for change in tuple(self._changes):
            if change.start <= t < change.end:
                p[names.index(change.parameter)] *= change.factor
        return p

    def _jump(self, dt: float) -> None:
        """Draw the next mode from the model's probabilities."""
        jump = self._truth.model.jump
        if jump is None:
            return
        chances = np.empty(len(jump.modes))
        plain(jump.chances)(self._x.copy(), self._u, self._p, dt, chances)
        self._x[self._truth.model.mode] = self._rng.choice(chances.size, p=chances)

    def _noise(self) -> np.ndarray:
        """Return a draw of N(0, Q), with the factor kept while Q stays."""
        truth = self._truth
        if truth.draw is not None:
            return truth.draw(self._rng.standard_normal(self._x.size), self._p, self._q, self._step)
        Q = np.zeros((self._x.size, self._x.size))
        truth.Q(self._x, self._u, self._p, self._q, self._step, Q)
        key = Q.tobytes()
        if self._factor is None or key != self._factor[0]:
            self._factor = (key, factor(Q))
        return np.sum(self._factor[1] * self._rng.standard_normal(self._x.size), axis=1)


def factor(Q: np.ndarray) -> np.ndarray:
    """Return L (n, n) with L Lᵀ = Q for a positive semidefinite Q, by Cholesky with complete pivoting.

    Elementwise operations only: LAPACK rounds differently on each processor, and a simulated recording must not. What
    remains of a diagonal entry within rounding of zero is zero, so that a singular Q has columns of zeros.

    Source: Higham (2002), Accuracy and Stability of Numerical Algorithms, 2nd edition, 10.3.
    """
    left = Q.copy()
    L = np.zeros_like(Q)
    floor = 16.0 * len(Q) * np.finfo(float).eps * np.diag(Q)
    for k in range(len(Q)):
        pivots = np.where(np.diag(left) > floor, np.diag(left), 0.0)
        i = int(np.argmax(pivots))
        if not pivots[i] > 0.0:
            break
        L[:, k] = left[:, i] / pivots[i] * np.sqrt(pivots[i])
        left -= L[:, k, None] * L[:, k]
        left[i, i] = 0.0
    return L


def _runs(states: np.ndarray, width: int) -> list[tuple[int, int]]:
    """Runs of consecutive states, at most `width` long, as pairs of first and end."""
    runs: list[tuple[int, int]] = []
    for state in states.tolist():
        if runs and runs[-1][1] == state and state - runs[-1][0] < width:
            runs[-1] = (runs[-1][0], state + 1)
        else:
            runs.append((state, state + 1))
    return runs


Profile = Callable[[float], float]
"""Value of an input at t seconds."""


def constant_input(value: float) -> Profile:
    """Return the profile of a constant."""
    return lambda t: value


def stepped_input(times: Sequence[float], values: Sequence[float], repeat: float | None = None) -> Profile:
    """Return a profile that has from each of `times` (s, rising) on the value beside it; before, the first value.

    It starts again after `repeat` seconds.
    """

    def at(t: float) -> float:
        t = t if repeat is None else t % repeat
        return values[max(0, int(np.searchsorted(times, t, side="right")) - 1)]

    return at


def sine_input(mean: float, amplitude: float, period: float, phase: float = 0.0) -> Profile:
    """Return the profile mean + amplitude · sin(2π t / period + phase); period in s, phase in rad."""
    return lambda t: mean + amplitude * float(np.sin(2.0 * np.pi * t / period + phase))


def summed_inputs(parts: Sequence[Profile]) -> Profile:
    """Return the sum of profiles."""
    return lambda t: sum(part(t) for part in parts)
