"""State-space models: names, units, prior, noise and plain functions of ONE state.

x' = f(x, u, p, dt) + w,   w ~ N(0, Q(x, u, p, dt))
y  = h(x, u, p) + v,       v ~ N(0, R)

A model is written once, for one state, in plain Python that fills `out`; `compiled/` turns it into machine code
that every filter calls.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..errors import LARGEST, ModelError
from .parts import CellNames, Field, Limits, Row, Sensor, State, Stuck, check_range, correlation_error

LARGE = 1024
"""States beyond which no filter forms an (nx, nx) matrix: priors are diagonal, moments are means and variances."""

TRUTH_BLOCK = 32  # States up to which one event of the log holds the whole true state
SHOWN = 64  # States that a track keeps of a model that does not choose them

__all__ = [
    "LARGE", "Field", "Input", "Jump", "Limits", "Noise", "Parameter", "Row", "Sensor", "State", "StateSpaceModel",
    "Stuck",
]  # fmt: skip


@dataclass(frozen=True)
class Noise:
    """A process noise: `variance` is the variance that it adds in one second, in `unit`.

    Without the model's Q, `name` is the state that it acts on, or the field on each of whose cells it acts.
    """

    name: str
    unit: str
    variance: float


@dataclass(frozen=True)
class Input:
    """One entry of u, held until it changes; `default` before the first value; the ranges are those of `State`."""

    name: str
    unit: str
    default: float = 0.0
    fitted: tuple[float, float] | None = None
    near: float | None = None
    far: float | None = None

    def __post_init__(self) -> None:
        """Refuse an empty range."""
        check_range(f"input {self.name}: fitted", self.fitted)


@dataclass(frozen=True)
class Parameter:
    """One entry of p, a constant of the model, with its admissible range; if `listed`, panels and fits offer it."""

    name: str
    unit: str
    value: float
    low: float = -np.inf
    high: float = np.inf
    listed: bool = True


@dataclass(frozen=True)
class Jump:
    """A discrete mode: the state with the values 0, 1, …, their names, and the probabilities of jumps.

        m' ~ chances(x, u, p, dt),   then   x' = f(x with m', u, p, dt) + w

    chances(x, u, p, dt, out) fills `out` (modes,) with the probability of each mode after `dt` seconds, given the state
    x with its mode. The mode's prior is that of its state: with two modes, the mean is the probability of the second;
    with more, a Gaussian at the whole numbers. f keeps the mode (out[mode] = x[mode]) and no noise acts on it. f and h
    must accept any number for it, since filters that do not sample use its mean (`indicator`).

    Source: Doucet, Gordon & Krishnamurthy (2001), Particle filters for state estimation of jump Markov linear systems,
    doi:10.1109/78.905890, section II (the mode jumps first, then the state moves in the new mode).
    """

    state: str
    modes: tuple[str, ...]
    chances: Callable


class EventLayout:
    """Sizes of a model's events.

    Args:
        name: Name of the model, for messages.
        sensors: Names of its sensors.
        rows: Number of rows of each sensor.
        nu: Number of inputs.
        nx: Number of states.
    """

    def __init__(self, name: str, sensors: tuple[str, ...], rows: tuple[int, ...], nu: int, nx: int) -> None:
        self.name, self.sensors, self.rows, self.nu, self.nx = name, sensors, rows, nu, nx

    def same(self, other: EventLayout | None) -> bool:
        """Return whether both have events of the same sizes."""
        if other is None or self is other:
            return self is other
        return (self.rows, self.nu, self.nx) == (other.rows, other.nu, other.nx)

    @cached_property
    def least(self) -> int:
        """Columns of an event that a fold reads: those of the longest measurement, or all inputs."""
        return max(*self.rows, self.nu)

    @cached_property
    def counts(self) -> np.ndarray:
        """Rows of each sensor."""
        return np.array(self.rows, np.int64)


def _twice(what: str, names: Sequence[str]) -> Iterator[str]:
    """Yield the first name that occurs twice, as a flaw."""
    for name in sorted(name for name, count in Counter(names).items() if count > 1)[:1]:
        yield f"{what} {name!r} twice; every name must differ"


@dataclass(frozen=True)
class StateSpaceModel:
    """A state-space model; see the module's equations.

    f(x, u, p, dt, out) fills the next state (nx,) after `dt` seconds. Q(x, u, p, q, dt, out) fills the covariance
    (nx, nx) of the noise added in `dt`, where q (nw,) holds the variances of `noises` as they are tuned now; without
    it, q is added to the states of the same names, as q·dt. F(x, u, p, dt, out) fills the Jacobian (nx, nx).

    `states` may be a `Field`, of any size. Beyond `LARGE` states there is no Q; shape(z, p, out) may then fill `out`
    (nx,) with L z, where L Lᵀ has ones on its diagonal: the noise of the process, √(q·dt) L z, and the spread of the
    prior, std L z, are correlated in space by it, without a matrix.

    A `jump` makes one state a discrete mode. `conditionally_linear` names states in which f and h are
    linear once the other states are known, with noise that does not depend on them: `rbpf` carries these by a Kalman
    filter. The last `considered` states are not estimated: their uncertainty widens P and lowers the gain, and no
    measurement changes them (Schmidt's filter). `prior_correlation` (nx, nx) is that of the prior; empty for
    independent states.

    Steps longer than `max_step` seconds are split, so that f may use a simple integration scheme.

    A `black_box` is not compiled: f(X, u, p, dt) takes a block of states X (N, nx) and returns the next ones (N, nx), a
    sensor's h(X, u, p) returns (N, ny). Row i of the result depends on row i alone, without randomness. `executor`
    splits the block: "threads" (for an f that releases the GIL), "processes" (f and h must be module-level functions of
    a module or of the model's file, which each process runs once), or any concurrent.futures.Executor; None does not
    split. Q and shape remain compiled functions of one state.
    """

    name: str
    title: str
    states: Sequence[State]
    sensors: tuple[Sensor, ...]
    noises: tuple[Noise, ...]
    f: Callable
    inputs: tuple[Input, ...] = ()
    parameters: tuple[Parameter, ...] = ()
    Q: Callable | None = None
    F: Callable | None = None
    shape: Callable | None = None
    linear: bool = False
    max_step: float = np.inf
    source: str = ""
    black_box: bool = False
    executor: Executor | str | None = None
    jump: Jump | None = None
    conditionally_linear: tuple[str, ...] = ()
    considered: int = 0
    prior_correlation: tuple[tuple[float, ...], ...] = ()

    def __post_init__(self) -> None:
        """Refuse models that no filter could run: nothing to estimate, duplicate names, numbers out of range."""
        for flaw in self._flaws():
            raise ModelError(f"model {self.name}: {flaw}")

    def _flaws(self) -> Iterator[str]:
        field = isinstance(self.states, Field)
        for kind in ("states", "sensors", "noises", "inputs", "parameters"):
            items = getattr(self, kind)
            if not items and kind in ("states", "sensors", "noises"):
                yield f"{kind} is empty; name at least one"
            yield from _twice(f"{kind} names", () if field and kind == "states" else [item.name for item in items])
        for state in () if field else self.states:
            if not (0.0 <= state.std <= LARGEST and abs(state.mean) <= LARGEST):
                yield (
                    f"the prior of {state.name} is {state.mean} ± {state.std}; both must be finite, {LARGEST:g} at "
                    "most, and the second zero or positive"
                )
        for item in self.parameters:
            if not item.low <= item.high:
                yield (
                    f"parameter {item.name} ranges from {item.low:g} to {item.high:g}; the first must not be above "
                    "the second"
                )
        for noise in self.noises:
            if not (noise.variance >= 0 and np.isfinite(noise.variance)):
                yield f"noise {noise.name} has variance {noise.variance}; it must be zero or positive"
        for sensor in self.sensors:
            if not sensor.rows:
                yield f"sensor {sensor.name} has no rows; name at least one"
            if len({row.name for row in sensor.rows}) < len(sensor.rows):
                yield f"sensor {sensor.name} names a row twice; every name must differ"
            wrong = correlation_error(sensor.correlation, len(sensor.rows)) if sensor.correlation is not None else None
            if wrong:
                yield f"the correlation of sensor {sensor.name} {wrong}"
            wrong = sensor.limits.flaw(len(sensor.rows)) if sensor.limits is not None else None
            if wrong:
                yield f"sensor {sensor.name}: {wrong}"
            for row in sensor.rows:
                if not (row.variance >= 0 and np.isfinite(row.variance)):
                    yield (
                        f"sensor {sensor.name}.{row.name} has variance {row.variance}; it must be positive, or zero "
                        "of a row without noise"
                    )
        stray = next((noise.name for noise in self.noises if not self.acts_on(noise.name)), None)
        if self.Q is None and stray is not None:
            yield f"noise {stray!r} is not a state or field; name one, or write Q(x, u, p, q, dt, out)"
        if self.Q is not None and (self.shape is not None or self.nx > LARGE):
            yield (
                f"Q of {self.nx:,} states would be a matrix of {8e-9 * self.nx**2:.3g} GB; name the noise after the "
                "field and correlate it with shape(z, p, out), which takes Q's place"
            )
        if self.black_box and (self.F or any(s.H or s.log_likelihood for s in self.sensors)):
            yield "a black box gives f and h of blocks of states only; leave out F, H and log_likelihood"
        if self.executor is not None and not self.black_box:
            yield "executor is for a black box; set black_box=True or leave it out"
        if isinstance(self.executor, str) and self.executor not in ("threads", "processes"):
            yield (
                f"executor is {self.executor!r}; it must be 'threads', 'processes', or a concurrent.futures.Executor"
            )
        yield from self._flaws_of_parts()
        if not self.max_step > 0:
            yield f"max_step is {self.max_step} s; it must be positive"

    def _flaws_of_parts(self) -> Iterator[str]:
        """Yield the flaws of the mode and the linear part."""
        if isinstance(self.states, Field) and (self.jump or self.conditionally_linear):
            yield "a field has no mode and no linear part; list the states"
        for name in self.conditionally_linear:
            if name not in self.state_names or (self.jump and name == self.jump.state):
                yield f"conditionally_linear names {name!r}, {'the mode' if name in self.state_names else 'no state'}"
        if len(set(self.conditionally_linear)) < len(self.conditionally_linear):
            yield "conditionally_linear names a state twice"
        if self.jump is None:
            return
        if self.jump.state not in self.state_names:
            yield f"jump names {self.jump.state!r}, no state; name one of them"
        state, last = self.states[self.mode], len(self.jump.modes) - 1
        if last < 1 or not 0 <= state.mean <= last or state.circular:
            yield (
                f"the mode {state.name} has {last + 1} values and the prior mean {state.mean:g}; it needs at least 2, "
                f"a mean between 0 and {max(1, last)}, and must not be an angle"
            )
        if self.Q is None and any(noise.name == state.name for noise in self.noises):
            yield f"a noise acts on the mode {state.name}, which jumps; leave it out"
        if self.black_box or self.linear:
            yield "a model with a jump is neither linear nor a black box; say neither"

    @cached_property
    def default_inputs(self) -> np.ndarray:
        """Inputs before their first value, (nu,)."""
        return np.array([item.default for item in self.inputs], float)

    @cached_property
    def default_parameters(self) -> np.ndarray:
        """Declared values of the parameters."""
        return np.array([item.value for item in self.parameters], float)

    @cached_property
    def mode(self) -> int:
        """Index of the state that is the discrete mode; -1 if none is."""
        return -1 if self.jump is None else self.state_names.index(self.jump.state)

    @cached_property
    def linear_states(self) -> np.ndarray:
        """Indices of the conditionally linear states, rising; of a linear model all."""
        if self.linear and not self.conditionally_linear and not isinstance(self.states, Field):
            return np.arange(self.nx)
        return np.array(sorted(self.state_names.index(name) for name in self.conditionally_linear), np.int64)

    def label(self, state: str) -> str:
        """Return the label of a state's estimate: its name, or that of a probability, for a mode with two values."""
        two = self.jump is not None and state == self.jump.state and len(self.jump.modes) == 2
        return f"probability of {state}" if two else state

    @cached_property
    def layout(self) -> EventLayout:
        """Sizes of this model's events."""
        rows = tuple(len(sensor.rows) for sensor in self.sensors)
        return EventLayout(self.name, self.sensor_names, rows, self.nu, self.nx)

    @property
    def nx(self) -> int:
        """Number of states."""
        return len(self.states)

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return len(self.inputs)

    @cached_property
    def ny(self) -> int:
        """Rows of the longest sensor."""
        return max(len(sensor.rows) for sensor in self.sensors)

    @cached_property
    def state_names(self) -> Sequence[str]:
        """Names of the states, in order."""
        if isinstance(self.states, Field):
            return CellNames(self.states)
        return tuple(state.name for state in self.states)

    @cached_property
    def prior_mean(self) -> np.ndarray:
        """Prior mean of every state, (nx,)."""
        if isinstance(self.states, Field):
            return self.states.prior_mean
        return np.array([state.mean for state in self.states], float)

    @cached_property
    def prior_std(self) -> np.ndarray:
        """Prior standard deviation of every state, (nx,)."""
        if isinstance(self.states, Field):
            return np.full(self.nx, float(self.states.std))
        return np.array([state.std for state in self.states], float)

    @cached_property
    def prior_cov(self) -> np.ndarray:
        """Prior covariance (nx, nx), of a model that is no large field."""
        if not self.prior_correlation:
            return np.diag(self.prior_std**2)
        return np.array(self.prior_correlation) * np.outer(self.prior_std, self.prior_std)

    @cached_property
    def circular(self) -> np.ndarray:
        """For each state, whether it is an angle, (nx,) int8."""
        if isinstance(self.states, Field):
            return np.zeros(self.nx, np.int8)
        return np.array([state.circular for state in self.states], np.int8)

    @property
    def grid(self) -> Field | None:
        """The field, if it has too many cells for a chart each; None otherwise."""
        return self.states if isinstance(self.states, Field) and self.nx > SHOWN else None

    @cached_property
    def shown(self) -> np.ndarray:
        """Indices of the states with a column in the track: all that are estimated, or those that a field names."""
        if isinstance(self.states, Field) and self.states.shown:
            return np.array(self.states.shown, np.int64)
        estimated = self.nx - self.considered
        if estimated <= SHOWN:
            return np.arange(estimated)
        if isinstance(self.states, Field):
            axes = [np.unique(np.linspace(0, n - 1, 6).round().astype(int)[1:-1]) for n in self.states.shape]
            cells = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))
            return np.ravel_multi_index(cells.T, self.states.shape)[:SHOWN].astype(np.int64)
        return np.unique(np.linspace(0, estimated - 1, SHOWN).round().astype(np.int64))

    @cached_property
    def shown_states(self) -> tuple[State, ...]:
        """The states of the track's columns, in order."""
        return tuple(self.states[int(j)] for j in self.shown)

    @property
    def units(self) -> dict[str, str]:
        """Units of the shown states and the inputs, by name."""
        units = {state.name: state.unit for state in self.shown_states}
        return units | {item.name: item.unit for item in self.inputs}

    def acts_on(self, noise: str) -> range:
        """Return the states to which a noise of that name adds: one, a whole field, or none."""
        if isinstance(self.states, Field):
            return range(self.nx if noise == self.states.name else 0)
        if noise not in self.state_names:
            return range(0)
        first = self.state_names.index(noise)
        return range(first, first + 1)

    def positions(self) -> np.ndarray | None:
        """Return the positions of the states, (nx, axes); None if one has none."""
        if isinstance(self.states, Field):
            return self.states.positions()
        places = [state.position for state in self.states]
        return None if any(place is None for place in places) else np.array(places, float)

    @property
    def periods(self) -> tuple[float, ...] | None:
        """Length after which space repeats along each axis (infinite where it does not); None without a field."""
        return self.states.periods if isinstance(self.states, Field) else None

    @cached_property
    def sensor_names(self) -> tuple[str, ...]:
        """Names of the sensors, in order."""
        return tuple(sensor.name for sensor in self.sensors)

    @cached_property
    def correlated(self) -> str | None:
        """Name of the first sensor whose rows are correlated, if there is one."""
        return next((sensor.name for sensor in self.sensors if sensor.correlation is not None), None)

    @cached_property
    def certain(self) -> str | None:
        """The first noise-free row or certain state, which can make covariances singular; None if there is none."""
        exact = [f"{sensor.name}.{row.name}" for sensor in self.sensors for row in sensor.rows if row.variance == 0.0]
        known = [] if isinstance(self.states, Field) else [state.name for state in self.states if state.std == 0.0]
        return f"{exact[0]} reads without noise" if exact else f"{known[0]} is certain at first" if known else None

    @cached_property
    def input_names(self) -> tuple[str, ...]:
        """Names of the inputs, in order."""
        return tuple(item.name for item in self.inputs)

    @cached_property
    def row_names(self) -> tuple[str, ...]:
        """Every sensor row: `speed`, or `gnss.east` where a sensor has several rows."""
        return tuple(
            sensor.name if len(sensor.rows) == 1 else f"{sensor.name}.{row.name}"
            for sensor in self.sensors
            for row in sensor.rows
        )

    @cached_property
    def row_start(self) -> tuple[int, ...]:
        """Index of each sensor's first row among all rows."""
        return tuple(int(k) for k in np.cumsum([0] + [len(sensor.rows) for sensor in self.sensors])[:-1])

    @cached_property
    def width(self) -> int:
        """Columns of an event of the log: as many as the longest measurement, the inputs, or a block of true states.

        A block holds the whole state of a small model, and `TRUTH_BLOCK` states of a large one.
        """
        return max(min(self.nx - self.considered, TRUTH_BLOCK), self.nu, self.ny)


def squared(unit: str) -> str:
    """Return the unit of a variance: °C → °C², m/s → (m/s)²."""
    if not unit or unit == "1":
        return unit
    return f"({unit})²" if "/" in unit or " " in unit or "·" in unit else f"{unit}²"


def per_second(unit: str) -> str:
    """Return the unit of a change a second: °C → °C/s, m/s → m/s²."""
    if unit.endswith("/s"):
        return f"{unit}²"
    return f"({unit})/s" if "/" in unit else f"{unit}/s"
