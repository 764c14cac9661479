"""Black-box models: their functions run on blocks of states in Python, on threads, processes or any executor.

Compiled filters that evaluate f and h only at their members can use them: the block is evaluated first, and the f or h
that the filter calls looks up the answer by the address of the member (see interpreted/view.py).
"""

from __future__ import annotations

import pickle
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Executor, ProcessPoolExecutor, ThreadPoolExecutor
from functools import lru_cache
from multiprocessing import current_process, get_context
from typing import Any

import numba
import numpy as np

from ..errors import ModelError
from ..model.check import place
from ..model.state_space import StateSpaceModel
from ..model.user_file import portable
from ..numerics.jit import floats, inlined
from ..numerics.linalg import copy_vector
from .orphan import leave_with_parent

ANSWER = 2
"""Numbers appended to the parameters: the addresses of the members and of their answers."""


@inlined
def _answer(x, p, out):
    """Fill out with the answer for the member at the address of x."""
    k = p.size - ANSWER
    member = (x.ctypes.data - int(p[k])) // (8 * x.size)
    answer = floats(int(p[k + 1]) + 8 * member * out.size, out.size)
    copy_vector(answer, out)


def answered_f(x, u, p, dt, out):
    """out = the answer of f."""
    _answer(x, p, out)


def answered_h(x, u, p, out):
    """out = the answer of h."""
    _answer(x, p, out)


class BlackBox:
    """The functions f(X, u, p, dt) and h(X, u, p) of a black box, run where its executor says."""

    def __init__(self, model: StateSpaceModel) -> None:
        self.model = model
        functions = (model.f, *(sensor.h for sensor in model.sensors)) if model.executor is not None else ()
        self._sent = {id(function): portable(function) for function in functions}

    def f(self, X: np.ndarray, u: np.ndarray, p: np.ndarray, dt: float) -> np.ndarray:
        """Return the next states (N, nx) of a block X (N, nx).

        Raises:
            ModelError: If the function fails or returns another shape.
        """
        return self._run("f", self.model.f, X, self.model.nx, u, p, dt)

    def h(self, sensor: int, X: np.ndarray, u: np.ndarray, p: np.ndarray) -> np.ndarray:
        """Return the predicted measurements (N, ny) of a sensor for a block of states X (N, nx).

        Raises:
            ModelError: If the function fails or returns another shape.
        """
        given = self.model.sensors[sensor]
        return self._run(f"h of sensor {given.name}", given.h, X, len(given.rows), u, p)

    def f_of_one(self, x: np.ndarray, u: np.ndarray, p: np.ndarray, dt: float, out: np.ndarray) -> None:
        """Fill out = f(x, u, p, dt)."""
        out[:] = self.f(x[None], u, p, dt)[0]

    def h_of_one(self, sensor: int, x: np.ndarray, u: np.ndarray, p: np.ndarray, out: np.ndarray) -> None:
        """Fill out = h(x, u, p) of a sensor."""
        out[:] = self.h(sensor, x[None], u, p)[0]

    def _run(self, what: str, function: Callable, X: np.ndarray, columns: int, *rest: Any) -> np.ndarray:
        executor = self.model.executor
        # A worker of a Dask cluster may have no processes of its own.
        here = executor == "processes" and current_process().daemon
        pool = None if here else _pool(executor) if isinstance(executor, str) else executor
        # Of a number that does not depend on where they run: blocks of another size may round differently.
        workers = int(getattr(pool, "_max_workers", numba.config.NUMBA_NUM_THREADS))
        pieces = [X] if executor is None else np.array_split(X, max(1, min(workers, len(X))))
        try:
            if pool is None:
                parts = [_call(function, piece, *rest) for piece in pieces]
            else:
                calls = [(_call, self._sent[id(function)], piece, *rest) for piece in pieces]
                try:
                    futures = [pool.submit(*call) for call in calls]
                except BrokenExecutor:
                    if pool is executor:
                        raise
                    # A worker was killed after the last call, for want of memory, say: not the function's failure.
                    _pool.cache_clear()
                    pool = _pool(executor)
                    futures = [pool.submit(*call) for call in calls]
                parts = [future.result() for future in futures]
        except (Exception, SystemExit) as error:  # noqa: BLE001  the user's own function may raise anything
            at = place(function, error)
            said = f"a block of {len(X)} states: {type(error).__name__}: {' '.join(str(error).split()) or 'no message'}"
            sent = pool is not None and not isinstance(pool, ThreadPoolExecutor)
            remedy = _remedy(error, self._sent[id(function)] if sent else None)
            raise ModelError(f"{at}model {self.model.name}: {what} fails on {said}; {remedy}") from error
        for piece, part in zip(pieces, parts, strict=True):
            if part.shape != (len(piece), columns):
                raise ModelError(
                    f"{place(function)}model {self.model.name}: {what} returns shape {part.shape} for {len(piece)} "
                    f"states; it must be {(len(piece), columns)}, a row a state"
                )
        return np.concatenate(parts) if len(parts) > 1 else np.array(parts[0])

    def probe(self) -> None:
        """Run f and every h at the prior and near it, as a block and state by state, which must agree.

        Raises:
            ModelError: If they fail, return another shape, a value at the prior that is not finite, or a value for a
                state that depends on the rest of the block or changes between calls.
        """
        model = self.model
        X = model.prior_mean + np.array([[0.0], [0.1], [-0.1]]) * model.prior_std
        u = model.default_inputs.copy()
        p = model.default_parameters.copy()
        dt = min(1.0, model.max_step)
        calls: list[tuple[str, Callable[[np.ndarray], np.ndarray]]] = [("f", lambda X: self.f(X, u, p, dt))]
        for k, sensor in enumerate(model.sensors):
            calls.append((f"h of sensor {sensor.name}", lambda X, k=k: self.h(k, X, u, p)))  # type: ignore[misc]
        for what, run in calls:
            block = run(X)
            bad = int(np.sum(~np.isfinite(block[0])))
            if bad:
                raise ModelError(
                    f"model {model.name}: {what} returns {bad} of {block[0].size} numbers that are not finite at the "
                    "prior; they must all be"
                )
            alone = np.concatenate([run(x[None]) for x in X])
            # Vectorised loops may round differently in blocks of another size.
            if not np.allclose(alone, block, rtol=1e-9, atol=1e-12 * np.nanmax(np.abs(block)), equal_nan=True):
                raise ModelError(
                    f"model {model.name}: {what} returns another value for a state alone than in a block; a row of the "
                    "result may depend on that row alone, and on no chance"
                )


