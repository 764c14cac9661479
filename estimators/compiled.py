"""A model as machine code, and the context in which a filter sees it.

`compile_model` turns the plain functions of a `StateSpaceModel` into addresses, and checks on the way that they agree
with the declaration: shapes, finiteness at the prior, and derivatives.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache, partial
from typing import Any

import numba
import numpy as np

from .black_box import BlackBox, answered_f, answered_h
from .context import (
    F_signature,
    H_signature,
    Q_signature,
    f_complex_signature,
    f_signature,
    h_complex_signature,
    h_signature,
    log_likelihood_signature,
    shape_signature,
)
from .errors import ModelError
from .jacobians import ANALYTIC, CENTRAL, COMPLEX_STEP, complex_step_f, complex_step_h, scratch_size
from .jit import address, jit
from .model import LARGE, Field, StateSpaceModel


@dataclass(frozen=True)
class CompiledModel:
    """A model whose functions are machine code; `f`, `h[k]` and `Q` can be called from Python too.

    A field too large for a matrix Q, or with a shape, has draw(z, p, q, dt) instead, which turns white z (nx,) into
    noise of the process.
    """

    model: StateSpaceModel
    f: Callable
    h: tuple[Callable, ...]
    Q: Callable
    static: dict[str, Any] = field(repr=False)
    keep_alive: tuple[Any, ...] = field(repr=False)
    draw: Callable | None = None
    box: BlackBox | None = None

    def f_block(self, X: np.ndarray, u: np.ndarray, p: np.ndarray, dt: float) -> np.ndarray:
        """f of every state of a block X (N, nx)."""
        if self.box is not None:
            return self.box.f(X, u, p, dt)
        out = np.empty(X.shape)
        for x, row in zip(np.ascontiguousarray(X), out, strict=True):
            self.f(x, u, p, dt, row)
        return out

    def h_block(self, sensor: int, X: np.ndarray, u: np.ndarray, p: np.ndarray) -> np.ndarray:
        """h (N, ny) of one sensor at every state of a block X (N, nx)."""
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
    kept: list[Any] = []

    def code(function: Callable | None, signature: Any, what: str) -> int:
        if function is None:
            return 0
        try:
            dispatcher = jit(getattr(function, "py_func", function))
            kept.append(dispatcher)
            return address(dispatcher, signature)
        except numba.core.errors.NumbaError as error:
            raise ModelError(f"model {model.name}: {what} cannot be compiled: {_gist(error)}") from None

    def complex_code(function: Callable, signature: Any) -> int:
        """The same function over complex numbers, or 0 where it is not analytic (comparisons, abs, atan2)."""
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                dispatcher = jit(getattr(function, "py_func", function))
                kept.append(dispatcher)
                return address(dispatcher, signature)
        except Exception as error:  # noqa: BLE001  Numba raises many kinds; each means the same here
            del error
            return 0

    _probe(model)
    _probe_likelihoods(model)
    box = BlackBox(model) if model.black_box else None
    if box is not None:
        box.probe()
    f = code(answered_f if box else model.f, f_signature, "f")
    f_dispatcher = box.f_of_one if box else kept[-1]
    F = code(model.F, F_signature, "F")
    diagonal = model.shape is not None or model.nx > LARGE
    model_Q = _each_cell if isinstance(model.states, Field) and not model.Q and not diagonal else model.Q
    Q = code(model_Q, Q_signature, "Q")
    Q_dispatcher = kept[-1] if model_Q else None
    shape = code(model.shape, shape_signature, "shape")
    shape_dispatcher = kept[-1] if model.shape else None
    h, H, h_dispatchers, likelihoods = [], [], [], []
    for k, sensor in enumerate(model.sensors):
        h.append(code(answered_h if box else sensor.h, h_signature, f"h of sensor {sensor.name}"))
        h_dispatchers.append(partial(box.h_of_one, k) if box else kept[-1])
        H.append(code(sensor.H, H_signature, f"H of sensor {sensor.name}"))
        what = f"log_likelihood of sensor {sensor.name}"
        likelihoods.append(code(sensor.log_likelihood, log_likelihood_signature, what))
    derivable = model.nx <= LARGE and box is None
    f_complex = 0 if model.F or not derivable else complex_code(model.f, f_complex_signature)
    h_complex = [
        0 if sensor.H or not derivable else complex_code(sensor.h, h_complex_signature) for sensor in model.sensors
    ]

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
        f=f_dispatcher,
        h=tuple(h_dispatchers),
        Q=q_function,
        keep_alive=tuple(kept),
        draw=draw if diagonal else None,
        box=box,
        static={
            "f": f,
            "f_complex": f_complex,
            "F": F,
            "F_mode": ANALYTIC if F else COMPLEX_STEP if f_complex else CENTRAL,
            "Q": Q,
            "shape": shape,
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
            "max_step": float(model.max_step),
            "noise_state": np.array([states.start for states in acts_on], np.int64),
            "noise_states": np.array([len(states) for states in acts_on], np.int64),
            "prior_mean": model.prior_mean,
            "prior_cov": model.prior_std[None] ** 2 if diagonal else np.diag(model.prior_std**2),
            "prior_rows": 1 if diagonal else model.nx,
            "shown": model.shown,
        },
    )
    _probe_angles(model, compiled.h)
    if derivable:
        _check_derivatives(compiled)
    return compiled


def _within(states: range, w: np.ndarray) -> np.ndarray:
    """The entries of w (nx,) that a range of states has, and zero elsewhere."""
    out = np.zeros_like(w)
    out[states.start : states.stop] = w[states.start : states.stop]
    return out


def _each_cell(x, u, p, q, dt, out):
    """Q of a field whose noise has its name: the same for every cell."""
    for j in range(x.size):
        out[j, j] = q[0] * dt


def _gist(error: Exception) -> str:
    """The line of Numba's long message that says what went wrong, and where."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    where = next((line for line in reversed(lines) if line.startswith("File ")), "")
    rows = [line for line in lines if not line.startswith(("Failed in", "File ", "During:", "^", "[1]", "[2]"))]
    return f"{rows[0] if rows else lines[0]} ({where})" if where else (rows[0] if rows else str(error))


