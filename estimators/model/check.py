"""Checks of a model's functions before a filter uses them; errors name the function's file and line.

Functions are called at the prior and near it; declared properties (mode, linear part, linearity) are tested there.
"""

from __future__ import annotations

import random
import re
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from types import CodeType
from typing import Any

import numpy as np

from ..errors import ModelError
from ..numerics.jit import plain
from .state_space import LARGE, StateSpaceModel
from .wrapping import is_derived


def place(function: object, error: BaseException | None = None) -> str:
    """Return file and line of a function, or of the last line in its file that an error passed, as `file:line: `."""
    code = _code(function)
    if code is None:
        return ""
    frames = traceback.extract_tb(error.__traceback__ if error else None)
    lines = [frame.lineno for frame in frames if frame.filename == code.co_filename and frame.lineno]
    if error is not None and error.__cause__ is not None:
        # Of an error in another process only the text of its traceback comes.
        found = re.findall(rf'File "{re.escape(code.co_filename)}", line (\d+)', str(error.__cause__))
        lines += [int(line) for line in found]
    return _shown(code.co_filename, lines[-1] if lines else code.co_firstlineno)


def _code(function: Any) -> CodeType | None:
    """Return the code of a function, of a `partial`, or of a callable object."""
    function = plain(function)
    function = function.func if isinstance(function, partial) else function
    code = getattr(function, "__code__", None) or getattr(type(function).__call__, "__code__", None)
    if code and "inner" in code.co_freevars and Path(code.co_filename).parent == Path(__file__).parent:
        # A wrapper of this package: the model's own function is inside.
        return _code(function.__closure__[code.co_freevars.index("inner")].cell_contents)
    return code


def _shown(file: str, line: int) -> str:
    path = Path(file)
    return f"{path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path}:{line}: "


def uncompilable(model: StateSpaceModel, what: str, function: Callable | None, error: Exception) -> ModelError:
    """Return the error of a function that Numba cannot compile, in one line with its place."""
    where = re.findall(r'File "([^"]+)", line (\d+)', str(error))
    at = _shown(str(Path(where[-1][0]).resolve()), int(where[-1][1])) if where else place(function)
    return ModelError(f"{at}model {model.name}: {what} cannot be compiled: {_gist(error)}; {_compilable(error)}")


def _compilable(error: Exception) -> str:
    """Return the remedy for a function that Numba cannot compile."""
    text = str(error)
    if "of type Module" in text:
        return "import the function that it calls by its name (from helpers import decay), so that it is compiled too"
    return "keep to numbers, math and loops, in the functions that it calls too"


