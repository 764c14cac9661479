"""Checks of a fold's arguments against the model. Compiled code trusts every size and index."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from .errors import LARGEST, EstimatorError
from .estimator import Estimator, Options
from .events.checks import admitted
from .gaussian.robust import ADAPT_R
from .log import Log
from .model.state_space import LARGE, StateSpaceModel
from .numerics.linalg import EPSILON
from .snapshots import Base
from .tuning import Tuning

ROUNDING = 1e-12
"""Tolerance for negative eigenvalues and asymmetry of a covariance, as a share of the largest variance."""


def check_pairs(pairs: ArrayLike | None, model: StateSpaceModel) -> np.ndarray:
    """Return pairs of states as (k, 2) int64.

    Raises:
        EstimatorError: If they are not pairs, or an index is out of range.
    """
    if pairs is None:
        return np.zeros((0, 2), np.int64)
    given = np.asarray(pairs)
    if given.size == 0:
        return np.zeros((0, 2), np.int64)
    if given.ndim != 2 or given.shape[1] != 2 or given.dtype.kind not in "iu":
        raise EstimatorError(
            f"pairs have shape {given.shape} and hold {given.dtype}; they must be indices of states, shape (k, 2)"
        )
    if given.min() < 0 or given.max() >= model.nx:
        wrong = int(given.min() if given.min() < 0 else given.max())
        raise EstimatorError(f"pairs name state {wrong}; {model.name} has states 0 to {model.nx - 1}")
    return np.ascontiguousarray(given, np.int64)


def check_log(log: Log, n: int, model: StateSpaceModel, estimator: Estimator, options: Options) -> None:
    """Check the log's events from the n-th on against the model.

    Raises:
        EstimatorError: If the log is too narrow, or the estimator does not support variances of single measurements.
        EventError: If an event from the n-th on does not fit the model.
    """
    layout = model.layout
    if log.width < layout.least:
        raise EstimatorError(
            f"the log has {log.width} value column(s); an event of {model.name} needs {layout.least}: make it by "
            "Log.of(model)"
        )
    if not layout.same(log.layout):
        admitted(log.events.select(slice(n, None)), log.width, layout)
    if log.has_variances:
        check_variances(estimator, options)


def check_tuning(tuning: Tuning, model: StateSpaceModel) -> None:
    """Check the sizes of a tuning.

    Raises:
        EstimatorError: With the first group of another size than in the model.
    """
    sizes = {
        "q": (tuning.q, len(model.noises), "noises"),
        "r": (tuning.r, len(model.row_names), "sensor rows"),
        "p": (tuning.p, len(model.parameters), "parameters"),
        "used": (tuning.used, len(model.sensors), "sensors"),
    }
    for name, (values, count, what) in sizes.items():
        if np.shape(values) != (count,):
            raise EstimatorError(
                f"tuning: {name} has shape {np.shape(values)}; {model.name} has {count} {what}: start from "
                "Tuning.of(model)"
            )


def check_base(base: Base, model: StateSpaceModel) -> None:
    """Check the sizes of a base.

    Raises:
        EstimatorError: If mean, covariance or inputs have other sizes than in the model.
    """
    if base.u.shape != (model.nu,):
        raise EstimatorError(f"base: u has shape {base.u.shape}; {model.name} has {model.nu} inputs")
    _check_sizes("base", base.mean, base.cov, model)


def check_prior(prior: Sequence[ArrayLike], model: StateSpaceModel, entry: Estimator) -> tuple[np.ndarray, np.ndarray]:
    """Return a prior's mean (nx,) and covariance (nx, nx), or variances (1, nx) of a large or shaped state.

    Raises:
        EstimatorError: If a size does not fit, a number is not finite, or the covariance is not positive semidefinite,
            or is singular and the estimator needs its Cholesky factor.
    """
    if not (isinstance(prior, (tuple, list)) and len(prior) == 2):
        raise EstimatorError(f"prior is {type(prior).__name__}; it must be (mean, cov)")
    mean, cov = (np.array(part, float, order="C") for part in prior)
    diagonal = model.shape is not None or model.nx > LARGE
    _check_sizes("prior", mean, cov, model, rows=1 if diagonal else model.nx)
    if not (np.all(np.abs(mean) <= LARGEST) and np.all(np.abs(cov) <= LARGEST)):
        raise EstimatorError(f"prior: mean and covariance must be finite, and {LARGEST:g} at most")
    if diagonal:
        if np.any(cov < 0.0):
            raise EstimatorError(f"prior: the least variance is {cov.min():g}; it must be zero or positive")
        return mean, cov
    scale = float(np.max(np.diag(cov), initial=0.0))
    if np.max(np.abs(cov - cov.T)) > ROUNDING * scale:
        i, j = divmod(int(np.argmax(np.abs(cov - cov.T))), model.nx)
        raise EstimatorError(
            f"prior: the covariance of {model.state_names[i]} and {model.state_names[j]} is {cov[i, j]:g}, and "
            f"{cov[j, i]:g} the other way round; it must be symmetric"
        )
    cov = 0.5 * (cov + cov.T)
    std = np.sqrt(np.maximum(np.diag(cov), 0.0))
    # Eigenvalues of the correlations, as variances in different units cannot be compared.
    unit = np.where(std > 0.0, std, 1.0)
    least = float(np.linalg.eigvalsh(cov / np.outer(unit, unit)).min())
    if np.any(np.diag(cov) < 0.0) or least < -ROUNDING * model.nx:
        raise EstimatorError(
            f"prior: the covariance has the eigenvalue {least:g} in units of its deviations; it must be positive "
            "semidefinite: lessen the correlations"
        )
    if entry.needs_factor and least <= 4.0 * model.nx * EPSILON:
        exact = [name for name, s in zip(model.state_names, std, strict=True) if s == 0.0]
        what = f"{exact[0]} is certain" if exact else "its states are perfectly correlated"
        raise EstimatorError(
            f"prior: {what}, so its covariance is singular and has no sigma points for {entry.name}; use sr-ukf or "
            "ekf, or add a small variance"
        )
    if model.mode >= 0 and not 0.0 <= mean[model.mode] <= len(model.jump.modes) - 1:  # type: ignore[union-attr]
        raise EstimatorError(f"prior: the mean of the mode {model.state_names[model.mode]} is out of its range")
    return mean, cov


def _check_sizes(what: str, mean: np.ndarray, cov: np.ndarray, model: StateSpaceModel, rows: int | None = None) -> None:
    n = model.nx
    if mean.shape != (n,):
        raise EstimatorError(f"{what}: mean has shape {mean.shape}; {model.name} has {n} states: give ({n},)")
    wanted = ((n, n), (1, n)) if rows is None else ((rows, n),)
    if cov.shape not in wanted:
        raise EstimatorError(f"{what}: cov has shape {cov.shape}; for {model.name} it must be {wanted[0]}")


def check_soft(tuning: Tuning, entry: Estimator, options: Options) -> None:
    """Refuse a soft gate, which inflates R, for a filter with a fixed or adapted R.

    Raises:
        EstimatorError: With the remedy.
    """
    if tuning.gate is not None and tuning.gate_kind == "soft":
        _check_other_r(entry, options, "a soft gate inflates R", ", or gate.kind to hard")


def check_variances(entry: Estimator, options: Options) -> None:
    """Refuse measurements with variances of their own for a filter with a fixed or adapted R.

    Raises:
        EstimatorError: With the remedy.
    """
    _check_other_r(entry, options, "readings bring their own variance")


def _check_other_r(entry: Estimator, options: Options, why: str, remedy: str = "") -> None:
    if entry.fixed_r:
        raise EstimatorError(f"estimator {entry.name}: {why}, but its gain is for one R; use kf")
    if options.get("adapt") == ADAPT_R:
        learns = "adapt learns one R of each sensor; set adapt to off or Q"
        raise EstimatorError(f"estimator {entry.name}: {why}, but {learns}{remedy}")
