"""Compilation of a model to machine code.

`compile_model` turns the plain functions of a `StateSpaceModel` into addresses, and checks them against the
declaration: shapes, finite values at the prior, and derivatives.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache, partial
from typing import Any

import numpy as np
from numba import types

from ..errors import ModelError
from ..model.check import check_parts, probe, probe_angles, probe_likelihoods
from ..model.state_space import LARGE, Field, StateSpaceModel
from ..model.wrapping import is_derived, noise_function
from ..numerics.helpers import with_helpers
from ..numerics.jit import Signature, address, jit, plain
from .black_box import ANSWER, BlackBox, answered_f, answered_h
from .context import (
    F_signature,
    H_signature,
    Q_signature,
    f_complex_signature,
    f_rows_signature,
    f_signature,
    h_complex_signature,
    h_rows_signature,
    h_signature,
    log_likelihood_signature,
    looped_f,
    looped_h,
    shape_signature,
)
from .jacobians import ANALYTIC, CENTRAL, COMPLEX_STEP, complex_step, scratch_size
from .model_code import ModelCode, SharedCode, call_h, call_h_block, call_own_F, call_own_H


@dataclass(frozen=True)
class CompiledModel:
    """Compiled functions of a model; `f`, `h[k]` and `Q` can be called from Python too.

    A field too large for a matrix Q, or with a shape, has draw(z, p, q, dt) instead, which turns white noise z (nx,)
    into process noise.
    """

    model: StateSpaceModel
    f: Callable
    h: tuple[Callable, ...]
    Q: Callable
    static: dict[str, Any] = field(repr=False)
    keep_alive: tuple[object, ...] = field(repr=False)
    draw: Callable | None = None
    box: BlackBox | None = None

    def f_block(self, X: np.ndarray, u: np.ndarray, p: np.ndarray, dt: float) -> np.ndarray:
        """Return f of every state of a block X (N, nx)."""
        if self.box is not None:
            return self.box.f(X, u, p, dt)
        out = np.empty(X.shape)
        for x, row in zip(np.ascontiguousarray(X), out, strict=True):
            self.f(x, u, p, dt, row)
        return out

    def h_block(self, sensor: int, X: np.ndarray, u: np.ndarray, p: np.ndarray) -> np.ndarray:
        """Return h (N, ny) of one sensor at every state of a block X (N, nx)."""
        if self.box is not None:
            return self.box.h(sensor, X, u, p)
        out = np.empty((len(X), len(self.model.sensors[sensor].rows)))
        for x, row in zip(np.ascontiguousarray(X), out, strict=True):
            self.h[sensor](x, u, p, row)
        return out


def compile_model(model: StateSpaceModel) -> CompiledModel:
    """Compile a model and check its functions against its declaration.

    Raises:
        ModelError: If a function cannot be compiled, fills the wrong shape, gives a value that is not finite at the
            prior, or an analytic Jacobian disagrees with differences.
    """
    return _compile(model)


@lru_cache(maxsize=32)
def _compile(model: StateSpaceModel) -> CompiledModel:
    made = ModelCode(model)
    probe(model)
    probe_likelihoods(model)
    box = BlackBox(model) if model.black_box else None
    if box is not None:
        box.probe()
    sizes = (model.nx, model.nu, len(model.parameters) + (ANSWER if box else 0))
    f_one = made.compiled(answered_f if box else model.f, f_signature, "f")
    f = made.address(looped_f(f_one, *sizes), f_rows_signature)
    F = made.over_complex(model.F, F_signature) if is_derived(model.F) else made.of(model.F, F_signature, "F")
    diagonal = model.shape is not None or model.nx > LARGE
    model_Q = noise_function(model) if isinstance(model.states, Field) and not diagonal else model.Q
    Q_dispatcher = made.compiled(model_Q, Q_signature, "Q") if model_Q else None
    shape_dispatcher = made.compiled(model.shape, shape_signature, "shape") if model.shape else None
    derivable = model.nx <= LARGE and box is None
    f_complex = 0 if F or not derivable else made.over_complex(jit(with_helpers(plain(model.f))), f_complex_signature)
    h, h_calls = _h_of_sensors(made, model, sizes, box)
    H = _of_sensors(made, model, "H", H_signature)
    likelihoods = _of_sensors(made, model, "log_likelihood", log_likelihood_signature)
    h_complex = _h_over_complex(made, model) if derivable else [0] * len(model.sensors)

    correlations = [np.array(sensor.correlation) if sensor.correlation else None for sensor in model.sensors]
    made.kept.append(correlations)

    acts_on = [model.acts_on(noise.name) for noise in model.noises] if model.Q is None else []

    def q_function(x, u, p, q, dt, out):  # noqa: ANN001, ANN202
        if Q_dispatcher is not None:
            Q_dispatcher(x, u, p, q, dt, out)
            return
        for k, states in enumerate(acts_on):
            for j in states:
                out[j, j] += q[k] * dt

    def draw(z, p, q, dt):  # noqa: ANN001, ANN202
        w = z
        if shape_dispatcher is not None:
            w = np.empty_like(z)
            shape_dispatcher(z, p, w)
        return sum(np.sqrt(q[k] * dt) * _within(states, w) for k, states in enumerate(acts_on))

    compiled = CompiledModel(
        model=model,
        f=box.f_of_one if box else f_one,
        h=h_calls,
        Q=q_function,
        keep_alive=tuple(made.kept),
        draw=draw if diagonal else None,
        box=box,
        static={
            "f": f,
            "f_complex": f_complex,
            "F": F,
            "F_mode": ANALYTIC if F else COMPLEX_STEP if f_complex else CENTRAL,
            "Q": address(Q_dispatcher, Q_signature) if Q_dispatcher is not None else 0,
            "shape": address(shape_dispatcher, shape_signature) if shape_dispatcher is not None else 0,
            "each_state": int(model.Q is None),
            "Q_varies": int(_varies(model)),
            "h": np.array(h, np.int64),
            "h_complex": np.array(h_complex, np.int64),
            "H": np.array(H, np.int64),
            "H_mode": np.array(
                [ANALYTIC if a else COMPLEX_STEP if c else CENTRAL for a, c in zip(H, h_complex, strict=True)], np.int64
            ),
            "log_likelihood": np.array(likelihoods, np.int64),
            "row_start": np.array(model.row_start, np.int64),
            "row_count": np.array([len(sensor.rows) for sensor in model.sensors], np.int64),
            "circular_x": model.circular,
            "circular_y": np.array([row.circular for sensor in model.sensors for row in sensor.rows], np.int8),
            # The address of each sensor's correlation, or 0.
            "correlation": np.array([0 if c is None else c.ctypes.data for c in correlations], np.int64),
            "max_step": float(model.max_step),
            "noise_state": np.array([states.start for states in acts_on], np.int64),
            "noise_states": np.array([len(states) for states in acts_on], np.int64),
            "prior_mean": model.prior_mean,
            "prior_cov": model.prior_std[None] ** 2 if diagonal else model.prior_cov,
            "n_considered": model.considered,
            "linear_states": model.linear_states,
            "n_linear": len(model.linear_states),
            "sampled_states": _sampled(model),
            "n_sampled": _sampled(model).size,
            "jump": made.of(model.jump.chances, f_signature, "jump.chances") if model.jump else 0,
            "mode": model.mode,
            "n_modes": len(model.jump.modes) if model.jump else 0,
            "prior_rows": 1 if diagonal else model.nx,
            "shown": model.shown,
        },
    )
    probe_angles(model, compiled.h)
    if derivable:
        _check_derivatives(compiled)
    check_parts(model, compiled.f, compiled.h)
    return compiled


Sizes = tuple[int, int, int]
"""Numbers of states, inputs and parameters."""


def _h_of_sensors(
    made: ModelCode, model: StateSpaceModel, sizes: Sizes, box: BlackBox | None
) -> tuple[list[int], tuple[Callable, ...]]:
    """Return the address of the loop over rows of each sensor's h, and its h as a function of one state for Python."""
    calls: dict[int, Callable] = {}

    def own(k: int) -> int:
        sensor = model.sensors[k]
        h = made.compiled(answered_h if box else sensor.h, h_signature, f"h of sensor {sensor.name}")
        target = made.address(looped_h(h, *sizes, len(sensor.rows)), h_rows_signature)
        calls[target] = h
        return target

    def common(shared: SharedCode) -> int:
        loop = looped_h(shared.dispatcher, *sizes, len(model.sensors[shared.members[0]].rows), shared=True)
        more = types.BaseTuple.from_types(shared.types)
        return made.address(loop, types.void(*h_rows_signature.args, more))

    functions = [answered_h if box else sensor.h for sensor in model.sensors]
    targets = made.of_sensors(functions, h_rows_signature, own, common)
    if box is not None:
        return targets, tuple(partial(box.h_of_one, k) for k in range(len(targets)))
    return targets, tuple(calls.get(target) or partial(_call_h, target) for target in targets)


