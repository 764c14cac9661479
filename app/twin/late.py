"""What becomes of late readings: as the YAML says, or by what going back would cost."""

from __future__ import annotations

from typing import NamedTuple

from config.schema import TwinSection
from estimators.errors import EstimatorError
from estimators.estimator import Estimator
from estimators.fold_checks import check_variances
from estimators.late import EVENT_S_PER_NUMBER, rewind_seconds
from estimators.model.state_space import StateSpaceModel
from estimators.snapshots import Snapshots
from estimators.tuning import Tuning


class Late(NamedTuple):
    """Whether late readings are used when they come, with R inflated, and why; else the filter goes back."""

    inflate: bool
    reason: str


def late_policy(config: TwinSection, model: StateSpaceModel, estimator: Estimator, tuning: Tuning) -> Late:
    """The policy, with its arithmetic."""
    section = config.time
    if section.late != "auto":
        return Late(section.late == "inflate", f"time.late is {section.late}")
    options = estimator.complete_for(model, tuning.options)
    numbers = estimator.state_size(options, model.nx) + estimator.memory(options, model)
    events = Snapshots(8 * numbers).every
    seconds = rewind_seconds(numbers, events)
    sum_ = f"{events} events x {numbers:,} numbers x {EVENT_S_PER_NUMBER * 1e9:g} ns = {seconds:.2g} s to go back"
    if seconds <= section.late_allowed:
        return Late(False, f"{sum_}, allowed {section.late_allowed:g} s")
    try:
        check_variances(estimator, options)
    except EstimatorError as error:
        return Late(False, f"{sum_}, more than {section.late_allowed:g} s, but {error}")
    return Late(True, f"{sum_}, more than {section.late_allowed:g} s")
