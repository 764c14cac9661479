"""Small models that tests of several packages share: a level that wanders, read by any number of sensors."""

from collections.abc import Mapping
from typing import Any

from estimators.model.state_space import Noise, Row, Sensor, State, StateSpaceModel


def unchanged(x, u, p, dt, out):
    out[:] = x


def first_state(x, u, p, out):
    out[:] = x[0]


def first_state_squared(x, u, p, out):
    out[0] = x[0] * x[0]


def level_model(
    sensors: Mapping[str, float | Mapping[str, float]],
    q: float,
    *,
    state: str = "level",
    mean: float = 0.0,
    std: float = 1.0,
    h: Any = first_state,
    **fields: Any,
) -> StateSpaceModel:
    """Return a random walk of one state; all rows of all sensors read it.

    Args:
        sensors: Variance by sensor, or by row of a sensor with several.
        q: Variance that a second adds.
        state: Name of the state.
        mean: Prior mean, m.
        std: Prior standard deviation, m.
        h: Function of every sensor.
        fields: Other fields of the model, which replace these.
    """
    rows = {name: given if isinstance(given, Mapping) else {name: given} for name, given in sensors.items()}
    given: dict[str, Any] = {
        "name": state,
        "title": state,
        "states": (State(state, "m", mean, std),),
        "noises": (Noise(state, "m²/s", q),),
        "sensors": tuple(
            Sensor(name, tuple(Row(row, "m", variance) for row, variance in own.items()), h=h)
            for name, own in rows.items()
        ),
        "f": unchanged,
    }
    return StateSpaceModel(**(given | fields))


def many_states(count: int) -> StateSpaceModel:
    """Return a model of this many states, of which the first is read."""
    return level_model(
        {"y": 1.0}, 1.0, state="x0", name="many", states=tuple(State(f"x{k}", "m") for k in range(count))
    )


FLOAT_AND_SONAR = level_model({"float": 1.0, "sonar": {"near": 1.0, "far": 1.0}}, 0.1)
"""A level read by a sensor with one row and one with two."""