def _call(function: Callable, X: np.ndarray, u: np.ndarray, p: np.ndarray, *rest: float) -> np.ndarray:
    """Evaluate a block, with read-only views of the filter's arrays."""
    given = [X.view(), u.view(), p.view()]
    for array in given:
        array.flags.writeable = False
    return np.asarray(function(*given, *rest), float)


def pool_of(kind: str) -> Executor:
    """Return a pool of threads or processes, as many as there are processors."""
    count = int(numba.config.NUMBA_NUM_THREADS)
    # Spawned, not forked: a fork would copy the locks of threads that it does not copy.
    if kind == "threads":
        return ThreadPoolExecutor(count)
    return ProcessPoolExecutor(count, get_context("spawn"), initializer=leave_with_parent)


_pool = lru_cache(maxsize=2)(pool_of)
"""The pools that all models share."""


def _remedy(error: BaseException, sent: Callable | None) -> str:
    """Return the remedy for a failure; `sent` is the function if it was sent to another process."""
    if isinstance(error, BrokenExecutor):
        _pool.cache_clear()
    elif sent is None or _pickles(sent):
        return "mend it, or let it return NaN in the rows of states that it has no answer for"
    return "processes need functions defined in a module or file, use threads for others"


def _pickles(function: Callable) -> bool:
    """Return whether a function can be sent to another process.

    Tries pickle, whose errors differ between versions of Python and with the function's own `__reduce__`.
    """
    try:
        pickle.dumps(function)
    except Exception:  # noqa: BLE001
        return False
    return True
