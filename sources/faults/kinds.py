"""The catalogue of faults: effect, parameters and targets of each kind; and the checks of a fault."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import inf, isfinite
from typing import Protocol, runtime_checkable

from estimators.errors import LARGEST, nearest, quoted
from estimators.model.state_space import StateSpaceModel

MAX_DELAY_S = 1e6  # Seconds by which a fault may delay an event, eleven days


@dataclass(frozen=True)
class FaultParameter:
    """A number of a kind of fault; required without a default. `holds` checks it, `rule` describes the check.

    In `unit`, "row" stands for the unit of the sensor's row or of the input.
    """

    name: str
    unit: str
    help: str
    default: float | None
    holds: Callable[[float], bool]
    rule: str


@dataclass(frozen=True)
class FaultKind:
    """One kind of fault; `code` stands for it in the log's stamps, so it never changes.

    `of` are its possible targets: sensor, input, parameter, or twin (the whole). `rows`: it may affect a single row.
    """

    name: str
    code: int
    help: str
    of: tuple[str, ...]
    parameters: tuple[FaultParameter, ...] = ()
    rows: bool = False
    other: bool = False


def _size(unit: str, text: str) -> FaultParameter:
    return FaultParameter("size", unit, text, None, lambda x: abs(x) <= LARGEST, f"must lie within {LARGEST:g}")


def _positive(unit: str, text: str) -> FaultParameter:
    return FaultParameter(
        "size", unit, text, None, lambda x: 0.0 < x <= LARGEST, f"must be positive, and {LARGEST:g} at most"
    )


def _seconds(name: str, text: str, default: float | None = None) -> FaultParameter:
    def holds(x: float) -> bool:
        return (0.0 < x if default is None else 0.0 <= x) and x <= MAX_DELAY_S

    low = "positive" if default is None else "zero or positive"
    return FaultParameter(name, "s", text, default, holds, f"must be {low}, and {MAX_DELAY_S:g} s at most")


def _rate(text: str, default: float | None = 1.0) -> FaultParameter:
    return FaultParameter(
        "rate", "1", text, default, lambda x: 0.0 < x <= 1.0, "is a probability, above 0 and 1 at most"
    )


VALUE = ("sensor", "input")
ANY = ("sensor", "input", "twin")

_LIST = (
    FaultKind("bias", 1, "size is added to the value", VALUE, (_size("row", "offset"),), rows=True),
    FaultKind("drift", 2, "size is added for every second since the start", VALUE,
         (_size("row/s", "change a second"),), rows=True),
    FaultKind("scale", 3, "the value is multiplied by size", VALUE, (_size("1", "the factor"),), rows=True),
    FaultKind("stuck", 4, "the last value before the start is repeated", ("sensor", "input", "twin"), rows=True),
    FaultKind("spike", 5, "with probability rate a draw of that standard deviation is added", VALUE,
         (_positive("row", "standard deviation of a spike"), _rate("probability for each measurement", None)),
         rows=True),
    FaultKind("noise", 6, "a draw of that standard deviation is added to each measurement", VALUE,
         (_positive("row", "standard deviation of the added noise"),), rows=True),
    FaultKind("quantisation", 7, "values are rounded to multiples of size", VALUE,
         (FaultParameter("size", "row", "the step", None, lambda x: 1e-9 <= x <= LARGEST,
                    f"must be 1e-9 or more, and {LARGEST:g} at most"),),
         rows=True),
    FaultKind("dropout", 8, "with probability rate a measurement arrives empty", ANY,
         (_rate("probability for each measurement"),)),
    FaultKind("silence", 9, "nothing arrives; an input keeps its last value", ANY),
    FaultKind("delay", 10, "events arrive later by size", ANY, (_seconds("size", "the delay"),)),
    FaultKind("jitter", 11, "events arrive later by a draw of an exponential distribution", ANY,
         (_seconds("size", "mean of the delays"),)),
    FaultKind("bursts", 12, "events are held back, and arrive together every so many seconds", ANY,
         (_seconds("every", "seconds between two arrivals"),)),
    FaultKind("reorder", 13, "with probability rate a measurement arrives after the next one of its kind", ANY,
         (_rate("probability for each measurement"),)),
    FaultKind("duplicate", 14, "with probability rate a measurement is repeated", ANY,
         (_rate("probability for each measurement"),
          _seconds("every", "seconds between repetitions, by stamp and arrival; 0 repeats the stamp", 0.0),
          FaultParameter("count", "1", "repetitions of a measurement", 1.0,
                    lambda x: 1.0 <= x <= 1000.0 and x == round(x), "must be a whole number from 1 to 1000"))),
    FaultKind("clock_jump", 15, "the clock of the stamps is ahead by size", ANY,
         (FaultParameter("size", "s", "how far ahead; negative is behind", None, lambda x: abs(x) <= 1e9,
                    "must lie within 1e9 s"),)),
    FaultKind("clock_drift", 16, "the clock of the stamps gains size seconds a second", ANY,
         (FaultParameter("size", "s/s", "gain; negative loses", None, lambda x: abs(x) < 1.0,
                    "must lie between -1 and 1"),)),
    FaultKind("swap", 17, "the measurements of sensor and other are exchanged", ("sensor",),
         other=True),
    FaultKind("model", 18, "a true parameter of the simulated asset is multiplied by size", ("parameter",),
         (_size("1", "the factor"),)),
)  # fmt: skip

KINDS = {kind.name: kind for kind in _LIST}  # By name
OLD_NAMES = {"outliers": "spike"}  # Former names of kinds


def find_kind(name: str) -> FaultKind:
    """Return the kind of a current or former name."""
    return KINDS[OLD_NAMES.get(name, name)]


def problem(fault: Fault, model: StateSpaceModel) -> tuple[str, str] | None:
    """Return what is wrong with a fault: its field (empty for the fault itself) and a text; None if nothing is."""
    if OLD_NAMES.get(fault.kind, fault.kind) not in KINDS:
        return "kind", f"is {quoted(fault.kind)}; {nearest(fault.kind, list(KINDS))}"
    kind = find_kind(fault.kind)
    return _of_target(fault, kind, model) or _of_numbers(fault, kind)


def _of_target(fault: Fault, kind: FaultKind, model: StateSpaceModel) -> tuple[str, str] | None:
    known = {
        "sensor": list(model.sensor_names),
        "input": list(model.input_names),
        "parameter": [item.name for item in model.parameters],
    }
    given = [what for what in known if getattr(fault, what) is not None]
    if len(given) > 1:
        return given[1], f"is given beside {given[0]}; a fault is of one of them"
    what = given[0] if given else "twin"
    if what not in kind.of:
        if given:
            return what, f"is not used by a fault of kind {fault.kind}; leave it out"
        return "", f"has no {' or '.join(kind.of)}; a fault of kind {fault.kind} needs one"
    for field, names, word in ((what, known.get(what, []), what), ("other", known["sensor"], "sensor")):
        name = getattr(fault, field, None)
        if name is not None and name not in names:
            return field, f"is {quoted(name)}, no {word} of {model.name}; {nearest(name, names)}"
    if (fault.other is not None) != kind.other:
        if kind.other:
            return "other", f"is missing; a fault of kind {fault.kind} needs it"
        return "other", f"is not used by a fault of kind {fault.kind}; leave it out"
    rows = {sensor.name: [row.name for row in sensor.rows] for sensor in model.sensors}
    if kind.other:
        ours, theirs = len(rows[str(fault.sensor)]), len(rows[str(fault.other)])
        if fault.other == fault.sensor or ours != theirs:
            return (
                "other",
                f"is {fault.other!r}; it must be another sensor than {fault.sensor}, with {ours} row(s)",
            )
    if fault.row is not None:
        if not kind.rows or fault.sensor is None:
            return "row", f"is not used by a fault of kind {fault.kind}; leave it out"
        if fault.row not in rows[fault.sensor]:
            near = nearest(fault.row, rows[fault.sensor])
            return "row", f"is {quoted(fault.row)}, no row of {fault.sensor}; {near}"
    return None


def _of_numbers(fault: Fault, kind: FaultKind) -> tuple[str, str] | None:
    if not (isfinite(fault.start) and 0.0 <= fault.start <= LARGEST):
        return "start", f"is {fault.start:g} s; it must be zero or positive, and {LARGEST:g} s at most"
    if not fault.start < fault.end or not (fault.end <= LARGEST or fault.end == inf):
        return "end", f"is {fault.end:g} s; it must be above start ({fault.start:g} s), and {LARGEST:g} s at most"
    takes = {item.name: item for item in kind.parameters}
    for name in ("size", "rate", "every", "count"):
        value = getattr(fault, name)
        if name not in takes:
            if value is not None:
                return name, f"is not used by a fault of kind {fault.kind}; leave it out"
        elif value is None:
            if takes[name].default is None:
                return name, f"is missing; a fault of kind {fault.kind} needs it"
        elif not (isfinite(value) and takes[name].holds(value)):
            return name, f"is {value:g}; it {takes[name].rule}"
    return None


def numbers(fault: Fault) -> dict[str, float]:
    """Return the numbers of a fault by name, with defaults."""
    given = [(item, getattr(fault, item.name)) for item in find_kind(fault.kind).parameters]
    return {item.name: float(value if value is not None else item.default or 0.0) for item, value in given}


NEVER_NS = 2**62  # Time after any event, ns


@dataclass
class Change:
    """A true parameter that is multiplied by `factor` from `start` until `end`, ns of the asset's own time."""

    parameter: str
    factor: float
    start: int
    end: int


