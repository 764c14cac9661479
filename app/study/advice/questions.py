"""Questions of the decision tree: each is answered by a figure measured on the log."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from config.tunings import named
from estimators.diagnostics.calibration import LIMITS, Calibration, calibrations
from estimators.diagnostics.score import nis_verdict
from estimators.diagnostics.sensitivity.checklist import DIFFERENCE_QUANTILE, MAX_PROCESSOR_SHARE, Linearity
from estimators.diagnostics.sensitivity.gramian import MAX_PRIOR_LEFT
from estimators.diagnostics.sensitivity.posterior import FAR_SIGMA, FREQUENT_SHARE, HEAVY_KURTOSIS, MOST_STATES
from estimators.diagnostics.sensitivity.posterior import tails as measure_tails
from estimators.errors import EstimatorError, NisusError
from estimators.fold import Fold
from estimators.log import READING
from estimators.model.state_space import LARGE
from estimators.registry import checked, find_entry, unfit

from ...format_time import counted
from .measured import (
    NO,
    UNTOLD,
    YES,
    Claim,
    Measured,
    apart_text,
    bytes_text,
    digits,
    likelihood_of,
    percent,
    seconds_text,
)

Options = dict[str, float] | None

STEADY = "kf-steady"
PREFERRED = ("ensrf", "letkf", "etkf", "enkf")  # of large states: those that localise and draw no perturbations first

JUMPS = "the asset jumps, not the sensor; weights would reject good measurements"
EXACT = 1e-9  # difference in σ of two filters on a linear model, by rounding
PERIOD_TOLERANCE = 0.01  # share of the period by which the time between two readings may differ from it
MAX_UNEVEN_SHARE = 0.001  # share of the intervals that may differ: a fixed gain cannot follow lost or late measurements
MAX_LARGER_INNOVATION = 0.01  # share by which weights may increase the mean innovation; more where the asset jumps
MIN_DOF = 3.0  # of Student's t, below which it hardly has a variance; its kurtosis is finite above 4
OPERATIONS_PER_S = 1e9  # order of magnitude for one processor in small dense matrices

MEMBERS = (20.0, 40.0, 80.0)
RADIUS_SHARES = (0.05, 0.1, 0.2, 0.4)  # radii that are tried, as shares of the extent of the field
INFLATIONS = (1.0, 1.02, 1.05, 1.1)
LIKELIHOOD_MARGIN = 0.01  # nats per value; of options closer than this the cheapest is taken
SWEEP_BUDGET_S = 2.0  # seconds of one processor for each fold of the sweep

FILTERS_APART = "σ between ekf and ukf (95th percentile)"


@dataclass(frozen=True)
class Question:
    """Question of the tree, with the threshold of its figure and what both measure."""

    key: str
    text: str
    threshold: float
    of: str

    def claim(
        self,
        answer: str,
        figure: float | None,
        reason: str,
        remedy: str = "",
        *,
        threshold: float | None = None,
        of: str = "",
    ) -> Claim:
        """Return an answer; `threshold` and `of` replace those of the question."""
        limit = self.threshold if threshold is None else threshold
        return Claim(self.key, self.text, answer, figure, limit, of or self.of, reason, remedy)


CONSISTENT = Question(
    "consistent", "Are the innovations white and as large as predicted?", 1.0, "mean NIS per degree of freedom"
)
CURVATURE = Question(
    "curvature", "Is the curvature of f and h significant over the spread of the estimate?", LIMITS.bias, FILTERS_APART
)
OBSERVED = Question(
    "observed",
    "Is every state observable?",
    MAX_PRIOR_LEFT,
    "of its prior deviation left to the least observable state",
)
LINEAR = Question("linear", "Are f and h linear?", EXACT, FILTERS_APART)
REGULAR = Question(
    "steady",
    "Is it time-invariant, with regular measurements and no dropouts?",
    MAX_UNEVEN_SHARE,
    "of the intervals between readings off the period by more than 1 %",
)
PEAKS = Question(
    "peaks",
    "Does the posterior have several peaks?",
    FREQUENT_SHARE,
    "of the samples of the particle cloud with several peaks",
)
TAILS = Question("tails", "Are the innovations heavy-tailed?", HEAVY_KURTOSIS, "excess kurtosis of the innovations")
SIZE = Question("size", "Does the state dimension suit a full covariance at this rate?", float(LARGE), "states")
COST = Question("cost", "Is it fast enough for the asset?", MAX_PROCESSOR_SHARE, "of one processor")
QUESTIONS = (CONSISTENT, CURVATURE, OBSERVED, LINEAR, REGULAR, PEAKS, TAILS, SIZE, COST)


def used_rows(fold: Fold) -> list[Calibration]:
    """Return the calibration of the sensor rows in use."""
    found = calibrations(
        fold.model, fold.log.events, fold.track, gate=fold.tuning.gate, marginal=fold.marginal, limits=LIMITS
    )
    return [entry for entry in found if entry.role == "used"]


def correlated_rows(rows: Sequence[Calibration]) -> list[Calibration]:
    """Return the rows whose innovations are correlated beyond the limit."""
    return [entry for entry in rows if entry.correlation.beyond(-LIMITS.correlation, LIMITS.correlation)]


def consistent(measured: Measured, estimator: str, options: Options = None) -> Claim:
    """Check the chosen filter by mean NIS, and by scale and correlation of each row with their intervals."""
    fold = measured.folded(estimator, options).fold
    verdict = nis_verdict(fold.track, fold.log.events, fold.model, fold.tuning.baseline)
    nis = verdict.ratio
    if not np.isfinite(nis):
        return CONSISTENT.claim(UNTOLD, None, "no reading was used")
    rows = [entry for entry in used_rows(fold) if np.isfinite(entry.scale.high)]
    if not rows:
        return CONSISTENT.claim(UNTOLD, nis, "no row has enough readings for an interval")
    wide = 1.0 + LIMITS.width
    size, related = [entry for entry in rows if entry.scale.beyond(1.0 / wide, wide)], correlated_rows(rows)
    reason = f"{estimator}: {verdict.words}"
    if not size and not related:
        reason += f"; every band is right within a quarter, and no correlation is beyond {LIMITS.correlation:g}"
        return CONSISTENT.claim(YES, nis, f"{reason} ({counted(len(rows), 'row')})")
    remedies = []
    if size:
        one = max(size, key=lambda entry: abs(np.log(entry.scale.value)))
        reason += f"; bands of {one.subject} should be {digits(one.scale.value)} times as wide"
        remedies.append(f"noises are off: nisus tune {named(measured.twin.path)} fits Q and R to the log")
    if related:
        one = max(related, key=lambda entry: abs(entry.correlation.value))
        reason += f"; successive innovations of {one.subject} are correlated by {one.correlation.value:+.2f}"
        more = "too little Q, or a state is missing"
        remedies.append(more if one.correlation.value > 0.0 else "too much Q against R")
    return CONSISTENT.claim(NO, nis, reason, "; ".join(remedies))


def worst(found: Linearity) -> tuple[str, float, str]:
    """Return the state or sensor row in which EKF and UKF differ most, by how much, σ, and both in words."""
    name, _, apart = max((*found.states, *found.rows), key=lambda item: item.most)
    return name, apart, f"ekf and ukf agree to within {apart_text(apart)} (95th percentile; largest for {name})"


def curvature(measured: Measured) -> Claim:
    """Compare EKF and UKF along the log, in σ, and their likelihoods."""
    found = measured.linearity
    if found.reason:
        return CURVATURE.claim(UNTOLD, None, found.reason)
    name, apart, reason = worst(found)
    if not np.isfinite(apart):
        reason = f"ekf loses {name} where ukf does not"
    gain = measured.likelihood("ukf") - measured.likelihood("ekf")
    if np.isfinite(gain) and gain > 0.0:
        reason += f"; the likelihood of ukf is higher by {digits(gain)} nats per measurement"
    return CURVATURE.claim(YES if apart > LIMITS.bias else NO, apart, reason)


def observed(measured: Measured) -> Claim:
    """Find the state that keeps most of its prior deviation after all measurements, by the Gramian of the log."""
    found, model = measured.gramian, measured.twin.model
    if found.whole is None or found.whole.beyond:
        return OBSERVED.claim(UNTOLD, None, found.reason if found.whole is None else found.note)
    free = np.flatnonzero(model.prior_std > 0.0)
    if not free.size:
        return OBSERVED.claim(YES, 0.0, "every state is certain at first")
    left = found.whole.left[free]
    name, most = model.state_names[int(free[np.argmax(left)])], float(left.max())
    reason = (
        f"after all readings {name} keeps {percent(most)} of its prior deviation, the most of all states; "
        f"the Gramian has {found.whole.summary}"
    )
    names = ", ".join(found.whole.unobserved(model))
    if not names:
        return OBSERVED.claim(YES, most, reason)
    remedy = (
        f"no filter recovers {names}: add a sensor that it moves, or take it out of the state; until then it keeps its "
        f"prior and drifts, and its band is all that is known of it"
    )
    return OBSERVED.claim(NO, most, f"{reason}; not seen: {names}", remedy)


def sweep(measured: Measured, estimator: str) -> tuple[list[Claim], dict[str, float]]:
    """Choose radius, inflation and number of members, one after another; return claims and options."""
    options: dict[str, float] = {"members": MEMBERS[1]}
    claims = []
    if radii := _radii(measured, estimator):
        claims.append(_best(measured, estimator, options, "radius", radii, "Which localisation radius suits?"))
    if any(option.name == "inflation" for option in find_entry(estimator).options):
        question = "How much inflation does it need?"
        claims.append(_best(measured, estimator, options, "inflation", INFLATIONS, question))
    claims.append(_best(measured, estimator, options, "members", MEMBERS, "How many members does it need?"))
    return claims, options


def _best(
    measured: Measured, estimator: str, options: dict[str, float], name: str, values: Sequence[float], question: str
) -> Claim:
    """Try values of one option, and take the first within the margin of the best.

    Likelihoods are the means of a value over the events that all folds reached within the budget.
    """
    folds: list[Fold | None] = []
    for value in values:
        try:
            folds.append(measured.folded(estimator, {**options, name: value}, SWEEP_BUDGET_S).fold)
        except NisusError:
            folds.append(None)
    n = min((fold.n for fold in folds if fold is not None), default=0)
    model = measured.twin.model
    rows = max(len(sensor.rows) for sensor in model.sensors)
    found = [-np.inf if fold is None else likelihood_of(fold, n) / rows for fold in folds]
    of = f"{name} of {estimator}, the most likely within {LIKELIHOOD_MARGIN:g} nats a value"
    if not np.any(np.isfinite(found)):
        return Claim(name, question, UNTOLD, None, None, of, f"{estimator} fails with every {name}")
    best = float(np.max([nats for nats in found if np.isfinite(nats)]))
    chosen = next(value for value, nats in zip(values, found, strict=True) if nats >= best - LIKELIHOOD_MARGIN)
    options[name] = chosen
    table = ", ".join(f"{digits(value)}: {nats:.3f}" for value, nats in zip(values, found, strict=True))
    reason = f"log-likelihood a value of a reading, by {name}: {table}"
    if name == "members":
        reason += (
            f"; two independent states appear correlated by 1 / √{chosen:.0f} = {1.0 / np.sqrt(chosen):.2f} by chance, "
            f"and {chosen:.0f} × {model.nx:,} × 8 B = {bytes_text(8.0 * chosen * model.nx)}"
        )
    return Claim(name, question, YES, chosen, best, of, reason)


def _radii(measured: Measured, estimator: str) -> list[float]:
    """Return radii to try as shares of the largest extent; none if the filter has none or positions are unknown."""
    model, entry = measured.twin.model, find_entry(estimator)
    places = model.positions()
    if places is None or all(option.name != "radius" for option in entry.options):
        return []
    extent = float(np.max(np.ptp(places, axis=0)))
    try:
        checked(entry, model, {"radius": extent})
    except EstimatorError:  # the sensors have no places
        return []
    return [share * extent for share in RADIUS_SHARES]


def linear(measured: Measured) -> Claim:
    """Check by the model's declaration, or by the effect of linearisation along the log."""
    found, model = measured.linearity, measured.twin.model
    if found.reason:
        if model.linear:
            return LINEAR.claim(YES, None, "declared by the model: linear=True")
        return LINEAR.claim(UNTOLD, None, found.reason)
    _, apart, reason = worst(found)
    if model.linear:
        return LINEAR.claim(YES, apart, f"declared by the model (linear=True), and {reason}")
    if apart <= EXACT:
        remedy = "set linear=True in the model; kf then computes F once, ekf at every step"
        return LINEAR.claim(YES, apart, f"{reason}, which is rounding", remedy)
    return LINEAR.claim(NO, apart, reason)


