"""The schema of a twin's YAML.

The docstring under each field is its documentation in the JSON Schema that `nisus schema` writes for editors.
"""

from __future__ import annotations

import json
import re
from typing import Annotated, ClassVar, Literal

from pydantic import BeforeValidator, ConfigDict, Field, model_validator

from .fields import (
    AS_SECONDS,
    MAX_DURATION_S,
    Count,
    DuplicatesSection,
    Duration,
    DurationOrZero,
    ErrorSection,
    Flag,
    Interval,
    NoiseSection,
    NotNegative,
    Number,
    Numbers,
    Option,
    Positive,
    Positives,
    Ranges,
    Section,
    SpreadSection,
    StuckSection,
    Text,
    Texts,
    Time,
    Validity,
    refused,
)
from .model_schema import Model
from .output_schema import AlertSection, OutputsSection
from .source_schema import AssetSection, FaultSection, SourceSection

PERCENT = r"^([0-9]+\.?[0-9]*|\.[0-9]+) ?%$"
Percent = Annotated[str, Field(pattern=PERCENT)]
"""A share, as in 10 %."""


def _no_other_text(value: object) -> object:
    """Return a width; refuse text that is no share above zero."""
    if isinstance(value, str) and (not re.match(PERCENT, value) or not float(value.rstrip(" %")) > 0.0):
        raise refused("value", "give a positive number without a unit, or a share of the value above zero, as in 10 %")
    return value


Width = Annotated[Positive | Percent, BeforeValidator(_no_other_text, json_schema_input_type=Positive | Percent)]
"""A standard deviation, as a number or as a share of the value."""

GateProbability = Annotated[float, Field(strict=True, ge=0.5, lt=1)]


class PriorSection(Section):
    """Prior of one state, before the first measurement."""

    mean: Number | None = None
    """Expected value, in the state's unit. Default: the model's."""
    std: NotNegative | None = None
    """Standard deviation of the prior, in the state's unit. 0 is a state that is known exactly: kf, ekf, iekf and the
    square-root filters accept it, a field does not. Default: the model's."""


def as_width(value: float, given: float | str) -> float:
    """Return a width in the unit of a value, of which it may be a percentage."""
    return abs(value) * float(given.rstrip(" %")) / 100.0 if isinstance(given, str) else given


class WidenSection(Section):
    """Growth of a parameter's uncertainty outside the range of a state or an input in which it was fitted."""

    per: Positive = 1.0
    """Distance from that range, in its unit, that adds `by`. Default: 1."""
    by: Width
    """Standard deviation that it adds, in the parameter's unit, or in percent of the parameter's value, as in 50 %."""


class ParameterSection(Section):
    """Value of a parameter of the model, and how uncertain it is."""

    value: Number | None = None
    """Its value, in its unit. Default: the model's."""
    std: Width | None = None
    """Standard deviation of its true value about this one, in its unit, or in percent of the value, as in 10 %.
    Default: none, it is certain."""
    drift: NotNegative = 0.0
    """Random walk of an estimated one: standard deviation that one second adds, in its unit. Default: 0."""
    correlation: dict[str, Annotated[float, Field(strict=True, gt=-1, lt=1)]] = {}
    """Correlation of its deviation with those of other considered parameters, by name; a pair is given once, under
    either. Default: 0."""
    widen: dict[str, WidenSection] = {}
    """Growth of its uncertainty outside the fitted range (`valid_range`) of states and inputs, by their names, as in
    {temperature: {per: 10, by: 50 %}}. Default: none."""
    role: Literal["held", "considered", "estimated"] = "considered"
    """held: the filter takes it for certain. considered: no measurement changes it, and its uncertainty is part of the
    bands (Schmidt's filter). estimated: it becomes one of the last states (joint
    estimation), and may be named like any state. Default: considered, if it has a std or widens."""

    @model_validator(mode="after")
    def _complete(self) -> ParameterSection:
        if self.role == "estimated" and self.std is None:
            raise refused("absent", "is estimated and needs the standard deviation of its prior", "std")
        if self.role != "estimated" and self.drift:
            raise refused("relation", "is for a parameter with `role: estimated`; leave it out", "drift")
        if "role" in self.model_fields_set and self.role == "considered" and self.std is None and not self.widen:
            raise refused("absent", "is considered and needs a standard deviation, as in std: 10 %", "std")
        return self

    def spread(self, value: float) -> float | None:
        """Return the standard deviation of a parameter of this value; None if it is held."""
        if self.role == "held" or (self.std is None and not self.widen):
            return None
        return 0.0 if self.std is None else as_width(value, self.std)

    def widened(self, value: float) -> dict[str, float]:
        """Return the standard deviation that a unit of distance adds to a parameter of this value, by place."""
        return {name: as_width(value, section.by) / section.per for name, section in self.widen.items()}


