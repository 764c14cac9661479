"""Does a linearised model pass? The filter that linearises beside one that does not, over the same log.

The extended Kalman filter sees f and h as straight lines through its mean, the unscented one as they are over the
spread of the state. Where both conclude the same, the curvature over the spread does not matter. Whether the
innovations are white says something else: whether model and noise fit. Only if those of the linearised filter are
correlated and those of the other are not, linearising is to blame.
"""

from __future__ import annotations

from concurrent.futures import Executor
from typing import NamedTuple

import numpy as np

from ...fold import Fold
from ...log import READING, Log
from ...model.state_space import StateSpaceModel
from ...registry import find_entry, unfit
from ...snapshots import Base
from ...track import GATED, USED, Track
from ...tuning import Tuning
from ..calibration import LIMITS, standardised
from ..intervals import Interval, correlation_interval
from ..sensitivity.responses import each
from ..sensitivity.size import MOST_STATES
from ..sensitivity.words import digits
from ..whiteness import ljung_box

LEAST = 0.001
"""Of a σ; what is smaller is said to be."""

QUANTILE = 0.95
"""Of the differences along the track; a few at the start, where the spread is the prior's, need not matter."""

LINEARISED, UNSCENTED = "ekf", "ukf"


class Curvature(NamedTuple):
    """How far the two filters are apart in a state or in the prediction of a sensor row, in σ: RMS and quantile."""

    name: str
    rms: float
    most: float


class White(NamedTuple):
    """Innovations of one sensor row: correlation with the next and p-value of Ljung-Box, of both filters."""

    row: str
    linearised: Interval
    unscented: Interval
    p_linearised: float
    p_unscented: float


class Linearity(NamedTuple):
    """Whether a linearised model passes: `passes` is None where it cannot be told, `reason` says why.

    `exact`: f and h are linear by the model's own word, so the Kalman filter makes no error. `white` whether the
    innovations of the linearised filter pass (no correlation that matters), `text` the verdict in words.
    """

    reason: str
    exact: bool
    passes: bool | None
    white: bool
    states: tuple[Curvature, ...]
    rows: tuple[Curvature, ...]
    whiteness: tuple[White, ...]
    text: str


def linearity(
    model: StateSpaceModel,
    tuning: Tuning,
    log: Log,
    *,
    base: Base | None = None,
    executor: Executor | str | None = "threads",
) -> Linearity:
    """Fold a log with the extended and the unscented Kalman filter.

    Args:
        model: Of at most 64 states, to which both apply.
        tuning: As the twin's; options of its filter are not theirs and are left out.
        log: The events; it must not grow meanwhile (give a copy).
        base: Where the log starts, if older events were dropped.
        executor: As `sensitivity`.

    Raises:
        EstimatorError: As `Fold`.
        ModelError: As `Fold`.
    """
    reason = _reason_against(model)
    if reason:
        return Linearity(reason, model.linear, None, False, (), (), (), reason)
    plain = tuning.with_options({})

    def run(name: str) -> Fold:
        fold = Fold(name, model, plain, log, base=base)
        fold.advance()
        return fold

    straight, curved = each(run, (LINEARISED, UNSCENTED), executor)
    states = _states(straight, curved)
    rows, whiteness = _rows(straight, curved)
    passes = all(item.most <= LIMITS.bias for item in (*states, *rows))
    bad = [item for item in whiteness if item.linearised.beyond(-LIMITS.correlation, LIMITS.correlation)]
    text = _in_words(model.linear, states + rows, bad)
    return Linearity("", model.linear, passes, not bad, states, rows, whiteness, text)


def _reason_against(model: StateSpaceModel) -> str:
    if model.grid is not None or model.nx > MOST_STATES:
        return f"{model.name} has {model.nx:,} states; a linearised model is tried up to {MOST_STATES}"
    for name in (LINEARISED, UNSCENTED):
        unsuited = unfit(find_entry(name), model)
        if unsuited:
            return f"{name} does not apply: {unsuited}"
    return ""


