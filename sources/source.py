"""What a source is, and how a twin says what of it feeds the model."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol, runtime_checkable

if TYPE_CHECKING:
    from estimators.log import Events

Report = Callable[[str, str], None]
"""report(key, text): counted under `key`, `text` shown among the events; called from the source's thread."""

NEVER = "never seen"
"""Key of what a channel is mapped to and the source does not give."""

WRONG_TIME = "wrong time"
"""Key of events that are refused for their time."""

TRUNCATED = "truncated file"
"""Key of a file of which something is lost."""


class Source(Protocol):
    """Gives events in the order in which they arrived.

    `live` True is a bus, which sets its own pace and holds nothing back; False gives its events when it is asked.
    """

    live: bool

    def read(self, timeout: float) -> Events | None:
        """The next events; none after `timeout` seconds without one; None at the end."""

    def now(self) -> int | None:
        """The source's present time, ns; None if it has none."""

    def close(self) -> None:
        """Let go of files and buses."""


@runtime_checkable
class Spanned(Protocol):
    """A source that may know from when to when it lasts before it is read."""

    @property
    def span(self) -> tuple[int, int] | None:
        """First and last time, ns; None if it does not tell."""


@runtime_checkable
class Endless(Protocol):
    """A source that may have no end of its own."""

    @property
    def endless(self) -> bool:
        """Whether it has none."""


@runtime_checkable
class Paced(Source, Spanned, Protocol):
    """A source whose time can be held, hurried and sought; from any thread, while another reads."""

    speed: float
    paused: bool
    restarts: int
    """How often it was begun again, by seeking back: what was read before no longer holds."""

    def pause(self) -> None:
        """Hold its time."""

    def resume(self) -> None:
        """Let it go on."""

    def set_speed(self, speed: float) -> None:
        """Go on at `speed` times real time."""

    def step(self) -> None:
        """Release the events of the next time at which there are any."""

    def seek(self, t: int) -> None:
        """Move to t, ns."""


def span_of(source: Source) -> tuple[int, int] | None:
    """First and last time of a source, ns; None if it does not tell."""
    return source.span if isinstance(source, Spanned) else None


@dataclass(frozen=True)
class Condition:
    """A value that came along must lie in [low, high], or the reading is missing."""

    signal: str
    low: float
    high: float


@dataclass(frozen=True)
class Accuracy:
    """Where the variances of a sensor's readings come from, if these tell them: a signal for each row.

    A signal holds a standard deviation, or a variance if `squared`, in its unit; it is converted to the row's unit (or
    the square of that) and multiplied by `scale`. One entry stands for all rows.
    """

    signals: tuple[str, ...]
    squared: bool = False
    units: tuple[str | None, ...] = (None,)
    scale: tuple[float, ...] = (1.0,)

    def spread(self, rows: int) -> Accuracy:
        """With one entry for each of the rows."""
        each = {name: getattr(self, name) for name in ("signals", "units", "scale")}
        return replace(self, **{name: item * rows for name, item in each.items() if len(item) == 1})


@dataclass(frozen=True)
class Channel:
    """Where the values of one sensor, input or true state come from.

    `kind` is READING, INPUT or TRUTH and `index` that of the sensor, input or state. `signals` are signals of the CAN
    `message`, or columns of a table, one for each row. A value is converted from its unit to the model's and becomes
    scale * value + offset. `units` None means the DBC's own unit, or the model's where that is empty too.
    Where a condition of `where` fails the value is missing; where one of `only` fails, nothing was said of the channel.
    With convert "east_north" the two signals are latitude and longitude in degrees and become metres east and north of
    `origin`, which is the first valid fix unless given. `accuracy` is that of a sensor's readings, where they tell it.
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

    def __post_init__(self) -> None:
        """Spread the defaults over the rows."""
        count = len(self.signals)
        for field, default in (("units", None), ("model_units", ""), ("scale", 1.0), ("offset", 0.0)):
            value = tuple(getattr(self, field)) or (default,) * count
            if len(value) != count:
                raise ValueError(f"channel {self.name}: {field} has {len(value)} entries for {count} signals")
            object.__setattr__(self, field, value)
        if self.accuracy is not None:
            object.__setattr__(self, "accuracy", self.accuracy.spread(count))

    @property
    def needed(self) -> tuple[str, ...]:
        """The signals, those of the conditions and of the accuracy, each once."""
        own = self.accuracy.signals if self.accuracy is not None else ()
        return tuple(dict.fromkeys((*self.signals, *(item.signal for item in (*self.where, *self.only)), *own)))


def ignore(key: str, text: str) -> None:
    """A report that nobody wants."""
