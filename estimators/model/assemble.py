"""Assemble a model from its physics and the additions of a twin.

The order is fixed, and each step wraps the model of the step before:

1. `hybrid`: a learned correction beside f, with a noise for each corrected state.
2. `coloured`: states for process noise and sensor errors with a correlation time; correlation times are parameters.
3. `joint`: parameters, those of step 2 included, as the last states; then what considered ones may be off by.

So the physics keeps its states first, in their order: x = (physics, disturbances, sensor errors, parameters, deviations
of considered parameters).

Joint estimation moves parameters into the state:

    x⁺ = (x, θ),   x' = f(x, u, p(θ), dt) + w,   θ' = θ + w_θ,   y = h(x, u, p(θ)) + v

A moved parameter drifts as a random walk; with a drift of zero it is an unknown constant. A considered parameter stays
one, and its deviation δ is a state that no measurement changes: f and h take p + δ. Both act on the model only within
the parameter's range, so that an estimate outside cannot make a divisor zero. Derivatives are by complex step, since
the model's own do not include θ.

Source: Ljung (1979), Asymptotic behavior of the extended Kalman filter as a parameter estimator for linear systems,
doi:10.1109/TAC.1979.1101943, for the method and its limits: θ can be biased where Q and R are wrong.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from ..errors import ModelError
from ..numerics.jit import jit
from .coloured import ColouredError, coloured
from .hybrid import LearnedCorrection, hybrid
from .state_space import Noise, State, StateSpaceModel, squared
from .wrapping import as_inner


class AppendError(ModelError):
    """An addition that the model cannot have; `part` is its kind (learned, noise, error, estimate) and its name."""

    def __init__(self, part: tuple[str, str], message: str) -> None:
        super().__init__(message)
        self.part = part


def assemble(
    model: StateSpaceModel,
    *,
    learned: LearnedCorrection | None = None,
    noises: Mapping[str, float] | None = None,
    errors: Mapping[str, ColouredError] | None = None,
    estimated: Mapping[str, JointParameter] | None = None,
) -> StateSpaceModel:
    """Return the model with everything appended.

    Args:
        model: The physics; variances of its noises are the steady state of coloured ones.
        learned: A correction of its f.
        noises: Correlation time in seconds, by process noise.
        errors: Coloured errors, by sensor.
        estimated: Parameters to estimate, by name.

    Raises:
        AppendError: If something cannot be appended, with the part at fault.
    """
    noises, errors, estimated = noises or {}, errors or {}, estimated or {}
    if learned is not None:
        with _blamed("learned", ""):
            model = hybrid(model, learned)
    # Each alone first, so that an error names the one at fault.
    for name, over in noises.items():
        with _blamed("noise", name):
            coloured(model, {name: over})
    for name, error in errors.items():
        with _blamed("error", name):
            coloured(model, errors={name: error})
    model = coloured(model, noises, errors)
    for name, parameter in estimated.items():
        with _blamed("estimate", name):
            joint(model, {name: parameter})
    return joint(model, estimated)


@contextmanager
def _blamed(kind: str, name: str) -> Iterator[None]:
    try:
        yield
    except ModelError as error:
        raise AppendError((kind, name), str(error)) from None


class JointParameter(NamedTuple):
    """A parameter to estimate or to consider: `std` is that of its prior about its value, `drift` what a second adds.

    A considered one keeps its value whatever is measured, and the covariance of the states accounts for its `std`.
    """

    std: float
    drift: float = 0.0
    considered: bool = False


def joint(model: StateSpaceModel, estimated: Mapping[str, JointParameter]) -> StateSpaceModel:
    """Return the model with these parameters as its last states, in the order of the model's, considered ones last.

    Raises:
        ModelError: If it has no such parameter, or has a state of that name.
    """
    if not estimated:
        return model
    names = [item.name for item in model.parameters]
    for name, given in estimated.items():
        if name not in names:
            raise ModelError(f"model {model.name} has no parameter {name!r} to estimate; it has {', '.join(names)}")
        if (state := deviation(name) if given.considered else name) in model.state_names:
            raise ModelError(f"model {model.name} has a state {state!r}; {name} cannot get another of that name")
        if not given.std > 0.0:
            raise ModelError(
                f"model {model.name}: the prior of {name} has std {given.std:g}; an estimated or considered parameter "
                "must be uncertain: give a positive std"
            )
        if given.considered and given.drift:
            raise ModelError(f"model {model.name}: {name} is considered, so it cannot drift; leave the drift out")
    considered = [item for item in model.parameters if item.name in estimated and estimated[item.name].considered]
    moved = [item for item in model.parameters if item.name in estimated and item not in considered]
    kept = [item for item in model.parameters if item not in moved]
    added = [*moved, *considered]
    # Of each of the model's parameters: its index in θ and δ, and in p; -1 where it is not.
    place = tuple(
        (added.index(item) if item in added else -1, kept.index(item) if item in kept else -1)
        for item in model.parameters
    )
    low, high = (tuple(float(getattr(item, end)) for item in model.parameters) for end in ("low", "high"))
    layout = (model.nx, place, low, high)
    noises = tuple(Noise(item.name, f"{squared(item.unit)}/s", estimated[item.name].drift ** 2) for item in moved)
    return replace(
        model,
        states=(
            *model.states,
            *(State(m.name, m.unit, m.value, estimated[m.name].std) for m in moved),
            *(State(deviation(m.name), m.unit, 0.0, estimated[m.name].std) for m in considered),
        ),
        parameters=tuple(kept),
        noises=(*model.noises, *noises),
        f=_step(model.f, *layout),
        F=None,
        Q=None if model.Q is None else _noise(model.Q, len(model.noises), len(moved), *layout),
        sensors=tuple(replace(sensor, h=_sensor(sensor.h, *layout), H=None) for sensor in model.sensors),
        jump=None if model.jump is None else replace(model.jump, chances=_chances(model.jump.chances, *layout)),
        linear=False,
        considered=len(considered),
    )


def deviation(parameter: str) -> str:
    """Return the name of the state that a considered parameter's deviation becomes."""
    return f"{parameter}_deviation"