def _probe(model: StateSpaceModel) -> None:
    """Run the plain functions once with arrays of the declared sizes, where an index that is too large is an error."""
    x = model.prior_mean.copy()
    u = np.array([item.default for item in model.inputs], float)
    p = np.array([item.value for item in model.parameters], float)
    q = np.array([noise.variance for noise in model.noises], float)
    dt = min(1.0, model.max_step)
    n = model.nx
    calls: list[tuple[str, Callable | None, tuple, tuple[int, ...]]] = [
        ("f", model.f, (x, u, p, dt), (n,)),
        ("F", model.F, (x, u, p, dt), (n, n)),
        ("Q", model.Q, (x, u, p, q, dt), (n, n)),
        ("shape", model.shape, (np.random.default_rng(0).standard_normal(n), p), (n,)),
    ]
    for sensor in model.sensors:
        m = len(sensor.rows)
        calls.append((f"h of sensor {sensor.name}", sensor.h, (x, u, p), (m,)))
        calls.append((f"H of sensor {sensor.name}", sensor.H, (x, u, p), (m, n)))
    for what, function, arguments, shape in calls:
        if function is None or (model.black_box and what not in ("Q", "shape")):
            continue
        out = np.full(shape, np.nan)
        if what == "Q":
            out[:] = 0.0
        copies = tuple(item.copy() if isinstance(item, np.ndarray) else item for item in arguments)
        try:
            with np.errstate(all="ignore"):
                getattr(function, "py_func", function)(*copies, out)
        except Exception as error:  # noqa: BLE001  the user's own function may raise anything
            raise ModelError(
                f"model {model.name}: {what} fails at the prior with {n} states, {u.size} inputs and {p.size} "
                f"parameters: {type(error).__name__}: {error}; check it against the declared sizes"
            ) from None
        if not all(np.array_equal(copy, item) for copy, item in zip(copies, arguments, strict=True)):
            raise ModelError(
                f"model {model.name}: {what} writes to its arguments, which are the filter's own; it may fill out only"
            )
        if not np.all(np.isfinite(out)):
            raise ModelError(
                f"model {model.name}: {what} leaves {int(np.sum(~np.isfinite(out)))} of {out.size} entries of out "
                f"(shape {shape}) unset or not finite at the prior; it must fill them all"
            )
        if what == "Q" and not np.allclose(out, out.T):
            raise ModelError(f"model {model.name}: Q is not symmetric at the prior; fill both triangles")
        if what == "Q":
            values = np.linalg.eigvalsh(out)
            # Rounding leaves the zero eigenvalues of a singular Q at n ε of the largest.
            if values[0] < -1e-9 * max(values[-1], -values[0]):
                raise ModelError(
                    f"model {model.name}: Q has the eigenvalue {values[0]:.3g} at the prior; a covariance must be "
                    "positive semidefinite"
                )


