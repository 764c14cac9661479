"""What is decided of sensors that stay refused, while a fold goes on: a pure function of the log and the tuning."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from ..diagnostics.words import since
from ..log import READING, Log
from ..model.state_space import StateSpaceModel
from ..snapshots import Story
from ..track import GATED, USED, Track
from .doubt import ASKED, DUE, EVER, FROM, PASSED, RUN, SINCE, WAIT
from .stories import AGREES, BELIEVED, ISOLATED, REOPENED, Evidence, decided, told, weigh

STRETCH = 1024
"""Events, at most, over which two stories are compared: the work of a decision is bounded."""

ASKS = 64
"""Of the seconds until the asset is believed, the least part between two questions."""

LONGEST_WAIT = 3600.0
"""Seconds, at most, before a sensor that was isolated is asked again; `reopen` where that is longer."""


class Decision(NamedTuple):
    """What was decided of a sensor that stayed refused.

    `row`: absolute index of the reading at which, `first` of the first refused with which the stories begin; `time` and
    `since` (of the first refused) in seconds of the log. `outcome`: a word of stories.py. `refused`: readings in a row;
    `evidence`: log-likelihood of the story that the twin is wrong over that of the sensor, NaN where none was weighed;
    `witnesses`: readings of other sensors in it. `text`: one sentence.
    """

    row: int
    first: int
    time: float
    sensor: str
    outcome: str
    refused: int
    since: float
    evidence: float
    witnesses: int
    text: str


class Told(Protocol):
    """What a decision needs of a fold."""

    model: StateSpaceModel
    log: Log
    gate_limits: np.ndarray

    @property
    def track(self) -> Track:
        """The rows folded so far."""

    def second_story(self, start: int, stop: int, sensor: int) -> Story:
        """The events from `start` to `stop` folded apart, as if the twin had been wrong before."""

    def go_on_with(self, story: Story) -> None:
        """Take its state for one's own."""


def decide(fold: Told, row: int, doubt: np.ndarray, reopen: float) -> tuple[Decision | None, bool]:
    """Decide what to do about the sensor whose reading in a row of the track asks for it.

    Args:
        fold: The fold, which has come to this row; if the twin was wrong, it goes on in the second story.
        row: The row.
        doubt: What is remembered of the sensors (sensors, REMEMBERED); changed.
        reopen: Seconds after the first refused reading from which on the asset is believed if nothing tells.

    Returns:
        The decision, None if it is the one before; and whether the state is another now.
    """
    log, model = fold.log, fold.model
    sensor = int(log.channel[row])
    own, now = doubt[sensor], float(log.t[row])
    name, time, index = model.sensor_names[sensor], now * 1e-9, log.first + row
    nothing = Evidence(0.0, 0, 0.0)
    if own[RUN] == 0.0:
        own[ASKED], own[WAIT], own[DUE] = 0.0, 0.0, -np.inf
        text = told(model, name, AGREES, 0, "", nothing, 0.0, reopen, False, np.zeros(0))
        return Decision(index, index, time, name, AGREES, 0, time, np.nan, 0, text), False
    run, begun = int(own[RUN]), own[FROM]
    start = _first_refused(fold, row, sensor, int(own[SINCE]) - log.first)
    story = fold.second_story(start, row + 1, sensor)
    kind, channel = log.kind[start : row + 1], log.channel[start : row + 1]
    evidence = weigh(fold.track.select(slice(start, row + 1)), story.track, kind, channel, sensor, fold.gate_limits)
    never, asked = own[EVER] == 0.0, own[ASKED] != 0.0
    outcome = decided(evidence, never, now >= begun + reopen * 1e9)
    own[ASKED] = 1.0
    changed = outcome in (REOPENED, BELIEVED)
    if changed:
        fold.go_on_with(story)
        # What was refused was refused by another state.
        doubt[:, RUN] = 0.0
        own[PASSED], own[WAIT], own[ASKED], own[EVER], own[DUE] = 0.0, 0.0, 0.0, 1.0, -np.inf
    elif outcome == ISOLATED:
        own[WAIT] = max(reopen, min(2.0 * own[WAIT], LONGEST_WAIT))
        own[RUN], own[DUE] = 0.0, now + own[WAIT] * 1e9
    else:
        own[DUE] = min(now + 1e9 * max(0.5e-9 * (now - begun), reopen / ASKS), begun + reopen * 1e9)
        if asked:
            return None, False
    text = told(model, name, outcome, run, since(begun * 1e-9), evidence, own[WAIT], reopen, never, story.widened)
    return Decision(
        index, log.first + start, time, name, outcome, run, begun * 1e-9, evidence.total, evidence.witnesses, text
    ), changed


def _first_refused(fold: Told, row: int, sensor: int, since: int) -> int:
    """The first refused reading of a sensor from row `since` on, of those within reach before `row`."""
    log, begin = fold.log, max(since, row - STRETCH, 0)
    verdict, channel = fold.track.verdict[begin : row + 1], log.channel[begin : row + 1]
    mine = (log.kind[begin : row + 1] == READING) & (channel == sensor) & np.isin(verdict, (GATED, USED))
    return begin + int(np.flatnonzero(mine)[0])