def steady(measured: Measured) -> tuple[Claim, float]:
    """Check whether a fixed gain suffices, and return its period: time-invariant, one sensor, regular measurements."""
    model, log = measured.twin.model, measured.log
    against = unfit(find_entry(STEADY), model)
    if against:
        return REGULAR.claim(NO, None, f"{STEADY} does not apply: {against}"), 0.0
    value = log.events.value[:, : len(model.sensors[0].rows)]
    complete = (log.events.kind == READING) & np.isfinite(value).all(axis=1)
    intervals = np.diff(log.events.t[complete]) * 1e-9
    if not intervals.size:
        return REGULAR.claim(UNTOLD, None, "the log has one reading"), 0.0
    period = float(np.median(intervals))
    uneven = float(np.mean(np.abs(intervals - period) > PERIOD_TOLERANCE * period))
    reason = f"{model.sensor_names[0]} reads every {digits(period)} s, with {percent(uneven)} of the intervals off"
    if uneven > MAX_UNEVEN_SHARE:
        return REGULAR.claim(NO, uneven, f"{reason}: the gain has to follow them"), period
    try:
        one, other = (measured.folded(*given).fold.track for given in ((STEADY, {"period": period}), ("kf", {})))
    except EstimatorError as error:
        return REGULAR.claim(NO, uneven, str(error)), period
    with np.errstate(all="ignore"):
        share = np.abs(one.mean - other.mean) / other.std
    far = float(np.nanquantile(np.nanmax(share, axis=1), DIFFERENCE_QUANTILE))
    reason += f"; {STEADY} and kf agree to within {apart_text(far)} (95th percentile), limit {LIMITS.bias:g}"
    of = f"σ between {STEADY} and kf (95th percentile)"
    return REGULAR.claim(YES if far <= LIMITS.bias else NO, far, reason, threshold=LIMITS.bias, of=of), period


