"""Hybrid models: a learned correction beside the physics, with an uncertainty of its own that depends on the state.

    x' = f(x, u, p, dt) + dt m(z),   Q = Q_f(x, u, p, q, dt) + dt s(z) diag(q_learned),   z of x and u

m and s are those of correction.py, at the state from which the step begins, so steps must be short beside what changes
z. q_learned, a noise NAME_learned for each corrected state, is what a second adds where the correction knows nothing:
there the model is its physics, and as uncertain as that.

Source: Ko & Fox (2009), GP-BayesFilters, doi:10.1007/s10514-009-9119-x, 3.3, for a process on the residual of a model.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from ..errors import ModelError, nearest
from .correction import Correction, Net
from .joint import as_inner
from .state_space import LARGE, Field, Noise, Sensor, StateSpaceModel
from .units import squared


@dataclass(frozen=True, eq=False)
class Learned:
    """A correction of the states `corrects`, by `features`, states or inputs, with q_learned of each, `noise`."""

    corrects: tuple[str, ...]
    features: tuple[str, ...]
    noise: tuple[float, ...]
    correction: Correction


def learned_noise(state: str) -> str:
    """The noise that says how uncertain a corrected state is where the correction knows nothing."""
    return f"{state}_learned"


def hybrid(model: StateSpaceModel, learned: Learned) -> StateSpaceModel:
    """The model with a correction beside its f.

    Raises:
        ModelError: If it has no such state or input, or is none that can be corrected.
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
    acts_on = () if model.Q else tuple(model.acts_on(noise.name).start for noise in model.noises)
    Q = _noise(model.Q, acts_on, len(model.noises), *given)
    moved = {name for name in learned.features if name in model.state_names}
    kept = tuple(name for name in model.conditionally_linear if name not in moved)
    changed = replace(
        model, noises=(*model.noises, *added), Q=Q, F=None, linear=model.linear and not moved, conditionally_linear=kept
    )
    if model.black_box or isinstance(learned.correction, Net):
        f = _step_of_blocks(model.f, model.black_box, *given)
        return replace(changed, f=f, sensors=_heard_by_blocks(model), black_box=True, linear=False)
    F = None if model.F is None else _slope(model.F, *given)
    return replace(changed, f=_step(model.f, *given), F=F)


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
            raise ModelError(
                f"model {model.name}: {name} is an angle, which is no feature of a correction; leave it out"
            )
    if model.executor == "processes":
        raise ModelError(
            f"model {model.name}: its executor is 'processes', which a corrected model cannot be sent to; take threads"
        )


def places(model: StateSpaceModel, names: Sequence[str]) -> np.ndarray:
    """Where each state or input is: its index in x, or -1 less that in u."""
    found = [
        model.state_names.index(name) if name in model.state_names else -1 - model.input_names.index(name)
        for name in names
    ]
    return np.array(found, np.int64)


def gathered(X: np.ndarray, u: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Features (N, d) of states X (N, nx) at inputs u (nu,), or (N, nu)."""
    u = np.broadcast_to(u, (len(X), u.shape[-1]))
    return np.stack([X[:, j] if j >= 0 else u[:, -1 - j] for j in place], axis=1)


@lru_cache(maxsize=64)
def _step(function: Callable, learned: Learned, place: tuple[int, ...], target: tuple[int, ...]) -> Callable:
    inner, add = as_inner(function), as_inner(learned.correction.functions[0])
    features, states, data = np.array(place), np.array(target), learned.correction.data

    def f(x, u, p, dt, out):  # noqa: ANN001, ANN202
        inner(x, u, p, dt, out)
        add(x, u, dt, features, states, data, out)

    return f


@lru_cache(maxsize=64)
def _slope(function: Callable, learned: Learned, place: tuple[int, ...], target: tuple[int, ...]) -> Callable:
    inner, add = as_inner(function), as_inner(learned.correction.functions[1])
    features, states, data = np.array(place), np.array(target), learned.correction.data

    def F(x, u, p, dt, out):  # noqa: ANN001, ANN202
        inner(x, u, p, dt, out)
        add(x, u, dt, features, states, data, out)

    return F


@lru_cache(maxsize=64)
def _noise(
    function: Callable | None, acts_on: tuple[int, ...], m: int, learned: Learned, place: tuple[int, ...],
    target: tuple[int, ...],
) -> Callable:  # fmt: skip
    given = function is not None
    inner, share = as_inner(function or _nothing), as_inner(learned.correction.functions[2])
    white = np.array(acts_on, np.int64)
    features, states, data = np.array(place), np.array(target), learned.correction.data

    def Q(x, u, p, q, dt, out):  # noqa: ANN001, ANN202
        if given:
            inner(x, u, p, q[:m], dt, out)
        else:
            for i in range(white.size):
                out[white[i], white[i]] += q[i] * dt
        left = share(x, u, features, data)
        for i in range(states.size):
            out[states[i], states[i]] += q[m + i] * dt * left

    return Q


def _nothing(x, u, p, q, dt, out):  # noqa: ANN001, ANN202
    """The Q of a model whose noises are added by name."""


@lru_cache(maxsize=64)
def _step_of_blocks(
    function: Callable, black_box: bool, learned: Learned, place: tuple[int, ...], target: tuple[int, ...]
) -> Callable:
    inner = function if black_box else _of_blocks(function)
    features, states = np.array(place), np.array(target)

    def f(X: np.ndarray, u: np.ndarray, p: np.ndarray, dt: float) -> np.ndarray:
        out = np.array(inner(X, u, p, dt), float)
        out[:, states] += dt * learned.correction.mean(gathered(X, u, features))
        return out

    return f


def _heard_by_blocks(model: StateSpaceModel) -> tuple[Sensor, ...]:
    """The model's sensors, as a black box has them."""
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
    """A model's function of one state as one of a block of states (N, nx), with `columns` results, or as many."""
    inner = as_inner(function)

    def block(X: np.ndarray, *rest: Any) -> np.ndarray:
        out = np.empty((len(X), columns or X.shape[1]))
        for x, row in zip(X, out, strict=True):
            inner(x, *rest, row)
        return out

    return block
