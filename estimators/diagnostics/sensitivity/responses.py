"""Responses: how innovations and states move with each nudge, by folding the same log again."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import replace
from typing import Any, NamedTuple, TypeVar

import numba
import numpy as np

from ...fold import Fold
from ...log import READING, Log
from ...model.state_space import StateSpaceModel
from ...registry import find_entry, find_estimator, unfit
from ...snapshots import Base
from ...track import DIVERGED, MISSING, NONE, USED, Track
from ...tuning import Tuning
from .nudges import Given, Nudge, nudged

SMOOTH = ("ekf", "ukf", "kf")
"""Filters that stand in for one that draws at random, the first that applies."""

ASTRAY = 0.1
"""Share of the rows in which a filter has diverged, from which on it cannot stand in for another."""

THREADS = int(numba.config.NUMBA_NUM_THREADS)

T = TypeVar("T")
R = TypeVar("R")


class Response(NamedTuple):
    """What one unit of a nudge does: N events, `innovation` and `whitened` NaN where there is none.

    innovation (N, ny) is dν, whitened (N, ny) S^-1/2 dν, states (N, shown) dx, of the states that a track keeps.
    """

    nudge: Nudge
    innovation: np.ndarray
    whitened: np.ndarray
    states: np.ndarray


class Start(NamedTuple):
    """The fold that is nudged: its estimator, what it is given, its track, and the log's index of its first event."""

    estimator: str
    given: Given
    track: Track
    first: int
    note: str


def stand_in(estimator: str, model: StateSpaceModel) -> tuple[str, str]:
    """The filter to nudge in place of one that draws at random, and a note that says so, or nothing.

    With one seed the draws are the same, but a nudge changes which particles survive, so that differences are noise.

    Raises:
        EstimatorError: If the estimator does not exist or does not apply to the model.
    """
    if find_estimator(estimator, model).family not in ("particle", "ensemble"):
        return estimator, ""
    for name in SMOOTH:
        if unfit(find_entry(name), model) is None:
            return name, f"{estimator} draws at random; nudged in its place: {name}"
    return estimator, f"{estimator} draws at random, and no filter without chance applies: differences hold its noise"


def astray(estimator: str, instead: str, track: Track) -> str:
    """Why the fold of the filter `instead` tells nothing of what an estimator sees; nothing if it does.

    One peak in place of two, or a linearisation where there is none: what moves a filter that is lost moves no other.
    """
    if instead == estimator or np.mean(track.health == DIVERGED) <= ASTRAY:
        return ""
    return f"{estimator} draws at random, and {instead}, which would be nudged in its place, loses this track"


def start(estimator: str, model: StateSpaceModel, tuning: Tuning, log: Log, base: Base | None, most: int) -> Start:
    """Fold once, and prepare to fold the last `most` events again and again from what stood before them.

    What was refused stays refused under every nudge, however near to the gate it was: it is taken out of the log, and
    the gate is opened.
    """
    name, note = stand_in(estimator, model)
    if name != estimator:
        tuning = tuning.with_options({})
    fold = Fold(name, model, tuning, log, base=base)
    fold.advance()
    at, base = fold.base_at(max(0, log.n - most))
    still = log.copy()
    refused = (still.kind == READING) & ~np.isin(fold.track.verdict, (USED, NONE, MISSING))
    # Of a sensor that is held out nothing is used anyhow, and its prediction is of interest.
    refused &= tuning.used[np.where(still.kind == READING, still.channel, 0)]
    still.value[refused, : still.width] = np.nan
    if at:
        still.drop_front(at)
    given = Given(replace(tuning, gate=None), still, base)
    return Start(name, given, refold(name, given), at, note)


def refold(estimator: str, given: Given) -> Track:
    """The track of what is given."""
    fold = Fold(estimator, given.tuning.model, given.tuning, given.log, base=given.base)
    fold.advance()
    return fold.track


def respond(begun: Start, nudge: Nudge) -> Response:
    """The derivative, as a difference over a step; central where the range allows."""
    low, high = max(-nudge.step, nudge.low), min(nudge.step, nudge.high)
    below, above = (
        begun.track if size == 0.0 else refold(begun.estimator, nudged(begun.given, nudge, size))
        for size in (low, high)
    )
    return Response(nudge, *(change / (high - low) for change in moved(begun, above, below)))


class Moved(NamedTuple):
    """What is other in one track than in another; see `Response`."""

    innovation: np.ndarray
    whitened: np.ndarray
    states: np.ndarray


def moved(begun: Start, new: Track, old: Track | None = None) -> Moved:
    """A track less another, or less that of the fold without nudge; angles go by the shorter way."""
    model = begun.given.tuning.model
    log = begun.given.log
    old = old or begun.track
    innovation, states = new.innovation - old.innovation, new.mean - old.mean
    reading, channel = log.kind[: log.n] == READING, log.channel[: log.n]
    whitened = new.whitened - old.whitened
    for s, sensor in enumerate(model.sensors):
        own = reading & (channel == s)
        for k, row in enumerate(sensor.rows):
            if row.circular:
                innovation[own, k] = _shorter(innovation[own, k])
        # By the S of the fold without nudge, where its square root is known: where S moves, too, the whitened rows hold
        # what that does to the innovations there are. It is less than what a change of S tells in truth.
        if len(sensor.rows) == 1 or not np.isfinite(whitened[own]).any():
            whitened[own] = innovation[own] / begun.track.innovation_std[own]
    for j, state in enumerate(model.shown_states):
        if state.circular:
            states[:, j] = _shorter(states[:, j])
    return Moved(innovation, whitened, states)


def _shorter(angle: np.ndarray) -> np.ndarray:
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


def each(work: Callable[[T], R], items: Iterable[T], executor: Executor | str | None) -> list[R]:
    """Do the same with each item: "threads" side by side (a fold gives up the interpreter), None one by one."""
    own: Any = ThreadPoolExecutor(THREADS) if executor == "threads" else nullcontext(executor)
    with own as pool:
        return list(map(work, items) if pool is None else pool.map(work, items))
