"""An episode: one thing that was wrong, as it is told."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

CAUSES = (
    "shifted", "narrow", "wide", "correlated", "alternating", "spiky", "refused", "screened", "stuck", "disagreeing",
    "agreeing", "silent", "never heard", "missed", "outside", "impoverished", "stale", "diverged", "dropped",
)  # fmt: skip
"""Of episodes; each has its heading in docs/alarms.md, which says what it means and what to do."""


class Episode(NamedTuple):
    """Something that was wrong.

    `start` and `end` in seconds of the log; `end` None while it lasts. `subject`: a sensor, one of its rows, a state,
    an input, or "twin". `cause`: one of `CAUSES`. `size` in `unit` with its 95 % interval, `low` to `high` (NaN
    where there is none). `text`: one sentence with the remedy.
    """

    start: float
    end: float | None
    subject: str
    cause: str
    size: float
    low: float
    high: float
    unit: str
    text: str


class Found(NamedTuple):
    """An episode, and where it was found.

    `key`: what is tested, and on whom; of one key there is one episode at a time. `begin`: the first row in alarm,
    among those that are tested; `at`: its time, ns.
    """

    key: tuple[str, str]
    begin: int
    at: int
    episode: Episode


def episode_json(episode: Episode) -> dict[str, float | str | None]:
    """An episode for JSON: its fields by name; null for what is not a number, which JSON does not have."""
    return {k: None if isinstance(v, float) and not np.isfinite(v) else v for k, v in episode._asdict().items()}


def anchor(cause: str) -> str:
    """Of its heading in docs/alarms.md, as GitHub makes it."""
    return cause.replace(" ", "-")