def _call_h(target: int, x: np.ndarray, u: np.ndarray, p: np.ndarray, out: np.ndarray) -> None:
    """out = h(x, u, p) of the loop over rows at an address, from Python."""
    call_h(target, *(np.ascontiguousarray(item, float) for item in (x, u, p)), out)


def _of_sensors(made: ModelCode, model: StateSpaceModel, field: str, signature: Signature) -> list[int]:
    """Return the addresses of an optional function of the sensors."""

    def own(k: int) -> int:
        function = getattr(model.sensors[k], field)
        if is_derived(function):
            return made.over_complex(function, signature)
        return made.of(function, signature, f"{field} of sensor {model.sensors[k].name}")

    functions = [getattr(sensor, field) for sensor in model.sensors]
    return made.of_sensors(functions, signature, own, lambda shared: made.address(*shared.with_own(signature)))


def _h_over_complex(made: ModelCode, model: StateSpaceModel) -> list[int]:
    """Return the addresses of h over complex numbers; 0 with an analytic Jacobian, or if h is not analytic."""

    def own(k: int) -> int:
        return made.over_complex(model.sensors[k].h, h_complex_signature)

    functions = [None if sensor.H else sensor.h for sensor in model.sensors]
    signature = h_complex_signature
    return made.of_sensors(functions, signature, own, lambda shared: made.over_complex(*shared.with_own(signature)))