@jit
def _parameters(theta, p, place, low, high):
    """Return p(θ, δ): the model's own parameters, with moved and considered ones held within their ranges."""
    full = np.empty(len(place), theta.dtype)
    for k in range(len(place)):
        j, own = place[k]
        if j < 0:
            full[k] = p[own]
            continue
        value = theta[j] if own < 0 else p[own] + theta[j]
        if value.real < low[k]:
            full[k] = low[k]
        elif value.real > high[k]:
            full[k] = high[k]
        else:
            full[k] = value
    return full


@lru_cache(maxsize=64)
def _step(function: Callable, n: int, place: tuple, low: tuple, high: tuple) -> Callable:
    inner = as_inner(function)

    def f(x, u, p, dt, out):  # noqa: ANN001, ANN202
        inner(x[:n], u, _parameters(x[n:], p, place, low, high), dt, out[:n])
        for j in range(n, x.size):
            out[j] = x[j]

    return f


@lru_cache(maxsize=64)
def _chances(function: Callable, n: int, place: tuple, low: tuple, high: tuple) -> Callable:
    inner = as_inner(function)

    def chances(x, u, p, dt, out):  # noqa: ANN001, ANN202
        inner(x[:n], u, _parameters(x[n:], p, place, low, high), dt, out)

    return chances


@lru_cache(maxsize=256)
def _sensor(function: Callable, n: int, place: tuple, low: tuple, high: tuple) -> Callable:
    inner = as_inner(function)

    def h(x, u, p, out):  # noqa: ANN001, ANN202
        inner(x[:n], u, _parameters(x[n:], p, place, low, high), out)

    return h


@lru_cache(maxsize=64)
def _noise(function: Callable, nw: int, moved: int, n: int, place: tuple, low: tuple, high: tuple) -> Callable:
    inner = as_inner(function)

    def Q(x, u, p, q, dt, out):  # noqa: ANN001, ANN202
        inner(x[:n], u, _parameters(x[n:], p, place, low, high), q[:nw], dt, out[:n, :n])
        for j in range(moved):
            out[n + j, n + j] = q[nw + j] * dt

    return Q
