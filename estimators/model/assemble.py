"""Assemble a model from its physics and the additions of a twin.

The order is fixed, and each step wraps the model of the step before:

1. `hybrid`: a learned correction beside f, with a noise for each corrected state.
2. `coloured`: states for process noise and sensor errors with a correlation time; correlation times are parameters.
3. `with_instruments`: offsets and scales of sensors and inputs, as parameters.
4. `joint`: parameters, those of steps 2 and 3 included, as the last states; then what considered ones may be off by.

So the physics keeps its states first, in their order: x = (physics, disturbances, sensor errors, parameters, deviations
of considered parameters).

Joint estimation moves parameters into the state:

    x⁺ = (x, θ),   x' = f(x, u, p(θ), dt) + w,   θ' = θ + w_θ,   y = h(x, u, p(θ)) + v

A moved parameter drifts as a random walk; with a drift of zero it is an unknown constant. A considered parameter stays
one, and its deviation δ is a state that no measurement changes: f and h take p + δ. Deviations may be correlated, as a
fit leaves them. What a fit says ends where its data end: a widened parameter has a second such state η ~ N(0, 1),

    p_eff = p + δ + η Σ_k w_k d_k(x, u),   d_k = max(0, low_k - z_k, z_k - high_k)

with z_k a state or input whose range of validity is [low_k, high_k] and w_k the standard deviation that a unit of
distance from it adds. η is independent of δ: a correlation that data in the range established need not hold outside.

All act on the model only within the parameter's range, so that an estimate outside cannot make a divisor zero.
Derivatives are by complex step, since the model's own do not include θ.

Source: Ljung (1979), Asymptotic behavior of the extended Kalman filter as a parameter estimator for linear systems,
doi:10.1109/TAC.1979.1101943, for the method and its limits: θ can be biased where Q and R are wrong.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import lru_cache
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from ..errors import ModelError, nearest
from ..numerics.jit import inner_embedded, plain, stack_vector
from .coloured import ColouredError, coloured
from .hybrid import LearnedCorrection, hybrid, places
from .instruments import Instrument, with_instruments
from .state_space import Noise, Parameter, State, StateSpaceModel, squared
from .wrapping import as_inner, derived


class AppendError(ModelError):
    """An addition that the model cannot have.

    `part` is its kind (learned, noise, error, instrument, estimate, correlation) and its name.
    """

    def __init__(self, part: tuple[str, str], message: str) -> None:
        super().__init__(message)
        self.part = part


def assemble(
    model: StateSpaceModel,
    *,
    learned: LearnedCorrection | None = None,
    noises: Mapping[str, float] | None = None,
    errors: Mapping[str, ColouredError] | None = None,
    instruments: Mapping[str, Instrument] | None = None,
    estimated: Mapping[str, JointParameter] | None = None,
    correlations: Mapping[tuple[str, str], float] | None = None,
) -> StateSpaceModel:
    """Return the model with everything appended.

    Args:
        model: The physics; variances of its noises are the steady state of coloured ones.
        learned: A correction of its f.
        noises: Correlation time in seconds, by process noise.
        errors: Coloured errors, by sensor.
        instruments: Offsets and scales, by sensor or input.
        estimated: Parameters to estimate or to consider, by name.
        correlations: See `joint`.

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
    for name, instrument in (instruments or {}).items():
        with _blamed("instrument", name):
            with_instruments(model, {name: instrument})
    model = with_instruments(model, instruments or {})
    for name, parameter in estimated.items():
        with _blamed("estimate", name):
            joint(model, {name: parameter})
    with _blamed("correlation", ""):
        return joint(model, estimated, correlations)


@contextmanager
def _blamed(kind: str, name: str) -> Iterator[None]:
    try:
        yield
    except ModelError as error:
        raise AppendError((kind, name), str(error)) from None


class JointParameter(NamedTuple):
    """A parameter to estimate or to consider: `std` is that of its prior about its value, `drift` what a second adds.

    A considered one keeps its value whatever is measured, and the covariance of the states accounts for its `std`.
    `widened` is the standard deviation that a unit of distance outside the fitted range of a state or an input adds, by
    their names; with it `std` may be 0. What it adds to an estimated one is considered.
    """

    std: float
    drift: float = 0.0
    considered: bool = False
    widened: Mapping[str, float] = MappingProxyType({})


