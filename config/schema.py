"""The schema of a twin's YAML.

The docstring under each field is its documentation in the JSON Schema that `nisus schema` writes for editors.
"""

from __future__ import annotations

import json
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, model_validator
from pydantic_core import PydanticCustomError

from .fields import (
    LONGEST,
    Count,
    Duration,
    ErrorSection,
    Flag,
    NoiseSection,
    NotNegative,
    Number,
    Option,
    Positive,
    Positives,
    Seconds,
    Section,
    SomeSeconds,
    SpreadSection,
    Text,
    Texts,
    Time,
)
from .limits_schema import DuplicatesSection, Ranges, StuckSection, Validity
from .source_schema import FaultSection, SourceSection

GateProbability = Annotated[float, Field(strict=True, ge=0.5, lt=1)]


class PriorSection(Section):
    """What is believed of one state before the first reading."""

    mean: Number | None = None
    """Expected value, in the state's unit. Default: the model's."""
    std: NotNegative | None = None
    """Standard deviation of that belief, in the state's unit. 0 is a state that is known for certain, which kf, ekf,
    iekf and the square-root filters take; not of a field. Default: the model's."""


class UnknownSection(Section):
    """A parameter of the model that is estimated with the state."""

    std: Positive
    """Standard deviation of what is believed of it at the start, about its value, in its unit."""
    drift: NotNegative = 0.0
    """What one second adds to it: standard deviation of a random walk. Default: 0, an unknown constant."""


class RefitSection(Section):
    """Dual estimation: beside the filter of the state, a slow fit of parameters on windows of what was read.

    In joint estimation (`estimate`) one filter moves both.
    """

    entries: Texts
    """What is fitted: parameters (p.r0), noises (Q.winding, R.voltage), options of the estimator (options.alpha), or
    groups of them (p, Q, R, options)."""
    every: Duration
    """Time between two fits, of the asset's clock: 600, or 10 min."""
    window: Duration
    """Over how long the last readings are fitted: 1800, or 30 min. The first fit waits until so much was read."""
    adopt: Literal["by hand", "if better"] = "by hand"
    """What becomes of a result that predicts better what it was not fitted to, and has moved beyond its interval. by
    hand: it is proposed on the page, and waits. if better: it is adopted, and said. What is adopted is a tuning version
    with its evidence. Default: by hand."""


class SensorSection(SpreadSection):
    """The noise of one sensor as the estimator assumes it, what it can say, and whether the estimate uses it."""

    error: ErrorSection | None = None
    """An error that lasts, beside the white noise: {std: 3, over: 5 min}. A state is appended for each row,
    SENSOR_error (SENSOR_ROW_error of several rows), and the parameter SENSOR_error_time. Default: none."""
    correlation: tuple[tuple[Number, ...], ...] | None = None
    """Correlation of the noise of its rows, for example [[1, 0.5], [0.5, 1]], with R_ij = correlation_ij √(R_ii R_jj):
    it stays while the variances are tuned. Particle and ensemble filters take independent rows, [[1, 0], [0, 1]].
    Default: the model's."""
    range: Ranges | None = None
    """Least and greatest value that can be, in the sensor's unit, for example [-40, 180], null for none; a list of
    pairs gives one a row. What lies outside is kept in the log and not used. Default: every value can be."""
    saturation: Ranges | None = None
    """The values at which its converter clips: a reading at one of them or beyond is not used. As `range`. Default:
    none."""
    rate: Positives | None = None
    """Greatest change in a second, in the sensor's unit, against the last reading that kept all limits; noise may add
    8 standard deviations. A list gives one a row. Default: any change can be."""
    stuck: StuckSection | None = None
    """When readings that repeat themselves are not used any more. Default: never."""
    duplicates: DuplicatesSection | None = None
    """When a reading of the same values is the same reading, which counts once. Default: when it is of the same
    time."""
    use: Flag = True
    """false holds the sensor out: the estimate ignores it, and its prediction of it is scored. Default: true."""


class NormalSection(Section):
    """What was normal of one sensor row when this tuning was accepted; `nisus commission` writes it."""

    bias: Number = 0.0
    """Mean of its standardised innovations. Default: 0."""
    scale: Positive = 1.0
    """Their standard deviation. Default: 1."""
    correlation: Annotated[float, Field(strict=True, gt=-1, lt=1)] = 0.0
    """Their lag-1 correlation. Default: 0, white."""
    reached: dict[str, NotNegative] = {}
    """How high the tests of each cause rose on the accepted data, nats: {narrow: 12.5}. Default: 0."""
    nis: NotNegative = 0.0
    """The most that the mean NIS of the last readings was there at a reading of its sensor, as a multiple of what bias
    and scale make of it; the estimate is lost from half as much again on, and at least at ten. Default: 0."""


