"""Decide about sensors that stay rejected: the sensor is wrong, or the twin is. A function of log and tuning.

A second fold runs beside the first from the first rejection on, the last moment at which both were one: the covariance
is widened there, and the gate of the sensor is off. Its evidence is

    Δ = Σ over the other sensors of (ℓ₂ - ℓ₁)  -  ½ Σ over the sensor's own, in the second fold, of the excess

where ℓ is the predictive log-likelihood of a measurement, held-out sensors included, and a measurement beyond the gate
g costs as much as with its noise inflated until it lies on it,

    ℓ = -½ (c + log det S),   c = NIS up to g,   g + m log(NIS / g) beyond

so that no single measurement decides. A faulty sensor can report any value, so its own measurements count only against
it, where they contradict one another although the second fold accepts them.

Without a decision the sensor is accepted after a time only if the others could not have decided: if the folds predict
their measurements alike. What could be confirmed and was not stays rejected. If most measurements of several sensors
are rejected, the estimate is the suspect: the second fold opens the gate to all of them, and all measurements count.

Sources: Willsky & Jones (1976), doi:10.1109/TAC.1976.1101146, for the likelihood ratio of a jump in the state since the
time of its onset; Gustafsson (2000), Adaptive Filtering and Change Detection, chapter 9; Bar-Shalom, Li & Kirubarajan
(2001), Estimation with Applications to Tracking and Navigation, chapter 11.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from ..diagnostics.detectors import since
from ..log import MAINTENANCE, READING, Log
from ..model.state_space import StateSpaceModel
from ..snapshots import Story
from ..track import GATED, HELD_OUT, USED, Track
from .rejection_runs import ASKED, DUE, EVER, FROM, MIN_RUN, PASSED, RUN, SINCE, WAIT

MAX_COMPARED_EVENTS = 1024
"""Events over which two folds are compared at most."""

MAX_DECISIONS = 64
"""Decisions at most until the sensor is accepted without evidence."""

MAX_WAIT_S = 3600.0
"""Seconds at most until an isolated sensor is checked again; `reopen` where that is longer."""


class Decision(NamedTuple):
    """Decision about a sensor that stayed rejected.

    row: absolute index of the measurement at which it was taken; first: of the first rejected one, the start of the
    second fold; time and since (of the first rejected one), s. outcome: "doubted", "isolated", "reopened", "believed"
    or "agrees". refused: rejections in a row; evidence: log-likelihood ratio for a wrong twin, NaN where none was
    computed; witnesses: measurements of other sensors in it. text: one sentence.
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


class ReopeningFold(Protocol):
    """A fold, as far as decisions need it."""

    model: StateSpaceModel
    log: Log
    gate_limits: np.ndarray

    @property
    def track(self) -> Track:
        """Rows folded so far."""

    def second_story(self, start: int, stop: int, sensor: int, *, every: bool = False) -> Story:
        """Fold the events from `start` to `stop` apart, as if the twin had been wrong before."""

    def go_on_with(self, story: Story) -> None:
        """Continue from the state of a second fold."""