def _probe_angles(model: StateSpaceModel, h: Sequence[Callable]) -> None:
    """Refuse a sensor row that tells a full turn of a circular state, whose filters turn it back to within ±π."""
    if model.nx > LARGE or not np.any(model.circular):
        return
    x = model.prior_mean + 0.3 * model.prior_std
    u = np.array([item.default for item in model.inputs], float)
    p = np.array([item.value for item in model.parameters], float)
    for sensor, expected in zip(model.sensors, h, strict=True):
        here, there = np.empty(len(sensor.rows)), np.empty(len(sensor.rows))
        expected(x, u, p, here)
        for j in np.flatnonzero(model.circular):
            turned = x.copy()
            turned[j] += 2.0 * np.pi
            expected(turned, u, p, there)
            for row, before, after in zip(sensor.rows, here, there, strict=True):
                change = after - before
                if row.circular:
                    change -= 2.0 * np.pi * np.round(change / (2.0 * np.pi))
                if abs(change) > 1e-6 * max(1.0, abs(before)):
                    raise ModelError(
                        f"model {model.name}: row {row.name} of sensor {sensor.name} changes by {change:.3g} with a "
                        f"full turn of {model.state_names[int(j)]}, which is circular; declare the row circular, or "
                        "let h be periodic"
                    )


def _probe_likelihoods(model: StateSpaceModel) -> None:
    """Run each sensor's own log_likelihood once, at the reading that the prior predicts."""
    x = np.array([state.mean for state in model.states], float)
    u = np.array([item.default for item in model.inputs], float)
    p = np.array([item.value for item in model.parameters], float)
    for sensor in model.sensors:
        if sensor.log_likelihood is None:
            continue
        y = np.empty(len(sensor.rows))
        r = np.array([row.variance for row in sensor.rows], float)
        _python(sensor.h)(x, u, p, y)
        try:
            value = float(_python(sensor.log_likelihood)(y, x, u, p, r))
        except Exception as error:  # noqa: BLE001  the user's own function may raise anything
            raise ModelError(
                f"model {model.name}: log_likelihood of sensor {sensor.name} fails at the prior: "
                f"{type(error).__name__}: {error}; it takes (y, x, u, p, r) and returns a float"
            ) from None
        if np.isnan(value) or value == np.inf:
            raise ModelError(
                f"model {model.name}: log_likelihood of sensor {sensor.name} is {value} at the prior; it must be a "
                "finite number, or -inf where the reading is impossible"
            )


