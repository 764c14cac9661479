"""The schema of a twin's `source`: where its readings come from."""

from __future__ import annotations

import re
from datetime import date
from typing import TYPE_CHECKING, Annotated, Literal, Union
from zoneinfo import available_timezones

from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from estimators.errors import nearest

from .channels import ColumnSection, MessagesSection, SignalSection
from .extensions import schemas
from .fields import (
    AS_SECONDS,
    MAX_DURATION_S,
    Count,
    Duration,
    DurationOrZero,
    LevelSection,
    Number,
    Section,
    SpreadSection,
    Text,
    Texts,
    Time,
    as_list,
    one_of,
    refused,
)


class DatabaseSection(Section):
    """A DBC file and the bus on which it holds."""

    file: Text
    """Path of the DBC, relative to `folder` if the source has one, else to this YAML."""
    channel: Annotated[int, Field(strict=True)] | str | None = None
    """The bus's number or name in the log, where one log holds several. Default: null, every bus."""


def _databases(value: object) -> list[object]:
    return [{"file": item} if isinstance(item, str) else item for item in as_list(value) or []]


Databases = Annotated[
    tuple[DatabaseSection, ...],
    Field(min_length=1),
    BeforeValidator(_databases, json_schema_input_type=str | DatabaseSection | list[str | DatabaseSection]),
]


class SineSection(Section):
    """mean + amplitude·sin(2π t / period + phase)."""

    mean: Number = 0.0
    """Mean, in the input's unit. Default: 0."""
    amplitude: Number
    """Amplitude, in the input's unit."""
    period: Duration
    """Period, s."""
    phase: Number = 0.0
    """Phase at t = 0, rad. Default: 0."""


class ProfileSection(Section):
    """Course of one input over time: exactly one of constant, steps and sine."""

    constant: Number | None = None
    """A constant, in the input's unit."""
    steps: Annotated[tuple[tuple[Time, Number], ...], Field(min_length=1)] | None = None
    """[[t, value], ...]: from t seconds on, the value; before the first, the first value."""
    repeat: Duration | None = None
    """Seconds after which `steps` start again. Default: null, never."""
    sine: SineSection | None = None
    """A sine wave."""

    @model_validator(mode="after")
    def _one(self) -> ProfileSection:
        one_of(self, "constant", "steps", "sine", required=True)
        if self.steps is not None:
            times = [t for t, _ in self.steps]
            if times != sorted(set(times)):
                raise refused("relation", "must have rising times; put them in order", "steps")
        if self.repeat is not None and (self.steps is None or self.repeat <= self.steps[-1][0]):
            raise refused("relation", f"is {self.repeat} s; it needs steps that all begin before it", "repeat")
        return self


def _profiles(value: object) -> list[object]:
    return [
        {"constant": item} if isinstance(item, (int, float)) and not isinstance(item, bool) else item
        for item in as_list(value) or []
    ]


Profiles = Annotated[
    tuple[ProfileSection, ...],
    Field(min_length=1),
    BeforeValidator(_profiles, json_schema_input_type=float | ProfileSection | list[float | ProfileSection]),
]


class PlanSection(SpreadSection):
    """Rate, true noise and losses of one simulated sensor."""

    every: Count = 1
    """Steps between its measurements. Default: 1."""
    drop_every: Count | None = None
    """One in so many of its measurements is lost. Default: null, none."""


class TruthSection(Section):
    """Differences of the simulated asset from the estimator's model."""

    model: Text | None = None
    """Another model with the same states, inputs and sensors: a name, or file.py:Name. Default: the twin's."""
    parameters: dict[str, Number] = {}
    """The asset's true parameters; one that the twin estimates is constant, unless `noise` has it too. Default: those
    of the twin, or of `model` if it is given."""
    noise: dict[str, LevelSection] = {}
    """The asset's true process noise. Default: that of the twin, or of `model` if it is given."""
    every: Count | None = None
    """Steps between two outputs of the true value of every cell of a large field, for scores and pictures of the error;
    charted cells are output at each step. Default: null, never."""


class AssetSection(Section):
    """A simulated asset."""

    seed: Annotated[int, Field(strict=True, ge=0)] = 0
    """Seed of the noise; the same seed gives the same run. Default: 0."""
    step: Annotated[float, Field(strict=True, ge=1e-6, le=MAX_DURATION_S), AS_SECONDS] = 1.0
    """Seconds between two steps of the simulation. Default: 1."""
    duration: Duration | None = None
    """Seconds after which it ends. Default: null, never."""
    initial: dict[str, Number] = {}
    """True state at the start, by state, in its unit. Default: the prior's mean."""
    truth: TruthSection = TruthSection()
    """Where the asset differs from the estimator's model. Default: nowhere."""
    inputs: dict[str, Profiles] = {}
    """Inputs by name: a number, {steps}, {sine}, or a list of these, which is their sum. Default: the model's."""
    sensors: dict[str, PlanSection] = {}
    """Rates, noise and losses by sensor. Default: every sensor at every step."""
    faults: tuple[FaultSection, ...] = ()
    """Faults of its sensors, inputs or parameters, as in `faults` of the twin. On a bus they act before frames are
    encoded, and leave no mark in the log. Default: none."""