class EstimatorSection(Section):
    """The filter that runs first; the page swaps it."""

    name: Text
    """Name in the catalogue: kf, ekf, ukf, ..."""
    options: dict[str, Option] = {}
    """The filter's own options by name, for example {alpha: 0.5} of the UKF; a choice by its word, {resampling:
    stratified}, or its number. Default: the catalogue's."""


class GateSection(Section):
    """What becomes of readings far from their prediction."""

    probability: GateProbability
    """Probability with which a good reading passes, for example 0.9973; at least 0.5."""
    kind: Literal["hard", "soft"] = "hard"
    """hard: a reading outside is refused. soft: it counts, with its noise inflated until it lies on the gate, so that
    the further off it is the less it moves the estimate; kf-steady and `adapt: R` take no soft one."""
    reopen: Seconds | Literal["never"] = 30.0
    """A sensor that stays refused is judged by what the other sensors say: it is isolated, or the twin was wrong and
    lets it in. Where nothing tells, the asset is believed so many seconds after the first refused reading. never: a
    sensor that is refused stays refused. Default: 30."""

    @property
    def seconds(self) -> float | None:
        """`reopen` in seconds; None for never."""
        return None if self.reopen == "never" else float(self.reopen)


class TimeSection(Section):
    """How the twin treats lateness and silence."""

    horizon: SomeSeconds = 2.0
    """Seconds: a reading later than this is counted as stale and dropped. Size it by the worst credible latency."""
    degraded_after: Seconds | None = None
    """Seconds without a used reading after which the twin says that it is degraded. Default: the slowest time constant
    of the model at the prior, but at least 3 s and three periods of the slowest simulated sensor, and at most
    stale_after; `nisus fold` prints where it comes from."""
    stale_after: Seconds = 15.0
    """Seconds without a used reading after which the twin says that it is stale. Above degraded_after."""
    late: Literal["exact", "inflate", "auto"] = "auto"
    """What becomes of a reading that comes late, within the horizon. exact: it is put where it was measured and the
    filter goes back; nothing is lost. inflate: it is used when it comes, with a variance larger by what the model says
    that the reading has moved since; cheap, not exact, and not for filters with a fixed R. auto: exact, unless going
    back once may take longer than late_allowed, by an arithmetic that `nisus fold` prints. Default: auto."""
    late_allowed: Seconds = 0.25
    """Seconds that going back for one late reading may take, for late: auto. Default: 0.25."""
    tick: Annotated[float, Field(strict=True, ge=0.01, le=LONGEST)] = 0.5
    """Seconds of silence after which the estimate is predicted and shown without a reading."""

    @model_validator(mode="after")
    def _order(self) -> TimeSection:
        if self.degraded_after is not None and self.stale_after < self.degraded_after:
            raise PydanticCustomError(
                "order",
                "is {value} s; it must not be below degraded_after ({other} s)",
                {"value": self.stale_after, "other": self.degraded_after, "key": "stale_after"},
            )
        return self


class MaintenanceSection(Section):
    """Something of the asset that was changed."""

    at: Time
    """When, in seconds of the source's time."""
    what: Annotated[str, Field(min_length=1, max_length=200)]
    """What was changed, for people."""
    states: Annotated[tuple[Text, ...], Field(min_length=1)]
    """The states that it concerns: they are as uncertain as at the start again, and keep their mean."""


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
    """vehicle: what it moves among, as lines of points [east, north] in metres. Default: nothing."""
    size: tuple[Positive, Positive, Positive] = (4.4, 1.8, 1.45)
    """vehicle: its length, width and height in metres. Default: those of a car."""
    beams: dict[Text, Annotated[tuple[Number, ...], Field(min_length=1)]] = {}
    """vehicle: sensors that tell distances along beams, with the angle of each row's beam to the left of the heading,
    in radians. Default: none."""
    beacons: dict[Text, tuple[Text, Text]] = {}
    """vehicle: sensors that tell the distance to a beacon, with the parameters, or states, that say where it stands to
    the east and to the north. Default: none."""

    @model_validator(mode="after")
    def _complete(self) -> SceneSection:
        needed = {"vehicle": "position", "motor": "parts", "battery": "charge", "gripper": "states"}.get(self.kind)
        if needed is not None and not getattr(self, needed):
            raise PydanticCustomError("neither", "is a {kind} and has no {keys}", {"kind": self.kind, "keys": needed})
        if self.kind == "gripper" and len(self.states or ()) < 3:
            raise PydanticCustomError("neither", "is a gripper and has not all of surface, depth and contact", {})
        if self.temperature and len(self.temperature) != len(self.charge or ()):
            raise PydanticCustomError("neither", "has not as many temperatures as states of charge", {})
        return self


