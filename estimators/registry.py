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
from .model import LARGE, StateSpaceModel
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
    reason = unfit(ESTIMATORS[name], model)
    if reason:
        raise EstimatorError(f"estimator {name} does not apply: {reason}")
    return ESTIMATORS[name]


def unfit(entry: Estimator, model: StateSpaceModel) -> str | None:
    """Why an estimator does not fit a model, or None: its own reason, or the size of the covariance that it forms."""
    if entry.family == "ensemble":
        return entry.applies(model)
    if model.nx > LARGE:
        return (
            f"{model.name} is too large: a {entry.name} of {model.nx:,} states needs a {8e-9 * model.nx**2:,.3g} GB "
            "covariance; use an ensemble filter"
        )
    if model.shape is not None:
        return f"{model.name} gives its noise as a shape, not as a matrix; use an ensemble filter"
    return entry.applies(model)
