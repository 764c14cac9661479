"""What is decided of sensors that stay refused, while a fold goes on: a pure function of the log and the tuning."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from ..diagnostics.episodes.wording import since
from ..log import READING, Log
from ..model.state_space import StateSpaceModel
from ..snapshots import Story
from ..track import GATED, HELD_OUT, USED, Track
from .rejection_runs import ASKED, DUE, EVER, FROM, PASSED, RUN, SINCE, WAIT

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


DECISIVE = float(np.log(1000.0))
"""|Δ| from which a story is believed: the one is a thousand times likelier than the other."""

SHARE = 0.01
"""Of the variance that the prior gives a row: a state with less of it is not widened."""

NAMED = 4
"""States, at most, that a sentence names."""

DOUBTED, ISOLATED, REOPENED, BELIEVED, AGREES = "doubted", "isolated", "reopened", "believed", "agrees"
"""What can be decided: nothing tells yet; the sensor is wrong; the twin was wrong; nothing told for as long as the
tuning says, so the asset is believed; the sensor passes the gate again."""


class Evidence(NamedTuple):
    """What speaks for the second story: the others' log-likelihood, how many of their readings, and its own (≤ 0)."""

    others: float
    witnesses: int
    own: float

    @property
    def total(self) -> float:
        """Δ."""
        return self.others + self.own


def cost(nis: np.ndarray, dof: np.ndarray, limit: np.ndarray) -> np.ndarray:
    """c (N,) of readings: their NIS, and beyond the gate the least that inflated noise makes of it."""
    with np.errstate(divide="ignore", invalid="ignore"):
        beyond = limit + dof * np.log(nis / limit)
    return np.where(nis > limit, beyond, nis)


def degrees(track: Track) -> np.ndarray:
    """Rows that were there in each reading of a track (N,)."""
    rows: np.ndarray = np.isfinite(track.innovation_std).sum(axis=1)
    return rows


def softened(track: Track, limits: np.ndarray) -> np.ndarray:
    """Which rows of a track are readings beyond the gate that were used all the same (N,)."""
    beyond: np.ndarray = (track.verdict == USED) & (track.nis > limits[degrees(track)])
    return beyond


def log_likelihoods(track: Track, limits: np.ndarray) -> np.ndarray:
    """ℓ (N,) of the readings of a track but for a constant; limits (width + 1,): the gate by degrees of freedom.

    By NIS and the deviations that the track shows, as those of every family of filters mean the same; the correlation
    of a sensor's rows is left out of det S, in both stories.
    """
    dof = degrees(track)
    log_det = 2.0 * np.nansum(np.log(track.innovation_std), axis=1)
    likelihoods: np.ndarray = -0.5 * (cost(track.nis, dof, limits[dof]) + log_det)
    return likelihoods


def weigh(
    first: Track, second: Track, kind: np.ndarray, channel: np.ndarray, sensor: int, limits: np.ndarray
) -> Evidence:
    """What rows of the two stories say of a sensor; the first row is its first refused reading.

    That one itself says nothing: the second story was widened by it.
    """
    judged = [np.isin(track.verdict, (USED, GATED, HELD_OUT)) for track in (first, second)]
    others = (kind == READING) & (channel != sensor) & judged[0] & judged[1]
    gained = log_likelihoods(second.select(others), limits) - log_likelihoods(first.select(others), limits)
    own = (kind == READING) & (channel == sensor) & judged[1]
    own[0] = False
    mine = second.select(own)
    dof = degrees(mine)
    wild = mine.nis - cost(mine.nis, dof, limits[dof])
    return Evidence(float(np.nansum(gained)), int(np.sum(np.isfinite(gained))), -0.5 * float(np.nansum(wild)))


def widening(cov: np.ndarray, prior: np.ndarray, H: np.ndarray, innovation: np.ndarray) -> np.ndarray:
    """What to add to P's diagonal: α Σ, of the states that a sensor sees, α so that ν² ≤ α H Σ Hᵀ in every row.

    A state is seen that has a share in H Σ Hᵀ. One that hardly moves a reading, as the speed moves a late fix, would be
    widened in vain: all that knew it better would speak against the second story. Σ holds the prior's variances: they
    say what is believed of the states when nothing is known, one in relation to the other. The NIS is then the number
    of rows at most.

    Args:
        cov: Diagonal of P (nx,), which takes the place of Σ where that holds nothing that the sensor sees.
        prior: Diagonal of Σ (nx,).
        H: dh/dx (ny, nx).
        innovation: ν (ny,) of the first refused reading; NaN where there is no row.

    Returns:
        Variances (nx,).
    """
    nu = np.where(np.isfinite(innovation), innovation, 0.0)
    for variances in (prior, cov):
        added = np.where(np.isfinite(variances), variances, 0.0)
        parts = np.square(H) * added
        added[~np.any(parts > SHARE * parts.sum(axis=1)[:, None], axis=0)] = 0.0
        spread = np.square(H) @ added
        reached = (spread > 0.0) & (nu != 0.0)
        if np.any(reached):
            widest: np.ndarray = added * float(np.max(nu[reached] ** 2 / spread[reached]))
            return widest
    return np.zeros(len(cov))


def decided(evidence: Evidence, never_agreed: bool, waited: bool) -> str:
    """What follows from the evidence, of a sensor that never agreed with the twin, or for which was waited enough."""
    if evidence.total >= DECISIVE:
        return REOPENED
    if evidence.total <= -DECISIVE:
        return ISOLATED
    return BELIEVED if never_agreed or waited else DOUBTED


def told(
    model: StateSpaceModel, sensor: str, outcome: str, run: int, since: str, evidence: Evidence,
    wait: float, reopen: float, never_agreed: bool, added: np.ndarray,
) -> str:  # fmt: skip
    """One sentence for a user: what was refused since when, what it was taken for and why, what follows."""
    begun = f"{sensor}: {run} readings in a row refused {since}"
    others = f"the other sensors, by exp({evidence.others:+.0f})"
    if outcome == AGREES:
        return f"{sensor}: passes the gate again"
    if outcome == ISOLATED:
        alone = evidence.own <= evidence.others
        why = "its readings contradict one another" if alone else f"{others}, contradict it"
        return f"{begun}; the sensor is wrong, {why}: it stays refused, asked again in {wait:g} s"
    if outcome == DOUBTED:
        return f"{begun}; it or the twin is wrong, nothing tells which: it is believed {reopen:g} s after the first"
    most = np.argsort(-added, kind="stable")[:NAMED]
    units = {state.name: state.unit for state in model.shown_states}
    names = [model.state_names[j] for j in most if added[j] > 0.0]
    states = [f"{name} ± {added[j]:.3g} {units.get(name, '')}".rstrip() for name, j in zip(names, most, strict=False)]
    wide = f"let in, widened by {', '.join(states)}" if states else "let in"
    if outcome == REOPENED:
        return f"{begun}; the twin was wrong, {others}, agree with it: {wide}"
    if never_agreed:
        return f"{begun}, from its first; nothing confirms where the twin began: {wide}"
    return f"{begun}; nothing told for {reopen:g} s whether it or the twin is wrong: believed, {wide}"
