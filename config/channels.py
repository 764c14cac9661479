"""The channels of a source: how the values of one sensor, input or state are taken from it."""

from __future__ import annotations

from abc import abstractmethod
from typing import Annotated, Literal

from pydantic import Field, model_validator

from .fields import Condition, Number, Numbers, Positives, Repeats, Section, Text, Texts, one_of, refused


class AccuracySection(Section):
    """Noise that the source reports with each measurement, as a GNSS receiver does. Give one of the two.

    It replaces the tuned R for that measurement. If it is missing or not positive, R is used.
    """

    std: Texts | None = None
    """Name of the signal of the same message, or of the column, that holds the standard deviation; a list names one for
    each row of the sensor."""
    variance: Texts | None = None
    """The same of the variance."""
    units: Texts | None = None
    """Unit of each, converted to the row's, or to its square for a variance (cm, m^2, ...). Default: the DBC's, else
    the model's."""
    scale: Positives = (1.0,)
    """Factor applied after the conversion of units: 0.5 if two standard deviations are reported. Default: 1."""

    @property
    def names(self) -> tuple[str, ...]:
        """The signals or columns, one for all rows or one a row."""
        return self.std or self.variance or ()

    @model_validator(mode="after")
    def _one(self) -> AccuracySection:
        one_of(self, "std", "variance", required=True)
        return self


class ChannelSection(Section):
    """How the values of one sensor, input or state are taken from the source: value·scale + offset, in model units."""

    units: Texts | None = None
    """Unit of each value, converted to the model's (km/h, degC, deg/s, ...). Default: the DBC's, else the model's."""
    scale: Numbers = (1.0,)
    """Factor applied after the unit is converted; -1 turns an axis round. A list gives one a value. Default: 1."""
    offset: Numbers = (0.0,)
    """Added after `scale`, in the model's unit. A list gives one a value. Default: 0."""
    valid_if: dict[str, Condition] = {}
    """Conditions {name: value} or {name: [low, high]} on other values of the same row or message; where one fails, the
    measurement is missing. Of a table also texts: {quality: Good} or {quality: [Good, Uncertain]}. Default: none."""
    only: dict[str, Condition] = {}
    """Conditions as in `valid_if` that select the rows or frames of this channel: {anchor: 3}, {tag: TT101}. Others are
    ignored, without a missing measurement. Default: none."""
    landmark_column: Text | dict[Text, dict[Text, Condition]] | None = None
    """Column or signal with the landmark of each row, for a sensor with landmarks: landmark_id. If its values are not
    the ids of the sensors SENSOR_ID, also the value of each id: {node_id: {1: 0, 2: 1, 3: 5}}. Rows with other values
    are ignored. Default: none."""
    convert: Literal["east_north"] | None = None
    """east_north: the two values are latitude and longitude in degrees, and become metres east and north of `origin`.
    Default: null, no conversion."""
    origin: tuple[Number, Number] | None = None
    """Latitude and longitude of the local origin, degrees. Default: the first valid fix."""
    repeats: Repeats = "keep"
    """Rows of a sensor that repeat its value: keep takes each for a measurement; changes leaves out those whose value
    equals the one before; `every 10 s` too, but for one every 10 s while the value stays, if the source repeats a
    value for so long. `nisus log` finds it. Default: keep."""
    accuracy: AccuracySection | None = None
    """Noise that is reported with each measurement of a sensor, {std: SIGNAL}. Default: null, the tuned R."""

    @abstractmethod
    def names(self) -> tuple[str, ...]:
        """Return the signals or columns, one a row."""

    @model_validator(mode="after")
    def _lengths(self) -> ChannelSection:
        count = len(self.names())
        entries = [(key, "has {} entries", getattr(self, key)) for key in ("units", "scale", "offset")]
        if own := self.accuracy:
            texts = {"names {}": own.names, "units has {}": own.units, "scale has {}": own.scale}
            entries += [("accuracy", text, values) for text, values in texts.items()]
        for key, text, values in entries:
            if values is not None and len(values) not in (1, count):
                text = f"{text.format(len(values))}; give one, or one for each of the {count} values"
                raise refused("relation", text, key)
        if self.convert == "east_north" and count != 2:
            text = f"is east_north; it needs two values, latitude and longitude, and {count} are named"
            raise refused("relation", text, "convert")
        return self


class SignalSection(ChannelSection):
    """Values from the signals of one CAN message."""

    message: Text
    """The message's name in the DBC."""
    signals: Texts
    """Its signal's name, or a list: one for each row of the sensor. For a sensor with landmarks * is the id."""
    source: Annotated[int, Field(strict=True, ge=0, le=253)] | None = None
    """Source address of the sender of a J1939 message: 0x00. Default: null, the only sender on the bus."""

    @model_validator(mode="after")
    def _numbers(self) -> SignalSection:
        for key in ("valid_if", "only"):
            for name, rule in getattr(self, key).items():
                if rule.text is not None:
                    text = f"compares {name} with the text {rule.text[0]!r}; give the signal's raw number"
                    raise refused("relation", text, key)
        return self

    def names(self) -> tuple[str, ...]:
        """Return the signals, one a row."""
        return self.signals


class ColumnSection(ChannelSection):
    """Values from the columns of a table."""

    columns: Texts
    """The column's name, or a list: one for each row of the sensor. For a sensor with landmarks TT* names a column of
    each: TT followed by its id."""

    def names(self) -> tuple[str, ...]:
        """Return the columns, one a row."""
        return self.columns


class MessagesSection(Section):
    """A source of messages with values by name, which other programs, a broker, a server or a device send."""

    sensors: dict[str, ColumnSection] = {}
    """Sensors of the model and the names of the values that feed them. Default, without any sensor and input: all of
    them, by the names of the model."""
    inputs: dict[str, ColumnSection] = {}
    """Inputs of the model and the names of the values that feed them."""
    truth: dict[str, ColumnSection] = {}
    """States whose true value is sent too. They are scored, never used."""