def decide(fold: ReopeningFold, row: int, doubt: np.ndarray, reopen: float) -> tuple[Decision | None, bool]:
    """Decide about the sensor whose measurement in a row of the track is due for it.

    Args:
        fold: The fold up to this row; if the twin was wrong, it continues from the second fold.
        row: The row.
        doubt: State of the runs of rejections (sensors, REMEMBERED); changed.
        reopen: Seconds after the first rejection from which the sensor is accepted without evidence.

    Returns:
        The decision, None if it repeats the one before; and whether the state has changed.
    """
    log, model = fold.log, fold.model
    sensor = int(log.channel[row])
    own, now = doubt[sensor], float(log.t[row])
    name, time, index = model.sensor_names[sensor], now * 1e-9, log.first + row
    nothing = ReopeningEvidence(0.0, 0, 0.0)
    if own[RUN] == 0.0:
        own[ASKED], own[WAIT], own[DUE] = 0.0, 0.0, -np.inf
        text = decision_text(model, name, AGREES, 0, "", nothing, 0.0, reopen, False, np.zeros(0))
        return Decision(index, index, time, name, AGREES, 0, time, np.nan, 0, text), False
    run, begun = int(own[RUN]), own[FROM]
    # The first rejected measurement of the sensor, within reach.
    begin = max(int(own[SINCE]) - log.first, row - MAX_COMPARED_EVENTS, 0)
    mine = begin + log.events.select(slice(begin, row + 1)).of_sensor(sensor)
    start = int(mine[np.isin(fold.track.verdict[mine], (GATED, USED))][0])
    kind, channel = log.kind[start : row + 1], log.channel[start : row + 1]
    first = fold.track.select(slice(start, row + 1))
    most = _most_rejected(first, kind, channel)
    story = fold.second_story(start, row + 1, sensor, every=most)
    evidence = weigh(first, story.track, kind, channel, sensor, fold.gate_limits, every=most)
    never, asked = own[EVER] == 0.0, own[ASKED] != 0.0
    changed_asset = maintained(log.events.kind, start)
    outcome = decided(evidence, never or changed_asset, now >= begun + reopen * 1e9)
    own[ASKED] = 1.0
    changed = outcome in (REOPENED, BELIEVED)
    if changed:
        fold.go_on_with(story)
        # The rejections belong to another state.
        doubt[:, RUN] = 0.0
        own[PASSED], own[WAIT], own[ASKED], own[EVER], own[DUE] = 0.0, 0.0, 0.0, 1.0, -np.inf
    elif outcome == ISOLATED:
        own[WAIT] = max(reopen, min(2.0 * own[WAIT], MAX_WAIT_S))
        own[RUN], own[DUE] = 0.0, now + own[WAIT] * 1e9
    else:
        own[DUE] = min(now + 1e9 * max(0.5e-9 * (now - begun), reopen / MAX_DECISIONS), begun + reopen * 1e9)
        if asked:
            return None, False
    text = decision_text(
        model, name, outcome, run, since(begun * 1e-9), evidence, own[WAIT], reopen, never, story.widened
    )
    if changed_asset:
        text += "; maintenance has changed the asset, so the twin is wrong rather than the sensor"
    other = "" if changed else swapped(fold, start, row + 1, sensor)
    text += f"; {name} and {other} would fit if they were swapped" if other else ""
    return Decision(
        index, log.first + start, time, name, outcome, run, begun * 1e-9, evidence.total, evidence.witnesses, text
    ), changed


def maintained(kind: np.ndarray, row: int) -> bool:
    """Return whether maintenance was reported within `MAX_COMPARED_EVENTS` events before a row."""
    return bool(np.any(kind[max(0, row - MAX_COMPARED_EVENTS) : row] == MAINTENANCE))


def _most_rejected(track: Track, kind: np.ndarray, channel: np.ndarray) -> bool:
    """Return whether most measurements of several sensors are rejected, and most of all measurements."""
    rows = (kind == READING) & np.isin(track.verdict, (GATED, USED))
    rejected = np.where(track.verdict[rows] == GATED, 1.0, 0.0)
    sensors, place = np.unique(channel[rows], return_inverse=True)
    count = np.bincount(place)
    shares = np.bincount(place, rejected) / count
    several = np.sum((shares > 0.5) & (count >= MIN_RUN)) > 1
    return bool(several and sensors.size > 2 and rejected.mean() > 0.5)


