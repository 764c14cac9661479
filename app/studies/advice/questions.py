"""Questions of the decision tree: each is answered by a figure measured on the log."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from config.tunings import named
from estimators.diagnostics.calibration import LIMITS, calibrations
from estimators.diagnostics.innovations import mean_nis
from estimators.diagnostics.sensitivity.checklist import DIFFERENCE_QUANTILE, Linearity
from estimators.diagnostics.sensitivity.posterior import FAR_SIGMA, FREQUENT_SHARE, HEAVY_KURTOSIS, MOST_STATES, Tail
from estimators.diagnostics.sensitivity.posterior import tails as measure
from estimators.errors import EstimatorError, NisusError
from estimators.fold import Fold
from estimators.log import READING
from estimators.model.state_space import LARGE
from estimators.registry import checked, find_entry, unfit

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

CONSISTENT_QUESTION = "Are the innovations white and as large as predicted?"
CONSISTENT_OF = "mean NIS per degree of freedom"


def consistent(measured: Measured, estimator: str, options: dict[str, float] | None = None) -> Claim:
    """Check the chosen filter by mean NIS, and by scale and correlation of each row with their intervals."""
    twin = measured.twin
    fold = measured.folded(estimator, options).fold
    nis = mean_nis(fold.track, fold.tuning.gate)
    if not np.isfinite(nis):
        return Claim("consistent", CONSISTENT_QUESTION, UNTOLD, None, 1.0, CONSISTENT_OF, "no reading was used")
    found = calibrations(
        twin.model, fold.log.events, fold.track, gate=fold.tuning.gate, marginal=fold.marginal, limits=LIMITS
    )
    rows = [entry for entry in found if entry.role == "used" and np.isfinite(entry.scale.high)]
    if not rows:
        return Claim(
            "consistent",
            CONSISTENT_QUESTION,
            UNTOLD,
            nis,
            1.0,
            CONSISTENT_OF,
            "no row has enough readings for an interval",
        )
    wide = 1.0 + LIMITS.width
    size = [entry for entry in rows if entry.scale.beyond(1.0 / wide, wide)]
    related = [entry for entry in rows if entry.correlation.beyond(-LIMITS.correlation, LIMITS.correlation)]
    reason = f"{estimator}: mean NIS {digits(nis)} per degree of freedom"
    if not size and not related:
        reason += (
            f"; every band is right within a quarter, and no correlation is beyond {LIMITS.correlation:g} "
            f"({len(rows)} row{'s' if len(rows) > 1 else ''})"
        )
        return Claim("consistent", CONSISTENT_QUESTION, YES, nis, 1.0, CONSISTENT_OF, reason)
    remedies = []
    if size:
        one = max(size, key=lambda entry: abs(np.log(entry.scale.value)))
        reason += f"; bands of {one.subject} should be {digits(one.scale.value)} times as wide"
        remedies.append(f"noises are off: nisus tune {named(twin.path)} fits Q and R to the log")
    if related:
        one = max(related, key=lambda entry: abs(entry.correlation.value))
        reason += f"; successive innovations of {one.subject} are correlated by {one.correlation.value:+.2f}"
        remedies.append(
            "too little Q, or a state is missing" if one.correlation.value > 0.0 else "too much Q against R"
        )
    return Claim("consistent", CONSISTENT_QUESTION, NO, nis, 1.0, CONSISTENT_OF, reason, "; ".join(remedies))


def curvature(measured: Measured) -> Claim:
    """Compare EKF and UKF along the log, in σ, and their likelihoods."""
    question = "Is the curvature of f and h significant over the spread of the estimate?"
    found = measured.linearity
    if found.reason:
        return Claim("curvature", question, UNTOLD, None, LIMITS.bias, FILTERS_APART, found.reason)
    name, apart = worst(found)
    reason = f"ekf and ukf agree to within {apart_text(apart)} (95th percentile; largest for {name})"
    if not np.isfinite(apart):
        reason = f"ekf loses {name} where ukf does not"
    return Claim(
        "curvature",
        question,
        YES if apart > LIMITS.bias else NO,
        apart,
        LIMITS.bias,
        FILTERS_APART,
        reason + _gain(measured),
    )


def _gain(measured: Measured) -> str:
    """Return the gain in likelihood of the unscented filter, in words."""
    one, other = (measured.likelihood(name) for name in ("ekf", "ukf"))
    if not (np.isfinite(one) and np.isfinite(other)):
        return ""
    return f"; the likelihood of ukf is higher by {digits(other - one)} nats per measurement" if other > one else ""


MAX_PRIOR_LEFT = 0.9  # share of the prior deviation; a state that keeps more was not observed


def observed(measured: Measured) -> Claim:
    """Find the state that keeps most of its prior deviation after all measurements, by the Gramian of the log."""
    question = "Is every state observable?"
    of = "of its prior deviation left to the least observable state"
    found, model = measured.gramian, measured.twin.model
    if found.whole is None:
        return Claim("observed", question, UNTOLD, None, MAX_PRIOR_LEFT, of, found.reason)
    if found.whole.beyond:
        return Claim("observed", question, UNTOLD, None, MAX_PRIOR_LEFT, of, found.note)
    free = np.flatnonzero(model.prior_std > 0.0)
    if not free.size:
        return Claim("observed", question, YES, 0.0, MAX_PRIOR_LEFT, of, "every state is certain at first")
    left = found.whole.deviation[free]
    worst, most = model.state_names[int(free[np.argmax(left)])], float(left.max())
    unseen = [model.state_names[int(k)] for k in free[left > MAX_PRIOR_LEFT]]
    reason = (
        f"after all readings {worst} keeps {percent(most)} of its prior deviation, the most of all states; the Gramian "
        f"has rank {found.whole.rank} of {model.nx} and conditioning {digits(found.whole.conditioning)}"
    )
    if not unseen:
        return Claim("observed", question, YES, most, MAX_PRIOR_LEFT, of, reason)
    names = ", ".join(unseen)
    remedy = (
        f"no filter recovers {names}: add a sensor that it moves, or take it out of the state; until then it keeps its "
        f"prior and drifts, and its band is all that is known of it"
    )
    return Claim("observed", question, NO, most, MAX_PRIOR_LEFT, of, f"{reason}; not seen: {names}", remedy)


PREFERRED = ("ensrf", "letkf", "etkf", "enkf")
"""Filters of large states, the first that applies is taken: those that localise and draw no perturbations first."""

MEMBERS = (20.0, 40.0, 80.0)
RADIUS_SHARES = (0.05, 0.1, 0.2, 0.4)  # radii that are tried, as shares of the extent of the field

INFLATIONS = (1.0, 1.02, 1.05, 1.1)

LIKELIHOOD_MARGIN = 0.01  # nats per value; of options closer than this the cheapest is taken
SWEEP_BUDGET_S = 2.0  # seconds of one processor for each fold of the sweep


def sweep(measured: Measured, estimator: str) -> tuple[list[Claim], dict[str, float]]:
    """Choose radius, inflation and number of members, one after another; return claims and options."""
    options: dict[str, float] = {"members": MEMBERS[1]}
    has = {option.name for option in find_entry(estimator).options}
    claims = []
    if radii := _radii(measured, estimator):
        claims.append(_best(measured, estimator, options, "radius", radii, "What is the localisation radius?"))
    if "inflation" in has:
        values = list(INFLATIONS)
        claims.append(_best(measured, estimator, options, "inflation", values, "How much inflation does it need?"))
    claims.append(_best(measured, estimator, options, "members", list(MEMBERS), "How many members does it need?"))
    return claims, options


def _best(
    measured: Measured, estimator: str, options: dict[str, float], name: str, values: list[float], question: str
) -> Claim:
    """Try values of one option, and take the first within the margin of the best."""
    found = _likelihoods(measured, estimator, [{**options, name: value} for value in values])
    of = f"{name} of {estimator}, the likeliest within {LIKELIHOOD_MARGIN:g} nats a value"
    if not np.any(np.isfinite(found)):
        return Claim(name, question, UNTOLD, None, None, of, f"{estimator} fails with every {name}")
    best = float(np.nanmax([value if np.isfinite(value) else np.nan for value in found]))
    chosen = next(value for value, nats in zip(values, found, strict=True) if nats >= best - LIKELIHOOD_MARGIN)
    options[name] = chosen
    table = ", ".join(f"{digits(value)}: {nats:.3f}" for value, nats in zip(values, found, strict=True))
    reason = f"log-likelihood a value of a reading, by {name}: {table}"
    if name == "members":
        n = measured.twin.model.nx
        reason += (
            f"; two independent states appear correlated by 1 / √{chosen:.0f} = "
            f"{1.0 / np.sqrt(chosen):.2f} by chance, and {chosen:.0f} × {n:,} × 8 B = {bytes_text(8.0 * chosen * n)}"
        )
    return Claim(name, question, YES, chosen, best, of, reason)


def _likelihoods(measured: Measured, estimator: str, tried: list[dict[str, float]]) -> list[float]:
    """Return the mean log-likelihood of a value over the events that all folds reached within the budget."""
    folds: list[Fold | None] = []
    for options in tried:
        try:
            folds.append(measured.folded(estimator, options, SWEEP_BUDGET_S).fold)
        except NisusError:
            folds.append(None)
    n = min((fold.n for fold in folds if fold is not None), default=0)
    rows = max(len(sensor.rows) for sensor in measured.twin.model.sensors)
    return [-np.inf if fold is None else likelihood_of(fold, n) / rows for fold in folds]


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


STEADY = "kf-steady"

FILTERS_APART = "σ between ekf and ukf (95th percentile)"

EXACT = 1e-9  # difference in σ of two filters on a linear model, by rounding
PERIOD_TOLERANCE = 0.01  # share of the period by which the time between two readings may differ from it
MAX_UNEVEN_SHARE = 0.001  # share of the intervals that may differ: a fixed gain cannot follow lost or late measurements


def worst(found: Linearity) -> tuple[str, float]:
    """The state or sensor row in which the linearised and the unscented filter are farthest apart; how far, σ."""
    most = max((*found.states, *found.rows), key=lambda item: item.most)
    return most.name, most.most


def linear(measured: Measured) -> Claim:
    """Check by the model's declaration, or by the effect of linearisation along the log."""
    question = "Are f and h linear?"
    of = FILTERS_APART
    found, model = measured.linearity, measured.twin.model
    if found.reason:
        if model.linear:
            return Claim("linear", question, YES, None, EXACT, of, "declared by the model: linear=True")
        return Claim("linear", question, UNTOLD, None, EXACT, of, found.reason)
    name, apart = worst(found)
    told = f"ekf and ukf agree to within {apart_text(apart)} (95th percentile; largest for {name})"
    if model.linear:
        return Claim("linear", question, YES, apart, EXACT, of, f"declared by the model (linear=True), and {told}")
    if apart <= EXACT:
        remedy = "set linear=True in the model; kf then computes F once, ekf at every step"
        return Claim("linear", question, YES, apart, EXACT, of, f"{told}, which is rounding", remedy)
    return Claim("linear", question, NO, apart, EXACT, of, told)


