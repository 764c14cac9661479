"""Scores of a tuning on fitted and held-out measurements, the verdict on a fit, and the power of the likelihood.

The fit sees none of the criteria: the density of the measurements of held-out blocks, the measurements of each sensor
in turn predicted by the others, the coverage of the predictions, and the true state where a recording has it. A
held-out prediction is scored by the continuous ranked probability score, which is proper, in its unit, and robust
against single measurements.

They also choose the power of the likelihood, p(θ | y) ∝ p(y | θ)^η p(θ), 0 < η ≤ 1. If the model is right, η = 1. The
model of a real asset has slow errors, so that a thousand measurements carry the information of ten, and the likelihood
is overconfident: it fits noises to one stretch of time under which the states that are not measured leave their bands.
A smaller power discounts the measurements, and entries go back to their start, the least identified first.

With the aim `likelihood` the power is 1 unless there is evidence against it: among the powers that worsen no held-out
prediction, the largest whose prediction of the held-out blocks is within chance (two standard errors of the difference)
of the best. With references, whose independent errors are few, it is the smallest of those with which the fit is
proposed, preferably with all references in their bands.

The maximum at a power is taken from the parabola at the maximum x̂ of power 1, with H minus its second derivatives, D
those of the prior at x_0: x(η) = x_0 + (η (H - D) + D)⁻¹ η H (x̂ - x_0). Each is scored by folding.

Sources: Grünwald & van Ommen (2017), doi:10.1214/17-BA1085, for a power learnt by prediction; Breiman, Friedman, Olshen
& Stone, Classification and Regression Trees (1984), 3.4.3, for the simplest candidate that is no worse than by chance.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from functools import partial
from typing import NamedTuple

import numpy as np

from ..diagnostics.innovations import mean_nis
from ..diagnostics.intervals import correlation_interval
from ..diagnostics.references import Reference, held_out_references, references
from ..log import READING, TRUTH
from ..track import USED, Track
from .aims import CRPS, ERROR, LIKELIHOOD, WITNESSES, Aim, crps, densities, sensors_in_turn, track_of
from .entries import Setting
from .objective import Go, Objective, each_folded
from .recording import Recording
from .uncertainty import LikelihoodCurvature, Z

GAIN_BATCHES = 20  # Batches of time over which a difference is averaged, for its standard error
MIN_SIGMAS = 2.0  # Standard errors that a gain must exceed, and a loss before it counts
MIN_TOTAL_GAIN = 1.0  # Nats that a fit must gain on all held-out data: with less it is the same tuning in other digits
MAX_LOSS = 0.05  # Share by which the score of a held-out prediction may grow before it counts
MIN_COVERAGE = 0.9  # Coverage of a 95 % band from which on it is not too narrow
MAX_COVERAGE_LOSS = 0.05  # Coverage that may be lost before it counts, below `MIN_COVERAGE`
MIN_CORRELATED = 30  # Innovations from which their correlation is given
UNITS = {LIKELIHOOD: "a reading", WITNESSES: "a reading or witness"}  # Unit of a gain in nats, by aim


class PredictionScore(NamedTuple):
    """Quality of n held-out predictions.

    Root mean square error and mean CRPS are in `unit`, coverage is the share of errors inside the 95 % band; `scores`
    (n,) are the single CRPS.
    """

    unit: str
    n: int
    rms: float
    coverage: float
    crps: float
    scores: np.ndarray


class PartScore(NamedTuple):
    """Scores of one part of the recordings, with n measurements.

    Mean log density of a measurement, mean NIS per degree of freedom, share of innovations inside their 95 % band.
    `terms` (n,) are the single log densities, `aimed` the terms of the fit's aim from measurements and truths, if it
    holds no sensor out. `sensors` are those held out in turn, `withheld` the rows that the twin itself never uses,
    `states` those with a known truth, by name. `correlation` is that of successive innovations, by row.
    """

    n: int
    log_density: float
    nis: float
    coverage: float
    terms: np.ndarray
    aimed: np.ndarray
    sensors: dict[str, PredictionScore]
    withheld: dict[str, PredictionScore]
    states: dict[str, PredictionScore]
    correlation: dict[str, float] = {}

    @property
    def log_likelihood(self) -> float:
        """Log density of all its measurements, nats."""
        # As `Objective.all_terms`: those of an Executor may not be aligned.
        return float(np.require(self.terms, requirements="A").sum())


class Worth(NamedTuple):
    """Scores of the fitted part, and of the held-out part."""

    fitted: PartScore
    held_out: PartScore


Worths = tuple[dict[str, PredictionScore], dict[str, PredictionScore]]  # Of the fitted and the held-out part, by row


class FitVerdict(NamedTuple):
    """Whether the fit is proposed.

    `gain` is the mean on the held-out blocks, in nats per `each`, `error` its standard error, `reasons` those against
    it. `harmless` is whether no held-out prediction is worse, even without a gain.
    """

    proposed: bool
    gain: float
    error: float
    reasons: tuple[str, ...]
    each: str = "a reading"
    harmless: bool = False


def worths(estimator: str, settings: Sequence[Setting], recordings: Sequence[Recording], go: Go) -> list[Worth]:
    """Return the scores of each setting.

    Args:
        estimator: The filter.
        settings: Tunings and priors.
        recordings: With the truth, where it is known.
        go: Callback, see `Go`.

    Raises:
        Cancelled: If `go` returns False.
    """
    given = tuple(settings), tuple(recordings)
    found = worths_in_use(estimator, *given, go, Aim())
    return with_sensors(estimator, *given, found, range(len(found)), go)


def worths_in_use(
    estimator: str,
    settings: tuple[Setting, ...],
    recordings: tuple[Recording, ...],
    go: Go,
    aim: Aim,
    executor: Executor | str | None = "threads",
) -> list[Worth]:
    """Return the same without the sensors held out in turn, a fold of each recording."""
    work = partial(_in_use, estimator, settings, recordings, aim)
    folds, model = len(recordings), settings[0].tuning.model
    return each_folded(work, range(len(settings)), folds, estimator, model, executor=executor, go=go)


def with_sensors(
    estimator: str,
    settings: tuple[Setting, ...],
    recordings: tuple[Recording, ...],
    found: Sequence[Worth],
    wanted: Sequence[int],
    go: Go,
    executor: Executor | str | None = "threads",
) -> list[Worth]:
    """Return the scores `found` of the settings `wanted`, by index, with those of the sensors held out in turn.

    Each sensor takes a fold of each recording.
    """
    model = settings[0].tuning.model
    sensors = sensors_in_turn(settings[0], list(recordings))
    # An Executor of processes sends them once, whichever settings are wanted.
    work = partial(_in_turn, estimator, settings, recordings)
    items = [(k, s) for k in wanted for s in sensors]
    parts = iter(each_folded(work, items, len(recordings), estimator, model, executor=executor, go=go))
    completed = []
    for k in wanted:
        held: Worths = {}, {}
        for _ in sensors:
            for all_rows, rows in zip(held, next(parts), strict=True):
                all_rows.update(rows)
        completed.append(Worth(*(part._replace(sensors=rows) for part, rows in zip(found[k], held, strict=True))))
    return completed


def _in_use(estimator: str, settings: Sequence[Setting], recordings: Sequence[Recording], aim: Aim, k: int) -> Worth:
    """Return the scores of setting k without sensors in turn."""
    folded = [(record, track_of(estimator, settings[k], record)) for record in recordings]
    return Worth(*(_part(settings[k], folded, aim, part) for part in (False, True)))


def _in_turn(
    estimator: str, settings: Sequence[Setting], recordings: Sequence[Recording], item: tuple[int, int]
) -> Worths:
    """Return the scores of a sensor held out, by row, with setting k: on the fitted and on the held-out part."""
    k, s = item
    found: tuple[dict[str, list[Reference]], ...] = {}, {}
    for record in recordings:
        track = track_of(estimator, settings[k], record, without=s)
        for reference in held_out_references(settings[k].tuning.model, record.log.events, track, s):
            for group, part in zip(found, (False, True), strict=True):
                _collect(group, reference.finite(), record.held_out == part)
    fitted, held_out = ({name: _prediction(items) for name, items in group.items()} for group in found)
    return fitted, held_out


def gain(before: np.ndarray, after: np.ndarray) -> tuple[float, float]:
    """Return the mean of after less before (n,), and its standard error from batches of time: NaN of none."""
    difference = after - before
    n = difference.size
    if n == 0:
        return 0.0, np.nan
    if n < 2 * GAIN_BATCHES:
        return float(difference.mean()), float(difference.std() / np.sqrt(max(1, n - 1)))
    means = np.array([batch.mean() for batch in np.array_split(difference, GAIN_BATCHES)])
    return float(difference.mean()), float(means.std(ddof=1) / np.sqrt(GAIN_BATCHES))


def _part(setting: Setting, folded: list[tuple[Recording, Track]], aim: Aim, held_out: bool) -> PartScore:
    """Return the scores of the fitted or the held-out part of folded recordings, without sensors in turn."""
    model, gate = setting.tuning.model, setting.tuning.gate
    terms, aimed, normal, tracks = [], [], [], []
    # Withheld rows and true states: references by name.
    groups: tuple[dict[str, list[Reference]], ...] = ({}, {})
    for record, track in folded:
        log = record.log
        part = record.held_out == held_out
        reading, truth = log.events.kind == READING, log.events.kind == TRUTH
        terms.append(densities(track, gate)[part & reading])
        aimed.append(aim.fold_terms(log, track, setting)[part & (reading | truth)])
        used = part & (track.verdict == USED)
        normal.append((track.innovation[used] / track.innovation_std[used]).ravel())
        tracks.append(track.select(part))
        for item in references(model, log.events, track):
            _collect(groups[item.truth], item, part)
    every, inside = np.concatenate(terms), np.concatenate(normal)
    inside = inside[np.isfinite(inside)]
    nis = np.array([mean_nis(track, gate) for track in tracks])
    finite = np.isfinite(nis)
    weights = np.array([len(track) for track in tracks])[finite]
    withheld, states = ({name: _prediction(items) for name, items in group.items()} for group in groups)
    return PartScore(
        every.size,
        float(every.mean()) if every.size else np.nan,
        float(np.average(nis[finite], weights=weights)) if finite.any() else np.nan,
        float(np.mean(np.abs(inside) <= Z)) if inside.size else np.nan,
        every,
        np.concatenate(aimed),
        {},
        withheld,
        states,
        _correlations(setting, folded, held_out),
    )


def _collect(group: dict[str, list[Reference]], item: Reference, part: np.ndarray) -> None:
    """Add the errors of a reference at the events of a part (n,), if there are any."""
    kept = part[item.rows]
    if kept.any():
        group.setdefault(item.name, []).append(item._replace(error=item.error[kept], std=item.std[kept]))


def _correlations(setting: Setting, folded: list[tuple[Recording, Track]], held_out: bool) -> dict[str, float]:
    """Return the correlation of successive used innovations of each row, its mean over recordings by their length."""
    model, found = setting.tuning.model, {}
    for s, (sensor, start) in enumerate(zip(model.sensors, model.row_start, strict=True)):
        for k in range(len(sensor.rows)):
            series = []
            for record, track in folded:
                own = (track.verdict == USED) & (record.held_out == held_out) & (record.log.events.channel == s)
                e = track.innovation[own, k] / track.innovation_std[own, k]
                e = e[np.isfinite(e)]
                if e.size >= MIN_CORRELATED and np.ptp(e) > 0.0:
                    series.append((e.size, correlation_interval(e).value))
            if series:
                sizes, values = np.array(series).T
                found[model.row_names[start + k]] = float(np.average(values, weights=sizes))
    return found


def _prediction(items: list[Reference]) -> PredictionScore:
    error, std = np.concatenate([item.error for item in items]), np.concatenate([item.std for item in items])
    scores = crps(error, std)
    rms, coverage = float(np.sqrt(np.mean(error**2))), float(np.mean(np.abs(error) <= Z * std))
    return PredictionScore(items[0].unit, error.size, rms, coverage, float(scores.mean()), scores)


def verdict(before: Worth, after: Worth, aim: Aim, *, changed: bool = True) -> FitVerdict:
    """Judge by the held-out part: the aim of the fit must be better there, and nothing else worse."""
    one, other = before.held_out, after.held_out
    if not changed:
        few = (
            f": the true states and held-out sensors that --aim {aim.kind} weighs have {aim.independent:.0f} "
            "independent errors, and the measurements count no more"
            if aim.weights
            else ""
        )
        return FitVerdict(False, 0.0, 0.0, (f"the data identify none of the entries{few}",))
    if not one.n:
        return FitVerdict(False, np.nan, np.nan, ("no data were held out to judge the fit",))
    mean, error = _gain(one, other, aim)
    each = UNITS.get(aim.kind, "a reading")
    reasons = []
    if not mean > MIN_SIGMAS * error:
        unit = "of the score" if aim.kind in (CRPS, ERROR) else f"nats {each}"
        reasons.append(f"no better prediction of the held-out blocks: {mean:+.3g} ± {error:.2g} {unit}")
    elif aim.kind in UNITS and mean * other.aimed.size < MIN_TOTAL_GAIN:
        reasons.append(f"negligible gain: {mean * other.aimed.size:.2g} nats in total")
    # The references must not be predicted worse; without any, each sensor in turn stands in for them.
    groups = {"withheld": "sensor", "states": "true state"} if _has_references(before) else {"sensors": "sensor"}
    against = [
        reason
        for group, kind in groups.items()
        for name, old, new in _pairs(one, other, group)
        for reason in _against(f"held-out {kind} {name}", old, new)
    ]
    reasons += against
    return FitVerdict(not reasons, mean, error, tuple(reasons), each, not against)


def _has_references(worth: Worth) -> bool:
    """Return whether the held-out part has true states, or sensors that the twin never uses."""
    return bool(worth.held_out.withheld or worth.held_out.states)


def _pairs(one: PartScore, other: PartScore, group: str) -> list[tuple[str, PredictionScore, PredictionScore]]:
    """Return the predictions of a group, such as `states`, that two parts share, by name."""
    olds, news = getattr(one, group), getattr(other, group)
    return [(name, olds[name], news[name]) for name in olds if name in news]


def _gain(one: PartScore, other: PartScore, aim: Aim) -> tuple[float, float]:
    """Return the gain in the aim of the fit, and its standard error."""
    if aim.kind not in (CRPS, ERROR):
        return gain(one.aimed, other.aimed)
    pairs = [(old.scores / old.crps, other.sensors[name].scores / old.crps) for name, old in one.sensors.items()]
    found = [gain(-old, -new) for old, new in pairs if old.size == new.size]
    if not found:
        return 0.0, 0.0
    means, errors = np.array(found).T
    return float(means.mean()), float(np.sqrt(np.sum(errors**2)) / len(found))


def _against(what: str, old: PredictionScore, new: PredictionScore) -> list[str]:
    if old.n != new.n:
        return [f"{what}: {abs(old.n - new.n)} readings could not be predicted"]
    return [*worse(what, old, new), *narrower(what, old, new)]


def worse(what: str, old: PredictionScore, new: PredictionScore) -> Iterator[str]:
    """Yield the reason against a prediction whose score is worse beyond chance."""
    mean, error = gain(old.scores, new.scores)
    if mean > MAX_LOSS * old.crps and mean > MIN_SIGMAS * error:
        unit = f" {new.unit}" if new.unit else ""
        yield f"{what} is predicted worse: CRPS {new.crps:.3g}{unit} after {old.crps:.3g}"


def narrower(what: str, old: PredictionScore, new: PredictionScore) -> Iterator[str]:
    """Yield the reason against a prediction whose band is too narrow, and narrower than before."""
    if new.coverage < MIN_COVERAGE and new.coverage < old.coverage - MAX_COVERAGE_LOSS:
        yield f"{what} leaves its band: {100 * new.coverage:.0f} % inside after {100 * old.coverage:.0f} %"


POWERS = tuple(0.25**k for k in range(9))  # Powers to try: at the last, 65,536 measurements count as one


class Tempered(NamedTuple):
    """The chosen power, its point x (k,) and covariance (k, k), and the scores before and after."""

    power: float
    x: np.ndarray
    cov: np.ndarray
    before: Worth
    after: Worth
    verdict: FitVerdict


def tempered(
    objective: Objective,
    x: np.ndarray,
    shape: LikelihoodCurvature,
    setting: Callable[[np.ndarray], Setting],
    recordings: Sequence[Recording],
    *,
    powers: Sequence[float] = POWERS,
) -> Tempered:
    """Choose the power.

    Sensors are held out in turn only where that can decide: their folds are most of the cost.

    Args:
        objective: The objective.
        x: Its maximum, (k,).
        shape: Its curvature there.
        setting: Setting to fold at a point.
        recordings: With the truth, where it is known.
        powers: Powers to try, from 1 on, falling.
    """
    aim, estimator, go = objective.aim, objective.estimator, objective.go
    points = [at_power(objective, x, shape, power) for power in powers]
    settings = (setting(objective.start), *(setting(point) for point, _ in points))
    given = settings, tuple(recordings)
    found = worths_in_use(estimator, *given, go, aim, objective.executor)
    complete: set[int] = set()

    def complete_those(wanted: Sequence[int]) -> None:
        missing = [k for k in wanted if k not in complete]
        complete.update(missing)
        more = with_sensors(estimator, *given, found, missing, go, objective.executor)
        for k, worth in zip(missing, more, strict=True):
            found[k] = worth

    def judged(k: int) -> FitVerdict:
        return verdict(found[0], found[1 + k], aim, changed=x.size > 0)

    def harmless(k: int) -> bool:
        # Without sensors in turn there are fewer reasons against it.
        if judged(k).harmless and not _has_references(found[0]):
            complete_those((0, 1 + k))
        return judged(k).harmless

    if aim.kind in (CRPS, ERROR) or (aim.kind == WITNESSES and not _has_references(found[0])):
        complete_those(range(len(found)))
    if aim.kind == LIKELIHOOD:
        k = _largest_harmless(found[1:], [judged(k).gain for k in range(len(points))], harmless)
    else:
        k = _chosen(found[0], found[1:], [judged(k) for k in range(len(points))], aim)
    complete_those((0, 1 + k))
    return Tempered(powers[k], *points[k], found[0], found[1 + k], judged(k))


def at_power(
    objective: Objective, x: np.ndarray, shape: LikelihoodCurvature, power: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the maximum (k,) at a power, and its covariance (k, k)."""
    if power == 1.0 or not x.size:
        return x, shape.cov
    H = np.linalg.inv(shape.cov)
    start = objective.start
    cov = np.linalg.inv(power * H + (1.0 - power) * np.diag(objective.precision))
    return objective.within(start + cov @ (power * H @ (x - start))), cov


