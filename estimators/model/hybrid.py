"""Hybrid models: a learned correction beside the physics, with an uncertainty of its own that depends on the state.

    x' = f(x, u, p, dt) + dt m(z),   Q = Q_f(x, u, p, q, dt) + dt s(z) diag(q_learned),   z of x and u

m and s are those of correction.py, at the state from which the step begins, so steps must be short compared with the
changes of z. q_learned, a noise NAME_learned for each corrected state, is the variance that a second adds where the
correction has no data: there the model is its physics, with that uncertainty.

Source: Ko & Fox (2009), GP-BayesFilters, doi:10.1007/s10514-009-9119-x, 3.3, for a process on the residual of a model.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from ..errors import ModelError, nearest
from .correction import FUNCTIONS, Correction
from .state_space import LARGE, Field, Noise, Sensor, StateSpaceModel, squared
from .wrapping import as_inner, noise_function


@dataclass(frozen=True, eq=False)
class LearnedCorrection:
    """A correction of the states `corrects`, by `features`, states or inputs, with q_learned of each, `noise`."""

    corrects: tuple[str, ...]
    features: tuple[str, ...]
    noise: tuple[float, ...]
    correction: Correction


def learned_noise(state: str) -> str:
    """Return the name of the noise of a corrected state where the correction has no data."""
    return f"{state}_learned"


def hybrid(model: StateSpaceModel, learned: LearnedCorrection) -> StateSpaceModel:
    """Return the model with a correction beside its f.

    Raises:
        ModelError: If it has no such state or input, or cannot be corrected.
    """
    check_places(model, learned.corrects, learned.features)
    added = tuple(
        Noise(learned_noise(name), f"{squared(model.states[model.state_names.index(name)].unit)}/s", variance)
        for name, variance in zip(learned.corrects, learned.noise, strict=True)
    )
    for item in added:
        if item.name in (noise.name for noise in model.noises):
            raise ModelError(f"model {model.name} has a noise {item.name} already; it is corrected once")
    given = learned, tuple(places(model, learned.features)), tuple(places(model, learned.corrects))
    moved = {name for name in learned.features if name in model.state_names}
    changed = replace(
        model,
        noises=(*model.noises, *added),
        Q=_noise(noise_function(model), len(model.noises), *given),
        F=None,
        linear=model.linear and not moved,
        conditionally_linear=tuple(name for name in model.conditionally_linear if name not in moved),
    )
    add_rate, add_slope, _ = FUNCTIONS[type(learned.correction)]
    if model.black_box or add_rate is None:
        f = _step_of_blocks(model.f, model.black_box, *given)
        return replace(changed, f=f, sensors=_block_sensors(model), black_box=True, linear=False)
    F = None if model.F is None else _added(model.F, add_slope, *given)
    return replace(changed, f=_added(model.f, add_rate, *given), F=F)


def check_places(model: StateSpaceModel, corrects: Sequence[str], features: Sequence[str]) -> None:
    """Refuse states and features that a correction of the model cannot have.

    Raises:
        ModelError: With the reason.
    """
    if isinstance(model.states, Field) or model.nx > LARGE:
        raise ModelError(f"model {model.name} is a field, which cannot be corrected")
    known = {"state": tuple(model.state_names), "feature": (*model.state_names, *model.input_names)}
    for kind, names in (("state", corrects), ("feature", features)):
        if not names:
            raise ModelError(f"model {model.name}: the correction names no {kind}; name at least one")
        for name in names:
            if name not in known[kind]:
                what = "state" if kind == "state" else "state or input"
                raise ModelError(f"model {model.name} has no {what} {name!r}; {nearest(name, known[kind])}")
            if names.count(name) > 1:
                raise ModelError(f"model {model.name}: the correction names {name} twice; name it once")
    for name in {*corrects, *features}:
        if model.jump is not None and name == model.jump.state:
            raise ModelError(f"model {model.name}: {name} is its mode, which jumps; a correction cannot use it")
    for name in features:
        if name in model.state_names and model.circular[model.state_names.index(name)]:
            raise ModelError(f"model {model.name}: {name} is an angle, which cannot be a feature; leave it out")
    if model.executor == "processes":
        raise ModelError(
            f"model {model.name}: its executor is 'processes', which a corrected model cannot be sent to; use threads"
        )


def places(model: StateSpaceModel, names: Sequence[str]) -> np.ndarray:
    """Return where each state or input is: its index in x, or -1 less that in u."""
    found = [
        model.state_names.index(name) if name in model.state_names else -1 - model.input_names.index(name)
        for name in names
    ]
    return np.array(found, np.int64)


def gathered(X: np.ndarray, u: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Return the features (N, d) of states X (N, nx) at inputs u (nu,), or (N, nu)."""
    u = np.broadcast_to(u, (len(X), u.shape[-1]))
    return np.stack([X[:, j] if j >= 0 else u[:, -1 - j] for j in place], axis=1)


@lru_cache(maxsize=64)
def _added(
    function: Callable, addition: Callable, learned: LearnedCorrection, place: tuple[int, ...], target: tuple[int, ...]
) -> Callable:
    """Return f or F with the correction added to its result."""
    inner, add = as_inner(function), as_inner(addition)
    features, states, data = np.array(place), np.array(target), learned.correction.data

    def corrected(x, u, p, dt, out):  # noqa: ANN001, ANN202
        inner(x, u, p, dt, out)
        add(x, u, dt, features, states, data, out)

    return corrected


@lru_cache(maxsize=64)
def _noise(
    function: Callable, m: int, learned: LearnedCorrection, place: tuple[int, ...], target: tuple[int, ...]
) -> Callable:
    inner, share = as_inner(function), as_inner(FUNCTIONS[type(learned.correction)][2])
    features, states, data = np.array(place), np.array(target), learned.correction.data

    def Q(x, u, p, q, dt, out):  # noqa: ANN001, ANN202
        inner(x, u, p, q[:m], dt, out)
        left = share(x, u, features, data)
        for i in range(states.size):
            out[states[i], states[i]] += q[m + i] * dt * left

    return Q


@lru_cache(maxsize=64)
def _step_of_blocks(
    function: Callable, black_box: bool, learned: LearnedCorrection, place: tuple[int, ...], target: tuple[int, ...]
) -> Callable:
    inner = function if black_box else _of_blocks(function)
    features, states = np.array(place), np.array(target)

    def f(X: np.ndarray, u: np.ndarray, p: np.ndarray, dt: float) -> np.ndarray:
        out = np.array(inner(X, u, p, dt), float)
        out[:, states] += dt * learned.correction.mean(gathered(X, u, features))
        return out

    return f


def _block_sensors(model: StateSpaceModel) -> tuple[Sensor, ...]:
    """Return the model's sensors with functions of blocks of states, as a black box has them."""
    if model.black_box:
        return model.sensors
    for sensor in model.sensors:
        if sensor.log_likelihood is not None:
            raise ModelError(
                f"model {model.name}: a net makes it a black box, which takes no log_likelihood of sensor {sensor.name}"
            )
    return tuple(replace(sensor, h=_of_blocks(sensor.h, len(sensor.rows)), H=None) for sensor in model.sensors)


@lru_cache(maxsize=64)
def _of_blocks(function: Callable, columns: int | None = None) -> Callable:
    """Return a function of one state as one of a block of states (N, nx), with `columns` results, or nx."""
    inner = as_inner(function)

    def block(X: np.ndarray, *rest: object) -> np.ndarray:
        out = np.empty((len(X), columns or X.shape[1]))
        for x, row in zip(X, out, strict=True):
            inner(x, *rest, row)
        return out

    return block
