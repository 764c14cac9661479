"""A discrete mode: one state of a model that takes the values 0, 1, … and jumps among them.

    m' ~ chances(x, u, p, dt),   then   x' = f(x with m', u, p, dt) + w

Filters that sample draw the jump; the others see the model of mode_as_number.py.

Source: Doucet, Gordon & Krishnamurthy (2001), Particle filters for state estimation of jump Markov linear systems,
doi:10.1109/78.905890, section II (the mode jumps first, then the state moves in the new mode).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import ModelError

if TYPE_CHECKING:
    from .state_space import StateSpaceModel


@dataclass(frozen=True)
class Jump:
    """Which state is the mode, what its values 0, 1, … are called, and how it jumps.

    chances(x, u, p, dt, out) fills `out` (modes,) with the probability of each mode `dt` seconds on, from the state x,
    its mode included. The mode's prior is that of its state: of two modes, the mean is the probability of the second;
    of more, that of a Gaussian at the whole numbers. f keeps the mode (out[mode] = x[mode]) and no noise acts on it. f
    and h must take any number for it, since filters that do not sample give them its mean.
    """

    state: str
    modes: tuple[str, ...]
    chances: Callable


def check_parts(model: StateSpaceModel) -> None:
    """Try the declared mode and the declared linear part at states around the prior.

    Raises:
        ModelError: If the chances are none, f or Q moves the mode, or f or h is not linear where it is said to be.
    """
    if model.jump is None and not model.conditionally_linear:
        return
    rng = np.random.default_rng(0)
    u = np.array([item.default for item in model.inputs], float)
    p = np.array([item.value for item in model.parameters], float)
    q = np.array([max(noise.variance, 1e-12) for noise in model.noises], float)
    dt = min(0.1, model.max_step)
    for _ in range(8):
        x = model.prior_mean + model.prior_std * rng.standard_normal(model.nx)
        if model.jump is not None:
            x[model.mode] = rng.integers(len(model.jump.modes))
            _check_jump(model, x, u, p, q, dt)
        if model.conditionally_linear:
            _check_linear(model, x, u, p, q, dt, rng)


def _plain(function: Any) -> Callable:
    return getattr(function, "py_func", function)


def _check_jump(model: StateSpaceModel, x: Any, u: Any, p: Any, q: Any, dt: float) -> None:
    assert model.jump is not None
    name = model.jump.state
    c = np.full(len(model.jump.modes), np.nan)
    after = np.full(model.nx, np.nan)
    try:
        _plain(model.jump.chances)(x.copy(), u, p, dt, c)
    except Exception as error:  # noqa: BLE001  the user's own function may raise anything
        raise ModelError(
            f"model {model.name}: jump.chances fails with {model.nx} states and {c.size} modes: "
            f"{type(error).__name__}: {error}; it takes (x, u, p, dt, out)"
        ) from None
    if not (np.all(c >= 0.0) and abs(c.sum() - 1.0) < 1e-9):
        raise ModelError(
            f"model {model.name}: jump.chances gives {np.round(c, 6).tolist()} from mode {x[model.mode]:g}; it must "
            "give the probability of each mode, which sum to 1"
        )
    _plain(model.f)(x.copy(), u, p, dt, after)
    if after[model.mode] != x[model.mode]:
        raise ModelError(
            f"model {model.name}: f moves the mode {name} from {x[model.mode]:g} to {after[model.mode]:g}; it must "
            "keep it: jump.chances says how it jumps"
        )
    if model.Q is not None:
        Q = np.zeros((model.nx, model.nx))
        _plain(model.Q)(x.copy(), u, p, q, dt, Q)
        if np.any(Q[model.mode]):
            raise ModelError(f"model {model.name}: Q acts on the mode {name}, which jumps; leave its row zero")


def _check_linear(model: StateSpaceModel, x: Any, u: Any, p: Any, q: Any, dt: float, rng: Any) -> None:
    """A linear function's value at the middle of two points is the middle of its values."""
    names = ", ".join(model.conditionally_linear)
    other = x.copy()
    other[model.linear_states] += model.prior_std[model.linear_states] * rng.standard_normal(len(model.linear_states))

    def bend(function: Callable, size: int) -> float:
        a, b, middle = (np.full(size, np.nan) for _ in range(3))
        for z, out in ((x, a), (other, b), (0.5 * (x + other), middle)):
            function(z.copy(), out)
        scale = np.abs(a) + np.abs(b) + np.abs(middle)
        return float(np.max(np.abs(middle - 0.5 * (a + b)) / np.maximum(scale, 1e-300), initial=0.0))

    functions: list[tuple[str, Callable, int]] = [
        ("f", lambda z, out: _plain(model.f)(z, u, p, dt, out), model.nx),
        *(
            (f"h of sensor {sensor.name}", lambda z, out, h=sensor.h: _plain(h)(z, u, p, out), len(sensor.rows))
            for sensor in model.sensors
        ),
    ]
    for what, function, size in functions:
        if bend(function, size) > 1e-9:
            raise ModelError(
                f"model {model.name}: {what} is not linear in {names} when the others are known; take out of "
                "conditionally_linear what bends it"
            )
    if model.jump is not None:
        chances = np.empty((2, len(model.jump.modes)))
        for z, out in zip((x, other), chances, strict=True):
            _plain(model.jump.chances)(z.copy(), u, p, dt, out)
        if not np.allclose(chances[0], chances[1], rtol=1e-9, atol=1e-15):
            raise ModelError(
                f"model {model.name}: jump.chances depends on {names}, which conditionally_linear names; those of a "
                "jump may not: take out what they depend on"
            )
    if model.Q is not None:
        first, second = np.zeros((model.nx, model.nx)), np.zeros((model.nx, model.nx))
        _plain(model.Q)(x.copy(), u, p, q, dt, first)
        _plain(model.Q)(other, u, p, q, dt, second)
        if not np.allclose(first, second, rtol=1e-9, atol=0.0):
            raise ModelError(
                f"model {model.name}: Q depends on {names}, which conditionally_linear names; its noise may not"
            )
