"""Checks for the positions that localisation needs."""

from __future__ import annotations

from ..errors import EstimatorError
from ..model.field import Field
from ..model.state_space import StateSpaceModel


def check_placed(model: StateSpaceModel, radius: float) -> None:
    """Refuse a radius of localisation on a model without positions; 0 is none.

    Raises:
        EstimatorError: If the radius is positive and a state or a sensor row has no position.
    """
    if not radius > 0:
        return
    states = isinstance(model.states, Field) or all(state.position is not None for state in model.states)
    if states and all(row.position is not None for sensor in model.sensors for row in sensor.rows):
        return
    what = "sensor rows" if states else "states"
    raise EstimatorError(
        f"radius is {radius:g}, but model {model.name} does not say where its {what} are; "
        "give them positions, or set radius to 0"
    )
