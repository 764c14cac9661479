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

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ..errors import ModelError
from .ornstein_uhlenbeck import Layout, functions
from .state_space import Field, Noise, Parameter, Sensor, State, StateSpaceModel

REACH = 100.0
"""How many times shorter or longer than given a correlation time may be turned."""


class Lasting(NamedTuple):
    """An error of a sensor that lasts: its `variance`, one a row, and the correlation time `over` in seconds."""

    variance: tuple[float, ...]
    over: float


def disturbance_time(noise: str) -> str:
    """The parameter that says how long a noise lasts."""
    return f"{noise}_disturbance_time"


def error_time(sensor: str) -> str:
    """The parameter that says how long the error of a sensor lasts."""
    return f"{sensor}_error_time"


def errors_of(sensor: Sensor) -> list[str]:
    """The states, and the noises, that carry the error of a sensor, one a row."""
    one = len(sensor.rows) == 1
    return [f"{sensor.name}_error" if one else f"{sensor.name}_{row.name}_error" for row in sensor.rows]


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
        parameters.append(_time(disturbance_time(noise.name), over))
    first = {}
    for sensor in model.sensors:
        if sensor.name not in errors:
            continue
        lasting = errors[sensor.name]
        first[sensor.name] = model.nx + len(states)
        for name, row, variance in zip(errors_of(sensor), sensor.rows, lasting.variance, strict=True):
            states.append(State(name, row.unit, 0.0, float(np.sqrt(variance)), position=row.position))
            place.append((len(model.parameters) + len(parameters), len(model.noises) + len(added), 1.0))
            added.append(Noise(name, _squared(row.unit), variance))
        parameters.append(_time(error_time(sensor.name), lasting.over))
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
        **functions(model, layout, first),
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
        if len(lasting.variance) != rows[name] or not all(variance > 0.0 for variance in lasting.variance):
            given = ", ".join(f"{variance:g}" for variance in lasting.variance)
            raise ModelError(
                f"model {model.name}: the error of {name} has variance {given}; it must be positive, one for each of "
                f"{rows[name]} rows"
            )
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
