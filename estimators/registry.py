"""The catalogue of estimators, by name. An entry is written in the file of its filter."""

from __future__ import annotations

from difflib import get_close_matches

from .ekf import EKF
from .enkf import ENKF
from .ensrf import ENSRF
from .errors import EstimatorError
from .etkf import ETKF
from .filter import Estimator
from .kf import KF
from .letkf import LETKF
from .model import StateSpaceModel
from .pf import PF, PF_REG
from .ukf import UKF

ESTIMATORS: dict[str, Estimator] = {entry.name: entry for entry in (KF, EKF, UKF, PF, PF_REG, ENKF, ETKF, ENSRF, LETKF)}


def find_estimator(name: str, model: StateSpaceModel) -> Estimator:
    """The entry of that name, if it applies to the model.

    Raises:
        EstimatorError: If there is none, with near names; or if it does not apply, with the reason.
    """
    if name not in ESTIMATORS:
        near = get_close_matches(name, ESTIMATORS, n=3, cutoff=0.4) or list(ESTIMATORS)
        raise EstimatorError(f"estimator {name!r} does not exist; near: {', '.join(near)}")
    reason = ESTIMATORS[name].applies(model)
    if reason:
        raise EstimatorError(f"estimator {name} does not apply: {reason}")
    return ESTIMATORS[name]
