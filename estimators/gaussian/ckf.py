"""The cubature Kalman filter: 2n points of equal weight on a sphere through the true f and h, nothing to tune.

The points x ± √n U[k] with P = Uᵀ U, each of weight 1/(2n), are the unscented ones for α = 1, β = 0, κ = 0, whose
central point weighs nothing: it only anchors the mean of angles. Third-degree exact, and P cannot turn indefinite by a
negative weight.

Source: Arasaratnam & Haykin (2009), doi:10.1109/TAC.2009.2019800.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..estimator import Options
from ..model.state_space import StateSpaceModel
from ..tuning import Tuning
from .robust import OPTIONS, shared_options
from .shared import moments
from .ukf import UKF, sigma_points, weights


def tune(values: Options, model: StateSpaceModel, tuning: Tuning) -> np.ndarray:
    """The shared options, and the weights of the cubature rule."""
    return np.array([*shared_options(values), *weights(1.0, 0.0, 0.0, model.nx)])


def points(values: Options, state: np.ndarray, nx: int) -> np.ndarray:
    """The cubature points (2 nx, nx) of a state."""
    return sigma_points(*moments(values, state, nx), np.sqrt(nx))[1:]


CKF = replace(
    UKF,
    name="ckf",
    title="Cubature Kalman filter",
    fails_when="the points, √nx standard deviations out, leave where the model holds; or several peaks",
    source="Arasaratnam & Haykin (2009), doi:10.1109/TAC.2009.2019800",
    points=points,
    options=OPTIONS,
    tune=tune,
    refuses=lambda model, options: None,
)