def _largest_harmless(others: Sequence[Worth], gains: Sequence[float], harmless: Callable[[int], bool]) -> int:
    """Return the index of the largest harmless power that is as good as the best; 0 (power 1) if none is harmless.

    All harmless fits qualify, since a proposed one may win by chance when several powers are tried.
    """
    best = next((k for k in sorted(range(len(gains)), key=lambda k: -gains[k]) if harmless(k)), 0)
    return next((k for k in range(len(gains)) if _as_good(others[k], others[best]) and harmless(k)), 0)


def _chosen(own: Worth, others: Sequence[Worth], verdicts: Sequence[FitVerdict], aim: Aim) -> int:
    """Return the index of a power with which the fit is proposed; 0 (power 1, whose reasons are reported) if none."""
    qualified = [k for k, item in enumerate(verdicts) if item.proposed]
    qualified = [k for k in qualified if _in_band(own, others[k])] or qualified
    best = max(qualified, key=lambda k: verdicts[k].gain, default=0)
    return next((k for k in reversed(qualified) if _as_good(others[k], others[best])), 0) if aim.weights else best


def _as_good(one: Worth, best: Worth) -> bool:
    """Return whether a prediction of the held-out blocks is within chance of the best."""
    less, error = gain(one.held_out.aimed, best.held_out.aimed)
    return less <= MIN_SIGMAS * error


def _in_band(own: Worth, other: Worth) -> bool:
    """Return whether the bands of all references, fitted and held out, are wide enough or no narrower."""
    return all(
        new.coverage >= min(MIN_COVERAGE, old.coverage)
        for one, two in zip(own, other, strict=True)
        for group in ("withheld", "states")
        for _, old, new in _pairs(one, two, group)
    )
