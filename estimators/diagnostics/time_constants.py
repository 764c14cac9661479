"""Time constants of a linearised model."""

from __future__ import annotations

import numpy as np
from scipy.optimize import approx_fprime

from ..errors import ModelError
from ..model.state_space import StateSpaceModel
from ..numerics.jit import plain

MAX_STATES = 200  # States beyond which the eigenvalues are not worth their time
UNSTABLE = 1.0 - 1e-9  # Modulus from which on a mode does not decay: a random walk, or one that grows

_STEP = 6e-6


def jacobian(model: StateSpaceModel, x: np.ndarray, u: np.ndarray, p: np.ndarray, dt: float) -> np.ndarray:
    """Return ∂f/∂x (nx, nx) over dt, by central differences of the model's plain function.

    Raises:
        ModelError: If the model fails there.
    """

    def moved(x: np.ndarray) -> np.ndarray:
        out = np.empty(model.nx)
        plain(model.f)(x, u, p, dt, out)
        return out

    h = _STEP * np.maximum(1.0, np.abs(x))
    try:
        sides = [approx_fprime(x, moved, step) for step in (h, -h)]
    except Exception as error:  # noqa: BLE001  a user's function raises anything
        raise ModelError(f"{model.name}: f fails at the prior: {type(error).__name__}: {error}") from None
    return 0.5 * (sides[0] + sides[1]).reshape(model.nx, model.nx)


def time_constants(F: np.ndarray, dt: float) -> np.ndarray:
    """Return the time constants -dt/ln|λ| of the decaying modes of F (n, n) with eigenvalues λ, s, slowest first."""
    if not np.all(np.isfinite(F)):
        return np.zeros(0)
    modulus = np.abs(np.linalg.eigvals(F))
    decaying = modulus[(modulus < UNSTABLE) & (modulus > 0.0)]
    return np.sort(-dt / np.log(decaying))[::-1]