def swapped(fold: ReopeningFold, start: int, stop: int, sensor: int) -> str:
    """Return the rejected sensor with which this one, rejected too, would fit if their names were exchanged, else "".

    Each is compared with the prediction for the other, interpolated in time between rows `start` and `stop`.
    """
    model, log = fold.model, fold.log
    track = fold.track.select(slice(start, stop))
    events = log.events.select(slice(start, stop))

    def series(s: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return times, values, predictions and their variances of a sensor of which most measurements are rejected."""
        m = len(model.sensors[s].rows)
        rows = events.of_sensor(s)
        rows = rows[np.isin(track.verdict[rows], (GATED, USED))]
        if rows.size < MIN_RUN or np.mean(track.verdict[rows] == GATED) <= 0.5:
            rows = rows[:0]
        y = log.value[start + rows, :m]
        return log.t[start + rows], y, y - track.innovation[rows, :m], track.innovation_std[rows, :m] ** 2

    own, units = series(sensor), [row.unit for row in model.sensors[sensor].rows]
    limit = fold.gate_limits[len(units)]
    best, least = "", float(limit)
    for s, other in enumerate(model.sensors):
        theirs = series(s) if s != sensor and [row.unit for row in other.rows] == units else (np.zeros(0),)
        if not own[0].size or not theirs[0].size:
            continue
        fits = max(_exchanged(own, theirs), _exchanged(theirs, own))
        if fits < least:
            best, least = other.name, fits
    return best


def _exchanged(one: tuple[np.ndarray, ...], other: tuple[np.ndarray, ...]) -> float:
    """Return the median NIS of the measurements of one sensor as measurements of another."""
    (t, y, _, _), (at, _, predicted, variance) = one, other
    nis = np.zeros(t.size)
    for k in range(y.shape[1]):
        off = y[:, k] - np.interp(t, at, predicted[:, k])
        nis += off**2 / np.interp(t, at, variance[:, k])
    return float(np.nanmedian(nis))


DECISION_NATS = float(np.log(1000.0))
"""|Δ| from which one fold is accepted: it is a thousand times more likely than the other."""

MIN_VARIANCE_SHARE = 0.01
"""Share of the prior variance of a row below which a state is not widened."""

MAX_NAMED_STATES = 4
"""States named in a text at most."""

DOUBTED, ISOLATED, REOPENED, BELIEVED, AGREES = "doubted", "isolated", "reopened", "believed", "agrees"
"""Outcomes: no decision yet; the sensor is wrong; the twin was wrong; no evidence for as long as the tuning allows, so
the sensor is accepted; the sensor passes the gate again."""


class ReopeningEvidence(NamedTuple):
    """Evidence for the second fold: log-likelihood of the other sensors, number of measurements, own part (≤ 0).

    possible: the evidence to expect of the others, ½ Σ Δν² / S of the two folds' predictions.
    """

    others: float
    witnesses: int
    own: float
    possible: float = 0.0

    @property
    def total(self) -> float:
        """Δ."""
        return self.others + self.own


def cost(nis: np.ndarray, dof: np.ndarray, limit: np.ndarray) -> np.ndarray:
    """Return c (N,) of measurements: their NIS, and beyond the gate its least value with inflated noise."""
    with np.errstate(divide="ignore", invalid="ignore"):
        beyond = limit + dof * np.log(nis / limit)
    return np.where(nis > limit, beyond, nis)


def degrees(track: Track) -> np.ndarray:
    """Return the number of finite rows of each measurement of a track, (N,)."""
    return np.isfinite(track.innovation_std).sum(axis=1)


def softened(track: Track, limits: np.ndarray) -> np.ndarray:
    """Return which rows of a track are measurements beyond the gate that were used, (N,)."""
    return (track.verdict == USED) & (track.nis > limits[degrees(track)])


def log_likelihoods(track: Track, limits: np.ndarray) -> np.ndarray:
    """Return ℓ (N,) of the measurements of a track, up to a constant; limits (width + 1,): gate by degrees of freedom.

    NIS and standard deviations mean the same for every family of filters. Correlation of a sensor's rows is left out of
    det S, in both folds.
    """
    dof = degrees(track)
    log_det = 2.0 * np.nansum(np.log(track.innovation_std), axis=1)
    return -0.5 * (cost(track.nis, dof, limits[dof]) + log_det)


def weigh(
    first: Track, second: Track, kind: np.ndarray, channel: np.ndarray, sensor: int, limits: np.ndarray, *,
    every: bool = False,
) -> ReopeningEvidence:  # fmt: skip
    """Return the evidence in the rows of the two folds; the first row is the sensor's first rejected measurement.

    That one does not count: the second fold was widened by it. `every`: whether all sensors are in doubt, so that those
    of this one count as the others do.
    """
    judged = [np.isin(track.verdict, (USED, GATED, HELD_OUT)) for track in (first, second)]
    others = (kind == READING) & ((channel != sensor) | every) & judged[0] & judged[1]
    others[0] = False
    gained = log_likelihoods(second.select(others), limits) - log_likelihoods(first.select(others), limits)
    moved = (second.innovation[others] - first.innovation[others]) / first.innovation_std[others]
    own = (kind == READING) & (channel == sensor) & judged[1]
    own[0] = False
    mine = second.select(own)
    dof = degrees(mine)
    wild = mine.nis - cost(mine.nis, dof, limits[dof])
    count, against = int(np.sum(np.isfinite(gained))), 0.0 if every else -0.5 * float(np.nansum(wild))
    return ReopeningEvidence(float(np.nansum(gained)), count, against, 0.5 * float(np.nansum(moved**2)))


def widening(cov: np.ndarray, prior: np.ndarray, H: np.ndarray, innovation: np.ndarray) -> np.ndarray:
    """Return the addition to P's diagonal: α Σ of the states that a sensor observes, ν² ≤ α H Σ Hᵀ in every row.

    A state is seen that has a share in H Σ Hᵀ. One that hardly moves a reading, as the speed moves a late fix, would be
    widened in vain: all that knew it better would speak against the second story. Σ holds the prior's variances: they
    give the relative uncertainty of the states without measurements. The NIS is then the number
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
        added[~np.any(parts > MIN_VARIANCE_SHARE * parts.sum(axis=1)[:, None], axis=0)] = 0.0
        spread = np.square(H) @ added
        reached = (spread > 0.0) & (nu != 0.0)
        if np.any(reached):
            return added * float(np.max(nu[reached] ** 2 / spread[reached]))
    return np.zeros(len(cov))


def decided(evidence: ReopeningEvidence, never_agreed: bool, waited: bool) -> str:
    """Return the outcome; never_agreed: no measurement has passed yet; waited: the time without evidence is over."""
    if evidence.total >= DECISION_NATS:
        return REOPENED
    if evidence.total <= -DECISION_NATS:
        return ISOLATED
    if evidence.possible > DECISION_NATS and evidence.total <= 0.0:
        return ISOLATED if waited else DOUBTED
    return BELIEVED if never_agreed or waited else DOUBTED


def decision_text(
    model: StateSpaceModel, sensor: str, outcome: str, run: int, since: str, evidence: ReopeningEvidence,
    wait: float, reopen: float, never_agreed: bool, added: np.ndarray,
) -> str:  # fmt: skip
    """Return one sentence with the rejections, the decision, its reason and its consequence."""
    begun = f"{sensor}: {run} consecutive measurements rejected {since}"
    others = f"the other sensors, by exp({evidence.others:+.0f})"
    if outcome == AGREES:
        return f"{sensor}: passes the gate again"
    if outcome == ISOLATED and evidence.total > -DECISION_NATS:
        why = "no other sensor confirms it, though they could"
        return f"{begun}; {why}: it stays rejected and is checked again in {wait:g} s"
    if outcome == ISOLATED:
        alone = evidence.own <= evidence.others
        why = "its measurements contradict one another" if alone else f"{others}, contradict it"
        return f"{begun}; the sensor is wrong, {why}: it stays rejected and is checked again in {wait:g} s"
    if outcome == DOUBTED:
        return f"{begun}; it or the twin is wrong, without evidence which: accepted {reopen:g} s after the first"
    most = np.argsort(-added, kind="stable")[:MAX_NAMED_STATES]
    units = {state.name: state.unit for state in model.shown_states}
    names = [model.state_names[j] for j in most if added[j] > 0.0]
    states = [f"{name} ± {added[j]:.3g} {units.get(name, '')}".rstrip() for name, j in zip(names, most, strict=False)]
    wide = f"accepted, widened by {', '.join(states)}" if states else "accepted"
    if outcome == REOPENED:
        return f"{begun}; the twin was wrong, {others}, agree with it: {wide}"
    if never_agreed:
        return f"{begun}, from its first; no sensor confirms the prior: {wide}"
    return f"{begun}; no evidence for {reopen:g} s whether it or the twin is wrong: {wide}"
