"""Catalogue of estimators by name. Each entry stands in the file of its filter."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from .ensemble.enkf import ENKF
from .ensemble.ensrf import ENSRF
from .ensemble.etkf import ETKF
from .ensemble.letkf import LETKF
from .ensemble.localisation import check_placed
from .errors import EstimatorError, nearest, quoted
from .estimator import Estimator, Options
from .gaussian.ckf import CKF
from .gaussian.ekf import EKF
from .gaussian.iekf import IEKF
from .gaussian.kf import KF
from .gaussian.kf_steady import KF_STEADY
from .gaussian.sr_ekf import SR_EKF
from .gaussian.sr_kf import SR_KF
from .gaussian.sr_ukf import SR_UKF
from .gaussian.ukf import UKF
from .interpreted.filterpy import FILTERPY_EKF, FILTERPY_ENKF, FILTERPY_KF, FILTERPY_UKF
from .model.landmarks import missing
from .model.state_space import LARGE, StateSpaceModel
from .particle.apf import APF
from .particle.pf import PF, PF_REG
from .particle.pf_ekf import PF_EKF
from .particle.rbpf import RBPF

GAUSSIAN = (KF, KF_STEADY, EKF, IEKF, UKF, CKF, SR_KF, SR_EKF, SR_UKF)
PARTICLE = (PF, PF_REG, PF_EKF, APF, RBPF)
ENSEMBLE = (ENKF, ETKF, ENSRF, LETKF)
REFERENCE = (FILTERPY_KF, FILTERPY_EKF, FILTERPY_UKF, FILTERPY_ENKF)

ESTIMATORS: dict[str, Estimator] = {entry.name: entry for entry in GAUSSIAN + PARTICLE + ENSEMBLE + REFERENCE}


def find_entry(name: str) -> Estimator:
    """Return the entry of that name.

    Raises:
        EstimatorError: If there is none, with similar names, or all.
    """
    if name not in ESTIMATORS:
        raise EstimatorError(f"estimator {quoted(name)} does not exist; {nearest(name, ESTIMATORS)}")
    return ESTIMATORS[name]


def find_estimator(name: str, model: StateSpaceModel) -> Estimator:
    """Return the entry of that name, if it applies to the model.

    Raises:
        EstimatorError: If there is none, with similar names; or if it does not apply, with the reason.
    """
    entry = find_entry(name)
    for sensor in model.sensors:
        if sensor.place:
            raise EstimatorError(missing(model, sensor))
    reason = unfit(entry, model)
    if reason:
        raise EstimatorError(f"estimator {name} does not apply: {reason}")
    return entry


def checked(entry: Estimator, model: StateSpaceModel, options: Mapping[str, float | str]) -> Options:
    """Return the completed options if the estimator can run with them on the model; nothing is compiled.

    Raises:
        EstimatorError: If one is unknown, breaks its rule, or needs a declaration that the model lacks.
    """
    values = entry.complete_for(model, options)
    try:
        check_placed(model, values.get("radius", 0.0))
    except EstimatorError as error:
        raise EstimatorError(f"estimator {entry.name}: {error}") from None
    return values


def unfit(entry: Estimator, model: StateSpaceModel) -> str | None:
    """Return why an estimator does not apply to a model, or None: its own reason, or the size of its state."""
    if model.black_box and entry.blocks is None and not entry.interpreted:
        return (
            f"{model.name} is a black box, whose f and h run on blocks of states and are not compiled; {entry.name} "
            f"needs compiled ones; use {_those(lambda e: e.interpreted or e.blocks is not None)}"
        )
    if model.certain and not entry.singular:
        return (
            f"in {model.name} {model.certain}, and {entry.name} takes no singular covariance; give it a small "
            f"variance, or use {_those(lambda e: e.singular)}"
        )
    if model.considered and not entry.considers:
        return (
            f"{model.name} has parameters to consider, which {entry.name} cannot; hold or estimate them, or use "
            f"{_those(lambda e: e.considers)}"
        )
    if entry.family == "ensemble":
        return entry.applies(model)
    if model.nx > LARGE:
        needs = f"{_gigabytes(model.nx**2)} covariance"
        if entry.family == "particle":
            options = entry.complete({})
            size = entry.state_size(options, model.nx) + entry.memory(options, model)
            needs = f"{_gigabytes(size)} state, {options['particles']:,.0f} particles and their covariance"
        return f"{model.name} is too large: {entry.name} of {model.nx:,} states needs a {needs}; use an ensemble filter"
    if model.shape is not None:
        return f"{model.name} gives its noise as a shape, not as a matrix; use an ensemble filter"
    return entry.applies(model)


def _those(able: Callable[[Estimator], object]) -> str:
    return ", ".join(e.name for e in ESTIMATORS.values() if able(e))


def _gigabytes(numbers: int) -> str:
    """Format the memory of so many float64s."""
    size = 8e-9 * numbers
    return f"{size:,.0f} GB" if size >= 1000.0 else f"{size:.3g} GB"