@runtime_checkable
class Changeable(Protocol):
    """A simulated asset whose true parameters can be changed while it runs; from any thread.

    `live` is False if its time is that of its events.
    """

    live: bool

    def change(self, parameter: str, factor: float, start: int | None = None, length: int | None = None) -> Change:
        """Multiply a parameter for `length` ns, or for ever, from `start` on (ns), or with the next step.

        Raises:
            SourceError: If there is no such parameter.
        """

    def end(self, change: Change) -> None:
        """End a change with the next step."""


@dataclass(frozen=True)
class Fault:
    """One fault, from `start` until `end`, in seconds after the source's first event (or after it was injected).

    It affects a `sensor` (a `row` of it, or all), an `input` or, of kind model, a true `parameter` of a simulated
    asset; none of them means the whole source. `KINDS` defines the numbers and their units; None is the kind's default.
    Draws are a function of `seed`, by default (seed of the layer, number of the fault), and of the events alone.
    """

    kind: str
    sensor: str | None = None
    input: str | None = None
    parameter: str | None = None
    row: str | None = None
    other: str | None = None
    start: float = 0.0
    end: float = inf
    size: float | None = None
    rate: float | None = None
    every: float | None = None
    count: int | None = None
    seed: int | None = None

    @property
    def target(self) -> str:
        """The affected target, in words."""
        name = self.sensor or self.input or self.parameter or "the whole twin"
        return f"{name}.{self.row}" if self.row is not None else name