def as_parameter(value: object) -> object:
    """Return a number as the value of a parameter."""
    return value if isinstance(value, (dict, ParameterSection)) else {"value": value}


Parameters = dict[
    str, Annotated[ParameterSection, BeforeValidator(as_parameter, json_schema_input_type=Number | ParameterSection)]
]


OptionalParameter = Annotated[
    ParameterSection | None,
    BeforeValidator(as_parameter, json_schema_input_type=Number | ParameterSection | None),
]


class InstrumentSection(Section):
    """Offset and scale of a sensor or an input."""

    offset: OptionalParameter = None
    """Added offset: a value, or {value, std, role} as a parameter, as in {std: 0.005}, in its unit. It becomes the
    parameter NAME_offset (NAME_ROW_offset of several rows), which `parameters` may give in its place. Default: none."""
    scale: OptionalParameter = None
    """Scale factor: a value, or {value, std, role} as a parameter, as in {std: 0.2 %}. It becomes the parameter
    NAME_scale (NAME_ROW_scale of several rows). Default: none."""


class RefitSection(Section):
    """Dual estimation: parameters are fitted again on recent windows of the log while the filter estimates the state.

    In joint estimation (`role: estimated`) one filter estimates both.
    """

    entries: Texts
    """Fitted entries: parameters (p.r0), noises (Q.winding, R.voltage), options of the estimator (options.alpha), or
    groups of them (p, Q, R, options)."""
    every: Duration
    """Time between two fits by the asset's clock, in seconds or with a unit: 600, 10 min."""
    window: Duration
    """Length of the fitted window, in seconds or with a unit: 1800, 30 min. The first fit waits for a full window."""
    adopt: Literal["by hand", "if better"] = "by hand"
    """Use of a result that predicts held-out data better and has left its confidence interval. by hand: it is proposed
    on the page. if better: it is adopted with a notice. An adopted result is a tuning version with its evidence.
    Default: by hand."""


class SensorSection(SpreadSection, InstrumentSection):
    """Noise of one sensor as the estimator assumes it, limits of its measurements, and whether they are used."""

    error: ErrorSection | None = None
    """A coloured error beside the white noise: {std: 3, correlation_time: 5 min}. A state is appended for each row,
    SENSOR_error (SENSOR_ROW_error of several rows), and the parameter SENSOR_error_time. Default: none."""
    correlation: tuple[tuple[Number, ...], ...] | None = None
    """Correlation of the noise of its rows, for example [[1, 0.5], [0.5, 1]], with R_ij = correlation_ij √(R_ii R_jj):
    it stays while the variances are tuned. Particle and ensemble filters take independent rows, [[1, 0], [0, 1]].
    Default: the model's."""
    range: Ranges | None = None
    """Smallest and largest possible value, in the sensor's unit, for example [-40, 180], null for none; a list of pairs
    gives one a row. Measurements outside are kept in the log and not used. Default: no limits."""
    saturation: Ranges | None = None
    """Values at which its converter clips: a measurement at or beyond one of them is not used. As `range`. Default:
    none."""
    rate: Positives | None = None
    """Largest change a second, in the sensor's unit, since the last measurement within all limits; noise may add 8
    standard deviations. A list gives one a row. Default: no limit."""
    stuck: StuckSection | None = None
    """When repeated equal measurements are no longer used. Default: never."""
    rests: Flag = False
    """true switches off the detector of stuck values: the sensor may repeat its value for any time. Default: false, a
    sensor is stuck that repeats its value although the model or other sensors predict movement."""
    expected: Literal["steadily", "by chance"] = "steadily"
    """When it reports. by chance: when a landmark, tag or event comes into its view: its silence is no dropout.
    Default: steadily, or as the model says."""
    duplicates: DuplicatesSection | None = None
    """When a measurement of equal values is a copy, which counts once. Default: if its time is equal too."""
    landmarks: dict[Text, Numbers] | None = None
    """Landmarks of a sensor whose model declares a `place`: their coordinates by id, {6: [1.9, -5.6], 7: [1.8, -2.4]}.
    Each becomes a sensor SENSOR_ID with parameters such as SENSOR_6_east; all share this section. Default: none."""
    use: Flag = True
    """false holds the sensor out: the estimate ignores it, and its measurements are predicted and scored. Default:
    true."""


