"""Correlated errors: noise that lasts, as states of its own.

A noise of the process with a correlation time τ is no longer white, but an Ornstein-Uhlenbeck (first-order
Gauss-Markov) disturbance c that drives the states where the white noise did, along b with Q = q·dt·b bᵀ:

    dx = (f(x) + b c) dt,     dc = -c/τ dt + √q/τ dW,     var c = q / (2 τ)

so that ∫c dt gains the variance q a second in the long run, as the white noise does, and is it for τ → 0. A sensor's
error e that lasts is added to what the sensor is expected to say, beside its white noise:

    y = h(x) + e + v,         de = -e/τ dt + σ √(2/τ) dW,   var e = σ²

Both are exact over any step dt, however long beside τ. With a = dt/τ, for the given c at its start:

    c' = e⁻ᵃ c + w,           var w = q/(2τ) (1 - e⁻²ᵃ)
    ∫c dt = τ (1 - e⁻ᵃ) c + w_x,   var w_x = q (dt - 2τ (1 - e⁻ᵃ) + τ/2 (1 - e⁻²ᵃ)),   cov(w_x, w) = q/2 (1 - e⁻ᵃ)²

The integral is added after f, where the white noise was. The states begin in their steady state, N(0, var c) and
N(0, σ²). Correlation times are parameters; q stays the noise that it was, and σ² becomes another.

Source: Uhlenbeck & Ornstein (1930), doi:10.1103/PhysRev.36.823, for the process and its integral; Bryson & Johansen
(1965), doi:10.1109/TAC.1965.1098098, for states that carry correlated noise; Gillespie (1996),
doi:10.1103/PhysRevE.54.2084, for the moments of both over a finite step.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from ..errors import ModelError
from .joint import as_inner
from .state_space import Field, Noise, Parameter, Sensor, State, StateSpaceModel

REACH = 100.0
"""How many times shorter or longer than given a correlation time may be turned."""


class Lasting(NamedTuple):
    """An error of a sensor that lasts: its `std`, one a row, and the correlation time `over` in seconds."""

    std: tuple[float, ...]
    over: float


class Layout(NamedTuple):
    """Where things stand. The model within has n states, k parameters and m noises.

    State n + i keeps itself for the time p[time[i]]. The first `along.shape[1]` are disturbances: state n + i acts on
    the model's states along b = along[:, i] (n, disturbances), and `share[i]` of the noise q[noise[i]] drives it. The
    others are errors of sensors, with the variance q[noise[i]].
    """

    n: int
    k: int
    m: int
    time: tuple[int, ...]
    noise: tuple[int, ...]
    share: tuple[float, ...]
    along: tuple[tuple[float, ...], ...]


def coloured(
    model: StateSpaceModel, noises: Mapping[str, float] | None = None, errors: Mapping[str, Lasting] | None = None
) -> StateSpaceModel:
    """The model with states for what lasts: disturbances in the order of its noises, then errors of its sensors.

    A noise w gets the state `w_disturbance` (`w_x_disturbance` for each x, if it acts on several states
    independently), in units of the driven state a second, and the parameter `w_disturbance_time`. A sensor s gets the
    state `s_error` (`s_y_error` for each of several rows y) in units of its row, a noise of that name, whose value is
    the variance of the error, and the parameter `s_error_time`.

    Args:
        model: The model.
        noises: Correlation time in seconds, by noise.
        errors: What lasts of the errors of sensors, by sensor.

    Raises:
        ModelError: If there is no such noise or sensor, a number is not positive, a name is taken, the noise is not one
            that adds q·dt·D with a constant D, or the model is a field or a black box.
    """
    noises, errors = noises or {}, errors or {}
    if not noises and not errors:
        return model
    _check(model, noises, errors)
    states: list[State] = []
    parameters: list[Parameter] = []
    added: list[Noise] = []
    place: list[tuple[int, int, float]] = []
    along: list[np.ndarray] = []
    for k, noise in enumerate(model.noises):
        if noise.name not in noises:
            continue
        over = noises[noise.name]
        found = channels(model, noise.name)
        for j, share, b in found:
            driven = model.states[j]
            name = f"{noise.name}_disturbance" if len(found) == 1 else f"{noise.name}_{driven.name}_disturbance"
            std = float(np.sqrt(0.5 * noise.variance * share / over))
            states.append(State(name, _rate(driven.unit), 0.0, std, position=driven.position))
            place.append((len(model.parameters) + len(parameters), k, share))
            along.append(b)
        parameters.append(_time(f"{noise.name}_disturbance_time", over))
    first = {}
    for sensor in model.sensors:
        if sensor.name not in errors:
            continue
        lasting = errors[sensor.name]
        first[sensor.name] = model.nx + len(states)
        for row, deviation in zip(sensor.rows, lasting.std, strict=True):
            name = f"{sensor.name}_error" if len(sensor.rows) == 1 else f"{sensor.name}_{row.name}_error"
            states.append(State(name, row.unit, 0.0, deviation, position=row.position))
            place.append((len(model.parameters) + len(parameters), len(model.noises) + len(added), 1.0))
            added.append(Noise(name, _squared(row.unit), deviation**2))
        parameters.append(_time(f"{sensor.name}_error_time", lasting.over))
    layout = Layout(
        n=model.nx,
        k=len(model.parameters),
        m=len(model.noises),
        time=tuple(item[0] for item in place),
        noise=tuple(item[1] for item in place),
        share=tuple(item[2] for item in place),
        along=tuple(tuple(float(b[j]) for b in along) for j in range(model.nx)),
    )
    names = tuple(state.name for state in states)
    return replace(
        model,
        states=(*model.states, *states),
        parameters=(*model.parameters, *parameters),
        noises=(*model.noises, *added),
        f=_step(model.f, layout),
        F=None if model.F is None else _slope(model.F, layout),
        Q=_noise(model.Q, () if model.Q else _acts_on(model), layout),
        sensors=tuple(_heard(sensor, first.get(sensor.name), layout) for sensor in model.sensors),
        jump=None if model.jump is None else replace(model.jump, chances=_inside(model.jump.chances, layout)),
        conditionally_linear=(*model.conditionally_linear, *names) if model.conditionally_linear else (),
    )


def channels(model: StateSpaceModel, noise: str) -> list[tuple[int, float, np.ndarray]]:
    """What a noise drives, independently of each other: the first state j, the part s of q there, and b (nx,), b_j = 1.

    Q = q·dt·Σ s b bᵀ, by columns of the Cholesky factor.

    Raises:
        ModelError: If Q is not q·dt times a constant matrix.
    """
    index = [item.name for item in model.noises].index(noise)
    D = np.zeros((model.nx, model.nx))
    if model.Q is None:
        for j in model.acts_on(noise):
            D[j, j] = 1.0
    else:
        D = _rate_of_noise(model, index)
    found = []
    least = 1e-9 * np.diag(D)
    for j in range(model.nx):
        if D[j, j] > least[j]:
            b = D[:, j] / D[j, j]
            found.append((j, float(D[j, j]), b))
            D = D - D[j, j] * np.outer(b, b)
    if not found:
        raise ModelError(f"model {model.name}: its Q takes no noise {noise}, so there is nothing that could last")
    return found


def _rate_of_noise(model: StateSpaceModel, index: int) -> np.ndarray:
    """D with Q = … + q_index·dt·D, tried over times, states, inputs, parameters and noises."""
    assert model.Q is not None
    Q = getattr(model.Q, "py_func", model.Q)
    rng = np.random.default_rng(0)
    first = None
    for trial in range(6):
        spread = float(trial > 0)
        x = model.prior_mean + spread * model.prior_std * rng.standard_normal(model.nx)
        u = np.array([item.default + spread * rng.standard_normal() for item in model.inputs], float)
        p = np.array([item.value for item in model.parameters], float)
        dt = min(1.0, model.max_step) / (1.0 + trial)
        q = rng.uniform(0.5, 1.5, len(model.noises))
        more = q.copy()
        more[index] += 1.0 + trial
        low, high = np.zeros((2, model.nx, model.nx))
        Q(x, u, p, q, dt, low)
        Q(x, u, p, more, dt, high)
        D = (high - low) / ((1.0 + trial) * dt)
        first = D if first is None else first
        if not np.allclose(D, first, rtol=1e-8, atol=1e-10 * float(np.abs(high).max() / dt)):
            name = model.noises[index].name
            raise ModelError(
                f"model {model.name}: Q does not add {name} as q·dt times a constant matrix, so {name} cannot have a "
                "correlation time; give it a state of its own in the model"
            )
    assert first is not None
    return first


def _check(model: StateSpaceModel, noises: Mapping[str, float], errors: Mapping[str, Lasting]) -> None:
    """Refuse what has no states of its own to append to, and numbers and names that cannot be."""
    if isinstance(model.states, Field) or model.black_box:
        kind = "a field" if isinstance(model.states, Field) else "a black box"
        raise ModelError(f"model {model.name} is {kind}, whose errors cannot be given a correlation time")
    for name in noises:
        known = [item.name for item in model.noises]
        if name not in known:
            raise ModelError(f"model {model.name} has no noise {name!r}; it has {', '.join(known)}")
        if not model.noises[known.index(name)].variance > 0.0:
            raise ModelError(f"model {model.name}: noise {name} has variance 0, and an error of nothing cannot last")
    rows = {sensor.name: len(sensor.rows) for sensor in model.sensors}
    for name, lasting in errors.items():
        if name not in rows:
            raise ModelError(f"model {model.name} has no sensor {name!r}; it has {', '.join(rows)}")
        if len(lasting.std) != rows[name] or not all(std > 0.0 for std in lasting.std):
            raise ModelError(f"model {model.name}: the error of {name} needs {rows[name]} positive std, one a row")
    for name, over in [*noises.items(), *((name, lasting.over) for name, lasting in errors.items())]:
        if not 0.0 < over < np.inf:
            raise ModelError(f"model {model.name}: {name} lasts over {over:g} s; it must be a positive time")


def _time(name: str, over: float) -> Parameter:
    return Parameter(name, "s", over, over / REACH, over * REACH)


def _rate(unit: str) -> str:
    """The unit of a change a second: °C → °C/s, m/s → m/s²."""
    if unit.endswith("/s"):
        return f"{unit}²"
    return f"({unit})/s" if "/" in unit else f"{unit}/s"


def _squared(unit: str) -> str:
    """The unit of a variance."""
    if not unit or unit == "1":
        return unit
    return f"({unit})²" if "/" in unit or " " in unit or "·" in unit else f"{unit}²"


def _acts_on(model: StateSpaceModel) -> tuple[int, ...]:
    """The state on which each noise acts, of a model without Q."""
    return tuple(model.acts_on(noise.name).start for noise in model.noises)


def _integrated(a: float) -> float:
    """Variance of ∫c dt that a step of a = dt/τ adds, over q dt: 1 - (2 (1 - e⁻ᵃ) - (1 - e⁻²ᵃ)/2) / a."""
    if a < 0.05:
        # The terms above cancel to a²/3; of the series, the first that is left out is 3e-13 of that.
        c = (1 / 3, -1 / 4, 7 / 60, -1 / 24, 31 / 2520, -1 / 320, 127 / 181440)
        return a * a * (c[0] + a * (c[1] + a * (c[2] + a * (c[3] + a * (c[4] + a * (c[5] + a * c[6]))))))
    gone = -np.expm1(-a)
    return 1.0 - gone * (1.0 + 0.5 * gone) / a


def _named(function: Callable, inner: Any, layout: Layout, more: object = None) -> Callable:
    """The wrapper under a name of its own, by which the cache of compiled code tells it from that of another model."""
    told = repr((str(inner._uuid) if inner is not None else "", layout, more)).encode()
    function.__qualname__ = f"{function.__qualname__}_{hashlib.sha256(told).hexdigest()[:12]}"
    return function


@lru_cache(maxsize=64)
def _step(function: Callable, layout: Layout) -> Callable:
    inner = as_inner(function)
    n, k, time = layout.n, layout.k, np.array(layout.time)
    along = np.array(layout.along).reshape(n, -1)

    def f(x, u, p, dt, out):  # noqa: ANN001, ANN202
        inner(x[:n], u, p[:k], dt, out[:n])
        for i in range(time.size):
            a = dt / p[time[i]]
            if i < along.shape[1]:
                moved = -np.expm1(-a) * p[time[i]] * x[n + i]
                for j in range(n):
                    out[j] += along[j, i] * moved
            out[n + i] = np.exp(-a) * x[n + i]

    return _named(f, inner, layout)


@lru_cache(maxsize=64)
def _slope(function: Callable, layout: Layout) -> Callable:
    inner = as_inner(function)
    n, k, time = layout.n, layout.k, np.array(layout.time)
    along = np.array(layout.along).reshape(n, -1)

    def F(x, u, p, dt, out):  # noqa: ANN001, ANN202
        out[:, :] = 0.0
        inner(x[:n], u, p[:k], dt, out[:n, :n])
        for i in range(time.size):
            a = dt / p[time[i]]
            if i < along.shape[1]:
                for j in range(n):
                    out[j, n + i] = -np.expm1(-a) * p[time[i]] * along[j, i]
            out[n + i, n + i] = np.exp(-a)

    return _named(F, inner, layout)


@lru_cache(maxsize=64)
def _noise(function: Callable | None, acts_on: tuple[int, ...], layout: Layout) -> Callable:
    given = function is not None
    inner = as_inner(function or _nothing)
    n, k, m = layout.n, layout.k, layout.m
    time, noise, share = np.array(layout.time), np.array(layout.noise), np.array(layout.share)
    along = np.array(layout.along).reshape(n, -1)
    states = np.array(acts_on, np.int64)

    def Q(x, u, p, q, dt, out):  # noqa: ANN001, ANN202
        white = q[:m].copy()
        for i in range(along.shape[1]):
            white[noise[i]] = q[noise[i]] * _integrated(dt / p[time[i]])
        if given:
            inner(x[:n], u, p[:k], white, dt, out[:n, :n])
        else:
            for i in range(states.size):
                out[states[i], states[i]] += white[i] * dt
        for i in range(time.size):
            a = dt / p[time[i]]
            variance = q[noise[i]]
            if i < along.shape[1]:
                variance = 0.5 * q[noise[i]] * share[i] / p[time[i]]
                for j in range(n):
                    both = variance * p[time[i]] * np.expm1(-a) ** 2 * along[j, i]
                    out[j, n + i] = both
                    out[n + i, j] = both
            out[n + i, n + i] = -variance * np.expm1(-2.0 * a)

    return _named(Q, inner, layout, acts_on)


def _nothing(x, u, p, q, dt, out):  # noqa: ANN001, ANN202
    """The Q of a model whose noises are added by name."""


def _heard(sensor: Sensor, first: int | None, layout: Layout) -> Sensor:
    """The sensor with the errors that begin at state `first`, or with none."""
    return replace(
        sensor,
        h=_sensor(sensor.h, first, layout),
        H=None if sensor.H is None else _sensor_slope(sensor.H, first, layout),
        log_likelihood=(None if sensor.log_likelihood is None else _likelihood(sensor.log_likelihood, first, layout)),
    )


@lru_cache(maxsize=256)
def _sensor(function: Callable, first: int | None, layout: Layout) -> Callable:
    inner = as_inner(function)
    n, k, wrong, e = layout.n, layout.k, first is not None, first or 0

    def h(x, u, p, out):  # noqa: ANN001, ANN202
        inner(x[:n], u, p[:k], out)
        if wrong:
            for i in range(out.size):
                out[i] += x[e + i]

    return _named(h, inner, layout, first)


@lru_cache(maxsize=256)
def _sensor_slope(function: Callable, first: int | None, layout: Layout) -> Callable:
    inner = as_inner(function)
    n, k, wrong, e = layout.n, layout.k, first is not None, first or 0

    def H(x, u, p, out):  # noqa: ANN001, ANN202
        out[:, :] = 0.0
        inner(x[:n], u, p[:k], out[:, :n])
        if wrong:
            for i in range(out.shape[0]):
                out[i, e + i] = 1.0

    return _named(H, inner, layout, first)


@lru_cache(maxsize=256)
def _likelihood(function: Callable, first: int | None, layout: Layout) -> Callable:
    inner = as_inner(function)
    n, k, wrong, e = layout.n, layout.k, first is not None, first or 0

    def log_likelihood(y, x, u, p, r):  # noqa: ANN001, ANN202
        told = y.copy()
        if wrong:
            for i in range(y.size):
                told[i] -= x[e + i]
        return inner(told, x[:n], u, p[:k], r)

    return _named(log_likelihood, inner, layout, first)


@lru_cache(maxsize=64)
def _inside(function: Callable, layout: Layout) -> Callable:
    inner = as_inner(function)
    n, k = layout.n, layout.k

    def chances(x, u, p, dt, out):  # noqa: ANN001, ANN202
        inner(x[:n], u, p[:k], dt, out)

    return _named(chances, inner, layout)
