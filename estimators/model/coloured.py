"""Coloured noise: process noise and sensor errors with a correlation time, as states of their own.

A noise of the process with a correlation time τ is no longer white, but an Ornstein-Uhlenbeck (first-order
Gauss-Markov) disturbance c that drives the states where the white noise did, along b with Q = q·dt·b bᵀ:

    dx = (f(x) + b c) dt,     dc = -c/τ dt + √q/τ dW,     var c = q / (2 τ)

so that ∫c dt gains the variance q a second in the long run, as the white noise does, and becomes it for τ → 0. A
sensor's coloured error e is added to the predicted measurement, beside its white noise:

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

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from ..errors import ModelError
from .state_space import Field, Noise, Parameter, Sensor, State, StateSpaceModel, per_second, squared
from .wrapping import as_inner, noise_function

TIME_RANGE = 100.0  # Factor by which a correlation time may be tuned below or above the given one


class ColouredError(NamedTuple):
    """A coloured error of a sensor: its `variance`, one a row, and the correlation time `over` in seconds."""

    variance: tuple[float, ...]
    over: float


class ColouredLayout(NamedTuple):
    """Positions of the appended states. The model within has n states, k parameters and m noises.

    State n + i has the correlation time p[time[i]]. The first `along.shape[1]` are disturbances: state n + i acts on
    the model's states along b = along[:, i] (n, disturbances), driven by `share[i]` of the noise q[noise[i]]. The
    others are errors of sensors, with the variance q[noise[i]].
    """

    n: int
    k: int
    m: int
    time: tuple[int, ...]
    noise: tuple[int, ...]
    share: tuple[float, ...]
    along: tuple[tuple[float, ...], ...]


def disturbance_time(noise: str) -> str:
    """Return the name of the parameter that holds the correlation time of a noise."""
    return f"{noise}_disturbance_time"


def error_time(sensor: str) -> str:
    """Return the name of the parameter that holds the correlation time of a sensor's error."""
    return f"{sensor}_error_time"


def errors_of(sensor: Sensor) -> list[str]:
    """Return the names of the states, and of the noises, that carry the error of a sensor, one a row."""
    one = len(sensor.rows) == 1
    return [f"{sensor.name}_error" if one else f"{sensor.name}_{row.name}_error" for row in sensor.rows]


def coloured(
    model: StateSpaceModel, noises: Mapping[str, float] | None = None, errors: Mapping[str, ColouredError] | None = None
) -> StateSpaceModel:
    """Return the model with states for coloured noise: disturbances in the order of its noises, then sensor errors.

    A noise w gets the state `w_disturbance` (`w_x_disturbance` for each x, if it acts on several states
    independently), in units of the driven state a second, and the parameter `w_disturbance_time`. A sensor s gets the
    state `s_error` (`s_y_error` for each of several rows y) in units of its row, a noise of that name, whose value is
    the variance of the error, and the parameter `s_error_time`.

    Args:
        model: The model.
        noises: Correlation time in seconds, by noise.
        errors: Coloured errors, by sensor.

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
            states.append(State(name, per_second(driven.unit), 0.0, std, position=driven.position, appended=True))
            place.append((len(model.parameters) + len(parameters), k, share))
            along.append(b)
        parameters.append(_time(disturbance_time(noise.name), over))
    first = {}
    for sensor in model.sensors:
        if sensor.name not in errors:
            continue
        error = errors[sensor.name]
        first[sensor.name] = model.nx + len(states)
        for name, row, variance in zip(errors_of(sensor), sensor.rows, error.variance, strict=True):
            states.append(State(name, row.unit, 0.0, float(np.sqrt(variance)), position=row.position, appended=True))
            place.append((len(model.parameters) + len(parameters), len(model.noises) + len(added), 1.0))
            added.append(Noise(name, squared(row.unit), variance))
        parameters.append(_time(error_time(sensor.name), error.over))
    layout = ColouredLayout(
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
        Q=_noise(noise_function(model), layout),
        sensors=tuple(
            replace(
                sensor,
                h=_sensor(sensor.h, first.get(sensor.name), layout),
                H=sensor.H and _sensor_slope(sensor.H, first.get(sensor.name), layout),
                log_likelihood=sensor.log_likelihood
                and _likelihood(sensor.log_likelihood, first.get(sensor.name), layout),
            )
            for sensor in model.sensors
        ),
        jump=None if model.jump is None else replace(model.jump, chances=_inside(model.jump.chances, layout)),
        conditionally_linear=(*model.conditionally_linear, *names) if model.conditionally_linear else (),
    )


def channels(model: StateSpaceModel, noise: str) -> list[tuple[int, float, np.ndarray]]:
    """Return the independent parts of a noise: the first state j, the share s of q there, and b (nx,) with b_j = 1.

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
        raise ModelError(f"model {model.name}: its Q takes no noise {noise}, so it cannot have a correlation time")
    return found


def _rate_of_noise(model: StateSpaceModel, index: int) -> np.ndarray:
    """Return D with Q = … + q_index·dt·D, checked over times, states, inputs, parameters and noises."""
    assert model.Q is not None
    Q = getattr(model.Q, "py_func", model.Q)
    rng = np.random.default_rng(0)
    first = None
    for trial in range(6):
        spread = float(trial > 0)
        x = model.prior_mean + spread * model.prior_std * rng.standard_normal(model.nx)
        u = np.array([item.default + spread * rng.standard_normal() for item in model.inputs], float)
        turned = [item.value * (1.0 + 0.1 * spread * rng.standard_normal()) for item in model.parameters]
        p = np.array([np.clip(t, item.low, item.high) for t, item in zip(turned, model.parameters, strict=True)], float)
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