class NormalSection(Section):
    """Baseline of one sensor row, recorded when this tuning was accepted; `nisus commission` writes it."""

    bias: Number = 0.0
    """Mean of its standardised innovations. Default: 0."""
    scale: Positive = 1.0
    """Their standard deviation. Default: 1."""
    correlation: Annotated[float, Field(strict=True, gt=-1, lt=1)] = 0.0
    """Their lag-1 correlation. Default: 0, white."""
    reached: dict[str, NotNegative] = {}
    """Highest value of each detector on the accepted data, nats: {narrow: 12.5}. Default: 0."""
    nis: NotNegative = 0.0
    """Largest mean NIS of recent measurements there, as a multiple of the value that `bias` and `scale` give. The
    estimate counts as diverged from 1.5 times this on, and not below ten. Default: 0."""
    forced: str = ""
    """Why its log contradicted the baseline, if it was accepted with `--force`. Default: it did not."""


class EstimatorSection(Section):
    """The filter that runs first; the page can swap it."""

    name: Text
    """Name in the catalogue: kf, ekf, ukf, ..."""
    options: dict[str, Option] = {}
    """The filter's own options by name, for example {alpha: 0.5} of the UKF; a choice by its word, {resampling:
    stratified}, or its number. Default: the catalogue's."""


class GateSection(Section):
    """Treatment of measurements far from their prediction."""

    probability: GateProbability
    """Probability with which a valid measurement passes, for example 0.9973; at least 0.5."""
    kind: Literal["hard", "soft"] = "hard"
    """hard: a measurement outside is rejected. soft: its noise is inflated until it lies on the gate, so that it moves
    the estimate less the further off it is; kf-steady and `adapt: R` accept no soft gate. Default: hard."""
    reopen: Duration | Literal["never"] = 30.0
    """Seconds after the first rejected measurement from which a sensor is accepted again if the other sensors cannot
    decide. If they can, a sensor that stays rejected is isolated, or the estimate was wrong and accepts it. never: it
    stays rejected. Default: 30."""

    @property
    def seconds(self) -> float | None:
        """`reopen` in seconds; None for never."""
        return None if self.reopen == "never" else float(self.reopen)


STALE_RATIO = 4.0
"""Ratio of `stale_after` to a `degraded_after` that is longer than its default, where the YAML gives neither."""


class TimeSection(Section):
    """Treatment of late and missing measurements."""

    max_delay: DurationOrZero = 2.0
    """Seconds by which a measurement may be late; later ones are counted as stale and dropped. Choose the largest
    expected latency. Default: 2."""
    degraded_after: Duration | None = None
    """Seconds without a used measurement after which health is degraded. Default: the slowest time constant
    of the model at the prior, but at least 3 s and three periods of the slowest sensor (simulated, or the longest that
    a recording keeps four times in succession), and at most stale_after if that is given; `nisus fold` prints where it
    comes from."""
    stale_after: Duration = 15.0
    """Seconds without a used measurement after which health is stale; not below degraded_after. Default: 15, or four
    times a degraded_after that follows from a longer period."""
    paused_after: Duration | None = None
    """Seconds without any event, measurement or input, after which the inputs of the pause count as unknown, as where a
    logger was off while the asset ran on: the states that inputs drive become as uncertain as at the start. A gap of
    up to three median periods of the recording is none. Default: never; the last inputs are held."""
    late: Literal["exact", "inflate", "auto"] = "auto"
    """Treatment of a late measurement within `max_delay`. exact: it is inserted at its time and the filter rewinds.
    inflate: it is used on arrival, with its variance inflated by the predicted change since; fast, approximate, and not
    for filters with a fixed R. auto: exact, unless one rewind may take longer than late_allowed by the estimate that
    `nisus fold` prints. Default: auto."""
    late_allowed: Duration = 0.25
    """Seconds that one rewind may take, for late: auto. Default: 0.25."""
    predict_every: Annotated[float, Field(strict=True, ge=0.01, le=MAX_DURATION_S), AS_SECONDS] = 0.5
    """Seconds without a measurement after which the estimate is predicted and shown. Default: 0.5."""

    @model_validator(mode="after")
    def _order(self) -> TimeSection:
        if self.degraded_after is not None and self.stale_after < self.degraded_after:
            text = f"is {self.stale_after} s; it must not be below degraded_after ({self.degraded_after} s)"
            raise refused("relation", text, "stale_after")
        return self

    def stale_from(self, degraded: float) -> float:
        """Return `stale_after`; by default at least `STALE_RATIO` times a `degraded_after` that is longer than it."""
        given = "stale_after" in self.model_fields_set or degraded <= self.stale_after
        return self.stale_after if given else STALE_RATIO * degraded


