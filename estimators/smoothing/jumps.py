"""What happens to a state from outside the filter, as notes: a part that is changed, a twin found wrong and widened.

The mean stays, and x⁺ hangs together with x by a covariance C, so x | x⁺ ~ N(m + G (x⁺ - m), P - G P⁺ Gᵀ) with
G = C (P⁺)⁻¹, as over a step of the model.
"""

from __future__ import annotations

import numpy as np

from ..events.maintenance import without
from ..numerics.linalg import root
from .recorder import CUT, MOVED, Step, solve_semidefinite


def changed(mean: np.ndarray, cov: np.ndarray, prior: np.ndarray, state: int) -> Step:
    """One state of N(mean, cov) begins again with the prior's variance, apart from the others."""
    C = cov.copy()
    C[:, state] = 0.0
    return _note(mean, cov, without(cov, prior, state), C)


def widened(mean: np.ndarray, cov: np.ndarray, added: np.ndarray) -> Step:
    """Variances (nx,) are added to those of N(mean, cov)."""
    return _note(mean, cov, cov + np.diag(added), cov.copy())


def _note(mean: np.ndarray, cov: np.ndarray, after: np.ndarray, C: np.ndarray) -> Step:
    n = mean.size
    U, W = np.zeros((n, n)), np.zeros((n, n))
    nothing = np.zeros(0)
    if not root(after, U, n):
        return Step(np.array([float(CUT)]), mean, mean, np.zeros((n, n)), cov, nothing, 0)
    solve_semidefinite(U, C, W)
    return Step(np.array([float(MOVED)]), mean, mean, C, cov - W.T @ W, nothing, 0)