def _gist(error: Exception) -> str:
    """Return the line of a long message that holds the error."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    rows = [line for line in lines if not line.startswith(("Failed in", "File ", "During:", "^", "[1]", "[2]"))]
    return (rows or lines or ["no message"])[0]


def numbers(values: np.ndarray) -> str:
    """Return the first entries of a vector as text."""
    return f"[{', '.join(f'{value:.4g}' for value in values[:4])}{', …' if values.size > 4 else ''}]"


def _remedy(error: Exception, function: Callable, takes: str, sizes: str, at: str) -> str:
    """Return the remedy for an error that a function of the model raises at the prior."""
    if isinstance(error, (NameError, AttributeError, ImportError)):
        return "correct the name, or define it in the model's file"
    own = getattr(plain(function), "__code__", None)
    inside = any(own and frame.filename == own.co_filename for frame in traceback.extract_tb(error.__traceback__))
    if isinstance(error, TypeError) and not inside:
        return f"it takes {takes}"
    if isinstance(error, IndexError) or any(word in str(error) for word in ("broadcast", "unpack", "shape")):
        return f"check it against the declared sizes: {sizes}"
    return f"it may not fail at {at}; correct it, or the prior"


def indefinite(Q: np.ndarray) -> str | None:
    """Return why a matrix of finite numbers is not a covariance; None if it is one."""
    # Beside its own variances: a Q of nanometres may be lopsided too.
    if np.any(np.abs(Q - Q.T) > 1e-9 * np.sqrt(np.abs(np.outer(np.diag(Q), np.diag(Q))))):
        return "is not symmetric (fill both triangles)"
    values = np.linalg.eigvalsh(Q)
    # Rounding leaves the zero eigenvalues of a singular Q at n ε of the largest.
    if values[0] < -1e-9 * max(values[-1], -values[0]):
        return f"is not positive semidefinite (it has the eigenvalue {values[0]:.3g})"
    return None


Values = dict[str, Any]  # Arguments of a model's functions, by their names in the model's docstring


def prior_values(model: StateSpaceModel) -> Values:
    """Return the arguments at the prior, with default inputs and the declared parameters and noises."""
    return {
        "x": model.prior_mean.copy(),
        "u": model.default_inputs.copy(),
        "p": model.default_parameters.copy(),
        "q": np.array([noise.variance for noise in model.noises], float),
        "z": np.random.default_rng(0).standard_normal(model.nx),
        "dt": min(1.0, model.max_step),
    }


def _near_prior(model: StateSpaceModel, values: Values) -> Iterator[Values]:
    """Yield the arguments at two points away from the prior, where no entry is zero.

    A large field has none: a plain function takes seconds for so many cells.
    """
    rng = np.random.default_rng(1)
    for _ in range(2 if model.nx <= LARGE else 0):
        away = {
            name: value + 0.1 * (1.0 + np.abs(value)) * rng.uniform(0.5, 1.0, value.shape)
            for name, value in values.items()
            if isinstance(value, np.ndarray)
        }
        away["x"] = model.prior_mean + model.prior_std * rng.uniform(0.5, 1.5, model.nx)
        if model.jump is not None:
            away["x"][model.mode] = len(model.jump.modes) - 1
        yield values | away


def refuse_writing(
    model: StateSpaceModel, what: str, function: Callable, takes: str, *out: np.ndarray, more: Values | None = None
) -> list[np.ndarray]:
    """Refuse a function that changes its arguments, away from the prior or at it; return its results there.

    At the prior alone, a function that scales an entry that is zero there would pass. Away from it the function may
    fail, as not every state need have a result.

    Raises:
        ModelError: With the function's file and line.
    """
    prior = prior_values(model) | (more or {})
    python = plain(function)
    for values in (*_near_prior(model, prior), prior):
        names = takes.split(", ")
        given = [values[name] for name in names]
        copies = [item.copy() if isinstance(item, np.ndarray) else item for item in given]
        results = [item.copy() for item in out]
        with suppress(Exception), np.errstate(all="ignore"):
            python(*copies, *results)
        for name, copy, item in zip(names, copies, given, strict=True):
            if not np.array_equal(copy, item, equal_nan=isinstance(item, np.ndarray)):
                raise ModelError(
                    f"{place(function)}model {model.name}: {what} writes to its argument {name}, which is the "
                    "filter's own; copy what it changes, and fill out only"
                )
    return results


def _call(
    model: StateSpaceModel, what: str, function: Callable, takes: str, values: Values, *out: np.ndarray, sizes: str = ""
) -> Any:
    """Call a plain function with copies of its arguments and `out`; return its result as a float if it has no `out`.

    Raises:
        ModelError: With the function's file and line, if it raises anything; `sizes` are the declared ones.
    """
    given = [item.copy() if isinstance(item, np.ndarray) else item for item in map(values.get, takes.split(", "))]
    try:
        with np.errstate(all="ignore"):
            result = plain(function)(*given, *out)
            return result if out else float(result)
    except Exception as error:  # noqa: BLE001  the user's own function may raise anything
        at = f"x = {numbers(values['x'])}, u = {numbers(values['u'])}, p = {numbers(values['p'])}"
        signature = f"({takes}, out)" if out else f"({takes}) and returns a float"
        remedy = _remedy(error, function, signature, sizes, at) if sizes else f"it takes {signature}"
        raise ModelError(
            f"{place(function, error)}model {model.name}: {what} fails at the prior: {type(error).__name__}: "
            f"{_gist(error)}; {remedy}"
        ) from None


def _draws(function: object, depth: int = 4) -> bool:
    """Return whether a function that can be compiled, or one that it calls, draws random numbers anywhere."""
    code = _code(function)
    if code is None or depth == 0:
        return False
    return any(
        item is random
        or item is np.random
        or (item is np and "random" in code.co_names)
        or hasattr(getattr(item, "__self__", None), "seed")
        or _draws(item, depth - 1)
        for item in map(getattr(plain(function), "__globals__", {}).get, code.co_names)
    )


def probe(model: StateSpaceModel) -> None:
    """Run the plain functions with arrays of the declared sizes, so that an index out of range is an error."""
    values, n = prior_values(model), model.nx
    known: set[object] = set()  # code that writes to no argument, which many sensors may share
    calls: list[tuple[str, Callable | None, str, tuple[int, ...]]] = [
        ("f", model.f, "x, u, p, dt", (n,)),
        ("F", model.F, "x, u, p, dt", (n, n)),
        ("Q", model.Q, "x, u, p, q, dt", (n, n)),
        ("shape", model.shape, "z, p", (n,)),
    ]
    for sensor in model.sensors:
        m = len(sensor.rows)
        calls.append((f"h of sensor {sensor.name}", sensor.h, "x, u, p", (m,)))
        calls.append((f"H of sensor {sensor.name}", sensor.H, "x, u, p", (m, n)))
    for what, function, takes, shape in calls:
        if function is None or is_derived(function) or (model.black_box and what not in ("Q", "shape")):
            continue
        out = np.full(shape, 0.0 if what == "Q" else np.nan)
        sizes = f"{n} states, {model.nu} inputs and {len(model.parameters)} parameters, out of shape {shape}"
        _call(model, what, function, takes, values, out, sizes=sizes)
        named, again = f"{place(function)}model {model.name}: {what}", out
        if (_code(function), shape) not in known:
            [again] = refuse_writing(model, what, function, takes, np.zeros(shape))
            known.add((_code(function), shape))
        bad = np.argwhere(~np.isfinite(out))
        if bad.size:
            at = f"x = {numbers(values['x'])}, u = {numbers(values['u'])}, p = {numbers(values['p'])}"
            raise ModelError(
                f"{named} leaves {len(bad)} of {out.size} entries of out unset or not finite at the prior, the first "
                f"of them out[{', '.join(map(str, bad[0]))}]; it must fill them all with finite numbers at {at}"
            )
        if not np.array_equal(out, again) or _draws(function):
            raise ModelError(
                f"{named} returns another value for the same arguments when it is called again; it may depend on "
                "nothing else: give what is random as process noise, and time or a count as an input or a state"
            )
        wrong = indefinite(out) if what == "Q" else None
        if wrong:
            raise ModelError(f"{named} {wrong} at the prior; a covariance must be symmetric and positive semidefinite")


def probe_angles(model: StateSpaceModel, h: Sequence[Callable]) -> None:
    """Refuse a sensor row that changes with a full turn of a circular state, which filters wrap to ±π."""
    if model.nx > LARGE or not np.any(model.circular):
        return
    x = model.prior_mean + 0.3 * model.prior_std
    u, p = model.default_inputs, model.default_parameters
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


def probe_likelihoods(model: StateSpaceModel) -> None:
    """Run each sensor's own log_likelihood once, at the measurement that the prior predicts."""
    values = prior_values(model)
    for sensor in model.sensors:
        # A row without noise has none: only particle filters would use it, and they refuse such a model.
        if sensor.log_likelihood is None or any(row.variance == 0.0 for row in sensor.rows):
            continue
        y, r = np.zeros(len(sensor.rows)), np.array([row.variance for row in sensor.rows], float)
        plain(sensor.h)(values["x"].copy(), values["u"], values["p"], y)
        what, takes = f"log_likelihood of sensor {sensor.name}", "y, x, u, p, r"
        value = _call(model, what, sensor.log_likelihood, takes, values | {"y": y, "r": r})
        refuse_writing(model, what, sensor.log_likelihood, takes, more={"y": y + 0.5, "r": r})
        if np.isnan(value) or value == np.inf:
            raise ModelError(
                f"{place(sensor.log_likelihood)}model {model.name}: {what} is {value} at the prior; it must be a "
                "finite number, or -inf where the reading is impossible"
            )