class MaintenanceSection(Section):
    """Maintenance: a change of the asset."""

    at: Time
    """Time of the change, in seconds of the source's clock."""
    what: Annotated[str, Field(min_length=1, max_length=200)]
    """Description of the change."""
    states: Annotated[tuple[Text, ...], Field(min_length=1)]
    """Affected states: their variance returns to that of the prior, and they keep their mean."""


class SceneSection(Section):
    """The three-dimensional scene."""

    kind: Literal["belief", "vehicle", "motor", "battery", "gripper"] = "belief"
    """belief: the estimate as a point with its 1- and 2-sigma ellipsoids, over `axes`; every twin has it. vehicle: a
    body on a plane. motor: one cut open, in the colours of its temperatures. battery: its cells. gripper: its fingers
    about a part."""
    axes: Annotated[tuple[Text, ...], Field(min_length=1, max_length=3)] | None = None
    """belief: the states along x, y and z at first. Default: the first three."""
    parts: dict[Literal["winding", "tooth", "yoke", "magnet"], Text] | None = None
    """motor: which state is the temperature of which part. Parts that are not here are grey."""
    charge: Annotated[tuple[Text, ...], Field(min_length=1, max_length=24)] | None = None
    """battery: the state of charge of each cell, from 0 to 1."""
    temperature: Annotated[tuple[Text, ...], Field(max_length=24)] = ()
    """battery: the temperature of each cell. Default: cells have no colour."""
    states: dict[Literal["surface", "depth", "contact"], Text] | None = None
    """gripper: which state is where the part begins, in mm, how far the finger is past that, and whether they touch."""
    position: tuple[Text, Text] | None = None
    """vehicle: the states of the position to the east and to the north."""
    heading: Text | None = None
    """vehicle: the state of the heading, in radians from east to the left. Default: the direction of travel."""
    walls: tuple[Annotated[tuple[tuple[float, float], ...], Field(min_length=2)], ...] = ()
    """vehicle: walls, as lines of points [east, north] in metres. Default: none."""
    size: tuple[Positive, Positive, Positive] = (4.4, 1.8, 1.45)
    """vehicle: its length, width and height in metres. Default: those of a car."""
    beams: dict[Text, Annotated[tuple[Number, ...], Field(min_length=1)]] = {}
    """vehicle: sensors that measure distances along beams, with the angle of each row's beam to the left of the
    heading, in radians. Default: none."""
    beacons: dict[Text, tuple[Text, Text]] = {}
    """vehicle: sensors that measure the distance to a beacon, with the parameters or states that hold its position east
    and north; * in them is the landmark of a sensor with landmarks. Default: none."""

    @model_validator(mode="after")
    def _complete(self) -> SceneSection:
        needed = {"vehicle": "position", "motor": "parts", "battery": "charge", "gripper": "states"}.get(self.kind)
        if needed is not None and not getattr(self, needed):
            raise refused("absent", f"is a {self.kind} and has no {needed}")
        if self.kind == "gripper" and len(self.states or ()) < 3:
            raise refused("absent", "is a gripper and has not all of surface, depth and contact")
        if self.temperature and len(self.temperature) != len(self.charge or ()):
            raise refused("absent", "has not as many temperatures as states of charge")
        return self


