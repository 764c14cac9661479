"""The kinds of value that a twin's YAML holds, shared by the schema's sections."""

from __future__ import annotations

import ast
import inspect
import math
import re
import sys
from typing import Annotated, Any, ClassVar, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    GetJsonSchemaHandler,
    Tag,
    model_validator,
)
from pydantic_core import CoreSchema, PydanticCustomError

from estimators.errors import LARGEST

MAX_DURATION_S = 1e9  # Seconds that anything may last: 32 years

MAX_TIME_S = 9e9
"""Seconds from 1970 until the year 2255: times are int64 nanoseconds, which end soon after."""


def refused(
    kind: Literal["value", "relation", "both", "absent", "no_kind"], text: str, key: str = ""
) -> PydanticCustomError:
    """Return an error, which `problems.report` completes to a line with place, key and value.

    Args:
        kind: value: of a single value. relation: of the section's `key` with others. both: of a section with a key too
            many, `key`. absent: of a section that lacks a key. no_kind: of one that lacks the key of its kind.
        text: Rule that a value breaks; for the other kinds the words after the name of the key or section.
        key: The key that is at fault.
    """
    return PydanticCustomError(kind, "{text}", {"text": text, "key": key})


Number = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-LARGEST, le=LARGEST)]
Positive = Annotated[float, Field(strict=True, allow_inf_nan=False, gt=0, le=LARGEST)]
NotNegative = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0, le=LARGEST)]
TIME_UNITS = {"ms": 1e-3, "s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0}
"""Units in which a duration may be given, in seconds."""


def as_seconds(value: Any) -> Any:
    """Return a duration as its seconds: `5 min` is 300; a number is seconds already."""
    if not isinstance(value, str):
        return value
    number, unit = re.fullmatch(r"\s*([-+.\deE]*)\s*(.*?)\s*", value).groups()  # type: ignore[union-attr]
    try:
        return float(number) * TIME_UNITS[unit]
    except (ValueError, KeyError):
        rule = f"give seconds, or a number with one of {', '.join(TIME_UNITS)}, as in 5 min"
        raise refused("value", rule) from None


AS_SECONDS = BeforeValidator(as_seconds, json_schema_input_type=float | str)
Duration = Annotated[float, Field(strict=True, allow_inf_nan=False, gt=0, le=MAX_DURATION_S), AS_SECONDS]
DurationOrZero = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0, le=MAX_DURATION_S), AS_SECONDS]
Time = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-MAX_TIME_S, le=MAX_TIME_S), AS_SECONDS]


def repeat_period(value: str) -> float | None:
    """Return the seconds of `every 10 s`; 0 of `changes`, None of `keep`."""
    word, _, duration = value.partition(" ")
    return as_seconds(duration) if word == "every" else {"keep": None, "changes": 0.0}[value]


def _repeats(value: str) -> str:
    """Refuse what is no rule for repeats."""
    try:
        period = repeat_period(value)
    except (KeyError, PydanticCustomError):
        period = -1.0
    if period is not None and not (value == "changes" or 0.0 < period <= MAX_DURATION_S):
        raise refused("value", "give keep, changes, or every with a duration, as in every 10 s")
    return value


Repeats = Annotated[str, AfterValidator(_repeats)]
Count = Annotated[int, Field(strict=True, ge=1)]


def as_choice(value: object) -> object:
    """Return the word of a switch: `adapt: false` is off."""
    return {True: "on", False: "off"}[value] if isinstance(value, bool) else value


Option = Annotated[Number | Annotated[str, Field(min_length=1)], BeforeValidator(as_choice)]
Flag = Annotated[bool, Field(strict=True)]
Text = Annotated[str, Field(min_length=1)]
EnvironmentName = Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]*$")]
"""Name of an environment variable: secrets stand in the environment, never in a file."""

Host = Annotated[str, Field(pattern=r"^[^\s/]+$")]
Port = Annotated[int, Field(strict=True, ge=1, le=65535)]


def as_list(value: object) -> Any:
    """Return a lone value as a list of one."""
    return value if isinstance(value, (list, tuple)) or value is None else [value]


Texts = Annotated[
    tuple[Text, ...], Field(min_length=1), BeforeValidator(as_list, json_schema_input_type=str | list[str])
]
OneOrMore = BeforeValidator(as_list, json_schema_input_type=float | list[float])
Numbers = Annotated[tuple[Number, ...], Field(min_length=1), OneOrMore]
Positives = Annotated[tuple[Positive, ...], Field(min_length=1), OneOrMore]
NotNegatives = Annotated[tuple[NotNegative, ...], Field(min_length=1), OneOrMore]