class SimulatorSection(AssetSection):
    """A simulated asset as the source."""

    type: Literal["simulator"]
    """simulator"""


class SignalMaps(Section):
    """Which CAN signals feed the model."""

    dbc: Databases
    """The DBC file, as path or {file, channel}; or a list of these where several buses have one each."""
    sensors: dict[str, SignalSection] = {}
    """Sensors of the model and the signals that feed them."""
    inputs: dict[str, SignalSection] = {}
    """Inputs of the model and the signals that feed them."""
    truth: dict[str, SignalSection] = {}
    """States whose true value the bus carries. They are scored, never used."""


class CanSection(SignalMaps):
    """A live CAN bus."""

    type: Literal["can"]
    """can"""
    interface: Text
    """Interface of python-can: virtual, udp_multicast, socketcan, pcan, ..."""
    channel: Annotated[int, Field(strict=True)] | str
    """Channel of the interface: vcan0, can0, 239.74.163.2, ... Of udp_multicast each group is a bus of its own."""
    options: dict[str, object] = {}
    """Further arguments of python-can's interface, for example {bitrate: 500000}. Default: none."""
    asset: AssetSection | None = None
    """A simulated asset: `nisus bus` plays it on the bus; with the interface `virtual` the twin does so itself."""
    recording: Texts | None = None
    """Recorded logs of this bus, relative to this YAML, which `nisus fold` reads in its place. Default: none."""


class RecordingSection(Section):
    """Files of a recording."""

    folder: Text | None = None
    """Folder of the recordings, relative to this YAML. The environment variable NISUS_DATA replaces it. If there is no
    such folder and `get` is given, the user's cache does. Default: null, `files` are relative to this YAML."""
    files: Texts
    """The recording's files in their order; * and ? match. A folder or ZIP archive is all recordings in it, by name.
    `--log FILE...` replaces them."""
    get: Text | None = None
    """Where to get the recording, shown when it is absent."""


def known_zone(name: str) -> str:
    """Return a time zone, UTC+1 as +01:00."""
    if offset := re.fullmatch(r"(?:UTC|GMT)?([+-])(0?\d|1[0-4])(?::?([0-5]\d))?", name):
        return f"{offset[1]}{offset[2]:0>2}:{offset[3] or '00'}"
    if name not in (zones := available_timezones()):
        raise refused("value", f"is no time zone of this machine; {nearest(name, zones)}")
    return name


class CanLogSection(SignalMaps, RecordingSection):
    """A recorded CAN log: MF4, BLF, ASC, TRC, candump, CSV (python-can, GVRET, CANedge) or SQLite (.db)."""

    type: Literal["can_log"]
    """can_log"""
    zone: Annotated[str, AfterValidator(known_zone)] | None = None
    """Time zone of dates in text logs, which have none there: Europe/Berlin, +01:00. Default: null, UTC."""


def _known_date(text: str) -> str:
    try:
        return date.fromisoformat(text).isoformat()
    except ValueError:
        raise refused("value", "is no date; write year, month and day: 2024-03-04") from None


class TimeColumnSection(Section):
    """The column that holds the time."""

    column: Annotated[
        tuple[Text, ...],
        Field(min_length=1, max_length=2),
        BeforeValidator(as_list, json_schema_input_type=str | list[str]),
    ]
    """Its name; or, of a CSV, the columns of date and clock: [Date, Clock]."""
    unit: Literal["s", "ms", "us", "ns", "min", "h", "d", "excel", "matlab"] = "s"
    """Its unit, if it holds numbers; excel and matlab count days, as serial dates do there. Default: s."""
    format: Text | None = None
    """Format of its dates, as in Python's strptime: "%m/%d/%Y %H:%M:%S". Default: null, detected."""
    zone: Annotated[str, AfterValidator(known_zone)] | None = None
    """Time zone of dates without an offset: Europe/Berlin, +01:00. Default: null, that of the heading or UTC."""
    date: Annotated[str, AfterValidator(_known_date)] | None = None
    """Date of a file's first row if the column holds clocks: 2024-03-04. Default: that in its name, or 1970-01-01."""
    shift: Time = 0.0
    """Seconds added to it: -0.2 if a row describes the 0.2 s before it, so that an input holds for these and not for
    the next. Default: 0."""