def steady(measured: Measured) -> tuple[Claim, float]:
    """Check whether a fixed gain suffices, and return its period: time-invariant, one sensor, regular measurements."""
    question = "Is it time-invariant, with regular measurements and no dropouts?"
    of = "of the intervals between readings off the period by more than 1 %"
    twin, log = measured.twin, measured.log
    against = unfit(find_entry(STEADY), twin.model)
    if against:
        return Claim("steady", question, NO, None, MAX_UNEVEN_SHARE, of, f"{STEADY} does not apply: {against}"), 0.0
    value = log.value[: log.n, : len(twin.model.sensors[0].rows)]
    there = (log.kind[: log.n] == READING) & np.isfinite(value).all(axis=1)
    apart = np.diff(log.t[: log.n][there]) * 1e-9
    if not apart.size:
        return Claim("steady", question, UNTOLD, None, MAX_UNEVEN_SHARE, of, "the log has one reading"), 0.0
    period = float(np.median(apart))
    uneven = float(np.mean(np.abs(apart - period) > PERIOD_TOLERANCE * period))
    reason = f"{twin.model.sensor_names[0]} reads every {digits(period)} s, with {percent(uneven)} of the intervals off"
    if uneven > MAX_UNEVEN_SHARE:
        return Claim(
            "steady", question, NO, uneven, MAX_UNEVEN_SHARE, of, f"{reason}: the gain has to follow them"
        ), period
    try:
        one, other = (
            measured.folded(name, given).fold.track for name, given in ((STEADY, {"period": period}), ("kf", {}))
        )
    except EstimatorError as error:
        return Claim("steady", question, NO, uneven, MAX_UNEVEN_SHARE, of, str(error)), period
    with np.errstate(all="ignore"):
        share = np.abs(one.mean - other.mean) / other.std
    far = float(np.nanquantile(np.nanmax(share, axis=1), DIFFERENCE_QUANTILE))
    said = f"{reason}; {STEADY} and kf agree to within {apart_text(far)} (95th percentile), limit {LIMITS.bias:g}"
    of = f"σ between {STEADY} and kf (95th percentile)"
    return Claim("steady", question, YES if far <= LIMITS.bias else NO, far, LIMITS.bias, of, said), period