def _varies(model: StateSpaceModel) -> bool:
    """Whether Q depends on the state, judged by its values at the prior and at 32 states spread around it."""
    if model.Q is None:
        return False
    rng = np.random.default_rng(0)
    u = np.array([item.default for item in model.inputs], float)
    p = np.array([item.value for item in model.parameters], float)
    q = np.array([max(noise.variance, 1e-12) for noise in model.noises], float)
    mean = np.array([state.mean for state in model.states], float)
    std = np.array([state.std for state in model.states], float)
    found = []
    with np.errstate(all="ignore"):
        for spread in [0.0] + [1.0, 5.0] * 16:
            out = np.zeros((model.nx, model.nx))
            x = mean + spread * std * rng.standard_normal(model.nx)
            _python(model.Q)(x, u, p, q, min(1.0, model.max_step), out)
            found.append(out)
    return any(not np.array_equal(found[0], other, equal_nan=True) for other in found[1:])


def _check_derivatives(compiled: CompiledModel) -> None:
    """Compare every analytic or complex-step Jacobian with central differences; demote or refuse what disagrees."""
    model, static = compiled.model, compiled.static
    rng = np.random.default_rng(0)
    u = np.array([item.default for item in model.inputs], float)
    p = np.array([item.value for item in model.parameters], float)
    std = model.prior_std
    dt = min(0.1, model.max_step)
    scratch = np.empty(scratch_size(model.nx, model.width))

    def differences(function: Callable, x: np.ndarray, rows: int) -> np.ndarray:
        J = np.empty((rows, x.size))
        for j in range(x.size):
            step = 1e-5 * max(abs(x[j]), std[j], 1e-3)
            high, low = x.copy(), x.copy()
            high[j] += step
            low[j] -= step
            a, b = np.empty(rows), np.empty(rows)
            function(high, a)
            function(low, b)
            J[:, j] = (a - b) / (high[j] - low[j])
        return J

    points = [static["prior_mean"] + 0.3 * std * rng.standard_normal(model.nx) for _ in range(3)]

    def disagree(jacobian: Callable, function: Callable, rows: int) -> float:
        """Largest difference relative to the size of the Jacobian, over the points where all is finite."""
        worst = 0.0
        for x in points:
            J = np.zeros((rows, model.nx))
            jacobian(x, J)
            D = differences(function, x, rows)
            if np.all(np.isfinite(D)):
                error = np.max(np.abs(J - D)) / max(1e-9, np.max(np.abs(D)))
                worst = max(worst, error if np.isfinite(error) else np.inf)
        return worst

    def f(x, out):  # noqa: ANN001, ANN202
        compiled.f(x, u, p, dt, out)

    tolerance = 1e-4  # central differences with a step of 1e-5 are good to about 1e-8; a wrong formula is off by more
    if static["F_mode"] == ANALYTIC:
        error = disagree(lambda x, J: _python(model.F)(x, u, p, dt, J), f, model.nx)
        if error > tolerance:
            raise ModelError(f"model {model.name}: F differs from central differences of f by {error:.2g} (relative)")
    elif static["F_mode"] == COMPLEX_STEP:
        if disagree(lambda x, J: complex_step_f(static["f_complex"], x, u, p, dt, J, scratch), f, model.nx) > tolerance:
            static["F_mode"] = CENTRAL
    for k, sensor in enumerate(model.sensors):

        def h(x, out, k=k):  # noqa: ANN001, ANN202
            compiled.h[k](x, u, p, out)

        rows = len(sensor.rows)
        mode = static["H_mode"][k]
        if mode == ANALYTIC:
            error = disagree(lambda x, J, s=sensor: _python(s.H)(x, u, p, J), h, rows)
            if error > tolerance:
                raise ModelError(
                    f"model {model.name}: H of sensor {sensor.name} differs from central differences of h "
                    f"by {error:.2g} (relative)"
                )
        elif mode == COMPLEX_STEP:
            target = int(static["h_complex"][k])
            if disagree(lambda x, J, a=target: complex_step_h(a, x, u, p, J, scratch), h, rows) > tolerance:
                static["H_mode"][k] = CENTRAL


def _python(function: Any) -> Callable:
    return getattr(function, "py_func", function)
