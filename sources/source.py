"""Interface of sources, and the channels that map their values to a model."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, replace
from math import isinf
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, TypeAlias, cast, runtime_checkable

if TYPE_CHECKING:
    import numpy as np

    from estimators.log import Events

Report = Callable[[str, str], None]
"""report(key, text): counted under `key`, `text` shown among the events; called from the source's thread."""

Numbers: TypeAlias = Mapping[str, Any]  # What a live source has read, as JSON keeps it over a restart
LOST_FRAMES = "frames lost"  # Key of frames that a bus's socket lost before they were read
NEVER = "never seen"  # Key of messages, signals and columns that channels need and the source never provides
WRONG_TIME = "wrong time"  # Key of events that are rejected for their time
UNDATED = "undated row"  # Key of rows of a table without a time
UNASSIGNED = "row of no sensor"  # Key of rows without a value in the column that names their source
NO_ASSET = "row of no asset"  # Key of rows and messages without the name of an asset, or with one that is not known
TRUNCATED = "truncated file"  # Key of incomplete files


class AssetEvents(NamedTuple):
    """Events of several assets: that of each event is `names[code]`, `code` of shape (N,)."""

    events: Events
    code: np.ndarray
    names: Sequence[str]


class Source(Protocol):
    """A source of events in their order of arrival.

    A `live` source, such as a bus, sets its own pace; any other returns its events when it is read.
    """

    live: bool

    def read(self, timeout: float) -> Events | None:
        """Return the next events; none after `timeout` seconds without one; None at the end."""

    def now(self) -> int | None:
        """Return the present time of the source, ns; None if it has no clock."""
        return None

    def close(self) -> None:
        """Close files and buses, if it has any."""
        return None


class Paced(Source, Protocol):
    """A source with controls of its time, from any thread while another reads."""

    speed: float
    paused: bool
    restarts: int
    """How often it began again by seeking back, which invalidates earlier events."""

    def pause(self) -> None:
        """Pause."""

    def resume(self) -> None:
        """Resume."""

    def set_speed(self, speed: float) -> None:
        """Continue at `speed` times real time."""

    def step(self) -> None:
        """Release the events of the next time at which there are any."""

    def seek(self, t: int) -> None:
        """Move to t, ns."""


@runtime_checkable
class Marked(Source, Protocol):
    """A live source that counts what it has read, and can continue there after a restart."""

    mark: int
    """Number of items that were read."""

    def numbers(self, mark: int) -> Numbers:
        """Return the state after `mark`, for `restore`; in one thread, with rising marks."""

    def restore(self, numbers: Numbers) -> None:
        """Continue with the `numbers` of the source before a restart, if any, and keep them from now on."""


@runtime_checkable
class Acknowledging(Marked, Protocol):
    """A source whose broker delivers each message again until it is acknowledged."""

    @property
    def unacknowledged(self) -> float:
        """Share of the messages without acknowledgement after which the broker sends no more, 0 to 1."""

    def acknowledge(self) -> None:
        """Acknowledge all that was read: it has been stored; in the thread that reads."""


class Recorded(Source):
    """What sources of recordings share: their events are those of a generator."""

    live = False
    _batches: Generator[Events, None, None]
    _timeout = 0.0

    def read(self, timeout: float) -> Events | None:
        """Return the next events; none if there are none within `timeout` seconds; None at the end."""
        self._timeout = timeout
        return next(self._batches, None)

    def close(self) -> None:
        """Close the open file."""
        self._batches.close()


def span_of(source: Source) -> tuple[int, int] | None:
    """Return first and last time of a source, ns; None if not known before it is read."""
    return getattr(source, "span", None)


def is_utc(source: Source) -> bool:
    """Return whether all times of a source, also of one behind faults, are of clocks that are set to UTC."""
    return getattr(getattr(source, "inner", source), "utc", False)


def is_endless(source: Source) -> bool:
    """Return whether a source has no end."""
    return getattr(source, "endless", False)


