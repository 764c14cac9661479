"""Sweep a parameter: likelihood and NIS of the last events over several values of one entry; noise estimates.

A job folds the events, one value after another, the nearest first, and ends as soon as another tuning runs.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from estimators.diagnostics.innovations import SensorNoise, mean_nis, sensor_noise
from estimators.diagnostics.score import score
from estimators.errors import ConfigError, NisusError
from estimators.track import FAILED, Track
from estimators.tuning import Tuning

from ..engine.copies import EventWindow
from ..engine.jobs import Job, JobCancelled
from ..engine.running_fold import Running
from .run_scores import seconds_per_event

FACTORS = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)

MAX_SWEEP_EVENTS, MIN_SWEEP_EVENTS = 20_000, 2048
"""Events that are folded again for every value, the last of the log; the minimum is for slow filters."""

VALUE_TIME_S, MAX_VALUE_TIME_S = 2.0, 10.0
"""Seconds that one value should take, and that the fewest events may take."""

TIMED_EVENTS = 32
"""Events that are folded to find the time of one."""

SETTLE_TIME_S = 0.3
"""Seconds without a change of the tuning before a sweep begins."""

CHUNK_EVENTS = 256
"""Events between two looks whether the result is still wanted."""

STALE_GROWTH = 1.5
"""A sweep is out of date once the log has so many times its events."""

MATCHED_R_KEY = "R, matched"
"""Key of the fold for `matched`."""

MAX_MATCHING_FOLDS, MATCHING_TOLERANCE = 5, 0.05
"""Folds in which R must converge, and the relative change that counts as converged."""

MAX_SWEEPS = 32
GROUPS = ("Q", "R")
"""Keys that scale all entries of a group."""


@dataclass(frozen=True)
class Point:
    """One value: `factor` times the present one, and its result.

    `log_likelihood` is that of the measurements used and rejected, `nis` their mean NIS per degree of freedom, 1 where
    the filter is consistent (estimators/diagnostics/innovation_size.py). Both are None if a measurement failed.
    """

    factor: float
    value: float
    log_likelihood: float | None
    nis: float | None


@dataclass(frozen=True)
class Swept:
    """Points of one key, by value, for a revision; `done` once all exist, or the `reason` why there are none.

    `value` is the present one; for a group it is 1, and the points' values are their factors.
    """

    key: str
    revision: int
    value: float
    events: int
    points: tuple[Point, ...] = ()
    done: bool = False
    reason: str = ""

    @property
    def best(self) -> Point | None:
        """The point with the highest likelihood."""
        known = [point for point in self.points if point.log_likelihood is not None]
        return max(known, key=lambda point: point.log_likelihood or 0.0) if known else None

    @property
    def level(self) -> float | None:
        """The value at which the mean NIS per degree of freedom is 1; None if it lies beyond the points.

        Interpolated between two points, both logarithmic. Covariance matching would choose it if this entry alone
        were wrong.

        Source: Mehra (1972), doi:10.1109/TAC.1972.1100100, section on covariance matching.
        """
        known = [(point.value, point.nis) for point in self.points if point.nis and point.value > 0.0]
        for (low, above), (high, below) in zip(known, known[1:], strict=False):
            first, second = np.log(above), np.log(below)
            if first * second <= 0.0 and first != second:
                return float(np.exp(np.log(low) + np.log(high / low) * first / (first - second)))
        return None


class Sweeps:
    """Sweeps of the running twin, one after another in one job; the last request comes first."""

    def __init__(self, engine: Running) -> None:
        self._engine = engine
        self._lock = threading.Lock()
        self._wanted: list[str] = []
        self._job: Job | None = None
        self._known: dict[str, Swept] = {}
        self._matched: tuple[int, int, dict[str, SensorNoise]] = (-1, 0, {})

    def around(self, key: str) -> Swept:
        """Return the sweep of a key as far as it is done, and queue the rest.

        Raises:
            ConfigError: If there is no such key, or its values are no numbers.
        """
        value = value_of(self._engine.tuning, key)
        known, revision = self._known.get(key), self._engine.revisions.runs[-1].number
        if known is None or known.revision != revision:
            known = Swept(key, revision, value, 0)
            self._want(key)
        elif known.done and known.events < min(MAX_SWEEP_EVENTS - MIN_SWEEP_EVENTS, self._engine.end() / STALE_GROWTH):
            # Return the previous sweep until the new one is ready.
            self._want(key)
        return known

    def matched(self) -> dict[str, SensorNoise] | None:
        """Return the noise of each row after covariance matching of all of R; None until it is known.

        If R alone was wrong, the innovations are white then; any other error leaves them correlated.
        """
        revision, events, rows = self._matched
        current = revision == self._engine.revisions.runs[-1].number
        if not current or events < self._engine.end() / STALE_GROWTH < MAX_SWEEP_EVENTS:
            self._want(MATCHED_R_KEY)
        return rows if current else None

    def _want(self, key: str) -> None:
        with self._lock:
            self._wanted = [key, *(other for other in self._wanted if other != key)][:MAX_SWEEPS]
            if self._job is None or self._job.over:
                self._job = self._engine.jobs.run("sweep", self._work)

    def _work(self, job: Job) -> None:
        while (key := self._next(job)) is not None:
            self.sweep(key, job)

    def _next(self, job: Job) -> str | None:
        """Return the last requested key once no slider has moved for `SETTLE_TIME_S`; None if there is none."""
        while True:
            tuning = self._engine.tuning
            job.rest(SETTLE_TIME_S)
            with self._lock:
                if not self._wanted:
                    self._job = None
                    return None
                if self._engine.tuning is tuning:
                    return self._wanted.pop(0)

    def sweep(self, key: str, job: Job) -> None:
        """Fold every value of a key; `around` returns the points as they come.

        Raises:
            JobCancelled: If the job is, or another tuning runs by now.
        """
        taken = self._engine.last_events(MIN_SWEEP_EVENTS, rows=True)
        if taken is None:
            return
        self._check(taken, job)
        most, reason = self._affordable(taken)
        if most > MIN_SWEEP_EVENTS:
            taken = self._engine.last_events(most, rows=True) or taken
        if key == MATCHED_R_KEY:
            if not reason:
                self._match(taken, job)
            return
        value, events = value_of(taken.tuning, key), len(taken.events)
        values = values_around(taken.tuning, key)
        if reason or not values:
            reason = reason or f"{key} is 0: nothing to scale"
            self._known[key] = Swept(key, taken.revision, value, events, done=True, reason=reason)
            return
        points: list[Point] = []
        for factor, tuning in values:
            points = sorted([*points, self._point(taken, key, factor, tuning, job)], key=lambda point: point.value)
            done = len(points) == len(values)
            self._known[key] = Swept(key, taken.revision, value, events, tuple(points), done)
        self._known = dict(list(self._known.items())[-MAX_SWEEPS:])

    def _match(self, taken: EventWindow, job: Job) -> None:
        """Fold with the R that the innovations of the previous fold imply, until it converges."""
        tuning, track = taken.tuning, taken.track
        for _ in range(MAX_MATCHING_FOLDS):
            r = tuning.r.copy()
            for name, estimate in sensor_noise(track, taken.events, tuning).items():
                if estimate.variance > 0.0:
                    r[tuning.model.row_names.index(name)] = estimate.variance
            following = replace(tuning, r=r)
            moved = np.abs(np.log(following.r[following.r > 0.0] / tuning.r[following.r > 0.0]))
            if not moved.size or moved.max() < MATCHING_TOLERANCE:
                break
            tuning = following
            try:
                track = self._fold(taken, tuning, job)
            except NisusError:
                return
        self._matched = taken.revision, len(taken.events), sensor_noise(track, taken.events, tuning)

    def _point(self, taken: EventWindow, key: str, factor: float, tuning: Tuning, job: Job) -> Point:
        """Fold one value."""
        value = value_of(tuning, key) if key not in GROUPS else factor
        try:
            track = self._fold(taken, tuning, job)
        except NisusError:
            return Point(factor, value, None, None)
        found = score(track, taken.events, self._engine.model, gate=tuning.gate)
        # A value at which more measurements fail has no likelihood to be compared.
        failed = np.sum(track.verdict == FAILED) > np.sum(taken.track.verdict == FAILED)
        known = (None if failed or not np.isfinite(each) else float(each)
                 for each in (found.log_likelihood, mean_nis(track, tuning.gate)))  # fmt: skip
        return Point(factor, value, *known)

    def _fold(self, taken: EventWindow, tuning: Tuning, job: Job) -> Track:
        fold = taken.fold(tuning=tuning, policy=self._engine.policy)
        while fold.advance(CHUNK_EVENTS):
            self._check(taken, job)
        return fold.track

    def _check(self, taken: EventWindow, job: Job) -> None:
        job.check()
        if self._engine.tuning is not taken.tuning:
            raise JobCancelled

    def _affordable(self, taken: EventWindow) -> tuple[int, str]:
        """Return how many events can be folded in reasonable time, or the reason why none."""
        if self._engine.model.black_box:
            return 0, f"{self._engine.model.name} is a black box, too slow to be folded again beside what runs"
        each = seconds_per_event(taken.fold(policy=self._engine.policy), TIMED_EVENTS)
        if each * len(taken.events) > MAX_VALUE_TIME_S:
            slow = f"{taken.estimator} takes {each * MIN_SWEEP_EVENTS:.0f} s for {MIN_SWEEP_EVENTS} events"
            return 0, f"{slow}, too slow to be folded again"
        return int(min(MAX_SWEEP_EVENTS, max(MIN_SWEEP_EVENTS, VALUE_TIME_S / max(each, 1e-9)))), ""


def value_of(tuning: Tuning, key: str) -> float:
    """Return the present value of an entry; 1 for a group.

    Raises:
        ConfigError: If there is no such entry, or it is no number.
    """
    if key in GROUPS:
        return 1.0
    value = tuning.get(key)
    if isinstance(value, (bool, str)) or value is None or key.startswith("gate"):
        raise ConfigError(f"{key} cannot be swept; Q., R. and p. entries can, and all of Q or R")
    return float(value)


def values_around(tuning: Tuning, key: str) -> list[tuple[float, Tuning]]:
    """Return a tuning for each factor within the entry's range, the nearest to 1 first; none if the value is zero."""
    if key not in GROUPS and value_of(tuning, key) == 0.0:
        return []
    found = []
    for factor in sorted(FACTORS, key=lambda factor: (abs(np.log(factor)), factor)):
        try:
            found.append((factor, scaled(tuning, key, factor)))
        except ConfigError:
            continue
    return found


