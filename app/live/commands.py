"""What a user can ask of a running twin.

A page, an API call or a test builds one of these and hands it to `engine.submit`, from any thread; the engine carries
them out in order, between two events, so nothing else ever touches the estimate.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class SetEstimator:
    """Fold the history with another estimator of the catalogue, and go on with it.

    With the options with which it was left, and these.
    """

    name: str
    options: Mapping[str, float] | None = None


@dataclass(frozen=True)
class SetTuning:
    """Turn one entry of the tuning: `Q.<noise>`, `R.<row>`, `p.<parameter>`, `use.<sensor>`, or one of the gate.

    These are `gate` (None: no gate), `gate.kind` (hard or soft) and `gate.reopen` (None: never).
    """

    key: str
    value: float | bool | str | None


@dataclass(frozen=True)
class SetTunings:
    """Turn several entries of the tuning at once, by key: Q, R, parameters, and `options.<name>` of the estimator.

    One refold, one revision.
    """

    values: Mapping[str, float]


@dataclass(frozen=True)
class SetOption:
    """Turn one option of the estimator that runs."""

    name: str
    value: float | bool | str


@dataclass(frozen=True)
class UseSensor:
    """Use a sensor's readings, or hold them out: predicted and scored, never used."""

    name: str
    used: bool


@dataclass(frozen=True)
class Restore:
    """Back to the estimator and the tuning that the session began with: as recorded in a review, else as configured."""


@dataclass(frozen=True)
class Load:
    """Back to the estimator and the tuning of the run of that number."""

    number: int


@dataclass(frozen=True)
class Pin:
    """Keep the track of a run, the running one or the last before it, to compare with; four at most."""

    number: int


@dataclass(frozen=True)
class Unpin:
    """Keep it no longer."""

    number: int


@dataclass(frozen=True)
class Note:
    """Give a run a name, and write a note on it; empty ones take them away."""

    number: int
    name: str = ""
    note: str = ""


@dataclass(frozen=True)
class Reset:
    """Forget the estimate: back to the model's prior at the present time."""


@dataclass(frozen=True)
class Maintenance:
    """Something of the asset was changed now, `what` in words: the states that it concerns, by name, start again.

    Their covariance is that of the prior, their mean stays, and a new version of the model begins.
    """

    what: str
    states: tuple[str, ...]


@dataclass(frozen=True)
class Pause:
    """Hold a replay or a simulation where it is, or let it go on."""

    paused: bool


@dataclass(frozen=True)
class Speed:
    """Play `factor` times as fast as real time; infinity is as fast as the estimator can."""

    factor: float


@dataclass(frozen=True)
class Step:
    """While paused: play the next event."""


@dataclass(frozen=True)
class Seek:
    """Go to a place in a recording, in seconds after its first event."""

    seconds: float


@dataclass(frozen=True)
class Record:
    """Record into a new file at `path`, or stop with None."""

    path: Path | None


@dataclass(frozen=True)
class InjectFault:
    """Put a fault into what the source says from now on; kinds and their numbers are those of sources/faults/kinds.py.

    `target` is a sensor, an input or a true parameter of a simulated asset; None is the whole source. `row` is one of a
    sensor, `other` the sensor with which a swap exchanges it. It ends after `duration` seconds, or by `ClearFault`.
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
    """End the fault of that number, or all with None."""

    number: int | None = None


Command = (
    SetEstimator | SetTuning | SetTunings | SetOption | UseSensor | Restore | Load | Pin | Unpin | Note | Reset
    | Maintenance | Pause | Speed | Step | Seek | Record | InjectFault | ClearFault
)  # fmt: skip
"""Any of them."""