def _check(model: StateSpaceModel, noises: Mapping[str, float], errors: Mapping[str, ColouredError]) -> None:
    """Refuse models to which no state can be appended, unknown names, and numbers that are not positive."""
    if isinstance(model.states, Field) or model.black_box:
        kind = "a field" if isinstance(model.states, Field) else "a black box"
        raise ModelError(f"model {model.name} is {kind}, whose noise cannot have a correlation time")
    for name in noises:
        known = [item.name for item in model.noises]
        if name not in known:
            raise ModelError(f"model {model.name} has no noise {name!r}; it has {', '.join(known)}")
        if not model.noises[known.index(name)].variance > 0.0:
            raise ModelError(f"model {model.name}: noise {name} has variance 0, so it cannot have a correlation time")
    rows = {sensor.name: len(sensor.rows) for sensor in model.sensors}
    for name, error in errors.items():
        if name not in rows:
            raise ModelError(f"model {model.name} has no sensor {name!r}; it has {', '.join(rows)}")
        if len(error.variance) != rows[name] or not all(variance > 0.0 for variance in error.variance):
            given = ", ".join(f"{variance:g}" for variance in error.variance)
            raise ModelError(
                f"model {model.name}: the error of {name} has variance {given}; it must be positive, one for each of "
                f"{rows[name]} rows"
            )
    for name, over in [*noises.items(), *((name, error.over) for name, error in errors.items())]:
        if not 0.0 < over < np.inf:
            raise ModelError(f"model {model.name}: {name} has the correlation time {over:g} s; it must be positive")


def _time(name: str, over: float) -> Parameter:
    return Parameter(name, "s", over, over / TIME_RANGE, over * TIME_RANGE)


def _integrated(a: float) -> float:
    """Return the variance of ∫c dt that a step of a = dt/τ adds, over q dt: 1 - (2 (1 - e⁻ᵃ) - (1 - e⁻²ᵃ)/2) / a."""
    if a < 0.05:
        # The terms above cancel to a²/3; the first omitted term of the series is 3e-13 of that.
        c = (1 / 3, -1 / 4, 7 / 60, -1 / 24, 31 / 2520, -1 / 320, 127 / 181440)
        return a * a * (c[0] + a * (c[1] + a * (c[2] + a * (c[3] + a * (c[4] + a * (c[5] + a * c[6]))))))
    gone = -np.expm1(-a)
    return 1.0 - gone * (1.0 + 0.5 * gone) / a


@lru_cache(maxsize=64)
def _step(function: Callable, layout: ColouredLayout) -> Callable:
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

    return f


@lru_cache(maxsize=64)
def _slope(function: Callable, layout: ColouredLayout) -> Callable:
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

    return F


@lru_cache(maxsize=64)
def _noise(function: Callable, layout: ColouredLayout) -> Callable:
    inner = as_inner(function)
    n, k, m = layout.n, layout.k, layout.m
    time, noise, share = np.array(layout.time), np.array(layout.noise), np.array(layout.share)
    along = np.array(layout.along).reshape(n, -1)

    def Q(x, u, p, q, dt, out):  # noqa: ANN001, ANN202
        white = q[:m].copy()
        for i in range(along.shape[1]):
            white[noise[i]] = q[noise[i]] * _integrated(dt / p[time[i]])
        inner(x[:n], u, p[:k], white, dt, out[:n, :n])
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

    return Q


@lru_cache(maxsize=256)
def _sensor(function: Callable, first: int | None, layout: ColouredLayout) -> Callable:
    inner = as_inner(function)
    n, k, has_error, e = layout.n, layout.k, first is not None, first or 0

    def h(x, u, p, out):  # noqa: ANN001, ANN202
        inner(x[:n], u, p[:k], out)
        if has_error:
            for i in range(out.size):
                out[i] += x[e + i]

    return h


@lru_cache(maxsize=256)
def _sensor_slope(function: Callable, first: int | None, layout: ColouredLayout) -> Callable:
    inner = as_inner(function)
    n, k, has_error, e = layout.n, layout.k, first is not None, first or 0

    def H(x, u, p, out):  # noqa: ANN001, ANN202
        out[:, :] = 0.0
        inner(x[:n], u, p[:k], out[:, :n])
        if has_error:
            for i in range(out.shape[0]):
                out[i, e + i] = 1.0

    return H


@lru_cache(maxsize=256)
def _likelihood(function: Callable, first: int | None, layout: ColouredLayout) -> Callable:
    inner = as_inner(function)
    n, k, has_error, e = layout.n, layout.k, first is not None, first or 0

    def log_likelihood(y, x, u, p, r):  # noqa: ANN001, ANN202
        corrected = y.copy()
        if has_error:
            for i in range(y.size):
                corrected[i] -= x[e + i]
        return inner(corrected, x[:n], u, p[:k], r)

    return log_likelihood


@lru_cache(maxsize=64)
def _inside(function: Callable, layout: ColouredLayout) -> Callable:
    inner = as_inner(function)
    n, k = layout.n, layout.k

    def chances(x, u, p, dt, out):  # noqa: ANN001, ANN202
        inner(x[:n], u, p[:k], dt, out)

    return chances