SHAPE_QUESTION = "Does the posterior have several peaks?"
SHAPE_OF = "of the samples of the particle cloud with several peaks"


def several(measured: Measured) -> Claim:
    """Check the share of samples in which two particle clouds both have more than one peak."""
    model = measured.twin.model
    if model.linear and model.jump is None and not any(sensor.log_likelihood for sensor in model.sensors):
        reason = "f and h are linear and the noise is Gaussian, so the posterior is Gaussian"
        return Claim("peaks", SHAPE_QUESTION, NO, 0.0, FREQUENT_SHARE, SHAPE_OF, reason)
    if model.nx > MOST_STATES:
        reason = (
            f"{model.nx:,} states: the number of particles needed grows exponentially, so a cloud cannot answer this "
            f"beyond {MOST_STATES}"
        )
        return Claim("peaks", SHAPE_QUESTION, UNTOLD, None, FREQUENT_SHARE, SHAPE_OF, reason)
    found = measured.peaks
    if found.reason:
        return Claim("peaks", SHAPE_QUESTION, UNTOLD, None, FREQUENT_SHARE, SHAPE_OF, found.reason)
    reason = f"{percent(found.several)} of {found.looks} samples of clouds of {found.estimator} over {found.over:.4g} s"
    if found.recoveries:
        reason += f"; the cloud lost the asset {found.recoveries} time(s), so its shape is not reliable"
        return Claim("peaks", SHAPE_QUESTION, UNTOLD, found.several, FREQUENT_SHARE, SHAPE_OF, reason)
    reason += f", at most {found.most} peak{'s' if found.most > 1 else ''} at once"
    return Claim(
        "peaks",
        SHAPE_QUESTION,
        YES if found.several > FREQUENT_SHARE else NO,
        found.several,
        FREQUENT_SHARE,
        SHAPE_OF,
        reason,
    )


