"""The schema of sensor limits and of a model's range of validity."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field, model_validator
from pydantic_core import PydanticCustomError

from .fields import Number, Positives, Seconds, Section, SomeSeconds, one_of
from .source_schema import RangeSection

Pair = tuple[Number | None, Number | None]


def _as_pairs(value: Any) -> Any:
    """Return a single pair as a list of one."""
    if not isinstance(value, (list, tuple)) or any(isinstance(item, (list, tuple)) for item in value):
        return value
    if len(value) != 2:
        raise PydanticCustomError("range", "give the least and the greatest value, null for none")
    return [value]


def _rising(pairs: tuple[Pair, ...]) -> tuple[Pair, ...]:
    for low, high in pairs:
        if low is not None and high is not None and not low < high:
            raise PydanticCustomError("range", "the first must be below the second")
    return pairs


def _holds_something(given: RangeSection) -> RangeSection:
    if given.min is None and given.max is None:
        raise PydanticCustomError("neither", "gives neither {keys}", {"keys": "min nor max"})
    if given.min is not None and given.max is not None and not given.min < given.max:
        raise PydanticCustomError("range", "its min must be below its max")
    return given


Ranges = Annotated[
    tuple[Pair, ...],
    Field(min_length=1),
    BeforeValidator(_as_pairs, json_schema_input_type=Pair | list[Pair]),
    AfterValidator(_rising),
]
Validity = Annotated[RangeSection, AfterValidator(_holds_something)]


def bounds(pair: Pair) -> tuple[float, float]:
    """Return the two ends; infinite where one is not given."""
    low, high = pair
    return -np.inf if low is None else low, np.inf if high is None else high


class StuckSection(Section):
    """When a sensor that repeats its value is stuck. Equal measurements are rejected until one differs."""

    readings: Annotated[int, Field(strict=True, ge=2)] | None = None
    """Number of equal measurements in a row from which on the sensor is stuck. Default: by `seconds` or `quantum`."""
    seconds: Seconds | None = None
    """Seconds of equal measurements after which the sensor is stuck. Default: by `readings` or `quantum`."""
    quantum: Positives | None = None
    """Step of the sensor's converter, in its unit; a list gives one a row. Values less than half a step apart are
    equal. Alone, it sets the length of a stuck run: noise gives a longer one less than once a day at the sensor's rate.
    Default: only identical numbers are equal."""
    std: Positives | None = None
    """Standard deviation of the noise before rounding, for the run length by `quantum`, if the sensor's `std` includes
    other errors; a list gives one a row. Default: the sensor's `std`."""

    @model_validator(mode="after")
    def _one(self) -> StuckSection:
        one_of(self, "readings", "seconds", required=False)
        if self.readings is None and self.seconds is None and self.quantum is None:
            raise PydanticCustomError("neither", "gives neither {keys}", {"keys": "readings, seconds nor quantum"})
        return self


class DuplicatesSection(Section):
    """Copies of measurements."""

    within: SomeSeconds
    """Seconds after a measurement within which one of equal values is a copy, for gateways that repeat messages. Below
    the sensor's own period and `time.stale_after`."""
