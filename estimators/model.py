"""What a model is: names, units, prior, noise and plain functions of ONE state.

x' = f(x, u, p, dt) + w,   w ~ N(0, Q(x, u, p, dt))
y  = h(x, u, p) + v,       v ~ N(0, R)

A model is written once, for one state, in plain Python that fills `out`; `compiled.py` turns it into machine code
that every filter calls.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from .errors import ModelError

TRUTH_BLOCK = 32
"""Most states for which an event of the log must have room to tell the truth."""


@dataclass(frozen=True)
class State:
    """One entry of x with its prior N(mean, std²); a `circular` one is an angle in radians and wraps to ±π."""

    name: str
    unit: str
    mean: float = 0.0
    std: float = 1.0
    circular: bool = False


@dataclass(frozen=True)
class Noise:
    """One source of process noise: `variance` is what it adds in one second, in `unit`."""

    name: str
    unit: str
    variance: float


@dataclass(frozen=True)
class Input:
    """One entry of u, a known input, held between its readings; `default` until the first."""

    name: str
    unit: str
    default: float = 0.0


@dataclass(frozen=True)
class Parameter:
    """One entry of p, a constant of the model, with the range in which it makes sense."""

    name: str
    unit: str
    value: float
    low: float = -np.inf
    high: float = np.inf


@dataclass(frozen=True)
class Row:
    """One entry of a sensor's reading, with the variance of its noise; `circular` as in `State`."""

    name: str
    unit: str
    variance: float
    circular: bool = False


@dataclass(frozen=True)
class Sensor:
    """One sensor: the rows that one reading of it holds, and what the model expects it to say.

    h(x, u, p, out) fills `out` (ny,). The optional H(x, u, p, out) fills the Jacobian (ny, nx). A sensor whose noise is
    not Gaussian gives log_likelihood(y, x, u, p, r) -> log p(y | x), with r (ny,) the rows' variances as they are tuned
    now; rows of y that are missing are NaN. Particle filters use it; the others use h and r.
    """

    name: str
    rows: tuple[Row, ...]
    h: Callable
    H: Callable | None = None
    log_likelihood: Callable | None = None


@dataclass(frozen=True)
class StateSpaceModel:
    """A state-space model; see the module's equations.

    f(x, u, p, dt, out) fills the next state (nx,) after `dt` seconds. Q(x, u, p, q, dt, out) fills the covariance
    (nx, nx) of the noise added in `dt`, where q (nw,) holds the variances of `noises` as they are tuned now; without
    it, q is added to the states of the same names, as q·dt. F(x, u, p, dt, out) fills the Jacobian (nx, nx).
    Steps longer than `max_step` seconds are split, so an f that integrates crudely need not integrate far.
    """

    name: str
    title: str
    states: tuple[State, ...]
    sensors: tuple[Sensor, ...]
    noises: tuple[Noise, ...]
    f: Callable
    inputs: tuple[Input, ...] = ()
    parameters: tuple[Parameter, ...] = ()
    Q: Callable | None = None
    F: Callable | None = None
    linear: bool = False
    max_step: float = np.inf
    source: str = ""

    def __post_init__(self) -> None:
        """Refuse what no filter could run: nothing to estimate, names used twice, numbers out of range."""
        for kind in ("states", "sensors", "noises"):
            if not getattr(self, kind):
                raise ModelError(f"model {self.name}: {kind} is empty; name at least one")
        for kind in ("states", "sensors", "noises", "inputs", "parameters"):
            names = [item.name for item in getattr(self, kind)]
            twice = sorted({name for name in names if names.count(name) > 1})
            if twice:
                raise ModelError(f"model {self.name}: {kind} names {twice[0]!r} twice; every name must differ")
        for state in self.states:
            if not (state.std > 0 and np.isfinite(state.std) and np.isfinite(state.mean)):
                raise ModelError(
                    f"model {self.name}: the prior of {state.name} is {state.mean} ± {state.std}; "
                    "both must be finite and the second positive"
                )
        for noise in self.noises:
            if not (noise.variance >= 0 and np.isfinite(noise.variance)):
                raise ModelError(
                    f"model {self.name}: noise {noise.name} has variance {noise.variance}; it must be zero or positive"
                )
        for sensor in self.sensors:
            for row in sensor.rows:
                if not (row.variance > 0 and np.isfinite(row.variance)):
                    raise ModelError(
                        f"model {self.name}: sensor {sensor.name}.{row.name} has variance {row.variance}; "
                        "it must be positive"
                    )
        if self.Q is None:
            strays = [noise.name for noise in self.noises if noise.name not in self.state_names]
            if strays:
                raise ModelError(
                    f"model {self.name}: noise {strays[0]!r} is not a state; name one, or write Q(x, u, p, q, dt, out)"
                )
        if not self.max_step > 0:
            raise ModelError(f"model {self.name}: max_step is {self.max_step} s; it must be positive")

    @property
    def nx(self) -> int:
        """Number of states."""
        return len(self.states)

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return len(self.inputs)

    @cached_property
    def state_names(self) -> tuple[str, ...]:
        """Names of the states, in order."""
        return tuple(state.name for state in self.states)

    @cached_property
    def sensor_names(self) -> tuple[str, ...]:
        """Names of the sensors, in order."""
        return tuple(sensor.name for sensor in self.sensors)

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
        """Columns that one event of the log needs: the longest of a reading, the inputs, and a block of true states.

        A block holds the whole state of a small model, and `TRUTH_BLOCK` states of a large one.
        """
        return max(min(self.nx, TRUTH_BLOCK), self.nu, *(len(sensor.rows) for sensor in self.sensors))