def several(measured: Measured) -> Claim:
    """Check the share of samples in which two particle clouds both have more than one peak."""
    model = measured.twin.model
    if model.linear and model.jump is None and not any(sensor.log_likelihood for sensor in model.sensors):
        reason = "f and h are linear and the noise is Gaussian, so the posterior is Gaussian"
        return PEAKS.claim(NO, 0.0, reason)
    if model.nx > MOST_STATES:
        return PEAKS.claim(
            UNTOLD,
            None,
            f"{model.nx:,} states: the number of particles needed grows exponentially, so a cloud cannot answer this "
            f"beyond {MOST_STATES}",
        )
    found = measured.peaks
    if found.reason:
        return PEAKS.claim(UNTOLD, None, found.reason)
    reason = f"{percent(found.several)} of {found.looks} samples of clouds of {found.estimator} over {found.over:.4g} s"
    if found.recoveries:
        reason += f"; the cloud lost the asset {found.recoveries} time(s), so its shape is not reliable"
        return PEAKS.claim(UNTOLD, found.several, reason)
    reason += f", at most {found.most} peak{'s' if found.most > 1 else ''} at once"
    return PEAKS.claim(YES if found.several > FREQUENT_SHARE else NO, found.several, reason)


def heavy(measured: Measured, estimator: str, options: Options = None) -> tuple[Claim, float]:
    """Check the excess kurtosis of the innovations, and return the degrees of freedom of a Student's t with as much.

    Source: the excess kurtosis of Student's t is 6 / (ν - 4), so ν = 4 + 6 / κ.
    """
    fold = measured.folded(estimator, options).fold
    track = fold.track
    found = measure_tails(measured.twin.model, fold.log, track, marginal=fold.marginal)
    if not found:
        return TAILS.claim(UNTOLD, None, "no row has enough readings"), np.inf
    worst = max(found, key=lambda tail: tail.kurtosis)
    reason = (
        f"{worst.row} has excess kurtosis {digits(worst.kurtosis)} and {percent(worst.far)} of its {worst.n:,} "
        f"innovations beyond {FAR_SIGMA:g} σ, the most of {len(found)} rows of {estimator}"
    )
    # A few of many rows have heavy tails by chance.
    if sum(tail.heavy for tail in found) <= FREQUENT_SHARE * len(found):
        return TAILS.claim(NO, worst.kurtosis, reason), np.inf
    if any(entry.subject == worst.row for entry in correlated_rows(used_rows(fold))):
        reason += "; they are also correlated, which points to model errors; weights would reject good measurements"
        return TAILS.claim(NO, worst.kurtosis, reason), np.inf
    # Two digits: more would differ each time the advice is applied and repeated.
    dof = float(f"{max(MIN_DOF, 4.0 + 6.0 / worst.kurtosis):.2g}")
    reason += f"; Student's t with 4 + 6 / κ = {digits(dof)} degrees of freedom has as heavy ones"
    weighing, weighted = with_weights(estimator, dof)
    if not weighted:
        return TAILS.claim(YES, worst.kurtosis, f"{reason}; {estimator} cannot weigh"), dof
    other = measured.folded(weighing, weighted).fold.track
    both = np.isfinite(track.innovation) & np.isfinite(other.innovation)
    scale = np.where(both, np.nanmedian(np.abs(track.innovation), axis=0), 1.0)
    before, after = (float(np.mean(np.abs(one.innovation / scale)[both])) for one in (track, other))
    change = after / before - 1.0
    reason += f"; weighted so, the innovations are {100 * abs(change):.2g} % {'larger' if change > 0 else 'smaller'}"
    if change > MAX_LARGER_INNOVATION:
        reason += f": {JUMPS}"
        return TAILS.claim(NO, worst.kurtosis, reason), np.inf
    return TAILS.claim(YES, worst.kurtosis, reason), dof


