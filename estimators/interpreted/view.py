"""The context of a filter in Python: functions of blocks of states, and numbers of model and tuning.

It wraps the context of compiled filters (compiled/context.py), so that both judge measurements by the same code.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np

from ..compiled.black_box import ANSWER
from ..compiled.context import with_parameters
from ..compiled.jacobians import CENTRAL_STEP, scratch_size, sensor_jacobian, state_jacobian
from ..compiled.model import CompiledModel
from ..errors import ModelError
from ..estimator import Code, Estimator, Options
from ..gaussian.shared import admit
from ..model.parts import covariance_of
from ..model.state_space import StateSpaceModel
from ..numerics.linalg import wrapped
from ..track import FAILED
from ..tuning import Tuning


class View:
    """Model, tuning and options of a filter, for its Python functions.

    `prior` has mean (nx,) and covariance (nx, nx); for each sensor `r` has the variances of its rows (ny,), `R` their
    covariance (ny, ny), and `angles` whether each is an angle.

    Only `kept`, the memory of filters, and the count and last of the model's failures change.
    """

    def __init__(
        self,
        compiled: CompiledModel,
        context: np.void,
        tuning: Tuning,
        options: Options,
        pairs: np.ndarray,
        held: dict[str, np.ndarray],
    ) -> None:
        """Wrap a context; `held` are the arrays that it points to."""
        model = compiled.model
        self.model: StateSpaceModel = model
        self.compiled, self.context, self.options, self.pairs = compiled, context, options, pairs
        self.nx, self.max_step, self.seed = model.nx, model.max_step, tuning.seed
        self.p, self.q = held["p"], held["q"]
        self.prior = held["prior_mean"], held["prior_cov"]
        self.circular = np.asarray(model.circular, bool)
        self.shown = model.shown
        ends = [first + len(sensor.rows) for first, sensor in zip(model.row_start, model.sensors, strict=True)]
        rows = [slice(first, end) for first, end in zip(model.row_start, ends, strict=True)]
        angles = np.array([row.circular for sensor in model.sensors for row in sensor.rows], bool)
        self.r = [held["r"][part] for part in rows]
        self.angles = [angles[part] for part in rows]
        self.R = [covariance_of(sensor.correlation, r) for sensor, r in zip(model.sensors, self.r, strict=True)]
        self._scratch = np.empty(scratch_size(model.nx, model.width))
        self.kept: dict = {}
        self.failures = 0
        self.failure: ModelError | None = None

    def failed(self, error: ModelError) -> None:
        """Count a failure of the model's Python."""
        self.failures += 1
        # The frames of its traceback hold the filter's arrays.
        self.failure = error.with_traceback(None)

    @contextmanager
    def brought(self, sensor: int, own: np.ndarray) -> Iterator[None]:
        """Context manager: replace R by a measurement's own variances (ny or more,); NaN leaves the tuned one."""
        r, tuned = self.r[sensor], (self.r[sensor].copy(), self.R[sensor])
        own = own[: len(tuned[1])]
        np.copyto(r[: own.size], own, where=np.isfinite(own))
        self.R[sensor] = covariance_of(self.compiled.model.sensors[sensor].correlation, r)
        try:
            yield
        finally:
            r[:], self.R[sensor] = tuned

    def f(self, X: np.ndarray, u: np.ndarray, dt: float) -> np.ndarray:
        """Return f of every state of a block X (N, nx) over dt seconds."""
        return self.compiled.f_block(X, u, self.p, dt)

    def h(self, sensor: int, X: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Return the predicted measurements (N, ny) of a sensor for a block of states X (N, nx)."""
        return self.compiled.h_block(sensor, X, u, self.p)

    def F(self, x: np.ndarray, u: np.ndarray, dt: float) -> np.ndarray:
        """Return df/dx (nx, nx) at a state; for a black box by central differences, evaluated in one block."""
        if self.model.black_box:
            return self._differences(lambda X: self.f(X, u, dt), x, self.circular)
        F = np.empty((self.nx, self.nx))
        state_jacobian(self.context, np.ascontiguousarray(x), u, dt, F, self._scratch)
        return F

    def H(self, sensor: int, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Return dh/dx (ny, nx) of a sensor at a state."""
        if self.model.black_box:
            return self._differences(lambda X: self.h(sensor, X, u), x, self.angles[sensor])
        H = np.empty((self.r[sensor].size, self.nx))
        sensor_jacobian(self.context, sensor, np.ascontiguousarray(x), u, H, self._scratch)
        return H

    def _differences(self, function: Callable, x: np.ndarray, circular: np.ndarray) -> np.ndarray:
        step = np.diag(CENTRAL_STEP * np.maximum(1.0, np.abs(x)))
        above, below = x + step, x - step
        images = function(np.vstack((above, below)))
        D = wrapped(images[: self.nx] - images[self.nx :], circular)
        return (D / np.diag(above - below)[:, None]).T

    def Q(self, x: np.ndarray, u: np.ndarray, dt: float) -> np.ndarray:
        """Return the covariance (nx, nx) of the process noise over dt seconds at a state."""
        Q = np.zeros((self.nx, self.nx))
        self.compiled.Q(np.ascontiguousarray(x), u, self.p, self.q, dt, Q)
        return Q

    def admit(
        self,
        sensor: int,
        y: np.ndarray,
        nu: np.ndarray,
        S: np.ndarray,
        innovation: np.ndarray,
        innovation_std: np.ndarray,
        score: np.ndarray,
    ) -> int:
        """Return the verdict on the innovation nu (m,) of the finite rows, of covariance S (m, m)."""
        rows = np.isfinite(y[: self.r[sensor].size])
        innovation[: rows.size][rows] = nu
        innovation_std[: rows.size][rows] = np.sqrt(np.diag(S))
        if not np.all(np.isfinite(S)):
            score[1] = nu.size
            return FAILED
        U = np.zeros_like(S)
        return int(admit(self.context, sensor, nu.size, nu.copy(), np.ascontiguousarray(S), U, score))


def driven(entry: Estimator) -> Code:
    """Return the four functions of an estimator for a black box, over a `View`.

    An ensemble or particle filter runs f and h at its members and nowhere else. So the block of members goes through
    the model's executor first; then the compiled function runs, and its calls of f and h look up the answer for the
    member at that address.
    """
    if entry.interpreted:
        return entry.code()
    entry.code()  # compiles them
    start, predict, update, describe = entry.functions
    assert entry.blocks is not None
    members = entry.blocks

    def answering(view: View, X: np.ndarray, answers: np.ndarray) -> np.void:
        """The context in which f, or h, of the members X is known; valid for as long as both arrays are."""
        if "answers" not in view.kept:
            p = np.append(view.p, np.zeros(ANSWER))
            view.kept["answers"] = p, with_parameters(view.context, p)
        p, context = view.kept["answers"]
        # Addresses of 48 bits are exact in a float64.
        p[-ANSWER:] = X.ctypes.data, answers.ctypes.data
        return context

    def predict_driven(view: View, u: np.ndarray, dt: float, index: int, state: np.ndarray, work: np.ndarray) -> None:
        X = members(view.options, state, view.nx)
        forward = view.f(X, u, dt)
        predict(answering(view, X, forward), u, dt, index, state, work)

    def update_driven(
        view: View,
        u: np.ndarray,
        sensor: int,
        y: np.ndarray,
        index: int,
        state: np.ndarray,
        work: np.ndarray,
        *rest: object,
    ) -> int:
        X = members(view.options, state, view.nx)
        expected = view.h(sensor, X, u)
        return int(update(answering(view, X, expected), u, sensor, y, index, state, work, *rest))

    def within(function: Callable) -> Callable:
        """The function, called with a view."""
        return lambda view, *given: function(view.context, *given)

    return Code(within(start), predict_driven, update_driven, within(describe))
