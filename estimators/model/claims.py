"""What a model claims of itself, tried before a filter relies on it: a mode that jumps, a linear part, linearity."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ..errors import ModelError
from ..numerics.jit import plain
from .check import refuse_writing
from .state_space import StateSpaceModel


def check_parts(model: StateSpaceModel, f: Callable, h: Sequence[Callable]) -> None:
    """Try the declared mode and the declared linear part, or linearity of the whole, at states around the prior.

    Args:
        model: The model.
        f: Its compiled f.
        h: The compiled h of each of its sensors.

    Raises:
        ModelError: If the chances are none, f or Q moves the mode, or f or h is not linear where it is said to be.
    """
    if model.jump is None and not model.conditionally_linear and not model.linear:
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
        if model.linear:
            _check_straight(model, np.arange(model.nx), f, h, x, u, p, dt, rng)
        if model.conditionally_linear:
            _check_straight(model, model.linear_states, f, h, x, u, p, dt, rng)
            _check_apart(model, x, u, p, q, dt, rng)


def _check_jump(model: StateSpaceModel, x: Any, u: Any, p: Any, q: Any, dt: float) -> None:
    assert model.jump is not None
    name = model.jump.state
    c = np.full(len(model.jump.modes), np.nan)
    after = np.full(model.nx, np.nan)
    try:
        plain(model.jump.chances)(x.copy(), u, p, dt, c)
    except Exception as error:  # noqa: BLE001  the user's own function may raise anything
        raise ModelError(
            f"model {model.name}: jump.chances fails with {model.nx} states and {c.size} modes: "
            f"{type(error).__name__}: {error}; it takes (x, u, p, dt, out)"
        ) from None
    refuse_writing(model, "jump.chances", model.jump.chances, "x, u, p, dt", c.copy())
    if not (np.all(c >= 0.0) and abs(c.sum() - 1.0) < 1e-9):
        raise ModelError(
            f"model {model.name}: jump.chances gives {np.round(c, 6).tolist()} from mode {x[model.mode]:g}; it must "
            "give the probability of each mode, which sum to 1"
        )
    plain(model.f)(x.copy(), u, p, dt, after)
    if after[model.mode] != x[model.mode]:
        raise ModelError(
            f"model {model.name}: f moves the mode {name} from {x[model.mode]:g} to {after[model.mode]:g}; it must "
            "keep it: jump.chances says how it jumps"
        )
    if model.Q is not None:
        Q = np.zeros((model.nx, model.nx))
        plain(model.Q)(x.copy(), u, p, q, dt, Q)
        if np.any(Q[model.mode]):
            raise ModelError(f"model {model.name}: Q acts on the mode {name}, which jumps; leave its row zero")


def _away(model: StateSpaceModel, x: Any, states: Any, rng: Any) -> Any:
    """x with other values of some states, far enough that what is curved shows beside the rounding of a large mean."""
    other = x.copy()
    reach = model.prior_std[states] + np.abs(model.prior_mean[states])
    other[states] += reach * rng.standard_normal(len(states))
    return other


def _check_straight(
    model: StateSpaceModel, states: Any, f: Callable, h: Sequence[Callable], x: Any, u: Any, p: Any, dt: float, rng: Any
) -> None:
    """Superposition: at the middle of two points a linear function, also with a constant, is the middle of its values.

    It is tried with the compiled functions, since a field may be linear too.
    """
    other = _away(model, x, states, rng)
    points = (x, other, 0.5 * (x + other))
    calls: list[tuple[str, Callable, int]] = [("f", lambda z, out: f(z, u, p, dt, out), model.nx)]
    for sensor, expected in zip(model.sensors, h, strict=True):
        call = lambda z, out, expected=expected: expected(z, u, p, out)  # noqa: E731
        calls.append((f"h of sensor {sensor.name}", call, len(sensor.rows)))
    for what, call, size in calls:
        a, b, middle = np.empty((3, size))
        for z, out in zip(points, (a, b, middle), strict=True):
            call(z.copy(), out)
        with np.errstate(all="ignore"):
            bend = np.abs(middle - 0.5 * (a + b)) / np.maximum(np.abs(a) + np.abs(b) + np.abs(middle), 1e-300)
        if not np.any(bend > 1e-9):
            continue
        if model.linear:
            raise ModelError(
                f"model {model.name}: {what} is not linear, though the model says linear=True; leave that "
                "out, or mend it"
            )
        names = ", ".join(model.conditionally_linear)
        raise ModelError(
            f"model {model.name}: {what} is not linear in {names} when the others are known; take out of "
            "conditionally_linear what bends it"
        )


def _check_apart(model: StateSpaceModel, x: Any, u: Any, p: Any, q: Any, dt: float, rng: Any) -> None:
    """Neither the chances of a jump nor the noise may depend on the conditionally linear states."""
    names = ", ".join(model.conditionally_linear)
    other = _away(model, x, model.linear_states, rng)
    if model.jump is not None:
        chances = np.empty((2, len(model.jump.modes)))
        for z, out in zip((x, other), chances, strict=True):
            plain(model.jump.chances)(z.copy(), u, p, dt, out)
        if not np.allclose(chances[0], chances[1], rtol=1e-9, atol=1e-15):
            raise ModelError(
                f"model {model.name}: jump.chances depends on {names}, which conditionally_linear names; those of a "
                "jump may not: take out what they depend on"
            )
    if model.Q is not None:
        first, second = np.zeros((model.nx, model.nx)), np.zeros((model.nx, model.nx))
        plain(model.Q)(x.copy(), u, p, q, dt, first)
        plain(model.Q)(other, u, p, q, dt, second)
        if not np.allclose(first, second, rtol=1e-9, atol=0.0):
            raise ModelError(
                f"model {model.name}: Q depends on {names}, which conditionally_linear names; its noise may not"
            )