def _sampled(model: StateSpaceModel) -> np.ndarray:
    """Return the states that are neither conditionally linear nor the mode; none for a field, which needs none."""
    if isinstance(model.states, Field):
        return np.zeros(0, np.int64)
    return np.array([j for j in range(model.nx) if j != model.mode and j not in model.linear_states], np.int64)


def _within(states: range, w: np.ndarray) -> np.ndarray:
    """Return w (nx,) with zeros outside a range of states."""
    out = np.zeros_like(w)
    out[states.start : states.stop] = w[states.start : states.stop]
    return out


def _varies(model: StateSpaceModel) -> bool:
    """Return whether Q depends on the state, from its values at the prior and at 32 states around it."""
    if model.Q is None:
        return False
    rng = np.random.default_rng(0)
    u = model.default_inputs.copy()
    p = model.default_parameters.copy()
    q = np.array([max(noise.variance, 1e-12) for noise in model.noises], float)
    found = []
    with np.errstate(all="ignore"):
        for spread in [0.0] + [1.0, 5.0] * 16:
            out = np.zeros((model.nx, model.nx))
            x = model.prior_mean + spread * model.prior_std * rng.standard_normal(model.nx)
            plain(model.Q)(x, u, p, q, min(1.0, model.max_step), out)
            found.append(out)
    return any(not np.array_equal(found[0], other, equal_nan=True) for other in found[1:])


def _check_derivatives(compiled: CompiledModel) -> None:
    """Compare Jacobians with central differences; reject analytic ones that differ, and replace complex steps."""
    model, static = compiled.model, compiled.static
    rng = np.random.default_rng(0)
    u = model.default_inputs.copy()
    p = model.default_parameters.copy()
    std = model.prior_std
    dt = min(0.1, model.max_step)
    scratch = np.empty(scratch_size(model.nx, model.width))

    def differences(block: Callable, x: np.ndarray, rows: int) -> np.ndarray:
        """Return central differences of block(X, out), which fills each row of `out` from that of X."""
        steps = 1e-5 * np.maximum(np.maximum(np.abs(x), std), 1e-3)
        X = np.concatenate([x + np.diag(steps), x - np.diag(steps)])
        out = np.empty((len(X), rows))
        block(X, out)
        n = x.size
        return ((out[:n] - out[n:]) / (X[:n] - X[n:]).diagonal()[:, None]).T

    points = [static["prior_mean"] + 0.3 * std * rng.standard_normal(model.nx) for _ in range(3)]

    def disagree(jacobian: Callable, block: Callable, rows: int) -> float:
        """Return the largest difference relative to the size of the Jacobian, over points with finite values."""
        worst = 0.0
        for x in points:
            J = np.zeros((rows, model.nx))
            jacobian(x, J)
            D = differences(block, x, rows)
            if np.all(np.isfinite(D)):
                error = np.max(np.abs(J - D)) / max(1e-9, np.max(np.abs(D)))
                worst = max(worst, error if np.isfinite(error) else np.inf)
        return worst

    def f(X, out):  # noqa: ANN001, ANN202
        for x, row in zip(X, out, strict=True):
            compiled.f(x, u, p, dt, row)

    tolerance = 1e-4  # central differences with a step of 1e-5 are good to about 1e-8; a wrong formula is off by more
    if static["F_mode"] == ANALYTIC:
        error = disagree(lambda x, J: call_own_F(static["F"], x, u, p, dt, J), f, model.nx)
        if error > tolerance and is_derived(model.F):
            static["F_mode"] = CENTRAL
        elif error > tolerance:
            raise ModelError(f"model {model.name}: F differs from central differences of f by {error:.2g} (relative)")
    elif static["F_mode"] == COMPLEX_STEP:
        target = static["f_complex"]
        error = disagree(lambda x, J: complex_step(target, False, x, u, p, dt, J, scratch), f, model.nx)
        if error > tolerance:
            static["F_mode"] = CENTRAL
    for k, sensor in enumerate(model.sensors):

        def h(X, out, target=int(static["h"][k])):  # noqa: ANN001, ANN202
            call_h_block(target, X, u, p, out)

        rows = len(sensor.rows)
        mode = static["H_mode"][k]
        if mode == ANALYTIC:
            error = disagree(lambda x, J, target=int(static["H"][k]): call_own_H(target, x, u, p, J), h, rows)
            if error > tolerance and is_derived(sensor.H):
                static["H_mode"][k] = CENTRAL
            elif error > tolerance:
                raise ModelError(
                    f"model {model.name}: H of sensor {sensor.name} differs from central differences of h "
                    f"by {error:.2g} (relative)"
                )
        elif mode == COMPLEX_STEP:
            target = int(static["h_complex"][k])
            if disagree(lambda x, J, a=target: complex_step(a, True, x, u, p, dt, J, scratch), h, rows) > tolerance:
                static["H_mode"][k] = CENTRAL