def scaled(tuning: Tuning, key: str, factor: float) -> Tuning:
    """Return the tuning with an entry, or all of a group, times a factor.

    Raises:
        ConfigError: If the entry's range does not allow it.
    """
    if factor == 1.0:
        return tuning
    if key not in GROUPS:
        return tuning.set(key, value_of(tuning, key) * factor)
    return replace(tuning, q=tuning.q * factor) if key == "Q" else replace(tuning, r=tuning.r * factor)


MAX_CHANCE = 1e-3
"""Probability of innovations as correlated, were the filter right, below which they are called correlated."""


@dataclass(frozen=True)
class NoiseEstimates:
    """Estimated R by key of the tuning, or the `reason` why there is none; and the sweep of all of Q.

    `doubts` has, by key, the reason not to use an estimate, also for "Q".
    """

    revision: int
    sensors: dict[str, SensorNoise]
    reason: str
    q: Swept
    doubts: dict[str, str]


def noise(engine: Running, sweeps: Sweeps) -> NoiseEstimates:
    """Estimate the noise from the last innovations of the running twin: each R, and all of Q scaled."""
    taken, q = engine.last_events(MAX_SWEEP_EVENTS, rows=True), sweeps.around("Q")
    if taken is None:
        return NoiseEstimates(q.revision, {}, "no readings yet", q, {})
    reason = "the filter adapts its noise itself" if taken.tuning.options.get("adapt", 0.0) else ""
    if engine.twin.plan.brings_variances:
        reason = "the readings bring their own variances"
    found = _by_key(taken.tuning, {} if reason else sensor_noise(taken.track, taken.events, taken.tuning))
    if any(estimate.chance < MAX_CHANCE for estimate in found.values()):
        # A wrong R alone leaves correlated innovations too; with the right one they are white.
        matched = sweeps.matched()
        found = found if matched is None else _by_key(taken.tuning, matched)
    return NoiseEstimates(taken.revision, found, reason, q, doubts(found, q.level))