class Section(BaseModel):
    """A mapping of the YAML. A key that it does not have is an error, with the keys that it has.

    A validator is built on first use, that of a twin with all its sections at once.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)
    free_keys: ClassVar[str | None] = None
    """Beginning of keys that may hold anything and are ignored."""

    @model_validator(mode="before")
    @classmethod
    def _known_keys(cls, data: object) -> object:
        # Before pydantic's own check, which reports the stray key but not its neighbours.
        if isinstance(data, dict):
            fields = cls.model_fields
            known = list(fields)
            if cls.free_keys is not None:
                data = {key: value for key, value in data.items() if not key.startswith(cls.free_keys)}
            for key in data:
                if key not in known:
                    raise PydanticCustomError("unknown_key", "unknown key", {"key": key, "known": known})
            # `time:` with every key under it commented out means the defaults.
            return {key: value for key, value in data.items() if value is not None or fields[key].is_required()}
        return data

    @classmethod
    def __get_pydantic_json_schema__(cls, core_schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        """Describe each key by the docstring under its field.

        Pydantic's own `use_attribute_docstrings` parses every section at import, which took half of the import time.
        """
        schema = handler(core_schema)
        described = handler.resolve_ref_schema(schema)["properties"]
        for section in reversed(cls.__mro__[: cls.__mro__.index(Section)]):
            if section.__qualname__ not in vars(sys.modules[section.__module__]):
                continue  # of `create_model`: it has no source, and its fields have descriptions
            body = ast.parse(inspect.getsource(section)).body[0].body  # type: ignore[attr-defined]
            for field, text in zip(body, body[1:]):
                if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr):
                    name = field.target.id  # type: ignore[union-attr]
                    described[name]["description"] = inspect.cleandoc(text.value.value)  # type: ignore[attr-defined]
        return schema


def one_of(section: Section, *keys: str, required: bool) -> None:
    """Refuse a section that gives two of `keys`, or none where one is needed."""
    given = [key for key in keys if getattr(section, key) is not None]
    if len(given) > 1:
        raise refused("both", f"gives both {given[0]} and {given[1]}", given[1])
    if required and not given:
        raise refused("absent", f"gives neither {' nor '.join(keys)}")


Pair = tuple[Number | None, Number | None]


def as_pair(value: object) -> object:
    """Refuse a list that is no pair."""
    if isinstance(value, (list, tuple)) and len(value) != 2:
        raise refused("value", "give the least and the greatest value, null for none")
    return value


def _rising(pair: Pair) -> Pair:
    low, high = pair
    if low is not None and high is not None and not low < high:
        raise refused("value", "the first must be below the second")
    return pair


Interval = Annotated[Pair, BeforeValidator(as_pair, json_schema_input_type=Pair), AfterValidator(_rising)]
"""The least and the greatest value, [20, 38]; null for none."""


def _not_negative(pair: Pair) -> Pair:
    if min(end for end in (*pair, 0.0) if end is not None) < 0.0:
        raise refused("value", "its ends must not be negative")
    return pair


class BoundedSection(Section):
    """A value and its range by the data sheet, within which a fit (`nisus tune`) stays."""

    value: NotNegatives
    """The value; a list gives one a row."""
    range: Annotated[Interval, AfterValidator(_not_negative)]
    """Smallest and largest admissible value, [0.3, 0.8]; null for none."""

    @property
    def ends(self) -> tuple[float, float]:
        """The two ends of the range."""
        low, high = self.range
        return low or 0.0, LARGEST if high is None else high

    @model_validator(mode="after")
    def _inside(self) -> BoundedSection:
        low, high = self.ends
        for value in self.value:
            if not low <= value <= high:
                raise refused("relation", f"is {value:g}; it must lie in its range ({low:g} to {high:g})", "value")
        return self


def _kind(given: object) -> str:
    return "bounded" if isinstance(given, (dict, BoundedSection)) else "plain"


Level = Annotated[
    Annotated[NotNegative, Tag("plain")] | Annotated[BoundedSection, Tag("bounded")], Discriminator(_kind)
]
Spread = Annotated[
    Annotated[NotNegatives, Tag("plain")] | Annotated[BoundedSection, Tag("bounded")], Discriminator(_kind)
]


class VarianceSection(Section):
    """A variance, or its square root."""

    needs_one: ClassVar[bool] = True
    variance: Any = None
    std: Any = None

    @model_validator(mode="after")
    def _one(self) -> VarianceSection:
        one_of(self, "variance", "std", required=self.needs_one)
        return self

    @property
    def variances(self) -> tuple[float, ...] | None:
        """The variances, one for all rows or one a row; None if none is given."""
        if self.variance is not None:
            return _values(self.variance)
        return tuple(std**2 for std in _values(self.std)) if self.std is not None else None

    @property
    def bounds(self) -> tuple[float, float] | None:
        """The least and the greatest variance, if they are given."""
        if isinstance(self.variance, BoundedSection):
            return self.variance.ends
        if isinstance(self.std, BoundedSection):
            return self.std.ends[0] ** 2, min(self.std.ends[1] ** 2, LARGEST)
        return None


def _values(given: float | tuple[float, ...] | BoundedSection) -> tuple[float, ...]:
    if isinstance(given, BoundedSection):
        return given.value
    return given if isinstance(given, tuple) else (given,)


class LevelSection(VarianceSection):
    """Strength of a process noise: the variance or standard deviation that one second adds. Give one of the two."""

    variance: Level | None = None
    """Variance added in one second, in the square of the state's unit for the usual additive noise. {value, range}
    also gives the range within which a fit stays."""
    std: Level | None = None
    """Its square root: the standard deviation after one second. As `variance`."""

    @model_validator(mode="after")
    def _single(self) -> LevelSection:
        for key in ("variance", "std"):
            given = getattr(self, key)
            if isinstance(given, BoundedSection) and len(given.value) > 1:
                raise refused("relation", "has several values; give one", key)
        return self

    @property
    def value(self) -> float:
        """The variance."""
        return (self.variances or (0.0,))[0]


class NoiseSection(LevelSection):
    """Strength and correlation time of a process noise."""

    correlation_time: Duration | None = None
    """Correlation time of the disturbance, in seconds or with a unit: 120, 2 min. A state
    NAME_disturbance and a parameter NAME_disturbance_time are appended; in the long run the disturbance adds the same
    `variance` a second as white noise. Default: none, white noise."""


class ErrorSection(VarianceSection):
    """A coloured error of a sensor, beside its white noise."""

    variance: Positives | None = None
    """Variance of the error, in the square of the sensor's unit; a list gives one a row."""
    std: Positives | None = None
    """Its square root: standard deviation, in the sensor's unit; a list gives one a row."""
    correlation_time: Duration
    """Correlation time of the error, in seconds or with a unit: 300, 5 min."""


