"""What a model is: its declaration, the checks when it loads, and the models made from it.

What a model's file needs is here: `from estimators.model import Row, Sensor, State, StateSpaceModel`.
"""

from .state_space import Field, Input, Jump, Limits, Noise, Parameter, Row, Sensor, State, StateSpaceModel, Stuck

__all__ = [
    "Field",
    "Input",
    "Jump",
    "Limits",
    "Noise",
    "Parameter",
    "Row",
    "Sensor",
    "State",
    "StateSpaceModel",
    "Stuck",
]