def with_weights(estimator: str, dof: float) -> tuple[str, dict[str, float]]:
    """Return the filter with Student's t and its options, none if it has none; kf replaces a fixed gain."""
    name = "kf" if estimator == STEADY else estimator
    entry = find_entry(name)
    if all(option.name != "robust" for option in entry.options):
        return name, {}
    weighted: Mapping[str, float | str] = {"robust": "student-t", "dof": dof}
    return name, {key: value for key, value in entry.complete(weighted).items() if key in weighted}


def small(measured: Measured) -> Claim:
    """Check whether 4 n³ + 6 m n² operations per measurement, and 8 n² bytes, are affordable.

    4 n³ are those of F P Fᵀ, 6 m n² those of the update with m rows.
    """
    model, rate = measured.twin.model, measured.rate
    n, m = model.nx, max(len(sensor.rows) for sensor in model.sensors)
    flops = 4.0 * n**3 + 6.0 * m * n**2
    share = rate * flops / OPERATIONS_PER_S
    reason = (
        f"{counted(n, 'state')}: a covariance takes {bytes_text(8.0 * n**2)} and 4 n³ + 6 m n² = {digits(flops)} "
        f"operations a reading of m = {counted(m, 'row')}; at {digits(rate)} readings a second that is "
        f"{digits(100 * share)} % of a processor of {digits(OPERATIONS_PER_S)} operations a second"
    )
    if n > LARGE:
        return SIZE.claim(NO, float(n), f"{reason}; beyond {LARGE:,} states no filter here forms one")
    if share <= MAX_PROCESSOR_SHARE:
        return SIZE.claim(YES, float(n), reason)
    return SIZE.claim(NO, share, reason, threshold=MAX_PROCESSOR_SHARE, of="of a processor for a covariance")


def affordable(measured: Measured, estimator: str, options: Options = None) -> Claim:
    """Check the measured time per measurement."""
    folded = measured.folded(estimator, options)
    share = folded.seconds * measured.rate
    runs = find_entry(estimator).runs(folded.fold.options, measured.twin.model.nx)
    reason = (
        f"{estimator} took {seconds_text(folded.seconds)} a reading ({digits(runs)} model runs a step); times "
        f"{digits(measured.rate)} readings a second that is {percent(share)} of a processor"
    )
    if share <= MAX_PROCESSOR_SHARE:
        return COST.claim(YES, share, reason)
    remedy = "fewer readings, fewer members, or a simpler filter: time.late and decimation are for the edge"
    return COST.claim(NO, share, reason, remedy)