def check_parts(model: StateSpaceModel, f: Callable, h: Sequence[Callable]) -> None:
    """Test the declared mode, the declared linear part and declared linearity at states around the prior.

    Args:
        model: The model.
        f: Its compiled f.
        h: The compiled h of each of its sensors.

    Raises:
        ModelError: If the chances are not probabilities, f or Q moves the mode, or f or h is not linear as declared.
    """
    if model.jump is None and not model.conditionally_linear and not model.linear:
        return
    rng = np.random.default_rng(0)
    u, p = model.default_inputs, model.default_parameters
    q = np.array([max(noise.variance, 1e-12) for noise in model.noises], float)
    dt = min(0.1, model.max_step)
    for _ in range(8):
        x = model.prior_mean + model.prior_std * rng.standard_normal(model.nx)
        if model.jump is not None:
            x[model.mode] = rng.integers(len(model.jump.modes))
            _check_jump(model, x, u, p, q, dt)
        if model.linear:
            _check_linear(model, np.arange(model.nx), f, h, x, u, p, dt, rng)
        if model.conditionally_linear:
            _check_linear(model, model.linear_states, f, h, x, u, p, dt, rng)
            _check_independent(model, x, u, p, q, dt, rng)


def _check_jump(model: StateSpaceModel, x: np.ndarray, u: np.ndarray, p: np.ndarray, q: np.ndarray, dt: float) -> None:
    assert model.jump is not None
    name = model.jump.state
    c, after = np.full(len(model.jump.modes), np.nan), np.full(model.nx, np.nan)
    sizes = f"{model.nx} states and {c.size} modes"
    _call(model, "jump.chances", model.jump.chances, "x, u, p, dt", {"x": x, "u": u, "p": p, "dt": dt}, c, sizes=sizes)
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


def _away(model: StateSpaceModel, x: np.ndarray, states: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return x with other values of some states, far enough that curvature exceeds the rounding of a large mean."""
    other = x.copy()
    reach = model.prior_std[states] + np.abs(model.prior_mean[states])
    other[states] += reach * rng.standard_normal(len(states))
    return other


def _check_linear(
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
                "out, or correct it"
            )
        names = ", ".join(model.conditionally_linear)
        raise ModelError(
            f"model {model.name}: {what} is not linear in {names} when the others are known; take out of "
            "conditionally_linear what bends it"
        )


def _check_independent(model: StateSpaceModel, x: Any, u: Any, p: Any, q: Any, dt: float, rng: Any) -> None:
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
