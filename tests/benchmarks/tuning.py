"""What a fit costs: seven noises of an unscented filter with four states, beside a loop of SciPy over FilterPy.

Published of others, as far as it was found: of the two tuners themselves no time is. LowLevelParticleFilters.jl says
what `autotune_covariances` finds, not how long it takes; what one of its folds takes it says (`PUBLISHED`, from
docs/src/benchmark.md of github.com/baggepinnen/LowLevelParticleFilters.jl): 50,000 steps of an unscented filter with
four states in 0.0177 s, and FilterPy's in 6.39 s on the same machine. MATLAB's `tune` of `trackingFilterTuner` shows
the cost of each iteration, 12 of them from an RMSE of 9.2177 to 9.0450 for one covariance and ten runs of 9.5 s, and no
time (https://www.mathworks.com/help/fusion/ref/trackingfiltertuner.parametercost.html); it needs the truth.
"""

from __future__ import annotations

from dataclasses import replace
from time import process_time

import numpy as np
from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter
from scipy.optimize import minimize

from app.twin.twin import Twin
from estimators.fit.fit import fit
from estimators.fit.recording import Recording
from estimators.log import INPUT, READING, Log

from .recovery import CASES, logs_of
from .timing import both, judged

SIZES = ((10_000, 3.0), (100_000, 30.0))
"""Readings, and the seconds of two processors within which seven noises should be fitted to them."""

PUBLISHED = (("LowLevelParticleFilters.jl", 0.017676814), ("FilterPy, there", 6.390492916))
"""Seconds of one fold of 50,000 steps, n = 4, m = 2."""

THEIR_READINGS = 300
"""A loop over FilterPy takes about as long for a reading as ours for a thousand."""


def tuning() -> None:
    """Print it."""
    case = replace(next(case for case in CASES if case.twin == "motor_joint"), duration=17_000.0)
    twin, logs = logs_of(case, 1)
    print("Fit of seven noises, UKF, n = 4 (motor_drive), all that `nisus tune` does: fit, intervals, judgement")
    for readings, bound in SIZES:
        log = _first(logs[0], readings)
        done: list[int] = []
        fit(twin.estimator, twin.tuning, [Recording(_first(logs[0], 300))])
        clock, spent = both(lambda log=log, done=done: done.append(_folds(twin, log)))  # type: ignore[misc]
        print(
            f"  {readings:7,} readings ({log.n:,} events): {clock:6.2f} s by the clock, {spent / 2:6.2f} s of each of "
            f"two processors, {done[0]} folds; bound {bound:.0f} s: {judged(spent / 2, bound, at_least=False)}"
        )
    seconds, evaluations = _theirs(twin, _first(logs[0], THEIR_READINGS))
    print(
        f"  a plain loop of SciPy (L-BFGS-B) over FilterPy, {THEIR_READINGS} readings: {seconds:.1f} s, {evaluations} "
        f"folds; for 10,000 of them {seconds * 10_000 / THEIR_READINGS:,.0f} s, and no intervals"
    )
    print("  of other tuners no time is published; of one fold, n = 4, µs a step:", end=" ")
    print(", ".join(f"{name} {1e6 * fold / 50_000:.3g}" for name, fold in PUBLISHED))


def _first(log: Log, readings: int) -> Log:
    """The part that has so many readings."""
    cut = log.copy()
    cut.n = int(np.flatnonzero(log.kind[: log.n] == READING)[readings - 1]) + 1
    return cut


def _folds(twin: Twin, log: Log) -> int:
    return fit(twin.estimator, twin.tuning, [Recording(log)]).folds


def _theirs(twin: Twin, log: Log) -> tuple[float, int]:
    """Seconds and evaluations of the negative log-likelihood, of all that one would write."""
    model, n = twin.model, twin.model.nx
    p = np.array([item.value for item in model.parameters])
    events = log.events
    prior = model.prior_mean, np.diag(model.prior_std**2)

    def fx(x: np.ndarray, dt: float, u: np.ndarray) -> np.ndarray:
        out = np.empty(n)
        model.f(x, u, p, dt, out)
        return out

    def hx(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        out = np.empty(3)
        for sensor in model.sensors:
            k = model.sensor_names.index(sensor.name)
            sensor.h(x, u, p, out[k : k + 1])
        return out

    def negative(theta: np.ndarray) -> float:
        q, r = np.exp(theta[:n]), np.exp(theta[n:])
        points = MerweScaledSigmaPoints(n, alpha=0.5, beta=2.0, kappa=0.0)
        ukf = UnscentedKalmanFilter(n, 3, 1.0, hx, fx, points)
        ukf.x, ukf.P, ukf.R = prior[0].copy(), prior[1].copy(), np.diag(r)
        u, clock, total = np.array([item.default for item in model.inputs], float), events.t[0], 0.0
        for t in np.unique(events.t):
            if t > clock:
                ukf.Q = np.diag(q * (t - clock) * 1e-9)
                ukf.predict(dt=(t - clock) * 1e-9, u=u)
                clock = t
            now = np.flatnonzero(events.t == t)
            for k in now[events.kind[now] == INPUT]:
                u = np.where(np.isfinite(events.value[k, : u.size]), events.value[k, : u.size], u)
            readings = now[events.kind[now] == READING]
            # Its update takes the points of the last prediction, so all that was read at one time goes in at once.
            if readings.size == 3 and t > events.t[0]:
                y = np.empty(3)
                y[events.channel[readings]] = events.value[readings, 0]
                ukf.update(y, u=u)
                total += ukf.log_likelihood
        return -total

    start = np.log(np.concatenate([twin.tuning.q, twin.tuning.r]))
    begun = process_time()
    found = minimize(negative, start, method="L-BFGS-B", bounds=[(value - 9.0, value + 9.0) for value in start])
    return process_time() - begun, int(found.nfev)