class GridAxis(Section):
    """Positions along one index of a field."""

    first: Number = 0.0
    """Position of cell 0. Default: 0."""
    step: Number
    """From one cell to the next, in the same unit; negative where positions fall."""
    unit: Text
    """m, for example; "° N" and "° E" for latitudes and longitudes, which are shown as ° S and ° W where negative."""


class ViewSection(Section):
    """Contents of the page."""

    labels: dict[Text, Text] = {}
    """Labels on the page by names of states, sensors and parameters, for example {v1: polarisation voltage}. That of a
    field is also its cells', that of v1 also of v1_1, v1_2 and so on. Default: the names."""
    grid: tuple[GridAxis, ...] | None = None
    """Positions of a field's cells, shown in place of their indices: {first, step, unit} for each index. Default: the
    indices."""

    pairs: tuple[tuple[Text, Text], ...] | None = None
    """Pairs of states whose joint covariance is drawn as an ellipse. Default: the first two states; of a large field
    none."""
    window: Duration = 60.0
    """Initial time span of the charts, s. Default: 60."""
    speed: Annotated[float, Field(strict=True, gt=0, le=1e9)] = 1.0
    """Speed of a simulation or of the replay of a recording, times real time. The page folds a recording to its end
    first; --speed overrides both. Default: 1."""
    cursor: DurationOrZero | None = None
    """Moment at which the cursor stands when the page has folded a recording, s after its start. Default: the end."""
    cells: Annotated[tuple[Text, ...], Field(min_length=1)] | None = None
    """Cells of a large field whose estimate is kept at every event and charted. Default: 16 spread over it."""
    picture: Duration | None = None
    """Seconds of the asset's time between two pictures of a large field. Default: a sixtieth of the window."""
    scene: SceneSection = SceneSection()
    """The three-dimensional scene. Default: the estimate over the first three states."""


def as_estimator(value: object) -> object:
    """Return a name as a filter without options."""
    return {"name": value} if isinstance(value, str) else value


def as_gate(value: object) -> object:
    """Return a number as a hard gate."""
    return value if value is None or isinstance(value, (dict, GateSection)) else {"probability": value}


AS_ESTIMATOR = BeforeValidator(as_estimator, json_schema_input_type=str | EstimatorSection)
Gate = Annotated[
    GateSection | None, BeforeValidator(as_gate, json_schema_input_type=GateProbability | GateSection | None)
]


