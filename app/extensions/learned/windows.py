"""Training data from a recording: windows of time, and the errors of the physics' rates in them.

    r: x(t + T) = x̂(t + T | x(t), r),   dx̂ = (f + r) dt

x are the known states: the truth where the recording has it, otherwise the smoothed estimate. x̂ starts there and
follows f through the window, with the recorded inputs and a rate r added; states that are not corrected follow their
known values. The features of a window are means over its time.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from estimators.compiled.context import steps_of
from estimators.compiled.model import compile_model
from estimators.diagnostics.calibration import held_inputs
from estimators.fold import Fold
from estimators.log import READING, RESET, Log, truth_of
from estimators.model.hybrid import gathered, places
from estimators.model.state_space import StateSpaceModel
from estimators.numerics.linalg import wrapped
from estimators.smoothing.smooth import smooth

MIN_LENGTH_SHARE = 0.5  # Shortest window, as a share of the length; the inverse is the longest
RATE_STEP = 1e-3  # Step of the derivative with respect to a rate, in prior standard deviations of its state


class Windows(NamedTuple):
    """M windows: features (M, d), rates (M, k) in units of the states per second, start and end (M,) in s, block (M,).

    `block` is the number of the stretch of time of each window, in order; `held_out` (M,) marks those for the verdict.
    """

    features: np.ndarray
    rates: np.ndarray
    start: np.ndarray
    end: np.ndarray
    block: np.ndarray
    held_out: np.ndarray

    def of(self, rows: np.ndarray) -> Windows:
        """Return some of them."""
        return Windows(*(column[rows] for column in self))

    @staticmethod
    def joined(parts: Sequence[Windows]) -> Windows:
        """Return the windows of several recordings, with distinct block numbers."""
        shifted, first = [], 0
        for part in parts:
            shifted.append(part._replace(block=part.block + first))
            first += int(part.block.max(initial=-1)) + 1
        return Windows(*(np.concatenate(columns) for columns in zip(*shifted, strict=True)))


def known_states(fold: Fold, physics: StateSpaceModel) -> np.ndarray:
    """Return the known states of the physics (events, nx): the truth, interpolated in time; otherwise smoothed.

    The fold is over the whole log, of a model whose first states are those of the physics, which is to be corrected.

    Raises:
        EstimatorError: If the fold's filter cannot be smoothed.
    """
    log = fold.log
    known = np.array(smooth(fold).mean[:, : physics.nx])
    t = log.events.t.astype(float)
    for j in range(physics.nx):
        rows, values = truth_of(log.events, j)
        if rows.size and not physics.circular[j]:
            known[:, j] = np.interp(t, t[rows], values)
    return known


def windows(
    physics: StateSpaceModel, log: Log, known: np.ndarray, held_out: np.ndarray, *, corrects: Sequence[str],
    features: Sequence[str], seconds: float, stretches: int,
) -> Windows:  # fmt: skip
    """Cut a log into windows.

    Args:
        physics: The model to correct.
        log: The events.
        known: States at each event, see `known_states`.
        held_out: Mask (events,) of the blocks that judge. A window that lies in both parts is left out.
        corrects: States to correct.
        features: States and inputs to predict the correction from.
        seconds: Length of a window.
        stretches: Number of stretches of time (`Windows.block`).
    """
    t = log.events.t
    told = held_inputs(physics, log.events)
    u = np.where(np.isfinite(told), told, physics.default_inputs)
    target, place = places(physics, corrects), places(physics, features)
    values = gathered(known, u, place)
    compiled = compile_model(physics)
    p = physics.default_parameters
    count = int((t[-1] - t[0]) * 1e-9 / seconds)
    edges = np.searchsorted(t, t[0] + np.round(np.arange(count + 1) * seconds * 1e9).astype(np.int64))
    found = []
    for k in range(count):
        rows = slice(edges[k], edges[k + 1])
        lasted = (t[min(edges[k + 1], log.n - 1)] - t[edges[k]]) * 1e-9
        kinds = log.kind[rows]
        judging = held_out[rows]
        if not MIN_LENGTH_SHARE * seconds < lasted < seconds / MIN_LENGTH_SHARE or judging.any() != judging.all():
            continue
        if not np.any(kinds == READING) or np.any(kinds == RESET):
            continue
        whole = slice(edges[k], edges[k + 1] + 1)
        rate = _rates(compiled.f, p, physics, t[whole], known[whole], u[whole], target)
        if not np.all(np.isfinite(rate)):
            continue
        weight = np.diff(t[edges[k] : edges[k + 1] + 1]) * 1e-9
        mean = weight @ values[rows] / lasted
        found.append((mean, rate, t[edges[k]] * 1e-9, t[edges[k + 1]] * 1e-9, k * stretches // count, judging[0]))
    columns: list[Any] = list(zip(*found, strict=True)) or [()] * 6
    rest = [np.array(c, kind) for c, kind in zip(columns[2:], "ddl?", strict=True)]
    return Windows(np.reshape(columns[0], (-1, len(features))), np.reshape(columns[1], (-1, len(corrects))), *rest)


def _rates(
    f: Callable, p: np.ndarray, model: StateSpaceModel, t: np.ndarray, known: np.ndarray, u: np.ndarray,
    target: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Return the constant rates (k,) added to the physics that lead from the first row to the last.

    One Newton step; NaN if it fails.
    """
    seconds = (t[-1] - t[0]) * 1e-9
    little = RATE_STEP * model.prior_std[target] / seconds
    turned = np.array([bool(model.circular[j]) for j in target])

    def missed(rates: np.ndarray) -> np.ndarray:
        x, out = known[0].copy(), np.empty(model.nx)
        for i in range(len(t) - 1):
            own = x[target]
            x[:] = known[i]
            x[target] = own
            dt = (t[i + 1] - t[i]) * 1e-9
            if dt > 0.0:
                steps = steps_of(dt, model.max_step)
                for _ in range(steps):
                    f(x, u[i], p, dt / steps, out)
                    x[:] = out
                    x[target] += rates * dt / steps
        return wrapped(known[-1][target] - x[target], turned)

    off = missed(np.zeros(target.size))
    slopes = np.array([(off - missed(rates)) / rates[c] for c, rates in enumerate(np.diag(little))]).T
    with np.errstate(all="ignore"):
        try:
            return np.asarray(np.linalg.solve(slopes, off))
        except np.linalg.LinAlgError:
            return np.full(target.size, np.nan)