TAILS_QUESTION = "Are the innovations heavy-tailed?"
TAILS_OF = "excess kurtosis of the innovations"

MAX_LARGER_INNOVATION = 0.01
"""Share by which weights may make the mean innovation larger; where the asset jumps they make it much larger."""

LEAST_DOF = 3.0
"""Degrees of freedom below which Student's t has hardly a variance; its kurtosis is infinite from four on."""


def heavy(measured: Measured, estimator: str, options: dict[str, float] | None = None) -> tuple[Claim, float]:
    """Check the excess kurtosis of the innovations, and return the degrees of freedom of a Student's t with as much.

    Source: the excess kurtosis of Student's t is 6 / (ν - 4), so ν = 4 + 6 / κ.
    """
    fold = measured.folded(estimator, options).fold
    track, model = fold.track, measured.twin.model
    found = measure(model, fold.log, track, marginal=fold.marginal)
    if not found:
        return Claim(
            "tails", TAILS_QUESTION, UNTOLD, None, HEAVY_KURTOSIS, TAILS_OF, "no row has enough readings"
        ), np.inf
    worst: Tail = max(found, key=lambda tail: tail.kurtosis)
    rows = [tail for tail in found if tail.heavy]
    reason = (
        f"{worst.row} has excess kurtosis {digits(worst.kurtosis)} and {percent(worst.far)} of its {worst.n:,} "
        f"innovations beyond {FAR_SIGMA:g} σ, the most of {len(found)} rows of {estimator}"
    )
    # A few of many rows have heavy tails by chance.
    if len(rows) <= FREQUENT_SHARE * len(found):
        return Claim("tails", TAILS_QUESTION, NO, worst.kurtosis, HEAVY_KURTOSIS, TAILS_OF, reason), np.inf
    related = [
        entry
        for entry in calibrations(model, fold.log.events, track, gate=measured.twin.tuning.gate, marginal=fold.marginal)
        if entry.role == "used" and entry.correlation.beyond(-LIMITS.correlation, LIMITS.correlation)
    ]
    if any(entry.subject == worst.row for entry in related):
        reason += "; they are also correlated, which points to model errors; weights would reject good measurements"
        return Claim("tails", TAILS_QUESTION, NO, worst.kurtosis, HEAVY_KURTOSIS, TAILS_OF, reason), np.inf
    # Two digits: more would differ each time the advice is applied and repeated.
    dof = float(f"{max(LEAST_DOF, 4.0 + 6.0 / worst.kurtosis):.2g}")
    reason += f"; Student's t with 4 + 6 / κ = {digits(dof)} degrees of freedom has as heavy ones"
    weighing, weighted = with_weights(estimator, dof)
    if not weighted:
        return Claim(
            "tails",
            TAILS_QUESTION,
            YES,
            worst.kurtosis,
            HEAVY_KURTOSIS,
            TAILS_OF,
            f"{reason}; {estimator} cannot weigh",
        ), dof
    other = measured.folded(weighing, weighted).fold.track
    both = np.isfinite(track.innovation) & np.isfinite(other.innovation)
    scale = np.where(both, np.nanmedian(np.abs(track.innovation), axis=0), 1.0)
    before, after = (float(np.mean(np.abs(one.innovation / scale)[both])) for one in (track, other))
    change = after / before - 1.0
    reason += f"; weighed so, the innovations are {100 * abs(change):.2g} % {'larger' if change > 0 else 'smaller'}"
    if change > MAX_LARGER_INNOVATION:
        reason += ": the asset jumps, not the sensor; weights would reject good measurements"
        return Claim("tails", TAILS_QUESTION, NO, worst.kurtosis, HEAVY_KURTOSIS, TAILS_OF, reason), np.inf
    return Claim("tails", TAILS_QUESTION, YES, worst.kurtosis, HEAVY_KURTOSIS, TAILS_OF, reason), dof