class TwinSection(Section):
    """A twin: a model of an asset, the source of its measurements, and the estimator that combines them.

    Keys that begin with `x-` are ignored: a place for anchors that several sections share.
    """

    model_config = ConfigDict(json_schema_extra={"patternProperties": {"^x-": {}}})
    free_keys: ClassVar[str] = "x-"

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]*$")] | None = None
    """Short name: letters, digits, _ and -. Default: the file's name without its ending."""
    title: Text | None = None
    """One line shown at the top of the page. Default: the model's title."""
    teaches: Text | None = None
    """One sentence for the gallery about the content of the example. Default: none."""
    question: Text | None = None
    """The question that this twin answers, for the gallery. Default: none."""
    model: Model
    """The model's name in the catalogue (motor_winding), or a Python file beside this one and the name of a model, or
    of a function that returns one, in it (./pump.py:Pump). Or {matrices: file, states, inputs, sensors} for a linear
    model, {fmu: file, step, ...} for an FMU."""
    parameters: Parameters = {}
    """The model's parameters by name: their values, in their units, or {value, std, correlation, widen, role}. Default:
    the model's values, held."""
    correction: Text | None = None
    """File of a learned correction, beside this one, as `nisus learn` writes it: a correction of the model's rates,
    with a noise NAME_learned for each corrected state. Default: none, the model alone."""
    refit: RefitSection | None = None
    """Dual estimation: parameters that are fitted periodically on recent measurements while the twin runs: {entries,
    every, window, adopt}. Default: never."""
    prior: dict[str, PriorSection] = {}
    """Prior before the first measurement, by state, or for a whole field under its name. Default: the model's."""
    noise: dict[str, NoiseSection] = {}
    """Process noise Q by name: its strength and correlation time. Default: the model's, white."""
    sensors: dict[str, SensorSection] = {}
    """Sensor noise R, limits and use by sensor. Default: the model's."""
    inputs: dict[str, InstrumentSection] = {}
    """Offsets and scales of inputs: the model takes scale·u + offset, as in {current: {offset: {std: 0.02}}}. Default:
    none."""
    valid_range: dict[str, Validity] = {}
    """Range over which the model was fitted or validated, by state or input, in its unit, for example
    {temperature: [20, 38]}. Outside it, by more than `extrapolate`, health is suspect. A fitted
    tuning version has the range of its recordings. An end that is not given is the model's. Default: the model's."""
    possible: dict[str, Interval] = {}
    """Physical limits of a state or an estimated parameter, in its unit, for example {level: [0, 2.4]}. While
    the band of its estimate lies beyond, health is suspect; a forecast ends there. The prior's mean lies within, and so
    does some of the range in `valid_range`. An end that is not given is the model's. Default: the model's; kelvins and
    kilograms are at least 0, unless the prior's mean is within 2 standard deviations of it."""
    withhold: dict[str, Positive] = {}
    """Half-width of the 95 % band of a state beyond which its estimate is withheld, in its unit, for example
    {soc: 0.2}: page, API and files then show the reason in place of a value. Default: never."""
    watched: Annotated[tuple[Text, ...], Field(min_length=1)] | None = None
    """States that somebody acts on: one whose corrections over its memory are too large makes the twin suspect, any
    other only itself. Default: all but parameters and errors that are estimated."""
    estimator: Annotated[EstimatorSection, AS_ESTIMATOR] = EstimatorSection(name="ekf")
    """The filter that runs first: a name, or {name, options}. Default: ekf."""
    filters: dict[str, dict[str, Option]] = {}
    """Options of other filters, by name, used when one is selected or compared, for example
    {letkf: {radius: 4}}. Default: the catalogue's."""
    gate: Gate = None
    """Probability with which a valid measurement passes the gate, for example 0.9973; measurements outside are
    rejected. Or {probability, kind, reopen}. Default: null, no gate."""
    baseline: dict[str, NormalSection] = {}
    """Baseline by sensor row, recorded when this tuning was accepted; alarms report deviations from it. It stands here
    or, as `nisus commission` writes it, in NAME.baseline.yaml beside NAME.yaml. Default: innovations that are white and
    consistent with the filter's covariance."""
    time: TimeSection = TimeSection()
    """Treatment of late and missing measurements."""
    maintenance: tuple[MaintenanceSection, ...] = ()
    """Changes of the asset; each begins a new version of the model. Default: none."""
    history: Count = 200_000
    """Events that are kept, and folded again when the tuning changes; older ones are dropped. Default: 200,000."""
    source: SourceSection
    """Source of the measurements; its `type` is simulator, can, can_log, table, merged, push, mqtt, opcua or modbus."""
    faults: tuple[FaultSection, ...] = ()
    """Faults that are injected into the source: a list of {kind, sensor, input, start, end, size, rate, ...}. They act
    in this order, after those of a simulator. Default: none."""
    outputs: OutputsSection = OutputsSection()
    """Publication of the estimate, and receivers of alerts: {receivers, ...}. Default: the page only."""
    alerts: tuple[AlertSection, ...] = ()
    """Rules for alerts to the receivers, as in [{health: suspect}, {state: winding, above: 150, probability: 0.05}].
    Default: {health: suspect} if there are receivers."""
    view: ViewSection = ViewSection()
    """Contents of the page."""

    def sensor_period(self, name: str | None = None) -> float | None:
        """Return the seconds between two measurements of a simulated sensor, or the slowest; None for other sources."""
        asset = self.source if isinstance(self.source, AssetSection) else getattr(self.source, "asset", None)
        if asset is None:
            return None
        plans = asset.sensors.values() if name is None else [asset.sensors[name]] if name in asset.sensors else []
        return float(asset.step * max((plan.every for plan in plans), default=1))


TwinSection.model_rebuild()  # on import, as several threads may need it first


def json_schema() -> dict[str, object]:
    """Return the schema, with a description of every key."""
    schema = TwinSection.model_json_schema(mode="validation")
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        **schema,
        "title": "Nisus twin",
        "description": TwinSection.__doc__,
    }


def json_schema_text() -> str:
    """Return the schema as the text of a file."""
    return json.dumps(json_schema(), indent=2, ensure_ascii=False) + "\n"