class SpreadSection(VarianceSection):
    """The noise of one sensor."""

    needs_one = False
    variance: Spread | None = None
    """Variance of the noise, in the square of the sensor's unit; a list gives one a row. 0 is a sensor without noise,
    which kf, ekf, iekf and the square-root filters take. {value, range} also gives the range of the data sheet,
    within which a fit stays. Default: the model's."""
    std: Spread | None = None
    """Its square root: standard deviation, in the sensor's unit, as {value: 0.5, range: [0.3, 0.8]}; a list gives one
    a row. As `variance`. Default: the model's."""


def _ordered(pair: Pair) -> Pair:
    if None not in pair and pair[0] > pair[1]:  # type: ignore[operator]
        raise refused("value", "the first must not be above the second")
    return pair


class ConditionSection(Section):
    """A range of values, its ends included, or texts of which a column must hold one."""

    range: Annotated[Pair, AfterValidator(_ordered)] = (None, None)
    """Lowest and highest value, null for none. Default: any."""
    text: Texts | None = None
    """Text, or a list of texts. Default: null, the column holds numbers."""


def _condition(value: object) -> object:
    if isinstance(value, bool):
        value = int(value)
    if isinstance(value, (int, float)):
        value = [value, value]
    if isinstance(value, list) and not any(isinstance(item, str) for item in value):
        return {"range": value}
    return {"text": value} if isinstance(value, (str, list)) else value


Condition = Annotated[
    ConditionSection,
    BeforeValidator(_condition, json_schema_input_type=float | bool | str | Pair | list[str] | ConditionSection),
]


def _as_pairs(value: object) -> object:
    """Return a single pair as a list of one."""
    if not isinstance(value, (list, tuple)) or any(isinstance(item, (list, tuple)) for item in value):
        return value
    return [as_pair(value)]


Ranges = Annotated[
    tuple[Pair, ...],
    Field(min_length=1),
    BeforeValidator(_as_pairs, json_schema_input_type=Pair | list[Pair]),
    AfterValidator(lambda pairs: tuple(map(_rising, pairs))),
]


class ValiditySection(Section):
    """A range of validity, its ends included."""

    range: Interval
    """Lowest and highest value, null for none."""
    extrapolate: Positive | None = None
    """Distance by which the model holds beyond the range. Default: 5 % of its width."""


Validity = Annotated[
    ValiditySection,
    BeforeValidator(
        lambda value: {"range": value} if isinstance(value, list) else value,
        json_schema_input_type=Pair | ValiditySection,
    ),
]


def bounds(pair: Pair, own: tuple[float, float] | None = None) -> tuple[float, float]:
    """Return the two ends; where one is not given that of `own`, unless the other is beyond; else infinite."""
    low, high = pair
    least, most = own or (-math.inf, math.inf)
    if low is None:
        low = least if high is None or least < high else -math.inf
    return low, high if high is not None else most if low < most else math.inf


class StuckSection(Section):
    """When a sensor that repeats its value is stuck. Equal measurements are rejected until one differs."""

    readings: Annotated[int, Field(strict=True, ge=2)] | None = None
    """Number of equal measurements in a row from which on the sensor is stuck. Default: by `seconds` or `quantum`."""
    seconds: Duration | None = None
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
            raise refused("absent", "gives neither readings, seconds nor quantum")
        return self


class DuplicatesSection(Section):
    """Copies of measurements."""

    within: DurationOrZero
    """Seconds after a measurement within which one of equal values is a copy, for gateways that repeat messages. Below
    the sensor's own period and `time.stale_after`."""