def with_weights(estimator: str, dof: float) -> tuple[str, dict[str, float]]:
    """The filter with Student's t, and its options, none if it has none; a fixed gain gives way to one that follows."""
    name = "kf" if estimator == STEADY else estimator
    entry = find_entry(name)
    if all(option.name != "robust" for option in entry.options):
        return name, {}
    weighted: Mapping[str, float | str] = {"robust": "student-t", "dof": dof}
    return name, {key: value for key, value in entry.complete(weighted).items() if key in weighted}


SPEED = 1e9
"""Multiplications and additions a second of one processor in small dense matrices, of the order of magnitude."""

MAX_PROCESSOR_SHARE = 0.5  # of one processor that an estimate may take; the rest is for late readings and refolds


def small(measured: Measured) -> Claim:
    """Check whether 4 n³ + 6 m n² operations per measurement, and 8 n² bytes, are affordable.

    4 n³ are those of F P Fᵀ, 6 m n² those of the update with m rows.
    """
    model, rate = measured.twin.model, measured.rate
    n, m = model.nx, max(len(sensor.rows) for sensor in model.sensors)
    flops = 4.0 * n**3 + 6.0 * m * n**2
    share = rate * flops / SPEED
    fits = n <= LARGE and share <= MAX_PROCESSOR_SHARE
    reason = (
        f"{_counted(n, 'state')}: a covariance takes {bytes_text(8.0 * n**2)} and 4 n³ + 6 m n² = {digits(flops)} "
        f"operations a reading of m = {_counted(m, 'row')}; at {digits(rate)} readings a second that is "
        f"{digits(100 * share)} % of a processor of {digits(SPEED)} operations a second"
    )
    if fits:
        figure, threshold, of = float(n), float(LARGE), "states"
    elif n > LARGE:
        figure, threshold, of = float(n), float(LARGE), "states"
        reason += f"; beyond {LARGE:,} states no filter here forms one"
    else:
        figure, threshold, of = share, MAX_PROCESSOR_SHARE, "of a processor for a covariance"
    question = "Does the state dimension suit a full covariance at this rate?"
    return Claim("size", question, YES if fits else NO, figure, threshold, of, reason)


def _counted(number: int, what: str) -> str:
    return f"{number:,} {what}{'s' if number > 1 else ''}"


COST_QUESTION = "Is it fast enough for the asset?"
COST_OF = "of one processor"


def affordable(measured: Measured, estimator: str, options: dict[str, float] | None = None) -> Claim:
    """Check the measured time per measurement."""
    folded = measured.folded(estimator, options)
    share = folded.seconds * measured.rate
    runs = find_entry(estimator).runs(folded.fold.options, measured.twin.model.nx)
    reason = (
        f"{estimator} took {seconds_text(folded.seconds)} a reading ({digits(runs)} model runs a step); times "
        f"{digits(measured.rate)} readings a second that is {percent(share)} of a processor"
    )
    if share <= MAX_PROCESSOR_SHARE:
        return Claim("cost", COST_QUESTION, YES, share, MAX_PROCESSOR_SHARE, COST_OF, reason)
    remedy = "fewer readings, fewer members, or a simpler filter: time.late and decimation are for the edge"
    return Claim("cost", COST_QUESTION, NO, share, MAX_PROCESSOR_SHARE, COST_OF, reason, remedy)