def joint(
    model: StateSpaceModel,
    estimated: Mapping[str, JointParameter],
    correlations: Mapping[tuple[str, str], float] | None = None,
) -> StateSpaceModel:
    """Return the model with these parameters as its last states, in the order of the model's, considered ones last.

    Args:
        model: The model.
        estimated: Parameters by name.
        correlations: Correlation of the deviations of two considered parameters, by their names. Default: 0.

    Raises:
        ModelError: If it has no such parameter, or has a state of that name; if the correlations are impossible.
    """
    if not estimated:
        return model
    names = [item.name for item in model.parameters]
    for name, given in estimated.items():
        if name not in names:
            raise ModelError(f"model {model.name} has no parameter {name!r} to estimate; it has {', '.join(names)}")
        if (state := deviation(name) if given.considered else name) in model.state_names:
            raise ModelError(f"model {model.name} has a state {state!r}; {name} cannot get another of that name")
        if not (given.std > 0.0 or (given.std == 0.0 and given.widened)):
            raise ModelError(
                f"model {model.name}: the prior of {name} has std {given.std:g}; an estimated or considered parameter "
                "must be uncertain: give a positive std"
            )
        if given.considered and given.drift:
            raise ModelError(f"model {model.name}: {name} is considered, so it cannot drift; leave the drift out")
    marked = [item for item in model.parameters if item.name in estimated and estimated[item.name].considered]
    considered = [item for item in marked if estimated[item.name].std > 0.0]
    widened = [item for item in model.parameters if item.name in estimated and estimated[item.name].widened]
    moved = [item for item in model.parameters if item.name in estimated and item not in marked]
    kept = [item for item in model.parameters if item not in moved]
    added = [*moved, *considered]
    # Of each of the model's parameters: its index in θ and δ, in p, and in η; -1 where it is not.
    place = tuple(
        (
            added.index(item) if item in added else -1,
            kept.index(item) if item in kept else -1,
            len(added) + widened.index(item) if item in widened else -1,
        )
        for item in model.parameters
    )
    low, high = (tuple(float(getattr(item, end)) for item in model.parameters) for end in ("low", "high"))
    layout = JointLayout(model.nx, place, low, high, _distances(model, widened, estimated))
    noises = tuple(Noise(item.name, f"{squared(item.unit)}/s", estimated[item.name].drift ** 2) for item in moved)
    found = replace(
        model,
        states=(
            *model.states,
            *(_moved(item, estimated[item.name]) for item in moved),
            *(State(deviation(m.name), m.unit, 0.0, estimated[m.name].std) for m in considered),
            *(State(outside(m.name), "1", 0.0, 1.0) for m in widened),
        ),
        parameters=tuple(kept),
        noises=(*model.noises, *noises),
        f=_step(model.f, layout),
        F=_slopes(model.f, layout, model.nx),
        Q=None if model.Q is None else _noise(model.Q, len(model.noises), len(moved), layout),
        sensors=tuple(
            replace(sensor, h=_sensor(sensor.h, layout), H=_sensor_slopes(sensor.h, len(sensor.rows), layout))
            for sensor in model.sensors
        ),
        jump=None if model.jump is None else replace(model.jump, chances=_chances(model.jump.chances, layout)),
        linear=False,
        considered=len(considered) + len(widened),
    )
    if model.linear and not widened and is_linear(found):
        found = replace(found, linear=True)
    return _correlated(found, [item.name for item in considered], correlations or {})


FAR_FROM_PRIOR = 4.0  # Standard deviations of its prior within which an estimated constant should stay


def _moved(item: Parameter, given: JointParameter) -> State:
    """Return the state of an estimated parameter; the model is outside its range where a constant leaves its prior."""
    far, limits = FAR_FROM_PRIOR * given.std, (item.low, item.high)
    fitted = None if given.drift else (item.value - far, item.value + far)
    return State(item.name, item.unit, item.value, given.std, fitted=fitted, limits=limits, appended=True)


def is_linear(model: StateSpaceModel) -> bool:
    """Return whether f and h of a joint model are linear in all of its states: superposition at points of its prior.

    A model that is linear stays so with offsets, but not with parameters that multiply states, or with bounded ones,
    which act within their range only.
    """
    rng = np.random.default_rng(0)
    p, dt, n = model.default_parameters, min(1.0, model.max_step), model.nx
    for spread in (1.0, 1e3):
        u = model.default_inputs + rng.standard_normal(model.nu)
        a, b = model.prior_mean + spread * (model.prior_std + 1e-3) * rng.standard_normal((2, n))
        middle = 0.5 * (a + b)
        images = [np.zeros((3, n)), *(np.zeros((3, len(sensor.rows))) for sensor in model.sensors)]
        for k, x in enumerate((a, b, middle)):
            plain(model.f)(x, u, p, dt, images[0][k])
            for sensor, image in zip(model.sensors, images[1:], strict=True):
                plain(sensor.h)(x, u, p, image[k])
        size = float(np.abs([a, b]).max())
        for image in images:
            bend = np.abs(image[2] - 0.5 * (image[0] + image[1]))
            if not np.all(bend <= 1e-9 * (size + np.abs(image).max(axis=0))):
                return False
    return True