def doubts(found: Mapping[str, SensorNoise], level: float | None) -> dict[str, str]:
    """Return, by key, why an estimate should not be used: the innovations are correlated, so their size misleads.

    Matching R to their size treats a coloured error as white noise: the bands become too narrow, and the estimate
    follows the error. Matching Q is right only if it would remove the correlation too: with all of Q times `level`, at
    which the NIS is consistent; None if that is not known.
    """
    correlated = {key: estimate for key, estimate in found.items() if estimate.chance < MAX_CHANCE}
    reasons = {
        key: f"the innovations are correlated ({estimate.correlation:+.2f} with the next, where chance allows "
        f"±{2.0 / np.sqrt(estimate.n):.2f}): a state is missing, Q is wrong, or the sensor's error lasts; their size "
        f"does not determine R"
        for key, estimate in correlated.items()
    }
    signs = {np.sign(estimate.correlation) for estimate in correlated.values()}
    if level is not None and signs and np.sign(np.log(level)) not in signs:
        more = "larger" if 1.0 in signs else "smaller"
        reasons["Q"] = f"the innovations are correlated, for which Q would have to be {more}: look for a missing state"
    return reasons


def _by_key(tuning: Tuning, rows: Mapping[str, SensorNoise]) -> dict[str, SensorNoise]:
    """Return the estimates by the tuning's keys: of one row, or of all rows that share an entry."""
    found = {}
    for key in (item.key for item in tuning.items() if item.key.startswith("R.")):
        names = [tuning.model.row_names[k] for k in tuning.rows_of(key)]
        known = [rows[row] for row in names if row in rows]
        if known:
            variances, stds, counts, _, chances = (np.array(column, float) for column in zip(*known, strict=True))
            worst = int(np.argmin(chances))
            found[key] = SensorNoise(
                float(variances.mean()),
                float(np.sqrt(np.sum(stds**2)) / len(known)),
                int(counts.sum()),
                known[worst].correlation,
                # The least of many chances is small by chance.
                min(1.0, len(known) * float(chances[worst])),
            )
    return found