class TableSection(RecordingSection):
    """A table: CSV, Parquet, Arrow (.feather), MATLAB (.mat up to version 7) or NumPy (.npz), or one of these as .gz.

    Columns of a MATLAB file are its vectors by their names there: meas.Voltage. Those of a NumPy archive are its arrays
    whose first axis is time: speed, or t2m_K[3,5] for a cell of a field. Those of a ROS 2 bag (.mcap, .db3, or the
    folder) are `time` and the fields of its messages: /odom.twist.twist.linear.x, /joint_states.position[elbow].
    """

    type: Literal["table"]
    """table"""
    time: TimeColumnSection
    """The column that holds the time: {column, unit}."""
    sensors: dict[str, ColumnSection] = {}
    """Sensors of the model and the columns that feed them."""
    inputs: dict[str, ColumnSection] = {}
    """Inputs of the model and the columns that feed them."""
    follow: Annotated[bool, Field(strict=True)] = False
    """Whether the files are CSV that grow, or appear in the folders that `files` names, while the twin runs: each row
    is read once, files in the order of their names. Default: false."""
    heading: Annotated[int, Field(strict=True, ge=1)] | Literal["none"] | None = None
    """Line of a CSV, or row of a sheet, with the names of the columns; none: c1, c2, ... Default: null, detected."""
    delimiter: Text | None = None
    """Sign between the cells of a CSV; tab and space are words. Default: null, detected."""
    decimal: Literal[".", ","] | None = None
    """Decimal sign of a CSV; the other one separates thousands. Default: null, detected."""
    skip: Annotated[int, Field(strict=True, ge=0)] = 0
    """Lines before the table, which are left out; a heading is detected after them. Default: 0."""
    sheet: Text | None = None
    """Sheet of a workbook, or group of channels of a TDMS file. Default: null, the only one with a table."""
    truth: dict[str, ColumnSection] = {}
    """States whose true value the table holds. They are scored, never used. Of a field under its name: the array
    with a cell for each of its own; cells that a sensor reads are left out."""


class PushSection(MessagesSection):
    """Messages that other programs send, with POST /api/readings or `nisus push`."""

    type: Literal["push"]
    """push"""


PartSection = Annotated[CanLogSection | TableSection, Field(discriminator="type")]
"""Recordings that can be merged."""


class MergedSection(Section):
    """Several recordings of one drive, merged in order of time."""

    type: Literal["merged"]
    """merged"""
    parts: Annotated[tuple[PartSection, ...], Field(min_length=1)]
    """The recordings: sections of type can_log or table, whose clocks agree."""

    @model_validator(mode="after")
    def _recorded(self) -> MergedSection:
        if any(isinstance(part, TableSection) and part.follow for part in self.parts):
            raise refused("relation", "have one with follow; a merged source reads recordings", "parts")
        return self


CoreSource = SimulatorSection | CanSection | CanLogSection | TableSection | MergedSection | PushSection
if TYPE_CHECKING:
    SourceSection = CoreSource
else:
    SourceSection = Annotated[Union[CoreSource, *schemas("sources").values()], Field(discriminator="type")]


class FaultSection(Section):
    """A fault that is injected into a source or a simulated asset, unknown to the estimator.

    It affects a `sensor`, an `input` or, of kind model, a `parameter`; without any of them the whole source. Its start
    and end are marked in the log.
    """

    kind: Literal[
        "bias", "drift", "scale", "stuck", "spike", "noise", "quantisation", "dropout", "silence", "delay", "jitter",
        "bursts", "reorder", "duplicate", "clock_jump", "clock_drift", "swap", "model", "outliers",
    ]  # fmt: skip
    """bias: `size` is added. drift: `size` is added for every second since `start`. scale: times `size`. stuck: the
    value before `start` is repeated. spike (outliers is its older name): with probability `rate` a draw of that
    standard deviation, `size`, is added. noise: a draw of that standard deviation is added to each. quantisation:
    rounded to multiples of `size`. dropout: with probability `rate` a measurement arrives empty. silence: nothing
    arrives. delay: arrives `size` seconds later. jitter: later by random seconds of that mean, `size`. bursts: arrives
    together, every `every` seconds. reorder: with probability `rate` it arrives after the next one. duplicate: with
    probability `rate` it is repeated `count` times, `every` seconds apart. clock_jump: stamped `size` seconds ahead.
    clock_drift: the clock gains `size` seconds a second. swap: readings of `sensor` come as those of `other`. model:
    the true parameter of a simulated asset is multiplied by `size`."""
    sensor: Text | None = None
    """The sensor's name."""
    input: Text | None = None
    """The input's name."""
    parameter: Text | None = None
    """The true parameter's name."""
    row: Text | None = None
    """The affected row of the sensor. Default: null, all."""
    other: Text | None = None
    """The sensor with which `sensor` is swapped."""
    start: DurationOrZero = 0.0
    """Start, seconds after the first event. Default: 0."""
    end: Duration | None = None
    """End, seconds after the first event. Default: null, never."""
    size: Number | None = None
    """Size: in the unit of the row or input (drift: per second), a factor, or seconds, by kind."""
    rate: Number | None = None
    """Probability for each measurement. Required by spike; otherwise the default is 1."""
    every: DurationOrZero | None = None
    """Seconds: of bursts between two arrivals, of duplicate between two repetitions. Default: of duplicate 0."""
    count: Count | None = None
    """Repetitions of a duplicate. Default: 1."""
    seed: Annotated[int, Field(strict=True, ge=0)] | None = None
    """Seed of its draws. Default: null, that of the simulated asset and the fault's place in the list."""