class ViewSection(Section):
    """What the page draws."""

    pairs: tuple[tuple[Text, Text], ...] | None = None
    """Pairs of states whose joint covariance is drawn as an ellipse. Default: the first two states; of a large field
    none."""
    window: Seconds = 60.0
    """Seconds that the charts show at first."""
    speed: Annotated[float, Field(strict=True, gt=0, le=1e9)] = 1.0
    """How many times real time a replay or a simulation runs at first; --speed says otherwise."""
    cells: Annotated[tuple[Text, ...], Field(min_length=1)] | None = None
    """Cells of a large field whose estimate is kept at every event and charted. Default: 16 spread over it."""
    picture: Seconds | None = None
    """Seconds of the asset's time between two pictures of a large field. Default: a sixtieth of the window."""
    scene: SceneSection = SceneSection()
    """The three-dimensional scene. Default: the belief over the first three states."""


def as_estimator(value: Any) -> Any:
    """A name stands for a filter without options."""
    return {"name": value} if isinstance(value, str) else value


def as_gate(value: Any) -> Any:
    """A number stands for a hard gate."""
    return value if value is None or isinstance(value, (dict, GateSection)) else {"probability": value}


class TwinSection(Section):
    """A twin: a model of an asset, the source of its readings, and the estimator that joins them."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]*$")] | None = None
    """Short name: letters, digits, _ and -. Default: the file's name without its ending."""
    title: Text | None = None
    """One line shown at the top of the page. Default: the model's title."""
    teaches: Text | None = None
    """One sentence for the gallery: what there is to see and to learn. Default: nothing."""
    question: Text | None = None
    """The question to which this twin is an answer, for the gallery. Default: none."""
    model: Text
    """The model's name in the catalogue (motor_winding), or a Python file beside this one and the name of a model, or
    of a function that returns one, in it (./pump.py:Pump)."""
    parameters: dict[str, Number] = {}
    """The model's parameters by name, in their units. Default: the model's values."""
    learned: Text | None = None
    """A file beside this one that corrects what the model says, as `nisus learn` writes it: what was learned from
    recordings, with a noise NAME_learned for each state that it corrects. Default: none, the model alone."""
    estimate: dict[str, UnknownSection] = {}
    """Parameters that are moved into the state and estimated with it, by name: {std, drift}. They become the last
    states, which may be named wherever a state may. Default: none."""
    refit: RefitSection | None = None
    """Parameters that are fitted again now and then, beside the running twin, on its last readings: {entries, every,
    window, adopt}. Default: never."""
    prior: dict[str, PriorSection] = {}
    """The belief before the first reading, by state, or of a whole field under its name. Default: the model's."""
    noise: dict[str, NoiseSection] = {}
    """Process noise Q by name: how much the model is distrusted, and for how long an error of it lasts. Default: the
    model's, white."""
    sensors: dict[str, SensorSection] = {}
    """Sensor noise R by sensor: how much each is distrusted. Default: the model's."""
    valid: dict[str, Validity] = {}
    """Range over which the model was fitted or checked, by state or input, in its unit, for example
    {temperature: {min: 20, max: 38}}. Outside it the twin is suspect. Default: the model's."""
    estimator: Annotated[
        EstimatorSection, BeforeValidator(as_estimator, json_schema_input_type=str | EstimatorSection)
    ] = EstimatorSection(name="ekf")
    """The filter that runs first: a name, or {name, options}. Default: ekf."""
    filters: dict[str, dict[str, Option]] = {}
    """Options of other filters, by name, for when one is chosen on the page or compared, for example
    {letkf: {radius: 4}}. Default: the catalogue's."""
    gate: Annotated[
        GateSection | None, BeforeValidator(as_gate, json_schema_input_type=GateProbability | GateSection | None)
    ] = None
    """Probability with which a good reading passes the gate, for example 0.9973; readings outside are not used. Or
    {probability, kind, reopen}. Default: null, no gate."""
    commissioned: dict[str, NormalSection] = {}
    """What was normal when this tuning was accepted, by sensor row: alarms are about what has changed since. Default:
    innovations that are white and as large as the filter says."""
    time: TimeSection = TimeSection()
    """How the twin treats lateness and silence."""
    maintenance: tuple[MaintenanceSection, ...] = ()
    """When something of the asset was changed: each begins a new version of the model. Default: never."""
    history: Count = 200_000
    """Events that are kept, and folded again when the tuning changes; the oldest are forgotten."""
    source: SourceSection
    """Where the readings come from; its `type` is simulator, can, can_log, table or merged."""
    faults: tuple[FaultSection, ...] = ()
    """Faults that are put into what the source says: a list of {kind, sensor, input, start, end, size, rate, ...}. They
    act in their order, after those of a simulator. Default: none."""
    view: ViewSection = ViewSection()
    """What the page draws."""


def json_schema() -> dict[str, Any]:
    """The schema, with a description of every key."""
    schema = TwinSection.model_json_schema(mode="validation")
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        **schema,
        "title": "Nisus twin",
        "description": "A twin: a model of an asset, the source of its readings, and the estimator that joins them.",
    }


def json_schema_text() -> str:
    """The schema as the text of a file."""
    return json.dumps(json_schema(), indent=2, ensure_ascii=False) + "\n"
