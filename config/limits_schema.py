"""The schema of what a sensor can say at all, and of where a model holds."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field, model_validator
from pydantic_core import PydanticCustomError

from .fields import Number, Positives, Seconds, Section, SomeSeconds, one_of
from .source_schema import RangeSection

Pair = tuple[Number | None, Number | None]


def _as_pairs(value: Any) -> Any:
    """A lone pair stands for a list of one."""
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
    """The two ends; infinite where there is none."""
    low, high = pair
    return -np.inf if low is None else low, np.inf if high is None else high


class StuckSection(Section):
    """When a sensor that repeats itself is stuck. Equal readings are refused from there on, until one differs."""

    readings: Annotated[int, Field(strict=True, ge=2)] | None = None
    """The reading that is equal to as many as these, itself among them, is stuck. Default: told by `seconds`, or by
    `quantum`."""
    seconds: Seconds | None = None
    """Readings that have been equal for so long are stuck. Default: told by `readings`, or by `quantum`."""
    quantum: Positives | None = None
    """Step of the sensor's converter, in its unit; a list gives one a row. Values less than half of it apart are equal.
    Alone, it says how many equal readings noise may give: a longer run would come by chance less than once a day at the
    sensor's rate. Default: only the same number is equal."""
    std: Positives | None = None
    """Standard deviation of the noise before it is rounded, for that arithmetic, where the sensor's `std` stands for
    more than that; a list gives one a row. Default: the sensor's `std`."""

    @model_validator(mode="after")
    def _one(self) -> StuckSection:
        one_of(self, "readings", "seconds", required=False)
        if self.readings is None and self.seconds is None and self.quantum is None:
            raise PydanticCustomError("neither", "gives neither {keys}", {"keys": "readings, seconds nor quantum"})
        return self


class DuplicatesSection(Section):
    """Readings that come again."""

    within: SomeSeconds
    """Seconds after a reading within which one of the same values is that reading again, as of a gateway that repeats
    what it hears. Below the sensor's own period, and below `time.stale_after`."""