def _curvature(name: str, apart: np.ndarray) -> Curvature:
    """Of differences in σ; infinite where one of the filters has no number and the other has."""
    there = apart[~np.isnan(apart)]
    if not there.size:
        return Curvature(name, 0.0, 0.0)
    return Curvature(name, float(np.sqrt(np.mean(there**2))), float(np.quantile(there, QUANTILE)))


def _apart(one: np.ndarray, other: np.ndarray, std: np.ndarray, circular: bool) -> np.ndarray:
    difference = one - other
    if circular:
        difference = (difference + np.pi) % (2.0 * np.pi) - np.pi
    with np.errstate(all="ignore"):
        share = np.abs(difference) / std
    lost = np.isfinite(other) & ~np.isfinite(one)
    # Where nothing is uncertain, rounding is no difference.
    share = np.where((std == 0.0) & (np.abs(difference) <= 1e-9 * np.maximum(1.0, np.abs(other))), 0.0, share)
    return np.where(lost, np.inf, share)


def _states(straight: Fold, curved: Fold) -> tuple[Curvature, ...]:
    model, one, other = straight.model, straight.track, curved.track
    return tuple(
        _curvature(state.name, _apart(one.mean[:, k], other.mean[:, k], other.std[:, k], state.circular))
        for k, state in enumerate(model.shown_states)
    )


def _rows(straight: Fold, curved: Fold) -> tuple[tuple[Curvature, ...], tuple[White, ...]]:
    model, log = straight.model, straight.log
    found, whiteness = [], []
    for s, sensor in enumerate(model.sensors):
        own = np.flatnonzero((log.kind[: log.n] == READING) & (log.channel[: log.n] == s))
        if not own.size:
            continue
        one, other = straight.track.select(own), curved.track.select(own)
        for k, row in enumerate(sensor.rows):
            name = model.row_names[model.row_start[s] + k]
            apart = _apart(one.innovation[:, k], other.innovation[:, k], other.innovation_std[:, k], row.circular)
            found.append(_curvature(name, apart))
            series = [_judged(track, k) for track in (one, other)]
            first, second = (correlation_interval(e[np.isfinite(e)]) for e in series)
            p_first, p_second = (ljung_box(e).p_value for e in series)
            whiteness.append(White(name, first, second, p_first, p_second))
    return tuple(found), tuple(whiteness)


def _judged(track: Track, k: int) -> np.ndarray:
    """Standardised innovations of the readings that were used or refused; NaN elsewhere."""
    judged = (track.verdict == USED) | (track.verdict == GATED)
    return np.where(judged, standardised(track, k, False), np.nan)


def _at_most(most: float) -> str:
    return f"less than {LEAST:g} σ" if most < LEAST else f"at most {digits(most)} σ"


def _in_words(exact: bool, apart: tuple[Curvature, ...], bad: list[White]) -> str:
    worst = max(apart, key=lambda item: item.most)
    figure = (
        f"{100 * QUANTILE:.0f} % of the time {LINEARISED} and {UNSCENTED} are {_at_most(worst.most)} apart "
        f"({worst.name})"
    )
    if exact:
        figure = f"f and h are linear, so the Kalman filter is exact; {figure}"
    elif worst.most <= LIMITS.bias:
        figure = f"a linearised model passes: {figure}"
    else:
        figure = f"a linearised model does not pass: {figure}, more than {LIMITS.bias:g} σ"
    if not bad:
        return f"{figure}; innovations of {LINEARISED} show no correlation beyond {LIMITS.correlation:g}"
    first = max(bad, key=lambda item: abs(item.linearised.value))
    if abs(first.linearised.value) - abs(first.unscented.value) > LIMITS.correlation:
        why = "the linearisation is to blame"
    elif worst.most <= LIMITS.bias:
        why = "so model or Q are off, not the linearisation"
    else:
        why = "so neither of them fits"
    return (
        f"{figure}; innovations are not white: {first.row} {first.linearised.value:+.2f} with {LINEARISED}, "
        f"{first.unscented.value:+.2f} with {UNSCENTED}, {why}"
    )
