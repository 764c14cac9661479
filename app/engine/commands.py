"""Commands of users to a running twin.

A page, an API call or a test passes one to `engine.submit`, from any thread. The engine carries them out in order,
between two events, so nothing else ever changes the estimate.

Edits that have the same `gesture`, a text that the sender chooses, are one run and one undo: the values of one drag.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class SetEstimator:
    """Fold the history with another estimator of the catalogue and go on with it.

    `options` are added to its last ones.
    """

    name: str
    options: Mapping[str, float] | None = None
    gesture: str = ""


@dataclass(frozen=True)
class SetTuning:
    """Set one entry of the tuning: `Q.<noise>`, `R.<row>`, `p.<parameter>`, `use.<sensor>`, or one of the gate.

    These are `gate` (None: no gate), `gate.kind` (hard or soft) and `gate.reopen` (None: never).
    """

    key: str
    value: float | bool | str | None
    gesture: str = ""


@dataclass(frozen=True)
class SetTunings:
    """Set several entries of the tuning at once, by key: Q, R, parameters, and `options.<name>` of the estimator.

    One refold, one revision.
    """

    values: Mapping[str, float]
    gesture: str = ""


@dataclass(frozen=True)
class SetOption:
    """Set one option of the running estimator."""

    name: str
    value: float | bool | str
    gesture: str = ""


@dataclass(frozen=True)
class UseSensor:
    """Use a sensor's measurements or hold them out: predicted and scored, never used."""

    name: str
    used: bool


@dataclass(frozen=True)
class Restore:
    """Return to the first estimator and tuning of the session: as recorded in a review, else as configured."""


@dataclass(frozen=True)
class Undo:
    """Take the last edit back, whoever made it."""


@dataclass(frozen=True)
class Redo:
    """Make the edit again that was taken back last."""


@dataclass(frozen=True)
class Load:
    """Return to the estimator and tuning of an earlier run."""

    number: int


@dataclass(frozen=True)
class Pin:
    """Keep a run on the charts for comparison; four at most."""

    number: int


@dataclass(frozen=True)
class Unpin:
    """Take a pinned run off the charts."""

    number: int


@dataclass(frozen=True)
class Note:
    """Set name and note of a run; empty ones remove them."""

    number: int
    name: str = ""
    note: str = ""


@dataclass(frozen=True)
class Annotate:
    """Write a note at a moment, or change the one of that `number`.

    `at` is in seconds of the log, as `start` of an episode; None is the newest measurement, or where the note is.
    """

    text: str
    at: float | None = None
    number: int | None = None


@dataclass(frozen=True)
class DeleteAnnotation:
    """Delete the note of that number."""

    number: int


@dataclass(frozen=True)
class Reset:
    """Reset the estimate to the model's prior at the present time."""


@dataclass(frozen=True)
class Maintenance:
    """Record a change of the asset, described by `what`; the named states start again.

    Their covariance becomes that of the prior, their mean stays, and a new version of the model begins.
    """

    what: str
    states: tuple[str, ...]


@dataclass(frozen=True)
class Pause:
    """Pause a replay or a simulation, or continue it."""

    paused: bool


@dataclass(frozen=True)
class Speed:
    """Play at `factor` times real time; infinity is as fast as possible."""

    factor: float


@dataclass(frozen=True)
class Step:
    """Play the next event while paused."""


@dataclass(frozen=True)
class Seek:
    """Go to a time of a recording, in seconds after its first event."""

    seconds: float


@dataclass(frozen=True)
class Record:
    """Record into a new file at `path`, or stop with None."""

    path: Path | None


@dataclass(frozen=True)
class InjectFault:
    """Inject a fault into the source from now on; kinds and their numbers are those of sources/faults/kinds.py.

    `target` is a sensor, an input or a true parameter of a simulated asset; None is the whole source. `row` is one of a
    sensor, `other` the sensor for a swap. The fault ends after `duration` seconds, or by `ClearFault`.
    """

    kind: str
    target: str | None = None
    size: float | None = None
    rate: float | None = None
    every: float | None = None
    count: int | None = None
    row: str | None = None
    other: str | None = None
    duration: float | None = None


@dataclass(frozen=True)
class ClearFault:
    """End the fault of that number, or all faults with None."""

    number: int | None = None


@dataclass(frozen=True)
class MuteAlerts:
    """Send no alerts for so many seconds, for example during maintenance; 0 ends it."""

    seconds: float
    reason: str = ""


Command = (
    SetEstimator | SetTuning | SetTunings | SetOption | UseSensor | Restore | Undo | Redo | Load | Pin | Unpin
    | Note | Annotate | DeleteAnnotation | Reset | Maintenance | Pause | Speed | Step | Seek | Record | InjectFault
    | ClearFault | MuteAlerts
)  # fmt: skip
"""A command."""