def deviation(parameter: str) -> str:
    """Return the name of the state that a considered parameter's deviation becomes."""
    return f"{parameter}_deviation"


def outside(parameter: str) -> str:
    """Return the name of the state that widens a considered parameter outside the range of its fit."""
    return f"{parameter}_outside"


Distances = tuple[tuple[int, int, float, float, float], ...]
"""Parameter, place of a state or input (index in x, or -1 less that in u), low and high end of its range, and the
standard deviation that a unit of distance adds."""


class JointLayout(NamedTuple):
    """States n of the model within; of each of its parameters the places in θ and δ, p and η, and its range."""

    n: int
    place: tuple[tuple[int, int, int], ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    distances: Distances

    def tables(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the layout as arrays, which compiled code reads faster than tuples."""
        ends = np.array([self.low, self.high], float).T.copy()
        return np.array(self.place, np.int64), ends, np.array(self.distances, float).reshape(-1, 5)


def _distances(model: StateSpaceModel, widened: Sequence[Parameter], given: Mapping[str, JointParameter]) -> Distances:
    names = [item.name for item in model.parameters]
    found = []
    for item in widened:
        for name, width in given[item.name].widened.items():
            known = (*model.state_names, *model.input_names)
            if name not in known:
                raise ModelError(f"model {model.name} has no state or input {name!r}; {nearest(name, known)}")
            at = places(model, [name])[0]
            limits = (model.states[at] if at >= 0 else model.inputs[-1 - at]).fitted
            if limits is None:
                raise ModelError(
                    f"model {model.name}: {item.name} is to widen outside the range of {name}, which has none; give it "
                    f"under `valid_range: {{{name}: [low, high]}}`"
                )
            found.append((names.index(item.name), int(at), float(limits[0]), float(limits[1]), float(width)))
    return tuple(found)


MIN_EIGENVALUE = -1e-3
"""Eigenvalue of a matrix of correlations below which it is none; those between it and zero are of rounded digits."""


def _correlated(
    model: StateSpaceModel, names: Sequence[str], given: Mapping[tuple[str, str], float]
) -> StateSpaceModel:
    """Return the model with correlated deviations of considered parameters."""
    if not given:
        return model
    R = np.eye(len(names))
    for (one, other), value in given.items():
        for name in (one, other):
            if name not in names:
                raise ModelError(
                    f"model {model.name}: the correlation of {one} and {other} needs both to be considered, and "
                    f"{name} is not; give it a std"
                )
        i, j = names.index(one), names.index(other)
        R[i, j] = R[j, i] = value
    values, vectors = np.linalg.eigh(R)
    if values[0] < MIN_EIGENVALUE:
        raise ModelError(
            f"model {model.name}: the correlations of {', '.join(names)} contradict each other (smallest eigenvalue "
            f"{values[0]:.2g}, which must not be negative); take them from one fit"
        )
    whole = np.eye(model.nx)
    begin = model.nx - model.considered
    own = slice(begin, begin + len(names))
    whole[own, own] = R if values[0] > 0.0 else (vectors * np.maximum(values, 1e-12)) @ vectors.T
    return replace(model, prior_correlation=tuple(map(tuple, whole.tolist())))


@inner_embedded
def _width(k, x, u, distances):
    """Return what η of parameter k is multiplied by: the distances outside their ranges, each times its width."""
    width = 0.0
    for i in range(len(distances)):
        if distances[i, 0] == k:
            at = int(distances[i, 1])
            z = x[at].real if at >= 0 else u[-1 - at]
            width += distances[i, 4] * max(0.0, distances[i, 2] - z, z - distances[i, 3])
    return width


@inner_embedded
def _within(value, low, high):
    """Return the value, or the end of the range beyond which it lies."""
    if value.real < low:
        return low
    if value.real > high:
        return high
    return value


@inner_embedded
def _fill(full, x, u, p, n, place, ends, distances):
    """Fill p(θ, δ, η): the model's own parameters, with moved and considered ones held within their ranges."""
    for k in range(place.shape[0]):
        j, own, out = place[k, 0], place[k, 1], place[k, 2]
        if j < 0 and out < 0:
            full[k] = p[own]
            continue
        value = x[n + j] if own < 0 else p[own] + x[n + j] if j >= 0 else p[own] + 0.0 * x[n]
        if out >= 0:
            value = value + _width(k, x, u, distances) * x[n + out]
        full[k] = _within(value, ends[k, 0], ends[k, 1])


@inner_embedded
def _free(x, u, p, n, k, place, ends, distances):
    """Return the complex step of parameter k: zero where its range ends."""
    j, own, out = place[k, 0], place[k, 1], place[k, 2]
    value = x[n + j] if own < 0 else p[own] + x[n + j] if j >= 0 else p[own]
    if out >= 0:
        value += _width(k, x, u, distances) * x[n + out]
    return STEP if ends[k, 0] <= value <= ends[k, 1] else 0.0


@lru_cache(maxsize=64)
def _step(function: Callable, layout: JointLayout) -> Callable:
    inner, n = as_inner(_chances(function, layout)), layout.n

    def f(x, u, p, dt, out):  # noqa: ANN001, ANN202
        inner(x, u, p, dt, out[:n])
        for j in range(n, x.size):
            out[j] = x[j]

    return f


STEP = 1e-20
"""Complex step of a derivative: see compiled/jacobians.py."""


@lru_cache(maxsize=64)
def _slopes(function: Callable, layout: JointLayout, rows: int) -> Callable:
    """Return d(f or h)/d(x, θ, δ, η) by complex step; the parameters are filled once for all columns."""
    inner, n, place = as_inner(function), layout.n, layout.place
    states, images, (at, ends, reach) = (0,) * n, (0,) * rows, layout.tables()

    def F(x, u, p, dt, out):  # noqa: ANN001, ANN202
        z, image, full = stack_vector(1j, states), stack_vector(1j, images), stack_vector(1j, place)
        for j in range(n):
            z[j] = x[j]
        _fill(full, x, u, p, n, at, ends, reach)
        for j in range(n):
            z[j] = complex(x[j], STEP)
            inner(z, u, full, dt, image)
            z[j] = x[j]
            for i in range(rows):
                out[i, j] = image[i].imag / STEP
        for k in range(at.shape[0]):
            j, outside = at[k, 0], at[k, 2]
            if j < 0 and outside < 0:
                continue
            full[k] = complex(full[k].real, _free(x, u, p, n, k, at, ends, reach))
            inner(z, u, full, dt, image)
            full[k] = full[k].real
            width = _width(k, x, u, reach) if outside >= 0 else 0.0
            for i in range(rows):
                slope = image[i].imag / STEP
                if j >= 0:
                    out[i, n + j] = slope
                if outside >= 0:
                    out[i, n + outside] = width * slope
        for i in range(rows, out.shape[0]):
            for j in range(x.size):
                out[i, j] = 1.0 if i == j else 0.0

    return derived(F)


@lru_cache(maxsize=256)
def _sensor_slopes(function: Callable, rows: int, layout: JointLayout) -> Callable:
    """Return dh/d(x, θ, δ, η)."""
    h = as_inner(function)

    def timed(x, u, p, dt, out):  # noqa: ANN001, ANN202
        h(x, u, p, out)

    slopes = as_inner(_slopes(timed, layout, rows))

    def H(x, u, p, out):  # noqa: ANN001, ANN202
        slopes(x, u, p, 0.0, out)

    return derived(H)


@lru_cache(maxsize=64)
def _chances(function: Callable, layout: JointLayout) -> Callable:
    inner, n, place, (at, ends, reach) = as_inner(function), layout.n, layout.place, layout.tables()

    def chances(x, u, p, dt, out):  # noqa: ANN001, ANN202
        full = stack_vector(x[0], place)
        _fill(full, x, u, p, n, at, ends, reach)
        inner(x[:n], u, full, dt, out)

    return chances


@lru_cache(maxsize=256)
def _sensor(function: Callable, layout: JointLayout) -> Callable:
    inner, n, place, (at, ends, reach) = as_inner(function), layout.n, layout.place, layout.tables()

    def h(x, u, p, out):  # noqa: ANN001, ANN202
        full = stack_vector(x[0], place)
        _fill(full, x, u, p, n, at, ends, reach)
        inner(x[:n], u, full, out)

    return h


@lru_cache(maxsize=64)
def _noise(function: Callable, nw: int, moved: int, layout: JointLayout) -> Callable:
    inner, n, place, (at, ends, reach) = as_inner(function), layout.n, layout.place, layout.tables()

    def Q(x, u, p, q, dt, out):  # noqa: ANN001, ANN202
        full = stack_vector(x[0], place)
        _fill(full, x, u, p, n, at, ends, reach)
        inner(x[:n], u, full, q[:nw], dt, out[:n, :n])
        for j in range(moved):
            out[n + j, n + j] = q[nw + j] * dt

    return Q