def controls_of(source: Source) -> Paced | None:
    """Return the controls of a source's time, also of one behind faults; None if it sets its own pace."""
    inner = getattr(source, "inner", source)
    # Asked for every batch; `isinstance` of a protocol would look up each of its names, which takes 20 µs.
    return cast(Paced, inner) if hasattr(inner, "set_speed") else None


@dataclass(frozen=True)
class Condition:
    """Another value of the same row or frame must lie in [low, high], or the measurement is missing.

    `signal` names it, or is a `TextMatch` of a table's column, which is 1 where the text is the wanted one.
    """

    signal: Any
    low: float
    high: float

    def __str__(self) -> str:
        if not isinstance(self.signal, str):
            return str(self.signal)
        if isinf(self.high):
            return f"{self.signal} of at least {self.low:g}"
        if isinf(self.low):
            return f"{self.signal} of at most {self.high:g}"
        return f"{self.signal} in {self.low:g} to {self.high:g}"


@dataclass(frozen=True)
class Accuracy:
    """Signals that report the noise of a sensor's measurements, one for each row.

    A signal holds a standard deviation, or a variance if `squared`, in its unit; it is converted to the row's unit (or
    the square of that) and multiplied by `scale`. One entry stands for all rows.
    """

    signals: tuple[str, ...]
    squared: bool = False
    units: tuple[str | None, ...] = (None,)
    scale: tuple[float, ...] = (1.0,)

    def spread(self, rows: int) -> Accuracy:
        """Return a copy with one entry for each row."""
        each = {name: getattr(self, name) for name in ("signals", "units", "scale")}
        return replace(self, **{name: item * rows for name, item in each.items() if len(item) == 1})


@dataclass(frozen=True)
class Channel:
    """Mapping of signals or columns to one sensor, input or true state.

    `kind` is READING, INPUT or TRUTH and `index` that of the sensor, input or state. `signals` are signals of the CAN
    `message`, of J1939 perhaps from one `source` address, or columns of a table, one for each row.
    A value is converted from its unit to the model's and becomes scale * value + offset. `units` None means the DBC's
    own unit, or the model's where that is empty too.
    The value is missing if a condition of `where` fails; the row or frame is ignored if one of `only` fails.
    With convert "east_north" the two signals are latitude and longitude in degrees and become metres east and north of
    `origin`, which is the first valid fix unless given. `accuracy` is reported with a sensor's measurements.
    `repeats` None uses every row; 0 those whose value differs from the one before; else also one every so many seconds.
    """

    kind: int
    index: int
    name: str
    signals: tuple[str, ...]
    message: str | None = None
    units: tuple[str | None, ...] = ()
    model_units: tuple[str, ...] = ()
    scale: tuple[float, ...] = ()
    offset: tuple[float, ...] = ()
    where: tuple[Condition, ...] = ()
    only: tuple[Condition, ...] = ()
    convert: str | None = None
    origin: tuple[float, float] | None = None
    accuracy: Accuracy | None = None
    repeats: float | None = None
    source: int | None = None

    def __post_init__(self) -> None:
        """Spread the defaults, and entries that are given once for all, over the rows."""
        count = len(self.signals)
        for field, default in (("units", None), ("model_units", ""), ("scale", 1.0), ("offset", 0.0)):
            value = tuple(getattr(self, field)) or (default,)
            value = value * count if len(value) == 1 else value
            if len(value) != count:
                raise ValueError(f"channel {self.name}: {field} has {len(value)} entries for {count} signals")
            object.__setattr__(self, field, value)
        if self.accuracy is not None:
            object.__setattr__(self, "accuracy", self.accuracy.spread(count))

    @property
    def measured(self) -> tuple[str, ...]:
        """The signals and those of the accuracy."""
        return (*self.signals, *(self.accuracy.signals if self.accuracy is not None else ()))

    @property
    def needed(self) -> tuple[Any, ...]:
        """The signals, those of the conditions and of the accuracy, each once."""
        return tuple(dict.fromkeys((*self.measured, *(item.signal for item in (*self.where, *self.only)))))


def ignore(key: str, text: str) -> None:
    """Ignore a report."""
